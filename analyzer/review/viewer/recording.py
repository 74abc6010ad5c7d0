"""Rerun recording of a timeline: in a file, or on a server for viewers."""

import os
import shutil
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, tzinfo
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.review.lanes import (
    DIRECTION,
    FEATURES,
    FLOOR,
    NOVELTY,
    PLOTS,
    PROBABILITIES,
    RECORDER,
    Checked,
    StateLane,
    sure_state,
)
from hearthlog.analyzer.review.live import (
    CurrentSound,
    CurrentSounds,
    Update,
    lasting,
    microphone_words,
    silent_since,
)
from hearthlog.analyzer.review.timeline import LogLines, Plot, Timeline, home_clock
from hearthlog.analyzer.review.timeline_reader import read_frames
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import (
    APPLICATION,
    LINES,
    NOTHING,
    WORDS,
    Boundary,
    Row,
    TimelineBlueprint,
    draw,
    draw_frames,
    draw_plot,
    lines_view,
    names_view,
    plot_entity,
    plot_view,
    review_layout,
    stack,
    states_view,
    tabs,
    text_view,
    write_checked,
)
from hearthlog.models.classes import Colour, in_words, ordered
from hearthlog.schemas.arrays import Bool
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS, time_text
from hearthlog.schemas.new_files import check_new, new_file

SUFFIX = ".rrd"


def check_output(output: Path) -> None:
    """Check that a recording can be saved under this name.

    Raise `DataError` if the name does not end in `.rrd`, the file exists, or its folder does not
    exist or cannot be written.
    """
    if output.suffix != SUFFIX:
        raise DataError(f"{output}: the name of a Rerun recording must end in {SUFFIX}")
    try:
        check_new(output)
    except LogError as error:
        raise DataError(str(error)) from error


def save_timeline(timeline: Timeline, output: Path, checked: Checked | None = None) -> None:
    """Write a timeline into a Rerun recording (`.rrd`).

    This sends no usage statistics and opens no port; only Rerun's viewer does.

    Raise `DataError` if the name has another suffix, the file exists, or it cannot be written.
    """
    check_output(output)
    try:
        with new_file(output) as temporary:
            _write(timeline, temporary, checked or {})
    except LogError as error:
        raise DataError(str(error)) from error


def _write(timeline: Timeline, output: Path, checked: Checked) -> None:
    """Write a recording through a pipe: writing to a file, Rerun hangs on a full disk."""
    rr.set_strict_mode(True)  # otherwise its errors become warnings, and the file is wrong
    recording = rr.RecordingStream(APPLICATION)
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as thread:
        pipe = Path(folder, "recording")
        os.mkfifo(pipe)
        written = thread.submit(_copy, pipe, output)
        recording.save(pipe)
        try:
            recording.send_blueprint(review_layout(timeline))
            canvas = Canvas(recording, timeline.clock)
            name_recording(recording, timeline)
            draw(timeline, canvas)
            write_checked(timeline, checked, canvas)
            for part in read_frames(timeline):
                draw_frames(part, canvas)
        finally:
            recording.disconnect()
        written.result()


def _copy(pipe: Path, output: Path) -> None:
    with pipe.open("rb") as source:
        try:
            with output.open("wb") as file:
                shutil.copyfileobj(source, file)
        except OSError:
            while source.read(1 << 20):  # to the end, otherwise nobody could close it
                pass
            raise


def name_recording(recording: rr.RecordingStream, timeline: Timeline) -> None:
    """Set the start and the name of a recording, from its span."""
    start, end = (timeline.clock.shown(time) for time in (timeline.grid.start, timeline.grid.end))
    recording.send_recording_start_time_nanos(start)
    recording.send_recording_name(f"{time_text(start):.16} to {time_text(end):.16}")


