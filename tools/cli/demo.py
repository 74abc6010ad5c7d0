"""`hearthlog demo`: the whole way from sound to a timeline, on a simulated home."""

import shutil
import sys
import time
from pathlib import Path
from threading import Event as Flag
from typing import Annotated

import typer

_START = "2026-03-01T00:00:00"
_SEED = 1


def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to make.")] = Path("demo"),
    minutes: Annotated[
        float, typer.Option(min=1, max=1440, help="Length of the simulated day.")
    ] = 24.0,
) -> None:
    """Simulate a home, learn its sounds, record and label a day of it, and draw the result."""
    from hearthlog.analyzer.review.timeline.read_timeline import read_timeline
    from hearthlog.analyzer.review.viewer.file import save_timeline
    from hearthlog.recorder.config import load_settings
    from hearthlog.recorder.recording import record_files
    from hearthlog.recorder.sources.audio_files import FileSource
    from hearthlog.schemas.errors import HearthlogError
    from hearthlog.tools.cli.info import info
    from hearthlog.tools.cli.record import start_time
    from hearthlog.tools.cli.train import train
    from hearthlog.tools.home.simulate import write_day, write_training_set
    from hearthlog.tools.home.sounds import LABELS

    if output.exists():
        raise HearthlogError(f"{output}: exists already; delete it or choose another --output")
    model, scenario = output / "home.safetensors", output / "scenario.toml"
    day, logs, timeline = output / "day.flac", output / "logs", output / "day.rrd"

    _say(f"1. Simulating a home: clips to learn from, and a day of {minutes:g} minutes")
    manifest = write_training_set(output / "clips", clips_per_class=12, seed=_SEED)
    truth = write_day(day, minutes, seed=_SEED + 1, manifest=None)
    scenario.write_text(
        "[classes]\n" + "".join(f'{label} = ["{label}"]\n' for label in LABELS), "utf-8"
    )

    _say(f"2. hearthlog train --data {manifest} --scenario {scenario} --output {model}")
    train(data=[manifest], scenario=str(scenario), output=model)

    _say(f"3. hearthlog record {day} --model {model} --output {logs} --start {_START}")
    settings = load_settings(None, {"output": logs, "model": model}, {})
    start = start_time(_START, day)
    began = time.perf_counter()
    record_files(settings, settings.microphone[0], FileSource([day], start), Flag())
    took = time.perf_counter() - began
    print(f"recorded and labelled at {60 * minutes / took:.0f} times the speed of life")
    print(f"{_agreement(logs, start, truth.spans):.1%} of the labels are what was simulated")
    print("(synthetic sounds are easy to tell apart; those of a real home are not)")

    _say(f"4. hearthlog info {logs}")
    info(logs)

    _say(f"5. hearthlog review {logs} --save {timeline}")
    save_timeline(read_timeline([logs]), timeline)

    _say(f"Look at it:           {_command('rerun')} --bind 127.0.0.1 {timeline}")
    print(f"Record a microphone:  {_command('hearthlog')} record --model {model}")


def _agreement(logs: Path, start: int, truth: list[tuple[float, float, str]]) -> float:
    """Share of the labels that the simulation meant in the middle of their frame."""
    import numpy as np

    from hearthlog.schemas.logs.columns import read_columns
    from hearthlog.schemas.logs.files import find_logs

    labels = read_columns(find_logs(logs), ["/mic/label"])["/mic/label"]
    middle = (labels["header.stamp"] - start) / 1e9 + 0.025
    meant = np.searchsorted([end for _, end, _ in truth], middle, side="right")
    names = [name for _, _, name in truth]
    true = np.array([*names, names[-1]], object)[meant]
    return float(np.mean(labels["label"] == true))


def _command(name: str) -> str:
    """Name a command as the user can type it: it may be in an environment that is not active."""
    if shutil.which(name):
        return name
    path = Path(sys.executable).with_name(name)
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _say(text: str) -> None:
    print(f"\n{text}", flush=True)
