"""A timeline in a file that Rerun's viewer opens."""

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import rerun as rr

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.timeline.checked_classes import Checked
from hearthlog.analyzer.review.timeline.model import Timeline
from hearthlog.analyzer.review.timeline.read_timeline import read_frames
from hearthlog.analyzer.review.viewer.canvas import Canvas
from hearthlog.analyzer.review.viewer.drawing import draw, draw_frames, write_checked
from hearthlog.analyzer.review.viewer.layout import APPLICATION, review_layout
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import time_text
from hearthlog.schemas.new_files import check_new, new_file

SUFFIX = ".rrd"


def check_output(output: Path) -> None:
    """Raise DataError unless a recording can be saved under this name.

    Raise `DataError` if the name does not end in `.rrd`, the file exists, or its folder does
    not exist or cannot be written.
    """
    if output.suffix != SUFFIX:
        raise DataError(f"{output}: the name of a Rerun recording must end in {SUFFIX}")
    try:
        check_new(output)
    except LogError as error:
        raise DataError(str(error)) from error


def save_timeline(timeline: Timeline, output: Path, checked: Checked | None = None) -> None:
    """Write a timeline into a Rerun recording (`.rrd`).

    Only Rerun's viewer sends usage statistics and opens a port; this does neither.

    Raise `DataError` if the name has another suffix, the file exists, or it cannot be written.
    """
    check_output(output)
    try:
        with new_file(output) as temporary:
            _write(timeline, temporary, checked or {})
    except LogError as error:
        raise DataError(str(error)) from error


def _write(timeline: Timeline, output: Path, checked: Checked) -> None:
    """Write a recording through a pipe: to a file, Rerun waits for ever where the disk is full."""
    rr.set_strict_mode(True)  # or its mistakes become warnings, and its file wrong
    recording = rr.RecordingStream(APPLICATION)
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as thread:
        pipe = Path(folder, "recording")
        os.mkfifo(pipe)
        written = thread.submit(_copy, pipe, output)
        recording.save(pipe)
        try:
            recording.send_blueprint(review_layout(timeline))
            canvas = Canvas(recording, timeline.clock)
            name_recording(recording, timeline)
            draw(timeline, canvas)
            write_checked(timeline, checked, canvas)
            for part in read_frames(timeline):
                draw_frames(part, canvas)
        finally:
            recording.disconnect()
        written.result()


def _copy(pipe: Path, output: Path) -> None:
    with pipe.open("rb") as source:
        try:
            with output.open("wb") as file:
                shutil.copyfileobj(source, file)
        except OSError:
            while source.read(1 << 20):  # to its end, or nobody could close it
                pass
            raise


def name_recording(recording: rr.RecordingStream, timeline: Timeline) -> None:
    """Set the start of a recording, and name it after its span."""
    start, end = (timeline.clock.shown(time) for time in (timeline.grid.start, timeline.grid.end))
    recording.send_recording_start_time_nanos(start)
    recording.send_recording_name(f"{time_text(start):.16} to {time_text(end):.16}")