PORT = 9876  # default server port of Rerun's viewer
_APPLICATION = "hearthlog_watch"  # separate: viewers keep the layout of each application
_MEMORY = "20MB"
_TOGETHER = 4 * NANOSECONDS  # minimum per plot message: each costs a viewer kilobytes for ever
_STATES = "lanes"  # entity of all lanes
_LANES_NAME = f"{WORDS}/lanes"
_CURRENT = "current"  # root of the texts of the current sounds
# Heights in points of a window of 768: large letters, lanes, a row of a class, and so on.
_TEXT_HEIGHT, _COLUMNS = 76, 2  # of the texts of microphones
_HEAD_HEIGHT, _LANE_HEIGHT, _ROW_HEIGHT, _AXIS_HEIGHT = 44, 42, 27, 24
_PLOTS_HEIGHT = 540
_DETAILS, _DETAILS_HEIGHT = {DIRECTION, NOVELTY, FEATURES}, 150  # plots in tabs
# Widths of a text and of a view in a window of 1366: all plots begin at 200, after their numbers.
_LANE_COLUMNS, _ROW_COLUMNS, _LEVEL_COLUMNS = (200, 1166), (183, 1183), (160, 1206)
_DETAILS_COLUMNS = 182, 1184
_STEP_SECONDS = 1, 10, 60  # between updates of a sound: in the first 10 s, the first minute, later
_LEAST_CHANGE = 0.1  # of a confidence, for an update
_WORDLESS, _LETTER = " ", 8.0  # after a state without its word; points of a letter
_MOST_NAMED = 8  # microphones in the text
_MOST_STATES = 2_000  # maximum of a lane's states with their own colours

Plots = dict[str, list[Plot]]  # by entity: the first plot of each set of names


