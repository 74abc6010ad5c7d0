"""What a recorder writes is on the graph of ROS 2, as the bytes of its log."""

import re
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager

import pytest
from conftest import HEARTHLOG
from logs import read
from rosgraph import (
    DISTRIBUTIONS,
    Ros,
    arrived,
    end,
    listener,
    logged,
    next_domain,
    of_the_log,
    wait_for,
    wait_until_arrived,
    wait_until_handled,
    wait_until_logged,
)

from hearthlog.schemas.logs.files import relabel_path
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import type_hash

MESSAGES = "hearthlog_msgs/msg/Audio"
STEADY = {f"/mic/{kind.lower()}": MESSAGES + kind for kind in ("Features", "Label")}
TOPICS = STEADY | {
    "/mic/info": message_types.STREAM_INFO,
    "/mic/statistics": message_types.STATISTICS,
    "/mic/segment": message_types.SEGMENT,
    "/mic/gap": message_types.GAP,
    "/diagnostics": message_types.DIAGNOSTICS,
    "/rosout": "rcl_interfaces/msg/Log",
}


@pytest.fixture(params=DISTRIBUTIONS)
def ros(request):
    return Ros(request.param, next_domain())


@contextmanager
def microphone_recorder(labmic, logs, *more, model="general"):
    """Record a virtual microphone."""
    command = [*HEARTHLOG, "record", "-o", logs, "--device", labmic.device, "--model", model]
    command += ["--max-bag-duration", "10", *more]
    quiet = {"stderr": subprocess.DEVNULL}
    with subprocess.Popen(list(map(str, command)), env=labmic.env, **quiet) as process:
        try:
            yield process
        finally:
            process.kill()


def lose_microphone(labmic, logs):
    """Unplug the microphone of a recorder after eight seconds, and plug it in again."""
    wait_until_logged(logs, features=160)
    labmic.unplug()
    time.sleep(5)
    labmic.restore()


def test_every_message_of_a_log_reaches_the_graph_once_and_in_order(ros, labmic, tmp_path):
    logs, output, at_sensor = tmp_path / "logs", tmp_path / "all", tmp_path / "sensor"
    labels = {"/mic/label": TOPICS["/mic/label"]}
    with ros.node("live", folder=logs) as node:
        with (
            listener(ros, output, TOPICS) as everything,
            listener(ros, at_sensor, labels, depth="sensor"),
        ):
            assert "is not there yet; waiting for a recorder" in node.stdout.readline()
            with microphone_recorder(labmic, logs) as recorder:
                lose_microphone(labmic, logs)
                wait_until_logged(logs, features=320, gap=1, segment=1)
                finished = wait_for(lambda: min(logs.rglob("*.mcap"), default=None))
                layer = relabel_path(finished, "other")  # speaks of what was heard before
                shutil.copy(finished, layer)
                wait_until_logged(logs, features=len(read(logs, "features")) + 100)
                recorder.send_signal(signal.SIGTERM)
                recorder.wait()
            layer.unlink()
            log = logged(logs)
            wait_until_arrived(output, log)
        assert end(node) == ""
    assert len(list(logs.rglob("*.mcap"))) > 1
    rows = of_the_log(output)
    for topic in TOPICS:
        got = [data for name, _, _, data in rows if name == topic]
        assert got == [data for name, _, data in log if name == topic], topic
    assert {name for name, *_ in rows} == TOPICS.keys()
    expected = {topic: type_hash(name) for topic, name in TOPICS.items()}
    assert {topic: ends[0][0] for topic, ends in everything.hashes.items()} == expected
    # Who keeps five messages loses seven of a burst of twelve; a busy machine may still lose a few.
    steady = [data for *_, data in arrived(at_sensor)]
    assert len(steady) > 0.6 * sum(name == "/mic/label" for name, *_ in log)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_node_ends_in_order_whenever_it_is_asked_to(ros, number, labmic, tmp_path):
    with microphone_recorder(labmic, tmp_path / "logs"):
        for seconds in (0.0, 0.5, 2.0):
            with ros.node("live", folder=tmp_path / "logs", delay=0.0) as node:
                wait_until_handled(node)
                time.sleep(seconds)
                printed = end(node, number)
                assert node.returncode == 0, printed
                assert "Traceback" not in printed


