"""What people ask of a recorder by MQTT: an event was something else, or nobody is to listen."""

import queue
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from threading import Thread
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hearthlog.analyzer.bridge.corrections import correct_event
from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.models.classes import CLASS_NAME
from hearthlog.recorder import pause_schedule
from hearthlog.schemas.messages.topics import spelt

_WAITING = 20  # commands; more are refused
_LONGEST = 4096  # bytes of one
_MOST_MINUTES = 7 * 24 * 60

FindEvent = Callable[[str], Event | None]


class Answer(NamedTuple):
    """What became of a command."""

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

    def problem(self) -> str:
        """Return what is wrong with the command; empty if nothing is."""
        of_class = self.correct is not None, self.told is not None
        if sum([*of_class, self.pause_minutes is not None, self.resume]) != 1:
            return "one of correct, told, pause_minutes and resume has to be there"
        if (self.label is not None) != any(of_class):
            return "label belongs to correct and told"
        return ""


class Commands:
    """Carries commands out, one after the other, in a thread of its own."""

    def __init__(
        self,
        folder: Path,
        node: str,
        switch: Callable[[str, bool], None],
        answered: Callable[[Answer], None],
    ) -> None:
        self._folder = folder
        self._node = node
        self._switch = switch
        self._answered = answered
        self._waiting: queue.Queue[tuple[bytes, FindEvent] | None] = queue.Queue(_WAITING)
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, payload: bytes, find_event: FindEvent) -> None:
        """Have a command carried out."""
        try:
            self._waiting.put_nowait((payload[: _LONGEST + 1], find_event))
        except queue.Full:
            self._answered(Answer(False, f"refused: {_WAITING} commands are waiting already"))

    def close(self) -> None:
        """End when the command that is carried out is done."""
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()
        self._waiting.put(None)

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self._answered(Answer(True, self._carry_out(*item)))
            except Exception as error:  # noqa: BLE001  the next one is to be carried out
                self._answered(Answer(False, f"refused: {error}"))

    def _carry_out(self, payload: bytes, find_event: FindEvent) -> str:
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
        event = find_event(command.correct or "")
        if event is None:
            raise BridgeError(f"{(command.correct or '')[:100]!r} is no event since last evening")
        correct_event(self._folder, self._node, event, label, by)
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
    if problem := command.problem():
        raise BridgeError(problem)
    return command
