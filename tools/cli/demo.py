"""`hearthlog demo`: from sound to a timeline, on a day of a simulated home."""

import shutil
import sys
import time
from pathlib import Path
from threading import Event as Flag
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.schemas.errors import HearthlogError
from hearthlog.tools.cli.options import parse_time, starter_here

if TYPE_CHECKING:
    from hearthlog.models.classifiers.model import Model
    from hearthlog.tools.home.simulate import LabelledSpan, Truth

_START = "2026-03-01T00:00:00"
_SEED = 1
_DENSE_MINUTES = 240  # shortest day that is not taken for a television
_POLL_SECONDS = 0.2


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to make.")] = Path("demo"),
    minutes: Annotated[
        float, typer.Option(min=1, max=1440, help="Length of the simulated day.")
    ] = 24.0,
    look: Annotated[bool, typer.Option("--open", help="Show the day in Rerun at the end.")] = False,
) -> None:
    """Compose a day of a home, record it with the starter model, and draw the result."""
    from hearthlog.analyzer.errors import require

    require("scipy", "rerun", "rerun_cli")
    from hearthlog.analyzer.review.timeline_reader import read_timeline
    from hearthlog.analyzer.review.viewer.process import (
        ViewerProcess,
        has_display,
        hidden_options,
    )
    from hearthlog.analyzer.review.viewer.recording import save_timeline
    from hearthlog.models.modelfile import load_model
    from hearthlog.models.starter import GENERAL
    from hearthlog.recorder.config import load_settings
    from hearthlog.recorder.recording import record_files
    from hearthlog.recorder.sources.audio_files import FileSource
    from hearthlog.tools.cli.info import info
    from hearthlog.tools.home.simulate import write_day

    if look and not has_display():
        raise HearthlogError(
            "there is no display; run without --open and open the file on another machine"
        )
    if output.exists():
        raise HearthlogError(f"{output}: already exists; delete it or choose another --output")
    starter = starter_here(Path(GENERAL))
    model = load_model(starter)
    day, logs, timeline = output / "day.flac", output / "logs", output / "day.rrd"

    _announce(f"1. Composing a day of a home, {minutes:g} minutes long")
    truth = write_day(day, minutes, seed=_SEED)
    print(_composed_of(truth))

    _announce(f"2. hearthlog record {day} --model {starter} --output {logs} --start {_START}")
    settings = load_settings(None, {"output": logs, "model": starter}, {})
    start = parse_time(_START, "--start")
    began = time.perf_counter()
    record_files(settings, FileSource([day], start), Flag())
    took = time.perf_counter() - began
    print(f"recorded and labelled at {60 * minutes / took:.0f} times real time")
    right, of_classes = _agreement(logs, start, truth.spans, model)
    print(
        f"{right:.0%} of all labels are correct, and {of_classes:.0%} of the labels of known sounds"
    )
    print(
        "(none of these recordings were used for training; for any other sound, unknown is correct)"
    )

    _announce(f"3. hearthlog info {logs}")
    info(logs)
    if minutes < _DENSE_MINUTES:
        print(
            f"(a whole day in {minutes:g} minutes is as dense as the sound of a television, and is "
            "counted as that; a real day is not)"
        )

    _announce(f"4. hearthlog review {logs} --save {timeline}")
    save_timeline(read_timeline([logs]), timeline)

    _announce(f"Look at it:           {_command('rerun')} {hidden_options()} {timeline}")
    print("                      (with these options no web page can find the viewer)")
    print(f"What is true:         {day.with_suffix('.txt')}, a label track for Audacity")
    print(f"Record a microphone:  {_command('hearthlog')} record")
    if look:
        with ViewerProcess(["--hide-welcome-screen", str(timeline)]) as viewer:
            while viewer.is_running():
                time.sleep(_POLL_SECONDS)
            viewer.check()


def _composed_of(truth: "Truth") -> str:
    """Return the number of recordings in a day, and of synthetic sounds."""
    clips = [event.plan.clip for event in truth.events]
    recordings = {clip.name for clip in clips if clip.path is not None}
    made_up = [clip.label for clip in clips if clip.path is None]
    which = f" ({', '.join(sorted(set(made_up)))})" if made_up else ""
    return f"{len(clips)} sounds, of {len(recordings)} recordings; made up: {len(made_up)}{which}"


def _agreement(
    logs: Path, start: int, truth: "list[LabelledSpan]", model: "Model"
) -> tuple[float, float]:
    """Return the share of correct labels at frame centres, of all frames and of known sounds.

    The second share covers the sounds of the model's classes, without silence.
    """
    import numpy as np

    from hearthlog.models.classes import SILENCE, UNKNOWN
    from hearthlog.schemas.logs.columns import read_columns
    from hearthlog.schemas.logs.files import find_logs

    labels = read_columns(find_logs(logs), ["/mic/label"])["/mic/label"]
    middle = (labels["header.stamp"] - start) / 1e9 + 0.025
    meant = np.searchsorted([end for _, end, _ in truth], middle, side="right")
    names = [name if name in model.classes else UNKNOWN for *_, name in truth]
    true = np.array([*names, names[-1]], object)[meant]
    right = labels["label"] == true
    is_class = (true != UNKNOWN) & (true != SILENCE)
    return float(np.mean(right)), float(np.mean(right[is_class])) if is_class.any() else 1.0


def _command(name: str) -> str:
    """Return a command as the user can type it: its environment may be inactive."""
    if shutil.which(name):
        return name
    path = Path(sys.executable).with_name(name)
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _announce(text: str) -> None:
    print(f"\n{text}", flush=True)
