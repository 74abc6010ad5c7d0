"""A timeline that goes on: a server that viewers connect to, and leave, as they like."""

import errno
import socket
from collections.abc import Iterable, Sequence
from typing import Self

import rerun as rr
import rerun.blueprint as rrb

from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.timeline.live import (
    GAP_LANE,
    LIVE_LANE,
    NOT_HEARD,
    TROUBLE_LANE,
    TROUBLES,
    Lane,
    Means,
    News,
)
from hearthlog.analyzer.review.timeline.model import LogLines
from hearthlog.analyzer.review.viewer.canvas import TIMELINE, Canvas
from hearthlog.analyzer.review.viewer.drawing import OVERVIEW, SHARED_AXIS, lane
from hearthlog.analyzer.review.viewer.process import HOST

PORT = 9876  # where Rerun's viewer looks for a server if it is not told
_APPLICATION = "hearthlog_watch"  # of its own: viewers keep the layout of each
_MEMORY = "200MB"
_LINES = "events"
_CLOCK: tuple[Colour, Colour] = ((52, 60, 70), (32, 38, 46))
_BRIGHT: Colour = (235, 215, 140)
_NEW: Colour = (160, 200, 255)
_TROUBLE_COLOURS: tuple[Colour, ...] = ((240, 140, 40), (230, 60, 60), (150, 90, 160))
_PLACES = {LIVE_LANE: 1, GAP_LANE: 9, TROUBLE_LANE: 9}
_MOST_STATES = 2_000  # of a lane that get the colours of their own


class LiveServer:
    """Draws news for all who look, and keeps the last of it for those who come later.

    Nothing of it is sent anywhere but to viewers that connect.

    Parameters
    ----------
    port : int
    bind : str
        Address to listen on.
    minutes : float
        That the time axes show.
    memory : str
        How much is kept for viewers that come later; then the oldest is dropped.

    Raises
    ------
    DataError
        If it cannot listen there.

    Attributes
    ----------
    url : str
        Where viewers connect to.
    """

    def __init__(self, port: int, bind: str, minutes: float, memory: str = _MEMORY) -> None:
        check_port(port, bind)
        rr.set_strict_mode(True)  # or its mistakes become warnings
        self._recording = rr.RecordingStream(_APPLICATION)
        sink = rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=memory)
        self.url = sink.uri
        self._recording.set_sinks(sink)
        self._recording.send_recording_name("live")
        self._canvas = Canvas(self._recording)
        self._minutes = minutes
        self._microphones: dict[str, dict[str, list[tuple[str, ...]]]] = {}
        self._lanes: dict[str, dict[str, Colour]] = {}
        self._is_laid_out = True  # there is nothing to lay out

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recording.disconnect()

    def show(self, news: Iterable[News]) -> None:
        """Draw what is new."""
        for each in news:
            if isinstance(each, LogLines):
                self._canvas.write_lines(_LINES, each)
            elif isinstance(each, Lane):
                self._show_lane(each)
            elif len(each.times):
                self._show_means(each)
        if not self._is_laid_out:
            layout = _Layout(self._microphones, self._minutes)
            self._recording.send_blueprint(layout, make_active=True, make_default=True)
            self._is_laid_out = True

    def _show_lane(self, news: Lane) -> None:
        if news.microphone:
            entity = lane(OVERVIEW, news.microphone, _PLACES[news.name], news.name)
        else:
            entity = f"{OVERVIEW}/0_{news.name.replace('/', '-')}"
        states = {state for state in news.changes.states if state is not None}
        if entity not in self._lanes and not states:
            return  # a lane is there once it has something to show
        known = self._lanes.get(entity) or _colours_of(news)
        if entity not in self._lanes or (states - known.keys() and len(known) < _MOST_STATES):
            self._lanes[entity] = {state: colour(state) for state in sorted(states)} | known
            self._canvas.configure_lane(entity, self._lanes[entity])
        self._canvas.change_states(entity, *news.changes)

    def _show_means(self, news: Means) -> None:
        kinds = self._microphones.setdefault(news.microphone, {})
        known = kinds.setdefault(news.kind, [])
        new = news.names not in known
        if new:
            known.append(news.names)
        root = _ENTITIES[news.kind].format(news.microphone)
        entity = f"{root}/{known.index(news.names)}"
        if new:
            self._configure_means(entity, news)
            self._is_laid_out = False
        if news.kind == "shares":
            self._canvas.add_bands(entity, news.times, news.values)
        elif news.kind == "features":
            self._canvas.add_shades(entity, news.times, news.values)
        else:
            self._canvas.draw_lines(entity, news.times, news.values)

    def _configure_means(self, entity: str, news: Means) -> None:
        if news.kind == "shares":
            self._canvas.configure_bands(entity, news.names, [colour(name) for name in news.names])
        elif news.kind == "features":
            self._canvas.configure_heat_map(entity, news.names)
        else:
            tint = _BRIGHT if news.kind == "level" else _NEW
            self._canvas.configure_lines(entity, news.names, [tint])


