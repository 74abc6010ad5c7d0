"""What is heard now, in words, and since when."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.heard_now import ANY_SOUND, HOLD_SECONDS
from hearthlog.analyzer.bridge.home_state import MicrophoneState
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.words import class_words, reason, room, told, when
from hearthlog.models.classes import SILENCE, in_words
from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import is_sound

_QUIETEST = -80.0  # dBFS, the left end of the bar
_GOES_ON = (HOLD_SECONDS + 5) * NANOSECONDS  # behind the end of a segment
_NOT_LISTENING = "Not listening"


class _Heard(NamedTuple):
    words: str
    since: int  # in nanoseconds of UTC; 0: not known


class NowHeard:
    """Says what each microphone hears, and remembers since when."""

    def __init__(self) -> None:
        self._last: dict[str, _Heard] = {}

    def describe(self, news: News) -> Any:
        """Describe what is heard for JSON."""
        microphones = news.state.present()
        return {
            "is_recording": news.state.is_recording(),
            "rooms": [
                self._room(each, news, is_alone=len(microphones) == 1) for each in microphones
            ],
        }

    def _room(self, microphone: MicrophoneState, news: News, *, is_alone: bool) -> Any:
        words = _sentence(microphone)
        last = self._last.get(microphone.name)
        if last is None or last.words != words:
            since = _known_since(microphone) or (news.today.now if last is not None else 0)
            last = self._last[microphone.name] = _Heard(words, since)
        shown = f"since {when(last.since, news.today.now, news.zone)}" if last.since else ""
        health = news.state.health.get(microphone.name)
        is_listening = microphone.is_listening()
        return {
            "room": "" if is_alone else room(microphone.name),
            "words": words,
            "since": shown,
            "why": reason(told(health.text)) if health is not None and not is_listening else "",
            "level": _level(microphone) if is_listening else None,
        }


def _sentence(microphone: MicrophoneState) -> str:
    if not microphone.is_listening():
        return _NOT_LISTENING
    names = [class_words(label) for label in heard_classes(microphone)]
    if names:
        return listed([names[0], *map(str.lower, names[1:])], "and")
    return "A sound" if microphone.heard.is_heard(ANY_SOUND) else in_words(SILENCE)


def heard_classes(microphone: MicrophoneState) -> list[str]:
    """Return the classes of sound that are heard now, in the order of the model."""
    return [
        label
        for label in microphone.classes
        if is_sound(label) and microphone.heard.is_heard(label)
    ]


def _known_since(microphone: MicrophoneState) -> int:
    """Return since when it has been so, as far as the log says; 0 if it does not."""
    if not microphone.is_listening():
        return microphone.heard.time
    heard = heard_classes(microphone)
    if heard:
        last = [microphone.last_event(label) for label in heard]
        end = microphone.heard.time - _GOES_ON
        going = [event.start for event in last if event is not None and event.end >= end]
        return max(going) if len(going) == len(heard) else 0
    return max((event.end for event in _last_events(microphone)), default=0)


def _last_events(microphone: MicrophoneState) -> Iterator[Event]:
    for label in microphone.labels():
        event = microphone.last_event(label)
        if event is not None:
            yield event


def _level(microphone: MicrophoneState) -> Any:
    """Return the level as a share of the bar and in words; None where it is not known."""
    level = microphone.level_dbfs
    if not math.isfinite(level):
        return None
    return min(max(round(1 - level / _QUIETEST, 2), 0.0), 1.0), f"{level:.0f} dB".replace(
        "-", "\N{MINUS SIGN}"
    )
