"""`hearthlog watch`: a home live, in Rerun, in Foxglove, or as lines of text."""

import math
import secrets
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import tzinfo
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.new_files import check_new, new_file
from hearthlog.tools.cli.options import LogsFolder, Timezone, parse_span
from hearthlog.tools.cli.terminal import (
    ReportOnce,
    bar_of,
    cropped,
    print_notice,
    show_page,
    stopped_by,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.foxglove.server import Admission
    from hearthlog.analyzer.review.live import CurrentSound, CurrentSounds
    from hearthlog.analyzer.review.viewer.recording import LiveServer
    from hearthlog.analyzer.review.viewer.viewer import Viewer


def show_in_foxglove(
    logs: Path,
    port: int | None,
    bind: str | None,
    origin: str | None,
    span: tuple[int | None, int | None],
    stop: Event,
) -> bool:
    """Serve viewers, live or a time span; return whether some logs could not be read."""
    from hearthlog.analyzer.foxglove.publisher import (
        Playback,
        Publisher,
        RecordedSpan,
        publish_live,
    )
    from hearthlog.analyzer.foxglove.server import PORT, Admission, serve
    from hearthlog.analyzer.http import HOST, listen
    from hearthlog.schemas.logs.files import find_logs

    address = _checked_address(bind or HOST)
    origins = frozenset() if origin is None else frozenset({_checked_origin(origin)})
    admission = Admission(address, secrets.token_urlsafe(16), origins)
    damaged, publisher, player = ReportOnce(), Publisher(), None
    if span != (None, None):
        recording = RecordedSpan(find_logs(logs), *span, damaged)
        for channel, schema in recording.channels.values():
            publisher.advertise(channel, schema)
        player = Playback(recording, publisher, stop)
    listener = listen(port or PORT, address)
    with (
        serve(listener, admission, ReportOnce(), publisher, player) as server,
        _reported_address(admission, port or PORT),
    ):
        if player is not None:
            player.play(server)
        else:
            publish_live(logs, publisher, stop, damaged)
    return bool(damaged)


@contextmanager
def _reported_address(admission: "Admission", port: int) -> Iterator[None]:
    """Print where viewers connect; in a journal, a temporary file with the token instead."""
    from hearthlog.recorder.host import writes_to_journal

    host = f"[{admission.bind}]" if ":" in admission.bind else admission.bind
    place = f"{host}:{port}"
    address = f"ws://{place}/?token={admission.token}"
    with ExitStack() as until_the_end:
        if writes_to_journal():  # readable by others
            folder = until_the_end.enter_context(TemporaryDirectory(prefix="hearthlog-"))
            file = Path(folder) / "foxglove-address"
            file.write_text(f"{address}\n")  # only this account can read the folder
            address = f"ws://{place}/; its full address is in {file}"
        print_notice(f"open in Foxglove or Lichtblick: {address}")
        print_notice("panels with the names of this home: `hearthlog watch --layout home.json`")
        exposed = (
            f"listening on {admission.bind}: everything shown, and the access token, crosses the "
            "network unencrypted; without --bind only this machine is reachable"
        )
        _report_reach(place, "" if ip_address(admission.bind).is_loopback else exposed)
        yield


def _report_reach(place: str, exposed: str) -> None:
    """Print how another machine reaches a loopback address, or who reaches another one."""
    if exposed:
        print_notice(exposed)
    else:
        print_notice(
            f"from another machine, first: ssh -L {place}:{place} and the name of this one"
        )


def _checked_address(bind: str) -> str:
    try:
        return str(ip_address(bind))
    except ValueError:
        wrong_use(f"--bind {bind}: not an address in digits, such as 192.168.1.5")


def _checked_origin(origin: str) -> str:
    parts = urlsplit(origin.rstrip("/"))
    if (
        parts.scheme not in {"http", "https"}
        or parts.geturl() != f"{parts.scheme}://{parts.netloc}"
    ):
        wrong_use(f"--origin {origin}: not the address of a page without its path, as https://a.b")
    return parts.geturl()


_POLL_SECONDS = 0.2
_MINUTES = 5


def watch(
    logs: LogsFolder,
    *,
    web: Annotated[bool, typer.Option("--web", help="Use a browser.")] = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Open no viewer; wait for viewers to connect.")
    ] = False,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Wait for Foxglove or Lichtblick instead of Rerun.")
    ] = False,
    text: Annotated[
        bool, typer.Option("--text", help="Print the current sounds as lines in the terminal.")
    ] = False,
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="Port for viewers, or, with --web, of the page."),
    ] = None,
    bind: Annotated[
        str | None,
        typer.Option(
            help="With --serve or --foxglove: address of this machine to listen on; by default "
            "a loopback address, with --serve a random one."
        ),
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(help="With --foxglove: allowed web page, such as https://lichtblick.example."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="With --foxglove: play the recording from this log time, such as "
            "2026-03-01T07:00 (UTC unless it has an offset)."
        ),
    ] = None,
    end: Annotated[
        str | None,
        typer.Option(help="With --foxglove: play the recording up to this log time."),
    ] = None,
    layout: Annotated[
        Path | None,
        typer.Option(
            dir_okay=False,
            metavar="FILE",
            help="Write a layout with the microphones and classes of this home: for Foxglove and "
            "Lichtblick if FILE ends in .json, for PlotJuggler if in .xml.",
        ),
    ] = None,
    minutes: Annotated[
        int | None,
        typer.Option(min=1, max=120, help="Minutes to show.", show_default=str(_MINUTES)),
    ] = None,
    timezone: Timezone = None,
) -> None:
    """Show the labels live, until the viewer is closed or Ctrl-C is pressed.

    The recorder is not affected: only its logs are read. Exit status 3: some logs could not
    be read.
    """
    rerun = {"web": web, "serve": serve, "minutes": minutes, "timezone": timezone}
    served = {"origin": origin, "start": start, "end": end}
    network = {"port": port, "bind": bind}
    _check_options(rerun, served, network, layout, text=text, foxglove=foxglove)
    if layout is not None:
        _write_layout(logs, layout, serves=foxglove)
        if not foxglove:
            return
    stop = stopped_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    from hearthlog.analyzer.review.live import last_time
    from hearthlog.schemas.logs.files import check_allowed

    check_allowed(logs)
    newest = last_time(logs)
    if newest is None and start is None and end is None:
        print_notice(f"no log in {logs} yet; waiting for a recorder")
    if text:
        troubled = print_sounds(logs, newest, timezone, stop)
    elif foxglove:
        span = parse_span(start, end)
        troubled = show_in_foxglove(logs, port, bind, origin, span, stop)
    else:
        shown = (port, bind, minutes or _MINUTES, timezone)
        troubled = _show_in_rerun(logs, newest, *shown, stop, web=web, serve=serve)
    if troubled:
        raise typer.Exit(3)


