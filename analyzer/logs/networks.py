"""With which networks of sounds the microphones of a home are heard, and since when."""

from collections.abc import Iterable
from contextlib import suppress
from datetime import tzinfo
from itertools import pairwise

from hearthlog.analyzer.logs.home_logs import HomeLog
from hearthlog.analyzer.logs.local_time import local_time
from hearthlog.analyzer.logs.recorder_info import embedding_source, microphones_of
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import EmbeddingSpace

_MOST = 4  # changes that are named


def network_changes(logs: Iterable[HomeLog], zone: tzinfo) -> list[str]:
    """Say when a home began to be heard with a network, with another one, or without any.

    Returns
    -------
    list of str
        A line for each microphone that is not always heard in one way.
    """
    heard: dict[tuple[str, str], list[tuple[int, EmbeddingSpace | None]]] = {}
    for log in logs:
        with suppress(LogError), LogFile(log.path) as file:
            for microphone in sorted(microphones_of(file, "features")):
                source = embedding_source(file, microphone)
                space = None if source is None else source.space
                heard.setdefault((log.node, microphone), []).append((log.start, space))
    return [
        f"{microphone}: {_changes(times, zone)}"
        for (_, microphone), times in sorted(heard.items())
        if len({space for _, space in times}) > 1
    ]


def _changes(times: list[tuple[int, EmbeddingSpace | None]], zone: tzinfo) -> str:
    parts = [f"heard {_with(times[0][1], None)}"]
    for (_, before), (start, space) in pairwise(times):
        if space != before:
            moment = f"{local_time(start, zone):%Y-%m-%d %H:%M}"
            parts.append(f"from {moment} {_with(space, before)}")
    if len(parts) > _MOST:
        parts = [parts[0], "…", *parts[1 - _MOST :]]
    text = ", ".join(parts)
    return f"{text}; only what one network heard is compared, all else by features"


def _with(space: EmbeddingSpace | None, before: EmbeddingSpace | None) -> str:
    if space is None:
        return "without a network"
    same = before is not None and before.network == space.network
    return f"with another projection of {space.network}" if same else f"with {space.network}"
