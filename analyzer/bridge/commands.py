"""Commands to the bridge: corrections of events, pauses, and muting of classes."""

import queue
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from threading import Thread
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.state import BridgeError
from hearthlog.models.classes import CLASS_NAME, CLASSES, class_name
from hearthlog.recorder import pause_schedule
from hearthlog.schemas.messages.topics import spelt

_BY_WORDS = {spelt(row.words): row.name for row in CLASSES}


def class_of(text: str) -> str:
    """Convert text to a class name: `Water tap` to `tap_water`.

    Raise `BridgeError` if the text is no valid class name.
    """
    spelling = spelt(text.strip()).strip("_")
    label = class_name(_BY_WORDS.get(spelling, spelling))
    if not CLASS_NAME.fullmatch(label):
        raise BridgeError(
            "This name cannot be used: write it with the letters a to z, digits and spaces, "
            "beginning with a letter."
        )
    return label


_WAITING = 20  # commands; more are refused
_LONGEST = 4096  # bytes of a command
_MOST_MINUTES = 7 * 24 * 60


class Answer(NamedTuple):
    """Result of a command."""

    done: bool
    text: str


class _Command(BaseModel):
    """One of `correct` and `told`, both with `label`, `pause_minutes` and `resume`."""

    model_config = ConfigDict(extra="forbid", strict=True)

    by: Annotated[str, Field(max_length=100, pattern=r"^[^\x00-\x1f\x7f]*$")] = ""
    correct: str | None = None
    told: bool | None = None
    label: str | None = None
    pause_minutes: Annotated[float, Field(gt=0, le=_MOST_MINUTES)] | None = None
    resume: bool = False

    def check(self) -> None:
        """Check which fields are there, or raise `BridgeError`."""
        of_class = self.correct is not None, self.told is not None
        if sum([*of_class, self.pause_minutes is not None, self.resume]) != 1:
            raise BridgeError("one of correct, told, pause_minutes and resume is required")
        if (self.label is not None) != any(of_class):
            raise BridgeError("label belongs to correct and told")


class Commands:
    """Runs commands one after the other in a separate thread."""

    def __init__(
        self,
        folder: Path,
        switch: Callable[[str, bool], None],
        answered: Callable[[Answer], None],
    ) -> None:
        self._folder = folder
        self._switch = switch
        self._answered = answered
        self._waiting: queue.Queue[tuple[bytes, HomeState] | None] = queue.Queue(_WAITING)
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, payload: bytes, state: HomeState) -> None:
        """Queue a command, or refuse it if the queue is full."""
        try:
            self._waiting.put_nowait((payload[: _LONGEST + 1], state))
        except queue.Full:
            self._answered(Answer(False, f"refused: {_WAITING} commands are waiting already"))

    def close(self) -> None:
        """Drop queued commands, and stop after the running one."""
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
        self._waiting.put(None)

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self._answered(Answer(True, self._carry_out(*item)))
            except Exception as error:  # noqa: BLE001  a failing command must not stop the next
                self._answered(Answer(False, f"refused: {error}"))

    def _carry_out(self, payload: bytes, state: HomeState) -> str:
        command = _parse(payload)
        by = command.by or "mqtt"
        if command.resume:
            was_paused = pause_schedule.resume(self._folder)
            return "it listens again" if was_paused else "it was not paused"
        if command.pause_minutes is not None:
            pause_schedule.pause(self._folder, timedelta(minutes=command.pause_minutes), by)
            return f"paused for {command.pause_minutes:g} minutes by {by}"
        label = spelt(command.label or "")
        if not CLASS_NAME.fullmatch(label):
            raise BridgeError(f"{label[:64]!r} cannot be the name of a class")
        if command.told is not None:
            self._switch(label, command.told)
            return f"{label} is {'' if command.told else 'not '}told of, says {by}"
        event = state.find_event(command.correct or "")
        if event is None:
            raise BridgeError(f"{(command.correct or '')[:100]!r} is no event since last evening")
        state.corrections.add(event, label, by)
        return f"{event.id} was {label}, says {by}"


def _parse(payload: bytes) -> _Command:
    if len(payload) > _LONGEST:
        raise BridgeError(f"a command has {_LONGEST} bytes at most")
    try:
        command = _Command.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "command"
        raise BridgeError(f"{where}: {first['msg']}") from error
    command.check()
    return command
