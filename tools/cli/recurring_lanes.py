"""Lanes of what recurs in a home: groups of sounds, and voices."""

from pathlib import Path
from typing import TYPE_CHECKING

from hearthlog.tools.cli.progress import share_done

if TYPE_CHECKING:
    from hearthlog.analyzer.review.timeline import Timeline


def add_groups(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the sounds of the groups in a file to a timeline.

    Raise `DataError` if there is no such file.
    """
    from hearthlog.analyzer.discover.group_spans import group_spans
    from hearthlog.analyzer.discover.groups_file import load_groups
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.review.timeline import LabelledSpans

    groups = load_groups(file)
    if groups is None:
        raise DataError(f"{file}: no such file of groups; `hearthlog discover` makes one")
    span = timeline.grid.start, timeline.grid.end
    with share_done("finding what recurs") as progress:
        spans_by_name, losses = group_spans(find_home_logs(logs), groups, *span, progress)
    for name, spans in spans_by_name.items():
        if name in timeline.microphones:
            timeline.microphones[name].recurring = LabelledSpans(*spans)
    timeline.losses += [text for text in losses if text not in timeline.losses]


def add_voices(timeline: "Timeline", logs: list[Path], file: Path) -> None:
    """Add the turns of the voices in a file to a timeline.

    Raise `DataError` if there is no such file.
    """
    from hearthlog.analyzer.discover.home_voices import find_voices
    from hearthlog.analyzer.discover.read_speech import read_speech
    from hearthlog.analyzer.discover.voice_summary import spoken_spans
    from hearthlog.analyzer.discover.voices_file import load_voices
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.review.timeline import LabelledSpans

    known = load_voices(file)
    if known is None:
        raise DataError(f"{file}: no such file of voices; `hearthlog voices` makes one")
    with share_done("telling voices apart") as progress:
        span = timeline.grid.start, timeline.grid.end
        speech = read_speech(find_home_logs(logs), *span, progress)
    voices, of = find_voices(speech, known)
    for name, spans in spoken_spans(speech, voices, of).items():
        if name in timeline.microphones:
            timeline.microphones[name].spoken = LabelledSpans(*spans)
    timeline.losses += [text for text in speech.losses if text not in timeline.losses]
