"""Embeddings of a network: ours, and the network's bare invocation; and their bytes in a log."""

from io import BytesIO

import numpy as np

from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES
from hearthlog.models.embedding.networks import (
    YAMNET,
    Embedder,
    EmbeddingStream,
    find_network,
    load_embedder,
)
from hearthlog.models.embedding.session import TfliteSession
from hearthlog.recorder.labelling.embedder_probe import probe_network
from hearthlog.recorder.stream.stages import embedding_messages
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS
from hearthlog.schemas.mcap.chunk_writer import GATHERED_SPAN, ChunkWriter
from hearthlog.tools.lab.bench.table import Row, Table, Target
from hearthlog.tools.lab.bench.timing import best_of
from hearthlog.tools.lab.bench.workload import Workload

_SECONDS = 60.0
_SECONDS_OF_LOG = 300.0
_DAY = 86_400
_AS_FAST = Target(0.8)
_SHARE = Target(1.0, at_most=True)
_MEGABYTES = Target(15.0, at_most=True)
_HOP_MS = 1e3 * HOP_FRAMES * FRAME_SECONDS


def measure(work: Workload) -> Table:
    """Measure the time of a window, beside that of the network alone, and the memory."""
    title = "embeddings: a window of a second, CPU time"
    path = find_network(YAMNET.name)
    if path is None:
        note = f"hearthlog models fetch {YAMNET.name}"
        return Table(title, [Row(f"hearthlog, {YAMNET.name}", None, note=note)])
    embedder, frames = load_embedder(YAMNET.name, path), work.frames(_SECONDS)
    sound, stamps = np.ones(len(frames), bool), np.arange(len(frames)) * FRAME_NANOSECONDS
    begins = range(0, len(frames) - WINDOW_FRAMES + 1, HOP_FRAMES)
    windows = [frames[begin : begin + WINDOW_FRAMES].ravel()[: YAMNET.window] for begin in begins]
    session = TfliteSession(path.read_bytes(), YAMNET.window, YAMNET.width, YAMNET.names)

    def alone() -> None:
        for window in windows:
            session(window)

    best = best_of(
        {"ours": lambda: EmbeddingStream(embedder).push(frames, sound, 0, stamps), "bare": alone}
    )
    ours, theirs = (1e3 * best[name].cpu / len(windows) for name in ("ours", "bare"))
    megabytes = probe_network(YAMNET.name, path).megabytes
    rows = [
        Row("hearthlog, window to logged integers", ours, "ms", theirs / ours, _AS_FAST),
        Row(f"{YAMNET.name} by LiteRT, bare", theirs, "ms"),
        Row("share of a core while there is sound", 100 * ours / _HOP_MS, "%", target=_SHARE),
        Row("a process that does nothing else", megabytes, "MB"),
        Row("in a log that is never quiet", _logged(embedder, work), "MB a day", target=_MEGABYTES),
    ]
    return Table(title, rows)


def _logged(embedder: Embedder, work: Workload) -> float:
    """Measure the embeddings of sounds in the chunks that a finished log has of them."""
    frames = work.frames(_SECONDS_OF_LOG)
    stamps = np.arange(len(frames)) * FRAME_NANOSECONDS
    found = EmbeddingStream(embedder).push(frames, np.ones(len(frames), bool), 0, stamps)
    stream = BytesIO()
    writer, begun = ChunkWriter(stream), 0
    for message in embedding_messages("mic", found, stamps[found.last_frames]):
        if message.log_time - begun >= GATHERED_SPAN:
            writer.flush()
            begun = message.log_time
        writer.add_message(1, message.log_time, message.data, message.log_time)
    writer.finish()
    return len(stream.getvalue()) * _DAY / (len(frames) * FRAME_SECONDS) / 1e6
