"""`python -m hearthlog.tools.lab.voices MANIFEST`: who speaks when, by pyannote.metrics.

Conversations are composed of the voices of a manifest, one of one voice, one of two, of three and
of four, and so on, and are recorded with the starter model. The diarization error rate is the share
of the time of speech that is missed, false or of another voice; a collar is left out around each
border. Beside it stand that of one voice for all, and that with the true times of speech.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from pyannote.core import Annotation, Segment, Timeline
from pyannote.metrics.diarization import DiarizationErrorRate

from hearthlog.analyzer.discover.speech import HomeSpeech, find_voices, read_speech, speech_voices
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.schemas.arrays import Float32, Int64
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS
from hearthlog.tools.lab.bench.table import Row, Table
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.conversations import Turn, clips_of_voices, converse, record_samples

_START = 1_772_352_000 * NANOSECONDS
_DAY = 86_400 * NANOSECONDS
_MOST_VOICES = 4
_COLLAR = 0.25  # seconds at either side of a border
_DRAWS = 1000


def voices(
    manifest: Annotated[Path, typer.Argument(help="Of speech; a voice is a source_group.")],
    conversations: Annotated[int, typer.Option(min=4)] = 24,
    seconds: Annotated[float, typer.Option(min=30, help="Of each.")] = 150.0,
    seed: Annotated[int, typer.Option(help="Of what is drawn.")] = 1,
) -> None:
    """Compose conversations, and tell how well their voices are told apart."""
    clips = clips_of_voices(manifest)
    if len(clips) < _MOST_VOICES:
        raise DataError(f"{manifest}: {len(clips)} voices; it takes {_MOST_VOICES}")
    with tempfile.TemporaryDirectory(prefix="hearthlog-voices-") as folder:
        analysed = [
            _analyse(clips, number, seconds, seed, Path(folder) / str(number))
            for number in range(conversations)
        ]
    title = f"voices: {conversations} conversations of {seconds:.0f} s by {len(clips)} voices"
    print(Table(title, _rows(analysed)))


class _Conversation(NamedTuple):
    """The true and the predicted speakers of a conversation."""

    truth: Annotation
    predicted: Annotation
    predicted_in_speech: Annotation  # with the true times of speech
    span: Timeline
    counted: int


def _analyse(
    clips: dict[str, list[Float32]], number: int, seconds: float, seed: int, folder: Path
) -> _Conversation:
    rng = np.random.default_rng([seed, number])
    names = rng.choice(sorted(clips), number % _MOST_VOICES + 1, replace=False)
    samples, turns = converse(
        {str(name): clips[name] for name in names}, seconds, 1000 * seed + number
    )
    start = _START + number * _DAY
    logs = record_samples(samples, folder, start, starter_file(GENERAL))
    speech = read_speech(find_home_logs([logs]))
    found, of = find_voices(speech, None)
    predicted = _annotation(speech, of, start)
    span = Timeline([Segment(0, seconds)])
    return _Conversation(
        _truth(turns), predicted, _of_speech(samples, turns), span, len(found.numbers)
    )


def _truth(turns: Sequence[Turn]) -> Annotation:
    truth = Annotation()
    for track, (start, end, voice) in enumerate(turns):
        truth[Segment(start, end), track] = voice
    return truth


def _annotation(speech: HomeSpeech, of: Int64, start: int) -> Annotation:
    predicted = Annotation()
    times = (speech.starts - start) / NANOSECONDS, (speech.ends - start) / NANOSECONDS
    for track, (first, last, voice) in enumerate(zip(*times, of[speech.voice], strict=True)):
        predicted[Segment(float(first), float(last)), track] = str(voice)
    return predicted


def _of_speech(samples: Float32, turns: Sequence[Turn]) -> Annotation:
    """Tell voices apart where somebody speaks in truth."""
    frames = samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES].reshape(-1, FRAME_SAMPLES)
    stamps = np.arange(len(frames)) * FRAME_NANOSECONDS
    middle = (stamps + FRAME_NANOSECONDS / 2) / NANOSECONDS
    is_speech = np.zeros(len(frames), np.bool_)
    for turn in turns:
        is_speech |= (turn.start <= middle) & (middle < turn.end)
    values = DEFAULT.extractor()(frames)[is_speech]
    predicted = Annotation()
    *spans, _ = speech_voices(stamps[is_speech], values, DEFAULT.feature_names)
    for track, (first, last, voice) in enumerate(zip(*spans, strict=True)):
        predicted[Segment(first / NANOSECONDS, last / NANOSECONDS), track] = str(voice)
    return predicted


def _rows(conversations: Sequence[_Conversation]) -> list[Row]:
    rows = []
    for name, collar in (("no collar", 0.0), (f"{_COLLAR} s", _COLLAR)):
        predicted = [
            _errors(each.truth, each.predicted, each.span, collar) for each in conversations
        ]
        speech = [
            _errors(each.truth, each.predicted_in_speech, each.span, collar)
            for each in conversations
        ]
        one = [
            _errors(each.truth, _one_voice(each.predicted), each.span, collar)
            for each in conversations
        ]
        missed, false, other, total = np.sum(predicted, axis=0)
        parts = f"{missed / total:.3f} missed, {false / total:.3f} false, {other / total:.3f} other"
        rows += [
            Row(f"error rate, {name}", _rate(predicted), note=f"{_interval(predicted)}; {parts}"),
            Row("  one voice for all", _rate(one), note=_interval(one)),
            Row("  times of speech known", _rate(speech), note=_interval(speech)),
        ]
    wrong = np.array([each.counted - len(each.truth.labels()) for each in conversations])
    note = ", ".join(f"{n:+d}: {(wrong == n).sum()}" for n in np.unique(wrong).tolist())
    return [*rows, Row("number of voices right", float((wrong == 0).mean()), note=note)]


def _one_voice(predicted: Annotation) -> Annotation:
    return predicted.rename_labels(dict.fromkeys(predicted.labels(), "0")).support()


def _errors(
    truth: Annotation, predicted: Annotation, span: Timeline, collar: float
) -> tuple[float, float, float, float]:
    # pyannote.metrics divides a collar between both sides of a border
    parts = DiarizationErrorRate(collar=2 * collar).compute_components(truth, predicted, uem=span)
    return parts["missed detection"], parts["false alarm"], parts["confusion"], parts["total"]


def _rate(errors: Sequence[tuple[float, ...]]) -> float:
    sums = np.sum(errors, axis=0)
    return float(sums[:3].sum() / sums[3])


def _interval(errors: Sequence[tuple[float, ...]]) -> str:
    """Return the 95 % interval of the rate, by drawing conversations again."""
    rng = np.random.default_rng(0)
    array = np.array(errors)
    drawn = array[rng.integers(len(array), size=(_DRAWS, len(array)))].sum(axis=1)
    low, high = np.quantile(drawn[:, :3].sum(axis=1) / drawn[:, 3], (0.025, 0.975))
    return f"{low:.3f} to {high:.3f}"


if __name__ == "__main__":
    run(voices)
