"""Recurring sounds on the page: groups found by `hearthlog discover`, and their naming."""

import os
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from datetime import tzinfo
from pathlib import Path
from threading import Lock, Thread, Timer
from typing import IO, Any, NamedTuple, cast

from hearthlog.analyzer.bridge.commands import class_of
from hearthlog.analyzer.bridge.corrections import READ_ONLY, REVIEWER
from hearthlog.analyzer.bridge.page import ENGLISH, Translation, one_line, room
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.analyzer.discover import (
    SUMMARY,
    GroupsSummary,
    GroupSummary,
    busiest_hours,
    load_summary,
)
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.models.classes import SILENCE
from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import read_time

_MOST_UNNAMED, _MOST_NAMED = 10, 50
_LABELS = 2
_SPACE = "\N{NO-BREAK SPACE}"


class Moment(NamedTuple):
    """The current time in nanoseconds of UTC, with the time zone of the home."""

    now: int
    zone: tzinfo


def shown_groups(summary: GroupsSummary) -> dict[str, GroupSummary]:
    """Return the displayed groups, by keys that are unique across summary files."""
    unnamed = [each for each in summary.groups if not each.name][:_MOST_UNNAMED]
    named = [each for each in summary.groups if each.name][:_MOST_NAMED]
    return {f"{each.number} of {summary.id}": each for each in [*unnamed, *named]}


def recurring_list(
    summary: GroupsSummary,
    written: int,
    outcomes: Mapping[str, str],
    moment: Moment,
    words: Translation = ENGLISH,
) -> Any:
    """Return the recurring sounds for JSON.

    `written` is when the summary was written, in nanoseconds of UTC; `outcomes` has the status of
    naming, by key of the group.
    """
    shown = shown_groups(summary)
    left = sum(not each.name for each in summary.groups) - _MOST_UNNAMED
    is_alone = len({name for each in summary.groups for name in each.microphones}) <= 1
    return {
        "looked": words.when(min(max(written, 0), moment.now), *moment),
        "more": words.text("recurring.more", count=words.number(left)) if left > 0 else "",
        "groups": [
            _described(key, group, outcomes.get(key, ""), (moment, words), is_alone=is_alone)
            for key, group in shown.items()
        ],
    }


def _described(
    key: str,
    group: GroupSummary,
    outcome: str,
    shown: tuple[Moment, Translation],
    *,
    is_alone: bool,
) -> Any:
    moment, words = shown
    number = words.text("recurring.sound", number=group.number)
    examples = _examples(group, moment, words, is_alone=is_alone)
    return {
        "id": key,
        "words": words.class_words(group.name) if group.name else number,
        "is_named": bool(group.name),
        "about": _how_often(group, words),
        "heard": _named_as(group, words),
        "listen": words.text("recurring.examples", times=examples),
        "said": outcome,
    }


def _how_often(group: GroupSummary, words: Translation) -> str:
    hours = busiest_hours(group.hours)
    first, _, last = hours.partition(" to ")
    often = words.times(group.times)
    return words.text(
        "recurring.often at" if hours else "recurring.often",
        times=f"{often[0].upper()}{often[1:]}",
        days=words.count("day", group.days),
        hours=words.text("recurring.hours", first=first, last=last) if last else hours,
        length=words.length(group.seconds),
    )


def _named_as(group: GroupSummary, words: Translation) -> str:
    labels = [*group.labels.items()][:_LABELS]
    shares = [f"{words.class_words(label)} ({100 * share:.0f}{_SPACE}%)" for label, share in labels]
    return words.text("recurring.labels", classes=words.listed(shares, "or")) if shares else ""


def _examples(group: GroupSummary, moment: Moment, words: Translation, *, is_alone: bool) -> str:
    return words.listed(
        [
            words.when(read_time(each.start), *moment, seconds=True)
            + ("" if is_alone else f" ({room(each.microphone)})")
            for each in sorted(group.examples, key=lambda each: read_time(each.start))
        ]
    )


_LONGEST_SECONDS = 6 * 3600.0
_NICE = 10
_LONGEST_LINE = 4096  # characters
_PREFIX = "hearthlog: "
_DONE_WITH_LOSSES = 3  # exit status


