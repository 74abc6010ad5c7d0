"""The current sound is a line in the terminal: its class, how sure, how long and how loud."""

import os
import pty
import re
import signal
import subprocess
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import HEARTHLOG
from livehome import LiveHome
from waiting import wait_for

from hearthlog.analyzer.logs.hidden_classes import write_hidden_classes
from hearthlog.analyzer.review.live import CurrentSound, lasting

FRAME = 50_000_000
BEGIN = 1_772_348_400 * 10**9


@contextmanager
def watching(folder, *options):
    """Run `hearthlog watch --text` into a pipe; yield its process and its lines."""
    command = [*map(str, [*HEARTHLOG, "watch", folder, "--text", *options])]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        lines = []
        reader = threading.Thread(target=lambda: lines.extend(process.stdout))
        reader.start()
        try:
            yield process, lines
        finally:
            process.kill()
            reader.join()


def pushed(*parts, start=BEGIN):
    """Give a sound after so many labels of each class, 50 ms each."""
    sound = CurrentSound("mic")
    labels = np.array([name for name, count in parts for _ in range(count)], object)
    times = start + FRAME * np.arange(len(labels))
    sound.push(times, labels, np.full(len(labels), 0.8, np.float32))
    return sound


def test_a_line_names_the_sound_of_now_and_a_new_line_the_next_one(tmp_path):
    home = LiveHome(tmp_path, ["living_room"])
    with watching(tmp_path, "--timezone", "Europe/Vienna") as (process, lines):
        wait_for(lambda: home.hears("coughing", "living_room") or lines)
        wait_for(lambda: home.hears("speech", "living_room") or "Talking" in lines[-1])
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        assert process.stderr.read() == ""
    assert re.fullmatch(r"\d\d:\d\d:\d\d  Living room  Coughing 90 % for (over )?\d s\n", lines[0])
    home.close()


def test_a_terminal_shows_one_line_and_keeps_those_that_ended(tmp_path):
    home = LiveHome(tmp_path)
    ours, theirs = pty.openpty()
    shown = []

    def read():
        try:
            while data := os.read(ours, 4096):
                shown.append(data.decode())
        except OSError:  # the terminal is closed
            pass

    command = [*map(str, [*HEARTHLOG, "watch", tmp_path, "--text"])]
    process = subprocess.Popen(command, stdout=theirs, stderr=subprocess.DEVNULL)
    os.close(theirs)
    reader = threading.Thread(target=read)
    reader.start()
    try:
        wait_for(lambda: home.hears("coughing") or "".join(shown).count("Coughing") > 1)
        wait_for(lambda: home.hears("speech") or "Talking" in "".join(shown))
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
        reader.join()
        os.close(ours)
        home.close()
    updates = "".join(shown).split("\x1b[1F\x1b[J")
    assert all(part.count("\n") == 1 for part in updates[:2])
    first = next(part for part in updates if "Talking" in part)
    assert [line.split()[2] for line in first.splitlines()] == ["Coughing", "Talking"]


def test_where_nobody_listens_the_line_says_so(tmp_path):
    home = LiveHome(tmp_path)
    home.hears("speech")
    home.close()
    with watching(tmp_path) as (_, lines):
        wait_for(lambda: any("Nobody listens since" in line for line in lines), 60)
    assert "Talking" in lines[0]


def test_a_class_that_is_hidden_is_a_sound(tmp_path):
    write_hidden_classes(tmp_path, ["music"])
    home = LiveHome(tmp_path)
    with watching(tmp_path) as (_, lines):
        wait_for(lambda: home.hears("music") or lines)
    assert "A sound 90 %" in lines[0]
    home.close()


def test_what_is_wrong_is_a_line(refused, tmp_path):
    assert "no such folder" in refused("watch", tmp_path / "gone", "--text")
    for option in (("--web",), ("--serve",), ("--foxglove",), ("--port", 1), ("--minutes", 3)):
        line = refused("watch", tmp_path, "--text", *option, status=2)
        assert line == f"{option[0]} does not go with --text"


def test_a_sound_begins_with_its_first_label_and_not_when_it_prevails():
    sound = pushed(("silence", 100), ("coughing", 30))
    assert (sound.label, sound.since) == ("coughing", BEGIN + 100 * FRAME)
    assert lasting(sound) == "for 2 s"


def test_a_sound_of_before_the_first_label_lasts_longer_than_can_be_said():
    assert lasting(pushed(("silence", 6_000))) == "for over 5 min"
    assert lasting(pushed(("coughing", 40), ("silence", 2 * 72_000))) == "for 2 h 0 min"


def test_a_few_other_labels_end_no_sound():
    sound = pushed(("silence", 40), ("coughing", 40), ("speech", 5), ("coughing", 40))
    assert (sound.label, sound.since) == ("coughing", BEGIN + 40 * FRAME)


@pytest.mark.parametrize("pause", [-600, 600])
def test_after_a_pause_or_a_change_of_the_clock_a_sound_begins_anew(pause):
    sound = pushed(("coughing", 100))
    later = BEGIN + (100 + 20 * pause) * FRAME
    sound.push(
        later + FRAME * np.arange(40), np.full(40, "coughing", object), np.ones(40, np.float32)
    )
    assert (sound.since, lasting(sound)) == (later, "for 2 s")


def test_labels_one_by_one_and_all_at_once_are_the_same():
    once = pushed(("silence", 50), ("coughing", 30), ("speech", 30))
    each = CurrentSound("mic")
    names = ["silence"] * 50 + ["coughing"] * 30 + ["speech"] * 30
    for number, name in enumerate(names):
        times = np.array([BEGIN + number * FRAME])
        each.push(times, np.array([name], object), np.array([0.8], np.float32))
    assert (each.label, each.since, each.is_older) == (once.label, once.since, once.is_older)
    assert each.confidence == pytest.approx(once.confidence)