_ENTITIES = {
    "shares": "{}/live/shares",
    "novelty": "{}/live/novelty",
    "level": "{}/level",
    "features": "{}/features",
}


def _colours_of(news: Lane) -> dict[str, Colour]:
    """Give the states that a lane is known to have their colours."""
    if not news.microphone:
        clock = [f"{hour:02}:{minute:02}" for hour in range(24) for minute in range(60)]
        return {text: _CLOCK[number % 2] for number, text in enumerate(clock)}
    if news.name == GAP_LANE:
        return {NOT_HEARD: GAP}
    if news.name == TROUBLE_LANE:
        return dict(zip(TROUBLES, _TROUBLE_COLOURS, strict=True))
    return {}


def check_port(port: int, bind: str = HOST) -> None:
    """Raise DataError unless one can listen there."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((bind, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise DataError(
                    f"port {port} is in use, perhaps by another viewer or watcher; choose another "
                    "one with --port"
                ) from error
            raise DataError(
                f"cannot listen on {bind}, port {port}: {error.strerror or error}"
            ) from error


class _Layout(rrb.Blueprint):
    """The views, whose time axes end with the newest data."""

    def __init__(
        self, microphones: dict[str, dict[str, list[tuple[str, ...]]]], minutes: float
    ) -> None:
        panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
        plots = [_plots(name, kinds) for name, kinds in sorted(microphones.items())]
        rows: list[tuple[int, rrb.View | rrb.Container]] = [
            (75 + 90 * len(plots), _lanes()),
            (580, plots[0] if len(plots) == 1 else rrb.Tabs(*plots)),
            (160, rrb.TextLogView(origin=_LINES, name="Events")),
        ]
        views = rrb.Vertical(*(view for _, view in rows), row_shares=[share for share, _ in rows])
        super().__init__(views, panel, collapse_panels=True)
        self._seconds = 60 * minutes

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        super()._log_to_stream(stream)
        boundary = rr.encodings.TimeRangeBoundary
        ends = (boundary.cursor_relative(seconds=seconds) for seconds in (-self._seconds, 0.0))
        stream.log(SHARED_AXIS, rrb.TimeAxis(view_range=rr.encodings.TimeRange(*ends)))


def _axis() -> rrb.TimeAxis:
    return rrb.TimeAxis(link="LinkToGlobal")


def _lanes() -> rrb.View:
    return rrb.StateTimelineView(origin=OVERVIEW, name="What is heard", time_view=_axis())


def _plots(microphone: str, kinds: dict[str, list[tuple[str, ...]]]) -> rrb.Container:
    rows: list[tuple[int, rrb.View]] = [
        (share, _plot(_ENTITIES[kind].format(microphone), kind, kinds[kind]))
        for kind, share in (("shares", 280), ("level", 120), ("novelty", 90), ("features", 180))
        if kind in kinds
    ]
    return rrb.Vertical(
        *(view for _, view in rows), row_shares=[share for share, _ in rows], name=microphone
    )


def _plot(origin: str, kind: str, names: Sequence[tuple[str, ...]]) -> rrb.View:
    name, scale = {
        "shares": ("How probable each class is", (0.0, 1.0)),
        "level": ("Level in dBFS", (-100.0, 0.0)),
        "novelty": ("Novelty: 0 as learnt, 1 never heard", (0.0, 1.0)),
        "features": (
            f"Features: 0 ({names[-1][0]}) to {len(names[-1]) - 1} ({names[-1][-1]}), dark is low",
            (-0.5, max(map(len, names)) - 0.5),
        ),
    }[kind]
    return rrb.TimeSeriesView(
        origin=origin,
        contents="$origin/**",
        name=name,
        axis_x=_axis(),
        axis_y=rrb.ScalarAxis(range=scale),
        plot_legend=rrb.PlotLegend(visible=kind == "shares", corner="LeftTop"),
    )