def _check_options(
    rerun: Mapping[str, object],
    served: Mapping[str, object],
    network: Mapping[str, object],
    layout: Path | None,
    *,
    text: bool,
    foxglove: bool,
) -> None:
    """Check that options of Rerun, of Foxglove's server, and of both fit what is shown."""
    if rerun["web"] and rerun["serve"]:
        wrong_use("--web opens a viewer here, --serve opens none: choose one")
    if text:
        others = {**rerun, **network, "foxglove": foxglove, "layout": layout, "timezone": None}
        _check_given("does not go with --text", **others)
    elif foxglove:
        _check_given("does not go with --foxglove", **rerun)
    elif layout is not None:
        _check_given("does not go with --layout", **rerun, **network)
    if network["bind"] is not None and not (rerun["serve"] or foxglove):
        wrong_use("--bind goes with --serve or --foxglove")
    if not foxglove:
        _check_given("goes with --foxglove", **served)


def _write_layout(logs: Path, file: Path, *, serves: bool) -> None:
    from hearthlog.analyzer.foxglove.layouts import (
        FOXGLOVE_SUFFIX,
        PLOTJUGGLER_SUFFIX,
        foxglove_layout,
        microphones_to_lay_out,
        plotjuggler_layout,
    )
    from hearthlog.analyzer.logs.home_logs import find_home_logs

    kinds = {
        FOXGLOVE_SUFFIX: (foxglove_layout, "Foxglove or Lichtblick: Layouts, Import from file"),
        PLOTJUGGLER_SUFFIX: (plotjuggler_layout, "PlotJuggler: Layout, after a log is opened"),
    }
    if file.suffix not in kinds:
        wrong_use(f"--layout {file}: must end in .json for Foxglove, or in .xml for PlotJuggler")
    check_new(file)
    write, where = kinds[file.suffix]
    text = write(microphones_to_lay_out(find_home_logs([logs])))
    with new_file(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if serves:
        print_notice(f"layout: {file.resolve()}; open it in {where}")
    else:
        print(file.resolve())
        print_notice(f"open it in {where}")


def _check_given(how: str, **options: object) -> None:
    for name, value in options.items():
        if value:
            wrong_use(f"--{name} {how}")


def _show_in_rerun(
    logs: Path,
    newest: int | None,
    port: int | None,
    bind: str | None,
    minutes: int,
    timezone: str | None,
    stop: Event,
    *,
    web: bool,
    serve: bool,
) -> bool:
    """Draw new data until stopped; return whether something could not be read."""
    from hearthlog.analyzer.logs.local_time import home_zone

    home_zone(timezone)
    with ExitStack() as opened:
        server = opened.enter_context(_server(port, bind, minutes, web=web))
        viewer = None
        if serve:
            _report_address(server.url, bind)
        else:
            viewer = opened.enter_context(_open(server.url, port, web=web))
            Thread(target=_wait_until_closed, args=(viewer, stop), daemon=True).start()
        start = 0 if newest is None else newest - minutes * 60_000_000_000
        troubled = _follow(logs, start, timezone, server, stop)
        if viewer is not None:
            viewer.check()
    return troubled


def _server(port: int | None, bind: str | None, minutes: int, *, web: bool) -> "LiveServer":
    from hearthlog.analyzer.http import free_port, hidden_address
    from hearthlog.analyzer.review.viewer.recording import PORT, LiveServer

    if bind is not None:
        return LiveServer(port or PORT, bind, minutes)
    bind = hidden_address()
    return LiveServer(free_port(None if web else port, bind), bind, minutes)


def _open(url: str, port: int | None, *, web: bool) -> "Viewer":
    from hearthlog.analyzer.review.viewer.viewer import open_window
    from hearthlog.analyzer.review.viewer.web import open_page

    if not web:
        return open_window(data=url)
    viewer = open_page(port, url)
    show_page(viewer.address)
    return viewer


def _report_address(url: str, bind: str | None) -> None:
    from hearthlog.analyzer.review.viewer.process import hidden_options

    print_notice(f"open with: rerun {hidden_options()} --connect {url}")
    exposed = (
        f"listening on {bind}: anybody who reaches this port, even a web page in a browser, sees "
        "everything shown; without --bind only users of this machine can"
    )
    _report_reach(urlsplit(url).netloc, exposed if bind is not None else "")


def _wait_until_closed(viewer: "Viewer", stop: Event) -> None:
    while viewer.is_open() and not stop.wait(_POLL_SECONDS):
        pass
    stop.set()


def _follow(
    logs: Path, start: int, timezone: str | None, server: "LiveServer", stop: Event
) -> bool:
    """Draw new data until stopped; return whether something could not be read."""
    from hearthlog.analyzer.logs.layers import zone_of
    from hearthlog.analyzer.review.live import CurrentSounds, LiveTimeline
    from hearthlog.schemas.logs.follow import follow_messages

    damaged = ReportOnce()
    live, sounds, zone = LiveTimeline(), CurrentSounds(logs, damaged), None
    sounds.hide()
    for path, batch in follow_messages(logs, start=start, stop=stop, damaged=damaged, ticks=True):
        try:
            if path == logs:
                sounds.is_live = True
            else:
                zone = zone or zone_of([logs], timezone)
                sounds.push(path, batch)
                live.hidden = sounds.hidden
                server.show(live.take(path, batch), zone)
        except LogError as error:
            damaged(error)
        if zone is not None and sounds.is_live:
            sounds.hide()
            server.show_current(sounds, zone)
        if stop.is_set():
            break
    return bool(damaged)


_LINE_SECONDS = 1.0  # between two updates
_LONGEST = 60.0  # seconds between two lines of a microphone, without a terminal
_QUIETEST, _LOUDEST = -70.0, -10.0  # dBFS at the ends of the bar of the level
_UP_AND_CLEAR = "\x1b[{}F\x1b[J"  # to the first of so many lines; clear from there


def print_sounds(logs: Path, newest: int | None, timezone: str | None, stop: Event) -> bool:
    """Print the current sounds until stopped; return whether something could not be read."""
    from hearthlog.analyzer.logs.layers import zone_of
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.analyzer.review.live import CurrentSounds
    from hearthlog.schemas.logs.follow import follow_messages

    home_zone(timezone)
    damaged, zone = ReportOnce(), None
    sounds = CurrentSounds(logs, damaged)
    lines = _SoundLines(sounds)
    start = None if newest is None else newest - _EARLIER_SECONDS * NANOSECONDS
    due = 0.0
    for path, batch in follow_messages(logs, start=start, stop=stop, damaged=damaged, ticks=True):
        sounds.is_live |= path == logs
        try:
            sounds.push(path, batch)
        except LogError as error:
            damaged(error)
        if sounds.is_live and sounds.microphones and time.monotonic() >= due:
            due = time.monotonic() + _LINE_SECONDS
            sounds.hide()
            zone = zone or zone_of([logs], timezone)
            lines.update(zone)
        if stop.is_set():
            break
    return bool(damaged)


_EARLIER_SECONDS = 300  # read at the start, for how long a sound has lasted


class _SoundLines:
    """Lines of microphones: redrawn in place on a terminal, else printed at changes."""

    def __init__(self, sounds: "CurrentSounds") -> None:
        self._sounds = sounds
        self._shown: dict[str, str] = {}  # by microphone: the line on the screen
        self._states: dict[str, str] = {}  # by microphone: the sound
        self._printed: dict[str, float] = {}  # by microphone: when, by CLOCK_MONOTONIC

    def update(self, zone: tzinfo) -> None:
        """Write what has changed."""
        sounds = self._sounds.microphones
        width = max(len(self._name(one)) for one in sounds.values())
        lines = {name: self._line(one, zone, width) for name, one in sorted(sounds.items())}
        words = self._sounds.words
        states = {name: words(one) if one.is_listening() else "" for name, one in sounds.items()}
        changed = [name for name in lines if self._states.get(name) != states[name]]
        if sys.stdout.isatty():
            ended = [self._shown[name] for name in changed if name in self._shown]
            back = _UP_AND_CLEAR.format(len(self._shown)) if self._shown else ""
            own = [cropped(line) for line in lines.values()]
            print(f"{back}{chr(10).join([*ended, *own])}", flush=True)
            self._shown = dict(zip(lines, own, strict=True))
        else:
            now = time.monotonic()
            for name, line in lines.items():
                if name in changed or now - self._printed[name] >= _LONGEST:
                    print(line, flush=True)
                    self._printed[name] = now
        self._states = states

    def _name(self, sound: "CurrentSound") -> str:
        from hearthlog.analyzer.review.live import microphone_words

        return microphone_words(sound.microphone)

    def _line(self, sound: "CurrentSound", zone: tzinfo, width: int) -> str:
        from hearthlog.analyzer.logs.local_time import local_time
        from hearthlog.analyzer.review.live import lasting, silent_since

        is_listening = sound.is_listening()
        moment = local_time(sound.time if is_listening else time.time_ns(), zone)
        start = f"{moment:%H:%M:%S}  {self._name(sound):{width}}  "
        if not is_listening:
            return start + silent_since(sound, zone)
        words = f"{self._sounds.words(sound)} {sound.confidence:.0%} {lasting(sound)}"
        words = words.replace("%", " %", 1)
        if math.isnan(sound.level_dbfs):
            return start + words
        share = (sound.level_dbfs - _QUIETEST) / (_LOUDEST - _QUIETEST)
        return f"{start}{words:32}  {bar_of(share)} {sound.level_dbfs:.0f} dBFS"
