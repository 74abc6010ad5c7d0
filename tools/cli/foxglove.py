"""`hearthlog watch --foxglove`: what is heard, or what was, in Foxglove and Lichtblick."""

import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from hearthlog.tools.cli.text import TellOnce, tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.foxglove.server import Admission


def show_in_foxglove(
    logs: Path,
    port: int | None,
    bind: str | None,
    origin: str | None,
    span: tuple[int | None, int | None],
    stop: Event,
) -> bool:
    """Serve viewers, live or what is of a span of time; tell whether some could not be read."""
    from hearthlog.analyzer.foxglove.publisher import (
        Playback,
        Publisher,
        RecordedSpan,
        publish_live,
    )
    from hearthlog.analyzer.foxglove.server import PORT, Admission, serve
    from hearthlog.analyzer.ports import HOST, listen
    from hearthlog.schemas.logs.files import find_logs

    address = _checked_address(bind or HOST)
    origins = frozenset() if origin is None else frozenset({_checked_origin(origin)})
    admission = Admission(address, secrets.token_urlsafe(16), origins)
    damaged, publisher, player = TellOnce(), Publisher(), None
    if span != (None, None):
        recording = RecordedSpan(find_logs(logs), *span, damaged)
        for channel, schema in recording.channels.values():
            publisher.advertise(channel, schema)
        player = Playback(recording, publisher, stop)
    listener = listen(port or PORT, address)
    with (
        serve(listener, admission, TellOnce(), publisher, player) as server,
        _address_said(admission, port or PORT),
    ):
        if player is not None:
            player.play(server)
        else:
            publish_live(logs, publisher, stop, damaged)
    return bool(damaged)


@contextmanager
def _address_said(admission: "Admission", port: int) -> Iterator[None]:
    """Say where viewers connect; in a journal the name of a file that has the token for now."""
    from hearthlog.recorder.host import writes_to_journal

    host = f"[{admission.bind}]" if ":" in admission.bind else admission.bind
    place = f"{host}:{port}"
    address = f"ws://{place}/?token={admission.token}"
    with ExitStack() as until_the_end:
        if writes_to_journal():  # which others may read
            folder = until_the_end.enter_context(TemporaryDirectory(prefix="hearthlog-"))
            file = Path(folder) / "foxglove-address"
            file.write_text(f"{address}\n")  # the folder is this account's alone
            address = f"ws://{place}/; its whole address, which opens it, is in {file}"
        tell(f"open in Foxglove or Lichtblick: {address}")
        _say_who_reaches(admission, place)
        yield


def _say_who_reaches(admission: "Admission", place: str) -> None:
    if ip_address(admission.bind).is_loopback:
        tell(f"from another machine, first: ssh -L {place}:{place} and the name of this one")
    else:
        tell(
            f"listening on {admission.bind}: what is heard here crosses the network in the clear, "
            "and so does the token that lets one look; without --bind, only this machine is reached"
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
