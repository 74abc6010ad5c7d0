"""`python -m hearthlog.tools.lab.month FOLDER`: a month of a recorder, fast, with faults."""

import shutil
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import soundfile
import typer

from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.home.simulate import write_day
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.month.faults import KINDS, plan_faults
from hearthlog.tools.lab.month.folders import MonthFolder
from hearthlog.tools.lab.month.summary import summarize
from hearthlog.tools.lab.month.watch import Watcher

_SOUND = 120.0  # minutes that are composed for a day of the recorder
_MOST_SOUND = 240.0


def month(
    output: Annotated[Path, typer.Argument(help="New folder.")],
    days: Annotated[float, typer.Option(min=0.05, max=366)] = 30.0,
    faults: Annotated[int, typer.Option(min=0, max=10_000)] = 200,
    kinds: Annotated[
        list[str] | None, typer.Option("--kind", help="Only faults of this kind.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another one makes other faults.")] = 0,
) -> None:
    """Run the recorder through days on a clock as fast as it can work, and through faults.

    Exit status 1: something is lost that is in no gap, or a target is missed; the lines say what.
    """
    unknown = [name for name in kinds or () if name not in KINDS]
    if unknown:
        raise HearthlogError(f"no fault is called {unknown[0]!r}; there are {', '.join(KINDS)}")
    if output.exists():
        raise HearthlogError(f"{output}: exists already; name a new folder")
    output.mkdir(parents=True)
    folder = MonthFolder(output)
    _compose(folder, min(days * _SOUND, _MOST_SOUND), seed)
    for model in (folder.model, folder.whole_model):
        shutil.copy(starter_file(GENERAL), model)
    plan = plan_faults(days, faults, seed, [name for name in KINDS if name in (kinds or KINDS)])
    folder.write_plan(plan)
    arguments = [str(output), str(days), str(seed)]
    began = time.monotonic()
    record = Watcher(folder, arguments, plan, seed).watch(int(days * 86_400) * NANOSECONDS)
    took = time.monotonic() - began
    print(f"{days:g} days in {took / 60:.0f} minutes, {days * 86_400 / took:.0f} times as fast")
    summary = summarize(record, plan, folder)
    print("\n".join(summary.lines))
    if summary.missed:
        sys.exit(1)


def _compose(folder: MonthFolder, minutes: float, seed: int) -> None:
    write_day(folder.composed, minutes, seed=seed)
    samples, _ = soundfile.read(folder.composed, dtype="int16")
    np.save(folder.sound, samples)


def main() -> None:
    """Run the command; one line on standard error says what is wrong."""
    run(month)


if __name__ == "__main__":
    main()
