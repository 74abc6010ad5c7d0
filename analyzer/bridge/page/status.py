"""Current state on the page: what sounds now, scenarios, what works, and what no model knows."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from hearthlog.analyzer.activity import ANY_SOUND, HOLD_SECONDS, SoundEvent
from hearthlog.analyzer.activity.doubtful_sounds import is_too_doubtful
from hearthlog.analyzer.activity.segments import source_microphone, source_parts
from hearthlog.analyzer.bridge.home_state import HomeState, LiveMicrophone
from hearthlog.analyzer.bridge.output import OutputUpdate
from hearthlog.analyzer.bridge.page import ENGLISH, Translation, one_line, reason, room
from hearthlog.models.classes import (
    IMPORTANT,
    ON_TELEVISION,
    RUNNING_WATER,
    SILENCE,
    SPEECH,
    WATER,
    ordered,
)
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.messages.topics import is_sound

# What people ask about: the page states which of these no model of the home can tell.
EXPECTED = frozenset({*IMPORTANT, SPEECH, *WATER})
_QUIETEST = -80.0  # dBFS at the left end of the bar
_HELD = (HOLD_SECONDS + 5) * NANOSECONDS  # after the end of a segment


class _Current(NamedTuple):
    words: str
    since: int  # in nanoseconds of UTC; 0: unknown


class RoomStatus:
    """Current sounds of each microphone, with their start times."""

    def __init__(self, words: Translation = ENGLISH) -> None:
        self._words = words
        self._last: dict[str, _Current] = {}

    def describe(self, update: OutputUpdate) -> Any:
        """Return the current sounds for JSON."""
        words, microphones = self._words, update.state.present()
        nothing = "now.nothing" if update.state.is_recording() else "now.not recording"
        return {
            "nothing": "" if microphones else words.text(nothing) + ".",
            "rooms": [
                self._room(each, update, is_alone=len(microphones) == 1) for each in microphones
            ],
        }

    def _room(self, microphone: LiveMicrophone, update: OutputUpdate, *, is_alone: bool) -> Any:
        words, sound = self._words, _sounds_in_words(microphone, self._words)
        last = self._last.get(microphone.name)
        if last is None or last.words != sound:
            since = _active_since(microphone) or (update.today.now if last is not None else 0)
            if _television_classes(microphone):
                since = 0  # its last sound is not when it began
            last = self._last[microphone.name] = _Current(sound, since)
        since_words = words.when(last.since, update.today.now, update.zone) if last.since else ""
        health = update.state.health.get(microphone.name)
        is_listening = microphone.is_listening()
        why = reason(one_line(health.text)) if health is not None and not is_listening else ""
        sentence = sound
        if since_words:
            sentence = words.text("now.since", words=sentence, time=since_words)
        if why:
            sentence = words.text("now.why", words=sentence, why=why)
        where = "" if is_alone else room(microphone.name)
        if where:
            sentence = words.text("now.room", room=where, words=words.inside_first(sentence))
        return {
            "room": where,
            "words": sound,
            "sentence": f"{sentence}.",
            "since": since_words,
            "why": why,
            "level": _level(microphone) if is_listening else None,
        }


def _sounds_in_words(microphone: LiveMicrophone, words: Translation) -> str:
    if not microphone.is_listening():
        return words.text("now.not listening")
    uncounted = _television_classes(microphone)
    names = [
        words.class_words(label)
        for label in active_classes(microphone)
        if label not in uncounted and not _may_be_another(microphone, label)
    ]
    names += [words.text("now.television")] * bool(uncounted)
    if names:
        return words.listed([names[0], *map(words.inside, names[1:])])
    is_sound_now = microphone.active.is_active(ANY_SOUND)
    return words.text("now.sound") if is_sound_now else words.class_words(SILENCE)


def _may_be_another(microphone: LiveMicrophone, label: str) -> bool:
    """Whether a label counts only where the model is sure, as of a telephone, and no such is going.

    A carer would take it for a telephone that nobody answers.
    """
    if not is_too_doubtful(label, 0.0):
        return False
    last, end = microphone.last_event(label), microphone.active.time - _HELD
    return last is None or last.end < end or is_too_doubtful(label, last.confidence)


def active_classes(microphone: LiveMicrophone) -> list[str]:
    """Return the active classes except silence, the most important first."""
    return [
        label
        for label in ordered(microphone.classes)
        if is_sound(label) and microphone.active.is_active(label)
    ]


def _television_classes(microphone: LiveMicrophone) -> set[str]:
    """Return the active classes that do not count, as something like a television is on."""
    active = {*active_classes(microphone)} & {*ON_TELEVISION}
    time = microphone.active.time
    now = [SoundEvent(microphone.name, label, time, time, 0.0, 0.0) for label in active]
    return active - {event.label for event in microphone.without_television(now)}


def _active_since(microphone: LiveMicrophone) -> int:
    """Return the start of the microphone's current state, from the log; 0 if unknown."""
    if not microphone.is_listening():
        return microphone.active.time
    active = active_classes(microphone)
    if active:
        last = [microphone.last_event(label) for label in active]
        end = microphone.active.time - _HELD
        going = [event.start for event in last if event is not None and event.end >= end]
        return max(going) if len(going) == len(active) else 0
    last = [microphone.last_event(label) for label in microphone.labels()]
    return max((event.end for event in last if event is not None), default=0)


