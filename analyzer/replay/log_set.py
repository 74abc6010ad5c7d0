"""The logs of a replay."""

from collections.abc import Sequence
from pathlib import Path

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, read_recorder_infos
from hearthlog.analyzer.replay.options import ReplayOptions
from hearthlog.schemas.errors import LogError, listed
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.merged_reading import time_spans

_NEVER = (1 << 63) - 1


class LogSet:
    """Logs of one microphone, in the order of their first messages.

    Parameters
    ----------
    paths : sequence of Path
        Layers and empty logs among them are left out.
    microphone : str or None
        Name of the microphone; None if there is one only.

    Attributes
    ----------
    first, last : int
        Log times of the first and the last message, in nanoseconds of UTC.

    Raises
    ------
    LogError
        If they hold no message, or one is damaged.
    """

    def __init__(self, paths: Sequence[Path], kind: str, microphone: str | None = None) -> None:
        spans = time_spans(paths)
        if not spans:
            raise LogError(f"{paths[0]}: no messages, nothing to replay")
        self.kind = kind
        self.first, self.last = spans[0][0], max(last for _, last, _ in spans)
        self._spans = spans
        self._microphone = microphone
        self._infos: dict[Path, list[RecorderInfo]] = {}

    def span(self, options: ReplayOptions) -> tuple[int, int]:
        """Return the span of time that is replayed.

        Returns
        -------
        start, end : int
            Log times in nanoseconds of UTC, from `start` on, before `end`; without a duration the
            end is the largest number of 64 bits.
        """
        start = self.first + round(options.start_offset * NANOSECONDS)
        if options.duration is None:
            return start, _NEVER
        return start, min(start + round(options.duration * NANOSECONDS), _NEVER)

    def chosen(self, options: ReplayOptions) -> list[RecorderInfo]:
        """Return the logs to replay.

        Returns
        -------
        list of RecorderInfo
            At least one, in the order of their first messages.

        Raises
        ------
        LogError
            If there is none, and as `between`.
        """
        infos = self.between(*self.span(options))
        if not infos:
            raise self.nothing()
        return infos

    def nothing(self) -> LogError:
        """Make the error that says that there is nothing to replay."""
        what = "clips" if self.kind == "audio" else "features"
        there = sorted({info.microphone for infos in self._infos.values() for info in infos})
        if self._microphone is not None and there and self._microphone not in there:
            return LogError(
                f"no microphone is called {self._microphone!r} there; choose {listed(there)}"
            )
        seconds = (self.last - self.first) / NANOSECONDS
        return LogError(f"no {what} to replay there; the logs last {seconds:.1f} s")

    def between(self, start: int, end: int) -> list[RecorderInfo]:
        """Return the logs that have messages in a span of time.

        Parameters
        ----------
        start, end : int
            Log times, in nanoseconds of UTC: from `start` on, before `end`.

        Returns
        -------
        list of RecorderInfo
            In the order of their first messages, without logs that have nothing of this kind.

        Raises
        ------
        LogError
            If they are of several microphones or nodes, or one is damaged or there twice.
        """
        infos: list[RecorderInfo] = []
        for first, last, path in self._spans:
            if first < end and last >= start:
                if path not in self._infos:
                    self._infos[path] = read_recorder_infos(path, self.kind)
                infos += self._infos[path]
        if self._microphone is not None:
            infos = [info for info in infos if info.microphone == self._microphone]
        names = sorted({f"{info.node}/{info.microphone}" for info in infos})
        if len(names) > 1:
            raise LogError(
                f"{infos[0].path}: these logs are of several microphones ({', '.join(names)}); "
                "replay one at a time, with --microphone or by naming only its logs"
            )
        by_frame: dict[tuple[int, int], RecorderInfo] = {}
        for info in infos:
            if info.first_frame is not None:
                same = by_frame.setdefault(info.first_frame, info)
                if same is not info:
                    raise LogError(f"{same.path} and {info.path} hold the same; leave out one")
        return infos
