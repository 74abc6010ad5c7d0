"""What is no regular file hangs nobody: passed over among the logs, one line where it is named."""

import os
import re
import shutil
import socket
from contextlib import closing
from threading import Event

import pytest
from log_fixtures import record_logs, run

from hearthlog.schemas.logs.follow import follow_messages

KINDS = ("pipe", "socket", "device", "folder")
AMONG = [
    "info LOGS",
    "catalog LOGS",
    "doctor LOGS",
    "cat LOGS --topics /mic/segment",
    "export LOGS -o OUT.csv --topics /mic/segment",
    "diff LOGS live live",
    "diff FIRST live live",
    "evaluate log LOGS --reference LABELS",
    "evaluate log FIRST --reference FIRST",
    "review LOGS --save OUT.rrd",
    "review FIRST --save OUT.rrd",
    "report LOGS -o OUT.html",
    "annotate export LOGS -o OUT.csv",
    "relabel LOGS --model MODEL",
    "replay LOGS -o OUT",
]
NAMED = [
    "info NAMED",
    "doctor NAMED",
    "cat NAMED",
    "export NAMED -o OUT.csv",
    "merge NAMED -o OUT.mcap",
    "cut NAMED --start 2026-03-01 -o OUT.mcap",
    "recover NAMED -o OUT.mcap",
    "recover NAMED --in-place",
    "replay NAMED -o OUT",
    "relabel NAMED --model MODEL",
    "diff NAMED live live",
    "evaluate log NAMED --reference LABELS",
    "review NAMED --save OUT.rrd",
    "report NAMED -o OUT.html",
    "annotate export NAMED -o OUT.csv",
    "record --config NAMED",
    "record SOUND --model NAMED -o OUT",
    "record NAMED -o OUT",
    "train --data NAMED --scenario general --output OUT.safetensors",
    "train --data LABELS --scenario NAMED.toml --output OUT.safetensors",
    "annotate import LOGS NAMED.csv",
    "evaluate log LOGS --reference NAMED.csv",
]
_TOOK = re.compile(r" in [0-9.]+ s \([0-9]+ times real time\)")
_HIDDEN = re.compile(r"--bind \S+ --port \d+")  # each time another address


def put(kind, path):
    """Put something there that is no regular file."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with closing(socket.socket(socket.AF_UNIX)) as bound:
            folder = os.open(path.parent, os.O_RDONLY)
            bound.bind(f"/proc/self/fd/{folder}/{path.name}")  # a socket's path must be short
            os.close(folder)


@pytest.fixture(scope="module")
def homes(tmp_path_factory, day, model_file):
    """The logs of a home; the same with what is no file among them; the first log of each."""
    plain, mixed = (tmp_path_factory.mktemp(name) for name in ("plain", "mixed"))
    first = min(record_logs([day], plain, model_file).rglob("*.mcap")).relative_to(plain)
    shutil.copytree(plain / "logs", mixed / "logs")
    for kind in KINDS:
        put(kind, (mixed / first).with_name(f"{kind}.mcap"))
        put(kind, (mixed / first).with_name(f"{first.stem}.relabel-{kind}.mcap"))
        put(kind, (mixed / first).with_name(f"home_{kind}.mcap.active"))
    return {"plain": plain / first, "mixed": mixed / first}


@pytest.fixture
def command(capfd, tmp_path, day, model_file):
    """Run a command about a log, or the home that it is of, in words that name places."""
    (tmp_path / "labels.txt").write_text("1.0\t5.0\tspeech\n")
    shutil.copy(model_file, tmp_path / "again.safetensors")

    def run_on(log, words):
        places = {
            "FIRST": log,
            "LOGS": log.parents[3],
            "LABELS": tmp_path / "labels.txt",
            "MODEL": tmp_path / "again.safetensors",
            "HERE": tmp_path,
            "SOUND": day,
        }
        for word in words.split():
            name, dot, suffix = word.partition(".")
            if name in {"OUT", "NAMED"}:
                places[word] = tmp_path / f"{name.lower()}{dot}{suffix}"
        result = run(capfd, *(places.get(word, word) for word in words.split()))
        for made in tmp_path.glob("out*"):
            shutil.rmtree(made) if made.is_dir() else made.unlink()
        return result

    return run_on


def reported(result, log):
    """What a command says, but for where the logs are, how fast it was, and what is drawn."""
    texts = (_HIDDEN.sub("", text.replace(str(log.parents[4]), "")) for text in result[1:])
    return result.returncode, *(_TOOK.sub("", text) for text in texts)


@pytest.mark.parametrize("words", AMONG)
def test_among_the_logs_it_is_passed_over(command, homes, words):
    plain, mixed = (reported(command(log, words), log) for log in homes.values())
    assert mixed == plain


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
@pytest.mark.parametrize("words", NAMED)
def test_where_it_is_named_it_is_one_line(command, homes, tmp_path, kind, words):
    (name,) = {word for word in words.split() if word.startswith("NAMED")}
    put(kind, tmp_path / name.replace("NAMED", "named"))
    result = command(homes["plain"], words)
    assert result.returncode == (2 if "--config" in words else 1)
    lines = [*result.stdout.splitlines(), *result.stderr.splitlines()]
    (line,) = (line for line in lines if "Not a regular file" in line or "no such" in line)
    assert str(tmp_path / name.replace("NAMED", "named")) in line or "/dev/zero" in line
    assert len(lines) <= 2


def test_a_link_that_leads_nowhere_is_not_passed_over(command, homes, tmp_path):
    (tmp_path / "a.mcap").symlink_to(homes["plain"])
    (tmp_path / "b.mcap").symlink_to(tmp_path / "nowhere")
    result = command(homes["plain"], "info HERE --verbose")
    assert result.returncode == 3
    assert "\n1 file, " in result.stdout
    assert result.stderr == (
        f"hearthlog: {tmp_path}/b.mcap: cannot be read (No such file or directory)\n"
    )


def test_who_follows_logs_passes_it_over(homes):
    folder = homes["mixed"].parent
    unread = {path for path in folder.iterdir() if path.is_file() and path.suffix == ".mcap"}
    stop = Event()
    for path, _ in follow_messages(folder, start=0, stop=stop):
        unread -= {path}
        if not unread:
            stop.set()


def test_a_recorder_starts_where_it_lies_for_a_log_that_was_left(homes, command):
    result = command(homes["mixed"], "record SOUND -o LOGS --start 2030-01-01")
    assert (result.returncode, result.stderr) == (0, "")
