"""The last events of a home, and what people may say that they were."""

from collections.abc import Callable
from typing import Any, NamedTuple

from hearthlog.analyzer.bridge.event_record import Event
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.page.words import class_words, length, room, sureness, when
from hearthlog.analyzer.colours import colour_on_paper
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import is_sound

_SHOWN = 20
_DAY = 24 * 3600 * NANOSECONDS


class LastEvents(NamedTuple):
    """The last events: themselves, by their ids, and what is shown of them."""

    events: dict[str, Event]
    shown: Any


def last_events(news: News, said_of: Callable[[Event], str]) -> LastEvents:
    """Find the last events, and describe them for JSON.

    Parameters
    ----------
    said_of : callable
        Returns what people said that an event was, in words; empty for nothing.
    """
    microphones = news.state.microphones.values()
    found: list[Event] = []
    for microphone in microphones:
        for label in microphone.labels():
            found += microphone.events(label, news.today.midnight - _DAY)[-_SHOWN:]
    found = sorted(found, key=lambda event: (event.start, event.id), reverse=True)[:_SHOWN]
    names = dict.fromkeys(
        label for each in microphones for label in [*each.classes, *each.labels()]
    )
    shown = {
        "events": [
            _described(event, news, said_of(event), is_alone=len(microphones) == 1)
            for event in found
        ],
        "classes": [(label, class_words(label)) for label in names if is_sound(label)],
    }
    return LastEvents({event.id: event for event in found}, shown)


def _described(event: Event, news: News, said: str, *, is_alone: bool) -> Any:
    return {
        "id": event.id,
        "label": event.label,
        "words": class_words(event.label),
        "colour": colour_on_paper(event.label),
        "time": when(event.start, news.today.now, news.zone, seconds=True),
        "length": length(event.seconds),
        "sure": sureness(event.confidence),
        "room": "" if is_alone else room(event.microphone),
        "said": said,
    }
