"""How microphones, recorder, disk and bridge are, a line each."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from hearthlog.analyzer.bridge.home_state import HomeState, MicrophoneState
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.words import reason, room, told, when

_WELL, _WARNING, _WRONG = 0, 1, 2  # as in diagnostics
_THINGS = {"disk": "Disk", "machine": "Clock and computer"}


class HealthLine(NamedTuple):
    """How one thing is: a level from 0, for well, to 2; and a text."""

    what: str
    level: int
    text: str


def health_list(news: News, node: str, started: int, recurring: str = "") -> list[Any]:
    """Say how everything is, for JSON.

    Parameters
    ----------
    started : int
        When the bridge was started, in nanoseconds of UTC.
    """
    lines = [*_lines(news, node, started)]
    if recurring:
        lines.append(HealthLine("Sounds that recur", _WARNING, recurring))
    return [line._asdict() for line in lines]


def _lines(news: News, node: str, started: int) -> Iterator[HealthLine]:
    state = news.state
    for microphone in state.present():
        yield _of_microphone(microphone, state)
    is_recording = state.is_recording()
    yield HealthLine(
        "Recorder",
        _WELL if is_recording else _WRONG,
        "recording" if is_recording else "nothing has been written for more than 15 seconds",
    )
    for subject, health in sorted(state.health.items()):
        if subject not in state.microphones:
            yield HealthLine(_thing(subject, node), min(health.level, _WRONG), told(health.text))
    yield HealthLine(
        "Bridge", _WELL, f"follows the recorder since {when(started, news.today.now, news.zone)}"
    )


def _of_microphone(microphone: MicrophoneState, state: HomeState) -> HealthLine:
    health = state.health.get(microphone.name)
    text, level = ("", _WELL) if health is None else (told(health.text), health.level)
    is_alone = len(state.present()) == 1
    what = "Microphone" if is_alone else f"Microphone, {room(microphone.name)}"
    if not microphone.is_listening():
        why = reason(text)
        return HealthLine(what, _WRONG, f"not listening: {why}" if why else "not listening")
    return HealthLine(what, min(level, _WRONG), f"listening: {text}" if level else "listening")


def _thing(subject: str, node: str) -> str:
    whose, _, part = subject.partition(" ")
    if whose == node and part in _THINGS:
        return _THINGS[part]
    return told(subject.replace("_", " ")).capitalize()