def _level(microphone: LiveMicrophone) -> Any:
    """Return the level as a share of the bar and as text; None if unknown."""
    level = microphone.level_dbfs
    if not math.isfinite(level):
        return None
    return min(max(round(1 - level / _QUIETEST, 2), 0.0), 1.0), f"{level:.0f} dB".replace(
        "-", "\N{MINUS SIGN}"
    )


_WELL, _WARNING, _WRONG = 0, 1, 2  # as in diagnostics
_THINGS = {"disk": "health.disk", "machine": "health.machine"}  # keys of words


def _line(what: str, level: int, text: str) -> dict[str, Any]:
    return {"what": what, "level": level, "text": text}


def health_list(
    update: OutputUpdate, node: str, started: int, recurring: str = "", words: Translation = ENGLISH
) -> list[Any]:
    """Return the health of all subjects for JSON.

    `started` is the start of the bridge, in nanoseconds of UTC; `recurring` is a problem with the
    recurring sounds, if any.
    """
    lines = [*_lines(update, node, started, words)]
    if recurring:
        lines.append(_line(words.text("health.recurring"), _WARNING, recurring))
    return lines


def _lines(update: OutputUpdate, node: str, started: int, words: Translation) -> Iterator[Any]:
    state = update.state
    for microphone in state.present():
        yield _of_microphone(microphone, state, words)
    is_recording = state.is_recording()
    yield _line(
        words.text("health.recorder"),
        _WELL if is_recording else _WRONG,
        words.text("health.recording" if is_recording else "health.not recording"),
    )
    for subject, health in sorted(state.health.items()):
        if subject not in state.microphones:
            level, text = min(health.level, _WRONG), words.translated(one_line(health.text))
            yield _line(_thing(subject, node, words), level, text)
    since = words.when(started, update.today.now, update.zone)
    yield _line(words.text("health.bridge"), _WELL, words.text("health.follows", time=since))


def _of_microphone(microphone: LiveMicrophone, state: HomeState, words: Translation) -> Any:
    health = state.health.get(microphone.name)
    text, level = ("", _WELL) if health is None else (one_line(health.text), health.level)
    is_alone = len(state.present()) == 1
    key = "health.microphone" if is_alone else "health.microphone of"
    what = words.text(key, room=room(microphone.name))
    if not microphone.is_listening():
        why = reason(text)
        key = "health.not listening because" if why else "health.not listening"
        is_meant = bool(why) and level == _WELL  # a pause, or quiet hours
        return _line(what, _WELL if is_meant else _WRONG, words.text(key, text=why))
    key = "health.listening but" if level else "health.listening"
    return _line(what, min(level, _WRONG), words.text(key, text=text))


def _thing(subject: str, node: str, words: Translation) -> str:
    owner, _, part = subject.partition(" ")
    if owner == node and part in _THINGS:
        return words.text(_THINGS[part])
    return one_line(subject.replace("_", " ")).capitalize()


def scenario_lines(update: OutputUpdate, words: Translation = ENGLISH) -> list[Any]:
    """Return a line for each scenario of each microphone, for JSON."""
    state, midnight = update.state, update.today.midnight
    lines = []
    for name in sorted(state.scenarios):
        own = state.scenarios[name]
        today = _today(own, midnight, words)
        if own.is_listening() or today:
            where = [room(source_microphone(name))] if len(state.microphones) > 1 else []
            what = " · ".join([room(source_parts(name)[1]), *where])
            nothing = words.text("now.none")
            about = words.text("now.scenario", now=_now(own, words), today=today or nothing)
            lines.append({"what": what, "about": about})
    return lines


def _now(own: LiveMicrophone, words: Translation) -> str:
    if not own.is_listening():
        return words.inside_first(words.text("now.not listening"))
    names = [words.inside(words.class_words(label)) for label in active_classes(own)]
    return words.listed(names) or words.text("now.none")


def _today(own: LiveMicrophone, midnight: int, words: Translation) -> str:
    """Format count and total length of each class since midnight, longest first."""
    events = {label: own.events(label, midnight) for label in own.labels()}
    seconds = {label: sum(each.seconds for each in same) for label, same in events.items() if same}
    return ", ".join(
        words.text(
            "class, times and length",
            **{"class": words.inside(words.class_words(label))},
            times=words.times(len(events[label])),
            length=words.length(seconds[label]),
        )
        for label in sorted(seconds, key=lambda label: -seconds[label])
    )


def missing_classes(microphones: Sequence[LiveMicrophone], words: Translation) -> str:
    """Return a note on the sounds that people ask about and no model of the home can tell.

    Empty while the classes of the models are not known.
    """
    if not microphones or not all(each.names for each in microphones):
        return ""
    detectable = {each.common_names.get(name, name) for each in microphones for name in each.names}
    hidden = frozenset[str]().union(*(each.hidden_classes for each in microphones))
    missing = EXPECTED - detectable - hidden
    notes = []
    if RUNNING_WATER in detectable and (joined_classes := missing & {*WATER}):
        missing -= {*WATER}
        water = words.inside(words.class_words(RUNNING_WATER))
        classes = _listed_classes(joined_classes, words)
        notes.append(words.text("missing.joined", classes=classes, water=water))
    if missing:
        notes.append(words.text("missing", classes=_listed_classes(missing, words)))
    return " ".join(notes)


def _listed_classes(names: Iterable[str], words: Translation) -> str:
    return words.listed([words.inside(words.class_words(name)) for name in ordered(names)])