@pytest.mark.parametrize(
    ("executable", "parameters", "environment", "line"),
    [
        ("live", {"delay": 90.0}, {}, "delay: from 0 to 60 seconds, not 90"),
        ("live", {}, {"ROS_DOMAIN_ID": "home"}, "ROS_DOMAIN_ID is not an integral number"),
        ("label", {}, {}, "name a model: --ros-args -p model:=general, or a model file"),
        ("label", {"model": "no.safetensors"}, {}, "no.safetensors: no such model file"),
        ("label", {"model": "audioset"}, {}, "model audioset is for embeddings, which this node"),
        ("label", {"model": "general", "microphone": "Küche"}, {}, "microphone name 'Küche'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(ros, executable, parameters, environment, line):
    with ros.node(executable, env=environment, **parameters) as node:
        printed = node.communicate(timeout=120)[0]
    assert printed.startswith("hearthlog_ros: ")
    assert line in printed
    assert printed.count("\n") == 1
    assert node.returncode == 1


def test_a_model_for_embeddings_labels_by_features_alone_and_says_so(ros):
    with ros.node("label", model="general-embedding") as node:
        assert "this node takes no embeddings: it labels by features only" in node.stdout.readline()
        assert end(node) == ""


def test_features_of_another_set_are_not_labelled(ros, labmic, tmp_path):
    (tmp_path / "home.toml").write_text('feature_set = "auros21"\nmodel = "none"\n')
    more = ["--config", tmp_path / "home.toml"]
    with (
        microphone_recorder(labmic, tmp_path / "logs", *more, model="none"),
        ros.node("live", folder=tmp_path / "logs") as live,
        ros.node("label", model="general") as label,
    ):
        printed = label.communicate(timeout=120)[0]
        end(live)
    # Features and what is known of them may arrive in either order.
    line = r"model general is for feature set home33; /mic/features has .*: choose another model\n"
    assert re.search(line, printed)
    assert label.returncode == 1


def test_a_microphone_is_labelled_under_one_name_only_once(ros, labmic, tmp_path):
    with (
        microphone_recorder(labmic, tmp_path / "logs"),
        ros.node("live", folder=tmp_path / "logs") as live,
        ros.node("label", model="general") as label,
    ):
        printed = label.communicate(timeout=120)[0]
        end(live)
    assert "/mic/label is published by hearthlog_live already" in printed
    assert label.returncode == 1


def test_features_are_labelled_elsewhere_on_the_graph_as_the_recorder_labels_them(
    ros, labmic, tmp_path
):
    logs, output = tmp_path / "logs", tmp_path / "labels"
    topics = {name: TOPICS[name] for name in ("/mic/label", "/mic/segment")}
    elsewhere = {f"/elsewhere{name}": kind for name, kind in topics.items()}
    renamed = [word for name in topics for word in ("-r", f"{name}:=/elsewhere{name}")]
    with (
        ros.node("live", folder=logs) as live,
        ros.node("label", model="general", remap=renamed) as label,
    ):
        assert "waiting for a recorder" in live.stdout.readline()
        with listener(ros, output, elsewhere | {"/mic/label_info": TOPICS["/mic/info"]}):
            with microphone_recorder(labmic, logs) as recorder:
                lose_microphone(labmic, logs)
                wait_until_logged(logs, features=320, gap=1, segment=1)
                recorder.send_signal(signal.SIGTERM)
                recorder.wait()
            log = [row for row in logged(logs) if row[0] in topics]
            wait_until_arrived(output, log, renamed="/elsewhere")
        assert (end(label), end(live)) == ("", "")
    rows = arrived(output)
    for topic in topics:
        got = [data for name, _, _, data in rows if name == f"/elsewhere{topic}"]
        assert got == [data for name, _, data in log if name == topic], topic
        assert got
    (info,) = [data for name, *_, data in rows if name == "/mic/label_info"]
    assert message_types.decode(info, message_types.STREAM_INFO).model == "general"
