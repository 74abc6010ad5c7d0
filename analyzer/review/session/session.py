"""A review session: what the keys of a reviewer do."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import tzinfo
from queue import Empty, SimpleQueue
from typing import NamedTuple, Protocol

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.marks.marks import PERSON, QUEUE, RANDOM, Mark
from hearthlog.analyzer.review.session.marking import Marking
from hearthlog.analyzer.review.timeline.model import LabelledSpans
from hearthlog.models.classes import UNKNOWN, in_words
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS

_POLL_SECONDS = 0.3
_LEAST_MARGIN = 20 * NANOSECONDS
_AROUND = 600 * NANOSECONDS
_RIGHT = "."
_CLASS_KEYS = "1234567890eghijklmorstvwxy"
_HELP = "drag a span on the time ruler, or set its ends with [ and ] at the time cursor; then"


class ReviewItem(NamedTuple):
    """A span to be reviewed."""

    start: int
    end: int
    label: str
    text: str
    chosen: str = QUEUE


class Screen(Protocol):
    """A viewer, for a session; all methods may raise ConnectionError or TimeoutError."""

    def is_open(self) -> bool:
        """Tell whether the viewer is open."""

    def selection(self) -> tuple[int, int] | None:
        """Return start and end of the selected span, in nanoseconds of UTC; None without one."""

    def cursor(self) -> int | None:
        """Return the time of the cursor, in nanoseconds of UTC; None if there is no cursor."""

    def show(self, start: int, end: int, margin: int) -> None:
        """Select a span, and show it with a margin.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC.
        margin : int
            On either side, in nanoseconds.
        """

    def ask(self, start: int, end: int, text: str) -> None:
        """Draw which span is asked, in place of the one before.

        Parameters
        ----------
        start, end : int
            In nanoseconds of UTC.
        text : str
            What is asked.
        """

    def play(self, start: int) -> None:
        """Let the time cursor run from a time on.

        Parameters
        ----------
        start : int
            In nanoseconds of UTC.
        """

    def redraw_marks(
        self, microphone: str, scenario: str, marks: LabelledSpans, reviewed: LabelledSpans
    ) -> None:
        """Draw what is reviewed of a microphone again.

        Parameters
        ----------
        microphone, scenario : str
            Their names; the second is empty for the sounds of the home.
        marks, reviewed : LabelledSpans
            All that it has now.
        """


@dataclass
class Session:
    """A review, driven by keys.

    Parameters
    ----------
    look_closely : callable
        Draws a span (start, end in nanoseconds of UTC) at the resolution of its frames.
    listen : callable
        Plays the kept sound of a span (start, end in nanoseconds of UTC); returns a line for the
        reviewer.
    items : sequence of ReviewItem
        The spans to go through; empty where the reviewer chooses spans.
    """

    screen: Screen
    marking: Marking
    classes: Sequence[str]
    zone: tzinfo
    say: Callable[[str], None]
    look_closely: Callable[[int, int], None]
    listen: Callable[[int, int], str]
    items: Sequence[ReviewItem] = ()
    _at: int = -1
    _judged: list[int] = field(default_factory=list)  # the item of each change
    _began: float = 0.0
    _begin: int | None = None  # of a span whose end is not set yet

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Each key, and what it does."""
        queued = bool(self.items)
        keys = [("a", "accept the label") if queued else ("c", "correct as labelled")]
        keys += [(_RIGHT, "or Enter: all else in the span is right")]
        keys += [(key, _words(label)) for key, label in self._labels.items()]
        keys += [("d", "delete marks"), ("z", "undo"), ("p", "play"), ("[", "from"), ("]", "to")]
        keys += [("n", "skip"), ("b", "back")] if queued else [("f", "frames near the cursor")]
        return [*keys, ("q", "quit")]

    def run(self, keys: "SimpleQueue[str]") -> int:
        """Obey keys until the reviewer quits or closes the viewer, or the last item is done.

        Raise `LogError` if a review layer is damaged when the session begins.
        """
        self._began = time.monotonic()
        self._redraw()
        self.say(f"{_HELP} press a key")
        if self.items:
            self._go(1)
        while self.screen.is_open() and self._at < max(len(self.items), 1):
            try:
                key = keys.get(timeout=_POLL_SECONDS)
            except Empty:
                continue
            if key == "q":
                break
            self.press(key)
        self._conclude()
        return len(self._judged)

    def press(self, key: str) -> None:
        """Obey one key. An error is shown to the reviewer, and changes nothing.

        Parameters
        ----------
        key : str
            One of `keys`, or Enter; where there are items, a space skips one, too. For any other
            key the keys are shown, unless it is white space.
        """
        try:
            self._press(key)
        except HearthlogError as error:
            self.say(str(error))
        except (ConnectionError, TimeoutError):
            self.say("the viewer did not answer, and nothing was done; press the key again")

    def _press(self, key: str) -> None:
        actions: dict[str, Callable[[], None]] = {
            "d": lambda: self._mark(self.marking.delete),
            "z": self._undo,
            "p": self._play,
            _RIGHT: self._rest_is_right,
            "\n": self._rest_is_right,
            "[": self._begin_here,
            "]": self._end_here,
        }
        if self.items:
            actions |= {
                "a": self._accept,
                "n": lambda: self._go(1),
                " ": lambda: self._go(1),
                "b": lambda: self._go(-1),
            }
        else:
            actions |= {"c": lambda: self._mark(self.marking.confirm), "f": self._look_around}
        if key in self._labels:
            self._mark_as(self._labels[key])
        elif key in actions:
            actions[key]()
        elif key.strip():
            self.say(f"{key!r} is no key; {', '.join(f'{k} {text}' for k, text in self.keys)}")

    @property
    def _labels(self) -> dict[str, str]:
        """What each key of a class marks."""
        classes = [name for name in self.classes if name != UNKNOWN]
        return dict(zip(_CLASS_KEYS, classes, strict=False)) | {"u": UNKNOWN}

    def _mark_as(self, label: str) -> None:
        chosen = "" if self._in_minute or not self.items else self.items[self._at].chosen
        self._mark(lambda start, end: self.marking.mark(start, end, label, chosen))

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
        self._done(start, end, "all else is right")
        if self.items:
            self._go(1)

    def _mark(self, change: Callable[[int, int], list[Mark]]) -> None:
        start, end = self._chosen()
        made = change(start, end)
        labels = dict.fromkeys(_words(mark.label) for mark in made)
        self._done(start, end, ", ".join(labels) or "no mark")
        if self.items and not self._in_minute:
            self._go(1)

    def _done(self, start: int, end: int, text: str) -> None:
        self._judged.append(self._at)
        self.say(f"{self._text(start, end)}  {text}")
        self._redraw()

    def _undo(self) -> None:
        span = self.marking.undo()
        if span is None:
            self.say("nothing to undo")
            return
        judged = self._judged.pop()
        self.say(f"{self._text(*span)}  undone")
        self._redraw()
        if judged != self._at:
            self._go(judged - self._at)

    def _redraw(self) -> None:
        of = self.marking.microphone, self.marking.scenario
        marks, reviewed = self.marking.marks(), self.marking.reviewed()
        with self._unless_silent():
            self.screen.redraw_marks(*of, marks, reviewed)

    @contextmanager
    def _unless_silent(self) -> Iterator[None]:
        """Tell the reviewer if the viewer does not answer; what was done stays done."""
        try:
            yield
        except (ConnectionError, TimeoutError):
            self.say("the viewer did not answer: what was done is done, but not shown")

    def _play(self) -> None:
        start, end = self._chosen()
        self.say(self.listen(start, end))
        self.screen.play(start)

    def _look_around(self) -> None:
        cursor = self._cursor()
        self.look_closely(cursor - _AROUND, cursor + _AROUND)
        self.say(f"every frame from {self._text(cursor - _AROUND, cursor + _AROUND)}")

    def _begin_here(self) -> None:
        self._begin = self._cursor()
        self.say(f"from {local_time(self._begin, self.zone):%H:%M:%S}; set the end with ]")

    def _end_here(self) -> None:
        selection = self.screen.selection()
        start = self._begin if self._begin is not None else selection and selection[0]
        end = self._cursor()
        if start is None or start >= end:
            raise DataError("a span ends after it begins: put the cursor where it begins, press [")
        self._begin = None
        self.screen.show(start, end, _margin(start, end))
        self.say(self._text(start, end))

    def _cursor(self) -> int:
        cursor = self.screen.cursor()
        if cursor is None:
            raise DataError("there is no time cursor; click on the time axis first")
        return cursor

    def _chosen(self) -> tuple[int, int]:
        item = self.items[self._at] if self.items else None
        span = self.screen.selection() or (item and (item.start, item.end))
        if span is None:
            raise DataError(f"no span is marked: {_HELP} press a key")
        return span

    def _go(self, step: int) -> None:
        """Show the next or the previous item."""
        self._at = max(self._at + step, 0)
        if self._at >= len(self.items):
            return
        item = self.items[self._at]
        self.say(
            f"{self._at + 1}/{len(self.items)}  {self._text(item.start, item.end)}  {item.text}"
        )
        margin = _margin(item.start, item.end)
        with self._unless_silent():
            self.look_closely(item.start - margin, item.end + margin)
            self.screen.ask(item.start, item.end, _question(item))
            self.screen.show(item.start, item.end, margin)

    def _text(self, start: int, end: int) -> str:
        length = (end - start) / NANOSECONDS
        return f"{local_time(start, self.zone):%a %d %b %H:%M:%S} + {length:.1f} s"

    def _conclude(self) -> None:
        minutes = (time.monotonic() - self._began) / 60
        count = len(self._judged)
        spans = "1 span" if count == 1 else f"{count} spans"
        self.say(f"{spans} reviewed in {minutes:.1f} min, {count / minutes:.1f} a minute")


def _question(item: ReviewItem) -> str:
    if item.chosen == RANDOM:
        return "all of this minute?"
    return f"{_words(item.label)}? {(item.end - item.start) / NANOSECONDS:.1f} s"


def _words(label: str) -> str:
    return in_words(label).lower()


def _margin(start: int, end: int) -> int:
    return max(_LEAST_MARGIN, (end - start) // 2)
