"""Review session: the reviewer's keys, and playback of kept sound."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import tzinfo
from functools import partial
from queue import Empty, SimpleQueue
from typing import Protocol

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.clips import play_sound, wav_bytes
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.marks.marks import PERSON, RANDOM, Mark
from hearthlog.analyzer.review.marking import Marking
from hearthlog.analyzer.review.review_queue import ReviewItem
from hearthlog.analyzer.review.timeline import Key, LabelledSpans, Question, SoundClip, sound_of
from hearthlog.models.classes import TELEVISION, UNKNOWN, colour, in_words
from hearthlog.schemas.errors import HearthlogError, LogError
from hearthlog.schemas.frames import NANOSECONDS

_POLL_SECONDS = 0.3
_LEAST_MARGIN = 20 * NANOSECONDS
_AROUND = 600 * NANOSECONDS
_RIGHT = "."
_CAPS = {_RIGHT: "Enter", "p": "Space"}
_NO_SOUND = "no sound of this span was kept"
_SILENT = "nothing to hear: its sound was not kept"
_NONE_AUDIBLE = (
    "None of these can be heard: record with `--keep-audio unsure` (see docs/recorder.md). "
    "You can still answer from memory."
)
_LOADING = "The picture is still loading; you can answer already."
_LONG = 60 * NANOSECONDS  # a longer span is marked by a second press
_ANSWERS = {"a", "c", _RIGHT, "n", "b", "q"}
_CLASS_KEYS = "1234567890eghijklorsvwxy"
_SELECT = "drag a span on the time ruler, or press [ at its start and ] at its end"


class Screen(Protocol):
    """Viewer interface of a session; all methods may raise ConnectionError or TimeoutError."""

    def is_open(self) -> bool:
        """Return whether the viewer is open."""

    def selection(self) -> tuple[int, int] | None:
        """Return start and end of the selected span, in nanoseconds of UTC; None without one."""

    def cursor(self) -> int | None:
        """Return the time of the cursor, in nanoseconds of UTC; None without a cursor."""

    def show(self, start: int, end: int, margin: int, *, select: bool = True) -> None:
        """Show a span with a margin, and select the span, or nothing.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC.
        margin : int
            On either side, in nanoseconds.
        """

    def refresh(self) -> None:
        """Draw the selected span, and put the lanes beside their names again."""

    def clear_question(self) -> None:
        """Remove the question of the previous span."""

    def show_question(self, start: int, end: int, question: Question) -> None:
        """Draw the requested span and its question, in place of the previous ones.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC.
        """

    def play(self, start: int) -> None:
        """Start the time cursor running from a time.

        Parameters
        ----------
        start : int
            In nanoseconds of UTC.
        """

    def redraw_marks(
        self, microphone: str, scenario: str, marks: LabelledSpans, reviewed: LabelledSpans
    ) -> None:
        """Redraw the reviewed spans of a microphone.

        Parameters
        ----------
        microphone, scenario : str
            Their names; the scenario is empty for the sounds of the home.
        marks, reviewed : LabelledSpans
            All current ones.
        """


@dataclass
class ReviewSession:
    """Keyboard-driven review of items; empty where the reviewer chooses spans.

    `look_closely` draws a span at the resolution of its frames; `listen` plays the kept sound of a
    span, and returns its length in seconds, 0 without sound, and a line for the reviewer; `stop`
    stops it; `show_keys` shows the keys. Spans have start and end in nanoseconds of UTC.
    """

    screen: Screen
    marking: Marking
    classes: Sequence[str]
    zone: tzinfo
    announce: Callable[[str], None]
    look_closely: Callable[[int, int], None]
    listen: Callable[[int, int], tuple[float, str]]
    stop: Callable[[], None]
    items: Sequence[ReviewItem] = ()
    show_keys: Callable[[], None] | None = None  # by default the lines of keys are announced
    _at: int = -1
    _judged: list[int] = field(default_factory=list)  # the item of each change
    _began: float = 0.0
    _is_loading: bool = False  # until the first key, while the viewer does not answer
    _is_pressed: bool = False
    _begin: int | None = None  # start of a span without an end yet
    _plays_until: float = 0.0  # by CLOCK_MONOTONIC
    _long: tuple[str, int, int] | None = None  # label and span of the last press, if too long

    @property
    def keys(self) -> list[Key]:
        """All keys."""
        labels = self._labels()
        own = [
            Key(key, text, colour(labels[key]) if key in labels else None, _CAPS.get(key, ""))
            for key, (text, _) in self._actions().items()
        ]
        return [*own, Key("q", "quit")]

    @property
    def key_lines(self) -> list[str]:
        """All keys as three lines: answers, sounds, and those for spans and marks."""
        lines: dict[str, list[str]] = {"answers": [], "sounds": [], "spans and marks": []}
        for one in self.keys:
            named = "sounds" if one.colour is not None else "spans and marks"
            lines["answers" if one.key in _ANSWERS else named].append(f"{one.cap} {one.text}")
        return [f"{what}: {', '.join(texts)}" for what, texts in lines.items()]

    def _labels(self) -> dict[str, str]:
        """Return the class of each key that names one."""
        classes = [name for name in self.classes if name not in {UNKNOWN, TELEVISION}]
        named = dict(zip(_CLASS_KEYS, classes, strict=False))
        return named | {"t": TELEVISION, "u": UNKNOWN}

    def _actions(self) -> dict[str, tuple[str, Callable[[], None]]]:
        """Text and function of each key."""
        actions: dict[str, tuple[str, Callable[[], None]]] = {}
        if self.items:
            actions["a"] = "confirm the label", self._accept
        for key, label in self._labels().items():
            actions[key] = _words(label), partial(self._mark_as, label)
        if not self.items:
            actions["c"] = "confirm the labels", lambda: self._mark(self.marking.confirm)
        actions |= {
            _RIGHT: ("confirm the rest", self._rest_is_right),
            "m": ("move the mark", self._move),
            "d": ("delete the marks", lambda: self._mark(self.marking.delete)),
            "z": ("undo", self._undo),
            "p": ("play or stop", self._play),
            "[": ("set the start", self._begin_here),
            "]": ("set the end", self._end_here),
        }
        if self.items:
            return actions | {
                "n": ("skip", lambda: self._go(1)),
                "b": ("go back", lambda: self._go(-1)),
            }
        return actions | {"f": ("draw each frame", self._look_around)}

    def run(self, keys: "SimpleQueue[str]") -> int:
        """Process keys until the reviewer quits or closes the viewer, or the last item is done.

        Raise `LogError` if a review layer is damaged when the session begins.
        """
        self._began = time.monotonic()
        if self.items and not self._is_any_audible:
            self.announce(_NONE_AUDIBLE)
        self._redraw("")
        self.announce(
            "press a if the label is right, else the key of the right class; n skips"
            if self.items
            else f"{_SELECT}; then press a key"
        )
        if self.items:
            self._go(1)
        while self.screen.is_open() and self._at < max(len(self.items), 1):
            try:
                key = keys.get(timeout=_POLL_SECONDS)
            except Empty:
                with suppress(ConnectionError, TimeoutError):
                    self.screen.refresh()
                continue
            if key == "q":
                break
            self.press(key)
        self._conclude()
        return len(self._judged)

    def press(self, key: str) -> None:
        """Process one key; an error is shown to the reviewer and changes nothing.

        A key is one of `keys`, Enter, or a space, which plays. Any other key except white space
        shows the list of keys.
        """
        self._is_pressed = True
        actions = self._actions()
        same = {"\n": _RIGHT, " ": "p"}.get(key, key)
        try:
            if same in actions:
                actions[same][1]()
            elif key.strip():
                if self.show_keys is not None:
                    self.show_keys()
                else:
                    for line in self.key_lines:
                        self.announce(line)
                self.announce(f"{key!r} does nothing: press one of these keys")
        except HearthlogError as error:
            self.announce(str(error))
        except (ConnectionError, TimeoutError):
            self.announce("nothing was done, as the viewer did not answer: press the key again")

    def _mark_as(self, label: str) -> None:
        chosen = "" if self._in_minute or not self.items else self.items[self._at].chosen
        start, end = self._chosen()
        is_item = bool(self.items) and (start, end) == self.items[self._at][:2]
        if end - start > _LONG and not is_item and (label, start, end) != self._long:
            self._long = label, start, end
            length = length_text(end - start)
            raise DataError(f"{length} is long: press the key again to mark it as {_words(label)}")
        self._long = None
        self._mark(lambda start, end: self.marking.mark(start, end, label, chosen))

    @property
    def _is_any_audible(self) -> bool:
        return any(item.is_audible for item in self.items)

    @property
    def _in_minute(self) -> bool:
        return bool(self.items) and self.items[self._at].chosen == RANDOM

    def _accept(self) -> None:
        if self._in_minute:
            self._rest_is_right()
        else:
            self._mark_as(self.items[self._at].label)

    def _rest_is_right(self) -> None:
        if self.items:
            item = self.items[self._at]
            start, end, chosen = item.start, item.end, item.chosen
        else:
            start, end, chosen = *self._chosen(), PERSON
        self.marking.review(start, end, chosen)
        self._done(start, end, "the rest is confirmed")
        if self.items:
            self._go(1)

    def _mark(self, change: Callable[[int, int], list[Mark]]) -> None:
        start, end = self._chosen()
        made = change(start, end)
        labels = ", ".join(dict.fromkeys(_words(mark.label) for mark in made))
        self._done(start, end, f"marked as {labels}" if labels else "marks deleted")
        if self.items and not self._in_minute:
            self._go(1)

    def _move(self) -> None:
        """Move the mark in the selected span, or the last one, to the ends of this span."""
        span = self.screen.selection()
        item = self.items[self._at] if self.items else None
        if span is None or (item and span == (item.start, item.end)):
            raise DataError("drag the new span of the mark first, then press m")
        made = self.marking.move(*span)
        self._done(made[0].start, made[-1].end, f"mark moved: {_words(made[0].label)}")

    def _done(self, start: int, end: int, text: str) -> None:
        self._judged.append(self._at)
        self.announce(f"{text}: {self._text(start, end)}")
        self._redraw("saved, but ")

    def _undo(self) -> None:
        span = self.marking.undo()
        if span is None:
            self.announce("nothing to undo")
            return
        judged = self._judged.pop()
        self.announce(f"undone: {self._text(*span)}")
        self._redraw("undone, but ")
        if judged != self._at:
            self._go(judged - self._at)

    def _redraw(self, done: str) -> None:
        of = self.marking.microphone, self.marking.scenario
        marks, reviewed = self.marking.marks(), self.marking.reviewed()
        with self._unless_silent(done):
            self.screen.redraw_marks(*of, marks, reviewed)

    @contextmanager
    def _unless_silent(self, done: str = "") -> Iterator[None]:
        """Report a viewer that does not answer, after what is `done` all the same."""
        try:
            yield
        except (ConnectionError, TimeoutError):
            if self._is_pressed:
                self.announce(f"{done}not shown, as the viewer did not answer")
            elif not self._is_loading:
                self._is_loading = True
                self.announce(_LOADING)

    def _play(self) -> None:
        """Play the selected span, or the item; stop a sound that plays."""
        if time.monotonic() < self._plays_until:
            self._plays_until = 0.0
            self.stop()
            self.announce("stopped")
            return
        start, end = self.span_to_play()
        seconds, text = self.listen(start, end)
        self._plays_until = time.monotonic() + seconds
        self.announce(text)
        if seconds:
            with suppress(ConnectionError, TimeoutError):  # it plays, also without a cursor
                self.screen.play(start)

    def span_to_play(self) -> tuple[int, int]:
        """Return the selected span, or the item, in nanoseconds of UTC.

        Raise `DataError` without both. Raise `ConnectionError` or `TimeoutError` if the viewer does
        not answer.
        """
        in_queue = 0 <= self._at < len(self.items)
        item = self.items[self._at] if in_queue else None
        span = self.screen.selection() or (item and (item.start, item.end))
        return span or self._chosen()

    def _look_around(self) -> None:
        cursor = self._cursor()
        self.look_closely(cursor - _AROUND, cursor + _AROUND)
        self.announce(f"each frame drawn: {self._text(cursor - _AROUND, cursor + _AROUND)}")

    def _begin_here(self) -> None:
        """Begin a span, or move the start of the selected one."""
        cursor, selection = self._cursor(), self.screen.selection()
        if selection is not None and cursor < selection[1]:
            self._select(cursor, selection[1])
            return
        self._begin = cursor
        begin = local_time(self._begin, self.zone)
        self.announce(f"start set, {begin:%H:%M:%S}: put the time cursor on the end and press ]")

    def _end_here(self) -> None:
        selection = self.screen.selection()
        start = self._begin if self._begin is not None else selection and selection[0]
        end = self._cursor()
        if start is None or start >= end:
            raise DataError("put the time cursor on the start and press [, then on the end and ]")
        self._select(start, end)

    def _select(self, start: int, end: int) -> None:
        self.screen.show(start, end, _margin(start, end))
        self._begin = None
        self.announce(self._text(start, end))

    def _cursor(self) -> int:
        cursor = self.screen.cursor()
        if cursor is None:
            raise DataError("click on the time ruler first: there is no time cursor")
        return cursor

    def _chosen(self) -> tuple[int, int]:
        """Return the selected span, or the item: but a minute is no single sound."""
        span = self.screen.selection()
        if span is not None:
            return span
        if self._in_minute:
            raise DataError("drag over the sound first; Enter confirms the rest of the minute")
        if not self.items:
            raise DataError(f"no span is selected: {_SELECT}")
        item = self.items[self._at]
        return item.start, item.end

    def _go(self, step: int) -> None:
        """Show the next or previous item."""
        self._at = max(self._at + step, 0)
        if self._at >= len(self.items):
            return
        item = self.items[self._at]
        place = f"{self._at + 1} of {len(self.items)}"
        silent = f"; {_SILENT}" if self._is_any_audible and not item.is_audible else ""
        span = self._text(item.start, item.end)
        margin = _margin(item.start, item.end)
        with self._unless_silent():
            self.screen.clear_question()
            self.look_closely(item.start - margin, item.end + margin)
            # A minute has several sounds: what is named in it is selected by hand.
            self.screen.show(item.start, item.end, margin, select=item.chosen != RANDOM)
        with self._unless_silent():
            text = f"{place}, {span}{silent}"
            self.screen.show_question(
                item.start, item.end, Question(_question(item), text, self._answers())
            )
        # Not before: nobody is to answer from the picture of the item before.
        self.announce(f"{place}: {_question(item)} {span}; {item.text}{silent}")

    def _text(self, start: int, end: int) -> str:
        return f"{local_time(start, self.zone):%a %d %b %H:%M:%S}, {length_text(end - start)}"

    def _conclude(self) -> None:
        minutes = (time.monotonic() - self._began) / 60
        count = len(self._judged)
        spans = "1 span" if count == 1 else f"{count} spans"
        self.announce(f"{spans} reviewed in {minutes:.1f} min, {count / minutes:.1f} a minute")

    def _answers(self) -> list[Key]:
        """Return the keys that answer the question of the current item."""
        item, labels = self.items[self._at], self._labels()
        yes = Key("a", "yes")
        if self._in_minute:
            yes = Key(_RIGHT, "yes, or the rest is right", shown=_CAPS[_RIGHT])
        others = [key for key, label in labels.items() if self._in_minute or label != item.label]
        named = {one.key: one for one in self.keys}
        play = [Key("p", "play", shown=_CAPS["p"])] if item.is_audible else []
        more = Key("n", "skip"), *play, Key("z", "undo")
        return [yes, *(named[key] for key in others), *more]


def _question(item: ReviewItem) -> str:
    if item.chosen == RANDOM:
        return "Is all of this minute labelled right?"
    return f"{in_words(item.label)}?"


def length_text(length: int) -> str:
    """Return a length in nanoseconds in words, as `53 min 20 s`; up to a minute with tenths."""
    if length <= _LONG:
        return f"{length / NANOSECONDS:.1f} s"
    minutes, seconds = divmod(round(length / NANOSECONDS), 60)
    hours, minutes = divmod(minutes, 60)
    parts = (hours, "h"), (minutes, "min"), (seconds, "s")
    return " ".join(f"{number} {unit}" for number, unit in parts if number)


def _words(label: str) -> str:
    return in_words(label).lower()


def _margin(start: int, end: int) -> int:
    return max(_LEAST_MARGIN, (end - start) // 2)


_LONGEST_SOUND = 60 * NANOSECONDS  # sent to a page: two megabytes


def sound_file(clips: Sequence[SoundClip], start: int, end: int) -> bytes:
    """Return the kept sound of the first minute of a span of time as a WAV file.

    Raise `DataError` if none was kept.
    """
    rate, samples = sound_of(clips, start, min(end, start + _LONGEST_SOUND))
    if not len(samples):
        raise DataError(_NO_SOUND)
    return wav_bytes(samples, rate)


def listen(clips: Sequence[SoundClip], start: int, end: int) -> tuple[float, str]:
    """Start playback of the kept sound of a span of time.

    Return the length of the sound in seconds, 0 if nothing plays, and a line for the reviewer: the
    length, or why there is no sound.
    """
    rate, samples = sound_of(clips, start, end)
    if not len(samples):
        return 0.0, _NO_SOUND
    try:
        play_sound(samples, rate)
    except LogError as error:
        return 0.0, str(error)
    seconds = len(samples) / rate
    return seconds, f"playing {seconds:.1f} s; Space stops it"