class LiveServer:
    """Draws updates for all connected viewers, and keeps recent data for later viewers.

    Lanes and lines are drawn at once, plots every few seconds. `memory` is the maximum data kept
    for later viewers, as `20MB`; then the oldest is dropped. Raise `DataError` if it cannot listen
    there.
    """

    def __init__(self, port: int, bind: str, minutes: float, memory: str = _MEMORY) -> None:
        free_port(port, bind)
        rr.set_strict_mode(True)  # otherwise its errors become warnings
        self._recording = rr.RecordingStream(_APPLICATION)
        sink = rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=memory)
        self.url = sink.uri
        self._recording.set_sinks(sink)
        self._recording.send_recording_name("live")
        self._canvas: Canvas | None = None  # None until the clock of the home is known
        self._minutes = minutes
        self._first, self._is_full = 0, False
        self._plots: Plots = {}
        self._waiting: dict[str, list[Plot]] = {}  # by entity: plots too short to be sent yet
        self._lanes: dict[str, dict[str, Colour]] = {}
        self._is_laid_out = True  # there is nothing to lay out
        self._current: dict[str, tuple[str, int, float]] = {}  # by microphone: what was last shown

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.disconnect()

    def show(self, updates: Iterable[Update], zone: tzinfo = UTC) -> None:
        """Draw updates, and redo the layout for each new plot.

        A change of the home's clock starts an axis of the new time.
        """
        for update in updates:
            if len(update.times):
                self._show(update, self._canvas_at(int(update.times[-1]), zone))
                self._fill(int(update.times[0]), int(update.times[-1]))
        if self._canvas is not None and self._plots and not self._is_laid_out:
            self._canvas.write(_LANES_NAME, "What is heard")
            begin = (
                Boundary.cursor_relative(seconds=-60 * self._minutes)
                if self._is_full
                else Boundary.absolute(nanos=self._canvas.clock.shown(self._first))
            )
            layout = _layout(self._plots, begin, self._canvas.clock.name)
            self._recording.send_blueprint(layout, make_active=True, make_default=True)
            self._is_laid_out = True

    def show_current(self, sounds: CurrentSounds, zone: tzinfo) -> None:
        """Show in large letters what is heard now, if it has changed enough.

        Each update costs a viewer some kilobytes that it never drops.
        """
        named = [one for _, one in sorted(sounds.microphones.items()) if one.time][:_MOST_NAMED]
        for one in named:
            step, last = _step(one, sounds), self._current.get(one.microphone)
            if last is not None and step[:2] == last[:2] and abs(step[2] - last[2]) < _LEAST_CHANGE:
                continue
            self._current[one.microphone] = step
            canvas = self._canvas_at(one.time, zone)
            clock = canvas.clock
            lane = f"{_STATES}/{one.microphone}/{RECORDER.name}"
            if not one.is_listening() and lane in self._lanes:  # or its last sound would go on
                canvas.change_states(lane, np.array([one.time]), [None])
            time = np.datetime64(clock.shown(one.time), "ns")
            heading = _heading(one, sounds, zone, several=len(named) > 1)
            self._recording.send_columns(
                f"{_CURRENT}/{one.microphone}",
                [rr.TimeColumn(clock.name, timestamp=[time])],
                rr.TextDocument.columns(text=[heading], media_type=["text/markdown"]),
            )

    def _fill(self, first: int, last: int) -> None:
        """Note the times of an update: the axes begin with the first until they are full."""
        self._first = min(first, self._first or first)
        if not self._is_full and last - self._first >= self._minutes * 60 * NANOSECONDS:
            self._is_full, self._is_laid_out = True, False

    def _canvas_at(self, time: int, zone: tzinfo) -> Canvas:
        clock = home_clock(zone, time, time + 1)
        if self._canvas is None or self._canvas.clock != clock:
            self._canvas = Canvas(self._recording, clock)
            self._is_laid_out = False
        return self._canvas

    def _show(self, update: Update, canvas: Canvas) -> None:
        if isinstance(update, LogLines):
            canvas.write_lines(LINES, update)
        elif isinstance(update, StateLane):
            self._show_lane(update, canvas)
        else:
            self._show_plot(update, canvas)

    def _show_lane(self, lane: StateLane, canvas: Canvas) -> None:
        entity = f"{_STATES}/{lane.microphone}/{lane.kind.name}"
        if lane.kind is RECORDER:
            lane = lane._replace(states=self._without_cut_words(lane))
        states = {state for state in lane.states if state is not None}
        if entity not in self._lanes and not states:
            return  # a lane appears with its first state
        colours = self._lanes.get(entity) or lane.kind.colours(lane.kind.states)
        if entity not in self._lanes or (states - colours.keys() and len(colours) < _MOST_STATES):
            known = {state.removesuffix(_WORDLESS): None for state in states}
            shades = lane.kind.colours(ordered(known))
            shades |= {f"{state}{_WORDLESS}": shade for state, shade in shades.items()}
            self._lanes[entity] = shades | colours
            names = [_state_name(state) for state in self._lanes[entity]]
            canvas.configure_states(entity, self._lanes[entity], names)
        canvas.change_states(entity, lane.times, lane.states)

    def _without_cut_words(self, lane: StateLane) -> list[str | None]:
        """Return the states, without a word those that are too short for it."""
        states = np.array(lane.states, object)
        first = np.flatnonzero(np.append(True, states[1:] != states[:-1]))
        ends = np.append(lane.times[first[1:]], lane.times[-1] + NANOSECONDS)
        points = (ends - lane.times[first]) * (_LANE_COLUMNS[1] / (60e9 * self._minutes))
        for begin, end, width in zip(first, [*first[1:], len(states)], points, strict=True):
            state = states[begin]
            if state is not None and width < _LETTER * len(_state_name(state)) + _LETTER:
                states[begin:end] = f"{state}{_WORDLESS}"
        return states.tolist()

    def _show_plot(self, plot: Plot, canvas: Canvas) -> None:
        """Draw into the entity of these names; another model or feature set has its own."""
        root = plot_entity(plot)
        same = self._plots.setdefault(root, [])
        names = [each.names for each in same]
        is_new = plot.names not in names
        entity = f"{root}/{len(names) if is_new else names.index(plot.names)}"
        if is_new:
            same.append(plot._replace(times=plot.times[:0], values=plot.values[:0]))
            _write_names(plot, canvas)
            self._is_laid_out = False
        waiting = [*self._waiting.pop(entity, []), plot]
        if is_new or abs(int(plot.times[-1] - waiting[0].times[0])) >= _TOGETHER:
            joined = _joined(waiting)
            if plot.kind is PROBABILITIES:  # pieces of a row must not overlap, or they are dots
                joined, rest = _complete_seconds(joined)
                self._waiting[entity] = [rest]
            draw_plot(joined, entity, canvas, is_new=is_new)
        else:
            self._waiting[entity] = waiting


def _state_name(state: str) -> str:
    """Return what is written on a state, of a space those without a word."""
    name = sure_state(state)
    doubt = state[len(name) :]
    return " " if state.endswith(_WORDLESS) else f"{in_words(name)}{doubt}"


