"""A ROS 2 beside the tests: nodes of hearthlog, and others that listen to them."""

import json
import os
import shlex
import signal
import subprocess
from collections import Counter
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import pytest
from logreader import LogReader
from waiting import wait_for

from hearthlog.schemas.logs.files import find_logs

_ROOT = Path(__file__).parents[1]
_first = 10 + 22 * (int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]) % 4)
_domains = cycle(range(_first, _first + 22))
DISTRIBUTIONS = ("jazzy", "kilted")
LISTEN = _ROOT / "tests" / "ros" / "listen.py"
_DISCOVERY = _ROOT / "tests" / "ros" / "discovery.xml"
_PROFILES = {"jazzy": "FASTRTPS_DEFAULT_PROFILES_FILE", "kilted": "FASTDDS_DEFAULT_PROFILES_FILE"}


def next_domain():
    """Give a domain in which no other test is."""
    return next(_domains)


class _Process(subprocess.Popen):
    """A process that a test which fails does not wait for."""

    def __exit__(self, kind, *error):
        if kind is not None:
            self.kill()
        super().__exit__(kind, *error)


class Ros:
    """One distribution, in a domain of its own."""

    def __init__(self, distribution, domain):
        self.setup = _ROOT / "build" / "ros" / distribution / "ros.sh"
        if not self.setup.exists():
            if os.environ.get("TESTS_REQUIRE_ROS"):
                pytest.fail(f"no ROS 2 {distribution}: run .ci/ros {distribution}")
            pytest.skip(f"needs a ROS 2: .ci/ros {distribution}")
        self.environment = os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        self.environment[_PROFILES[distribution]] = str(_DISCOVERY)
        self.environment.pop("PYTHONPATH", None)

    def start(self, *command, **options):
        """Start a command of this ROS."""
        line = f". {shlex.quote(str(self.setup))} && exec {shlex.join(map(str, command))}"
        environment = self.environment | options.pop("env", {})
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT} | options
        return _Process(["bash", "-c", line], env=environment, text=True, **pipes)

    def node(self, executable, *, remap=(), env=None, **parameters):
        """Start a node of hearthlog."""
        place = self.setup.parent / "install" / "hearthlog_ros" / "lib" / "hearthlog_ros"
        given = [f"{name}:={value}" for name, value in parameters.items()]
        return self.start(
            place / executable,
            "--ros-args",
            *(word for each in given for word in ("-p", each)),
            *remap,
            env=env or {},
        )


def wait_until_handled(process, number=signal.SIGTERM):
    """Wait until a process has a handler of a signal, or has ended.

    Before that the shell that finds a node, or Python while it starts, would take the signal.
    """
    status = Path(f"/proc/{process.pid}/status")

    def handled():
        if process.poll() is not None:
            return True
        caught = status.read_text().partition("SigCgt:")[2].split()
        return not caught or int(caught[0], 16) >> (number - 1) & 1

    wait_for(handled)


def end(process, number=signal.SIGTERM):
    """Ask a process to end; give what it has printed."""
    wait_until_handled(process)
    process.send_signal(number)
    try:
        return process.communicate(timeout=120)[0]
    finally:
        process.kill()
        process.stdout.close()


@contextmanager
def listener(ros, output, topics, depth="1000"):
    """Subscribe to topics; `types` of it then has the hashes of their types."""
    names = [word for pair in topics.items() for word in pair]
    process = ros.start("python", LISTEN, output, depth, *names)
    try:
        assert process.stdout.readline() == "listening\n"
        yield process
        process.hashes = json.loads(end(process).splitlines()[-1])
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def wait_until_arrived(output, log, renamed=""):
    """Wait until as many rows of each topic of a log have arrived as the log has.

    A topic that is published under another name has `renamed` before its own.
    """
    wanted = Counter(renamed + topic for topic, *_ in log)

    def missing():
        return wanted - Counter(topic for topic, *_ in of_the_log(output))

    wait_for(lambda: not missing(), what=lambda: f"not arrived: {missing()}")


def arrived(output):
    """Give rows of topic, monotonic and wall time of arrival, and bytes."""
    written = output.read_text().rpartition("\n")[0]
    rows = [json.loads(line) for line in written.splitlines()]
    return [(topic, mono, wall, bytes.fromhex(data)) for topic, mono, wall, data in rows]


def of_the_log(output):
    """Give what arrived, without the lines of the node itself."""
    return [row for row in arrived(output) if b"\0hearthlog_live\0" not in row[-1]]


def logged(folder):
    """Give rows of topic, log time and bytes, padded as they are on the wire."""
    if not list(folder.rglob("*.mcap*")):
        return []
    return [
        (item.topic, item.log_time, item.data + bytes(-len(item.data) % 4))
        for log in find_logs(folder)
        for item in LogReader(log).messages()
    ]


def wait_until_logged(folder, **counts):
    """Wait until a folder holds at least so many messages of each kind (`features`, `gap` …)."""

    def reached():
        found = Counter(topic.rpartition("/")[2] for topic, *_ in logged(folder))
        return all(found[kind] >= count for kind, count in counts.items())

    wait_for(reached)
