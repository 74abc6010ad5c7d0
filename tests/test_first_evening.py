"""The first evening: a microphone, a starter's labels, marks, a model of the home, its labels."""

import signal
import subprocess
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from conftest import HEARTHLOG
from logs import read
from waiting import wait_for

from hearthlog.models.modelfile import load_model
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import find_logs, is_layer

RATE = 16_000


def evening(household, seed=8):
    """Coughs and household sounds over steady noise, a few seconds apart, as int16."""
    rng = np.random.default_rng(seed)
    parts = []
    for name in ("coughing", "objects_activity"):
        for path in sorted((household / name).glob("*.flac"))[:4]:
            clip = np.concatenate(list(read_audio(path)))
            parts += [clip[: 2 * RATE], np.zeros(RATE)]
    sound = np.concatenate(parts)
    noisy = sound + rng.normal(0, 0.0008, len(sound))
    return (np.clip(noisy, -1, 1) * 32767).astype(np.int16)


@contextmanager
def recording(env):
    """Run `hearthlog record`, with nothing but a microphone."""
    with subprocess.Popen(
        [*HEARTHLOG, "record"], env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
            process.send_signal(signal.SIGTERM)
            process.output, process.errors = process.communicate(timeout=20)
        finally:
            process.kill()


def latest(kind):
    """Messages of the log that is being written."""
    with suppress(LogError):  # a log is completed, and gets its name, at any time
        logs = [log for log in find_logs(Path("logs")) if not is_layer(log)]
        return read(max(logs, key=lambda log: log.name), kind)
    return []


def sounds():
    return [m for m in latest("segment") if m.label != "silence"]


def test_an_evening_with_nothing_but_a_microphone(
    labmic, household, hearthlog, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    labmic.env.pop("HEARTHLOG_MODEL")
    labmic.configure(data=evening(household))
    with recording(labmic.env) as process:
        wait_for(lambda: len(sounds()) > 5)
        info = hearthlog("info", "logs")
        assert info.stdout.splitlines()[1].startswith("Home, microphone mic: ")
        assert "a starter model, not trained on this home" in info.stdout
        assert info.stdout.splitlines()[-2].endswith("hearthlog review logs --queue")
        queue = hearthlog("review", "logs", "--queue", "--save", "ten.txt")
        assert queue.returncode == 0, queue.stderr
        marks = hearthlog("annotate", "import", "logs", "ten.txt")
        assert marks.returncode == 0, marks.stderr
        info = hearthlog("info", "logs")
        assert info.stdout.splitlines()[-2].endswith("hearthlog train --home logs")
        trained = hearthlog("train", "--home", "logs")
        assert trained.returncode == 0, trained.stderr
        assert "home-1 refused: " in trained.stdout  # it is made all the same
        info = hearthlog("info", "logs")
        assert info.stdout.splitlines()[-2].endswith("hearthlog review logs --queue")
        refused = hearthlog("models", "promote", "home-1")
        assert refused.returncode == 1
        assert "it takes 10 min to judge it: record " in refused.stderr  # it learned from the rest
        promoted = hearthlog("models", "promote", "home-1", "--anyway")
        assert promoted.returncode == 0, promoted.stderr
        wait_for(lambda: [m.model for m in latest("info")] == ["home-1"])
        wait_for(lambda: len(latest("label")) > 40)
        back = hearthlog("models", "rollback")
        assert "is champion again, after home-1" in back.stdout, back.stderr
        wait_for(lambda: [m.model for m in latest("info")] == ["general"])
        again = hearthlog("models", "promote", "home-1")
        assert again.returncode == 0, again.stderr  # who insisted once is not asked again
        wait_for(lambda: [m.model for m in latest("info")] == ["home-1"])
    assert process.returncode == 0, process.errors
    assert "the labels are by the starter model general" in process.errors
    home = load_model(Path("models/home-1.safetensors"))
    assert sum(one.segments for one in home.description.training_data.home.values())
    assert [m.model_sha256 for m in latest("info")] == [home.sha256]