def _step(sound: CurrentSound, sounds: CurrentSounds) -> tuple[str, int, float]:
    """Return the words of a sound, the step of its length, and its confidence."""
    if not sound.is_listening():
        return "", 0, 0.0
    seconds = (sound.time - sound.since) / NANOSECONDS
    first, second, third = _STEP_SECONDS
    step = first if seconds < 10 else second if seconds < 60 else third
    return sounds.words(sound), int(seconds // step) + sound.since, sound.confidence


def _heading(sound: CurrentSound, sounds: CurrentSounds, zone: tzinfo, *, several: bool) -> str:
    """Return a heading of Markdown for a microphone."""
    if sound.is_listening():
        confidence = f"{100 * sound.confidence:.0f} %"
        parts = [sounds.words(sound), confidence, lasting(sound)]
    else:
        parts = [silent_since(sound, zone)]
    return f"# {' · '.join([microphone_words(sound.microphone)] * several + parts)}"


def _joined(parts: Sequence[Plot]) -> Plot:
    times = np.concatenate([part.times for part in parts])
    return parts[0]._replace(times=times, values=np.concatenate([part.values for part in parts]))


def _complete_seconds(plot: Plot) -> tuple[Plot, Plot]:
    """Return one row for each complete second, and the rows of the last second."""
    plot = _rows_of(plot, ~np.isnan(plot.values).all(axis=1))
    seconds = plot.times // NANOSECONDS
    is_last = seconds == (seconds[-1] if len(seconds) else 0)
    ends = np.append(np.diff(seconds) != 0, True)[: len(seconds)]
    complete = _rows_of(plot, ends & ~is_last)
    middles = complete.times // NANOSECONDS * NANOSECONDS + NANOSECONDS // 2
    return complete._replace(times=middles), _rows_of(plot, is_last)


def _rows_of(plot: Plot, rows: Bool) -> Plot:
    return plot._replace(times=plot.times[rows], values=plot.values[rows])


def _layout(plots: Plots, begin: Boundary, clock: str) -> TimelineBlueprint:
    """Lay out the views, whose time axes end with the newest data."""
    microphones = sorted({same[0].microphone for same in plots.values()})
    named = microphones[:_MOST_NAMED]
    views = (rrb.TextDocumentView(origin=f"{_CURRENT}/{name}", titlebar=False) for name in named)
    lines = -(-len(named) // _COLUMNS)
    current = rrb.Grid(*views, grid_columns=min(len(named), _COLUMNS))
    lanes = rrb.Horizontal(
        text_view(_LANES_NAME), states_view(_STATES, "Heard"), column_shares=_LANE_COLUMNS
    )
    rows: list[Row] = [
        (_TEXT_HEIGHT * lines, current),
        (_HEAD_HEIGHT + _LANE_HEIGHT * len(microphones), lanes),
        (_PLOTS_HEIGHT, tabs(_stack_plots(name, plots) for name in microphones)),
    ]
    panel = rrb.TimePanel(state="collapsed", timeline=clock, play_state="following")
    return TimelineBlueprint(rows, panel, begin, Boundary.cursor_relative(seconds=0.0))


def _stack_plots(microphone: str, plots: Plots) -> rrb.Container:
    """Show the plots of a microphone next to their names; some share tabs with the events."""
    rows: list[Row] = []
    details = []
    for title in dict.fromkeys(kind.title for kind in PLOTS):
        shown = {
            root: same
            for root, same in plots.items()
            if same[0].kind.title == title and same[0].microphone == microphone
        }
        if not shown:
            continue
        first = [plot for same in shown.values() for plot in same]
        view = plot_view(first, list(shown), live=True)
        if first[0].kind in _DETAILS:
            left = text_view(NOTHING)  # else its times would not lie below those of the others
            own = rrb.Horizontal(left, view, column_shares=_DETAILS_COLUMNS, name=view.name)
            details.append(own)
            continue
        names = [_name_entity(first[0], row) for row in range(max(map(_row_count, first)))]
        height, columns = first[0].kind.height, _LEVEL_COLUMNS
        texts: rrb.View | rrb.Container = text_view(names[0])
        if first[0].kind is PROBABILITIES:
            height, columns = _ROW_HEIGHT * len(names) + _AXIS_HEIGHT, _ROW_COLUMNS
            texts = names_view(names, len(names))
        rows.append((height, rrb.Horizontal(texts, view, column_shares=columns)))
    rows.append((_DETAILS_HEIGHT, tabs([*details, lines_view()])))
    return stack(rows, microphone)


def _write_names(plot: Plot, canvas: Canvas) -> None:
    """Write what is next to a plot: the names of its rows, or its title."""
    canvas.write(NOTHING, "")
    names = [*map(in_words, ordered(plot.names))] if plot.kind is PROBABILITIES else [plot.title]
    for row, name in enumerate(names):
        canvas.write(_name_entity(plot, row), name)


def _row_count(plot: Plot) -> int:
    return len(plot.names) if plot.kind is PROBABILITIES else 1


def _name_entity(plot: Plot, row: int) -> str:
    kind = "level" if plot.kind is FLOOR else plot.kind.name
    return f"{WORDS}/{plot.microphone}/{kind}/{row:02}"
