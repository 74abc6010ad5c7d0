"""The folder of a fast month."""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hearthlog.schemas.logs.files import stem
from hearthlog.schemas.mcap.logfile import ACTIVE_SUFFIX
from hearthlog.tools.lab.month.faults import Fault

NODE = "home"
_RETENTION_DAYS = 12
_STATISTICS_DAYS = 4
_FEATURES_DAYS = 8


class MonthFolder:
    """Where the parts of a fast month are.

    Parameters
    ----------
    root : Path
    """

    def __init__(self, root: Path) -> None:
        self.logs = root / "logs"
        self.plan = root / "faults.json"
        self.state = root / "state"
        self.composed = root / "sound.flac"
        self.sound = root / "sound.npy"
        self.model = root / "model.safetensors"
        self.whole_model = root / "whole.safetensors"
        self.errors = root / "recorder.err"
        self._root = root
        self._synced = root / "synced.json"
        self._begun = root / "begun.txt"
        self._sizes: dict[str, int] = {}

    def write_plan(self, faults: Sequence[Fault]) -> None:
        """Write down what is to happen.

        Parameters
        ----------
        faults : sequence of Fault
        """
        self.plan.write_text(json.dumps([asdict(fault) for fault in faults], indent=0))

    def faults(self) -> list[Fault]:
        """Return what is to happen, in the order of time."""
        return [Fault(**fault) for fault in json.loads(self.plan.read_text())]

    def settings(self) -> dict[str, Any]:
        """Return the configuration of the recorder."""
        return {
            "output": self.logs,
            "node": NODE,
            "model": self.model,
            "timezone": "UTC",
            "retention_days": _RETENTION_DAYS,
            "drop_statistics_days": _STATISTICS_DAYS,
            "drop_features_days": _FEATURES_DAYS,
        }

    def replace_model(self, content: bytes) -> None:
        """Put another file in the place of the model.

        Parameters
        ----------
        content : bytes
        """
        new = self.model.with_suffix(".new")
        with suppress(OSError):
            new.write_bytes(content)
            new.replace(self.model)

    def note_synced(self, descriptor: int) -> None:
        """Note how long a file is, in place of waiting until it is on the disk.

        Parameters
        ----------
        descriptor : int
            Of the file.
        """
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        if not path.name.endswith(ACTIVE_SUFFIX):
            return
        if path.name not in self._sizes:
            self.note_begun(os.getpid(), stem(path))
        self._sizes[path.name] = os.fstat(descriptor).st_size
        new = self._synced.with_suffix(".new")
        with suppress(OSError):
            new.write_text(json.dumps(dict(list(self._sizes.items())[-8:])))
            new.replace(self._synced)

    def note_begun(self, process: int, log: str) -> None:
        """Note the next log that was begun.

        Parameters
        ----------
        process : int
            Number of the recorder's process.
        log : str
            Its stem.
        """
        with self._begun.open("a") as file:
            file.write(f"{process} {log}\n")

    def begun(self) -> list[tuple[int, str]]:
        """Return the number of the process and the stem of each log, in the order of recording."""
        if not self._begun.exists():
            return []
        lines = (line.split() for line in self._begun.read_text().splitlines())
        return [(int(process), log) for process, log in lines]

    def synced(self) -> Mapping[str, int]:
        """Return the sizes to which files are on the disk, by their names."""
        try:
            sizes: dict[str, int] = json.loads(self._synced.read_text())
        except (OSError, ValueError):
            return {}
        return sizes
