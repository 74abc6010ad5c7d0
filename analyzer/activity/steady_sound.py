"""Steady sound: minutes that are labelled quiet, but louder than the other quiet around.

A model that does not know water, fans or machines labels their steady sound as quiet.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from hearthlog.analyzer.activity.event_counts import MINUTE
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.spans import NONE, Spans, joined, lengths
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.columns import Columns, read_columns

_LOUDER_DB = 8.0  # than the quiet around: a refrigerator adds about 3, a shower 14
_AROUND = 60  # quiet minutes before and after
_SHORTEST = 3 * MINUTE
_PAUSE = MINUTE  # with another sound in it
_QUIET_SHARE = 0.75  # of a quiet minute
_TINY = 1e-12


def read_steady_sound(
    logs: Iterable[Path], topic: str, quiet: Spans, start: int, end: int
) -> Spans:
    """Return when a microphone recorded steady sound, from the statistics of its features.

    Parameters
    ----------
    topic : str
        Of the statistics.
    quiet : Spans
        Labelled quiet.
    start, end : int
        Nanoseconds of UTC, of a day.
    """
    parts = [part for log in logs if (part := _read(log, topic, start, end)) is not None]
    if not parts:
        return NONE
    times, energy = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    return steady_sound(times, energy, quiet) if len(times) else NONE


def steady_sound(times: Int64, energy: Float64, quiet: Spans) -> Spans:
    """Return the steady sound among quiet minutes.

    Parameters
    ----------
    times : numpy.ndarray
        [shape=(n,)] in nanoseconds of UTC, in order.
    energy : numpy.ndarray
        [shape=(n,)] mean square of the sound of about a second.
    quiet : Spans
        Labelled quiet.
    """
    minutes, firsts = np.unique(times // MINUTE, return_index=True)
    edges = np.arange(minutes[0], minutes[-1] + 2) * MINUTE
    is_quiet = lengths(quiet, edges)[minutes - minutes[0]] >= _QUIET_SHARE * MINUTE
    if not is_quiet.any():
        return NONE
    middles = np.array([np.median(part) for part in np.split(energy, firsts[1:])])
    levels = 10 * np.log10(np.maximum(middles, _TINY))
    minutes, levels = minutes[is_quiet], levels[is_quiet]
    # A street may be 10 dB louder by day than at night: compared is the quiet of two hours around.
    padded = np.pad(levels, _AROUND, mode="symmetric" if len(levels) >= _AROUND else "edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1), axis=1)
    starts = minutes[levels >= around + _LOUDER_DB] * MINUTE
    spans = joined(starts, starts + MINUTE, _PAUSE)
    long = spans.ends - spans.starts >= _SHORTEST
    return Spans(spans.starts[long], spans.ends[long])


def _read(log: Path, topic: str, start: int, end: int) -> Sequence[Float64 | Int64] | None:
    """Return log times, which lie in the span, and mean energies; None if there are none."""
    try:
        columns = read_columns([log], [topic], start, end, ["mean"]).get(topic)
    except LogError:
        return None  # as without statistics
    return None if columns is None else _energies(columns)


def _energies(columns: Columns) -> Sequence[Float64 | Int64] | None:
    names, mean = array_names(columns.metadata, "mean"), columns["mean"]
    if "energy" not in names or mean.shape[1:] != (len(names),):
        return None
    return columns.log_times, mean[:, names.index("energy")].astype(np.float64)