class GroupNaming:
    """Names groups of sounds, one at a time, in a child process.

    Naming reads all logs: too much for the bridge process on a small box.
    """

    def __init__(self, folder: Path) -> None:
        self.outcomes: dict[str, str] = {}
        self._folder = folder
        self._process: subprocess.Popen[str] | None = None
        self._thread: Thread | None = None
        self._lock = Lock()

    def start(self, key: str, number: int, label: str, words: Translation = ENGLISH) -> str:
        """Start marking the sounds of a group, or unmarking for an empty label; return a status.

        Raise `BridgeError` if another group is being named, or the folder is not writable.
        """
        options = ["--undo", str(number)]
        text = words.text("recurring.undoing")
        if label:
            options = ["--name", f"{number}={label}", "--reviewer", REVIEWER]
            text = words.text("recurring.marking", **{"class": words.class_words(label)})
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                raise BridgeError(
                    "The box is still marking another sound. Try again when it has finished."
                )
            if not os.access(self._folder, os.W_OK):
                raise BridgeError(READ_ONLY)
            process = self._process = _started([*options, "--json", "--", str(self._folder)])
            self.outcomes[key] = text
            self._thread = Thread(
                target=self._follow, args=(process, key, number, words), daemon=True
            )
            self._thread.start()
        return text

    def close(self) -> None:
        """Terminate the process; marks made so far stay, and naming again completes them."""
        with self._lock:
            if self._process is not None:
                self._process.terminate()

    def _follow(
        self, process: subprocess.Popen[str], key: str, number: int, words: Translation
    ) -> None:
        """Wait for the process to end, and store its result."""
        timer = Timer(_LONGEST_SECONDS, process.kill)
        timer.daemon = True
        timer.start()
        with process:
            result, last = _read(cast(IO[str], process.stderr), f"{_PREFIX}group {number}:")
            self.outcomes[key] = _outcome(process.wait(), result, last, words)
        timer.cancel()


def _started(arguments: list[str]) -> subprocess.Popen[str]:
    """Start `hearthlog discover` with low priority."""
    try:
        process = subprocess.Popen(  # noqa: S603  a list of arguments, without a shell
            [*module_command("hearthlog.tools.cli.main"), "discover", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
    except OSError as error:
        raise BridgeError(f"It was not saved: {error.strerror}") from error
    with suppress(OSError):  # a sandbox may forbid it
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
    return process


def _read(stream: IO[str], wanted: str) -> tuple[str, str]:
    """Return the line that begins as wanted, and the last line, both without their prefix."""
    result = last = ""
    while line := stream.readline(_LONGEST_LINE):
        last = line.removeprefix(_PREFIX)
        if line.startswith(wanted):
            result = line.removeprefix(wanted)
    return one_line(result), one_line(last)


def _outcome(status: int, result: str, last: str, words: Translation) -> str:
    if status < 0:
        return words.text("recurring.signal", number=-status)
    if not result or status not in {0, _DONE_WITH_LOSSES}:
        problem = last or words.text("recurring.status", number=status)
        return words.text("recurring.not done", text=problem)
    return result if status == 0 else words.text("recurring.partly", text=result, rest=last)


_NOTHING: dict[str, Any] = {"looked": "", "more": "", "groups": []}


class RecurringSounds:
    """The groups found by `hearthlog discover`, if any; `problem` is why they cannot be shown."""

    def __init__(self, folder: Path) -> None:
        self.problem = ""
        self._file = folder / SUMMARY
        self._seen: tuple[int, ...] = ()
        self._written = 0
        self._summary: GroupsSummary | None = None
        self._naming = GroupNaming(folder)
        self._described: dict[str, tuple[Any, Any]] = {}  # state and content, by language

    def describe(self, moment: Moment, words: Translation = ENGLISH) -> Any:
        """Return the groups for JSON; empty without a readable summary."""
        self._look()
        if self._summary is None:
            return _NOTHING
        outcomes = dict(self._naming.outcomes)
        state = self._seen, outcomes, local_time(*moment).date()
        described = self._described.get(words.language)
        if described is None or described[0] != state:
            shown = recurring_list(self._summary, self._written, outcomes, moment, words)
            described = self._described[words.language] = state, shown
        return described[1]

    def name(self, key: str, text: str, words: Translation = ENGLISH) -> str:
        """Start naming a group by a class or its words, or removing an empty name; return a status.

        Raise `BridgeError` if the group no longer exists, the text is no valid class name, or
        naming cannot start.
        """
        summary = self._summary
        group = None if summary is None else shown_groups(summary).get(key)
        if group is None:
            raise BridgeError(
                "These sounds have been regrouped in the meantime. Look at the list again."
            )
        label = class_of(text) if text else ""
        if label == SILENCE:
            raise BridgeError("Write what it was: a recurring sound cannot be named silence.")
        return self._naming.start(key, group.number, label, words)

    def close(self) -> None:
        """Stop naming."""
        self._naming.close()

    def _look(self) -> None:
        """Reread the summary if its file has changed."""
        try:
            status = self._file.stat()
        except OSError:
            self._seen, self._summary, self.problem = (), None, ""
            return
        seen = status.st_ino, status.st_size, status.st_mtime_ns
        if seen == self._seen:
            return
        self._seen, self._written, self.problem = seen, status.st_mtime_ns, ""
        try:
            self._summary = load_summary(self._file)
        except HearthlogError as error:
            self._summary, self.problem = None, one_line(str(error))
