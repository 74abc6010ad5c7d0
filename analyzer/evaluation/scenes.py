"""Scenes: clips over steady noise as a microphone records them, and model scores on them."""

import random
import tempfile
import wave
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy.fft import irfft, rfft

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import Detections
from hearthlog.analyzer.evaluation.log_scores import evaluate_labelling, read_labelling
from hearthlog.analyzer.evaluation.model_scores import check_classes
from hearthlog.analyzer.logs.labelling import Labelling
from hearthlog.analyzer.training.dataset import (
    UNREADABLE,
    clip_recordings,
    cut_recordings,
    learned_groups,
)
from hearthlog.analyzer.training.manifest import (
    LabelledClip,
    Scenario,
    SkippedClip,
    example_of,
    why_skipped,
)
from hearthlog.analyzer.training.scores import Scores
from hearthlog.models.classes import COUGHING, SILENCE, UNKNOWN
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.installed import feature_set
from hearthlog.recorder.config import load_settings
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.open_audio import audio_seconds
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import Progress, SourceError, ignore_progress
from hearthlog.schemas.frames import FRAME_SECONDS, NANOSECONDS, SAMPLE_RATE

Colour = Literal["white", "pink", "brown"]
Clip = TypeVar("Clip")

_SINGLE_SECONDS = 0.3
_SLOPES = {"pink": 0.5, "brown": 1.0}
_LOWEST_HERTZ = np.float32(20.0)  # below it the spectrum is flat
_AT_ONCE = 1 << 20
_SECONDS = (3.0, 10.0)  # limits of the maximum length of a sound
_PAUSES = (0.5, 2.0, 6.0)  # seconds between two sounds
_SINGLE_PAUSES = (2.0, 8.0)
_MOST_SINGLE = 120
_BEFORE, _AFTER = 2.0, 5.0  # seconds of noise before the first sound and after the last
_LAST = 12.0  # seconds before the end without a start of a sound
_TAPER = 0.1  # power of a Hann window: fades in and out without loss of loudness


class Span(NamedTuple):
    """A labelled span; seconds from the start of the scene."""

    start: float
    end: float
    label: str


class Scene(NamedTuple):
    """Sound with its true labels."""

    samples: Float32  # [shape=(n,)]; at 16 kHz, -1 to 1
    truth: list[Span]  # successive spans without gaps; silence lies between the sounds

    @property
    def sounds(self) -> list[Span]:
        """Spans other than silence."""
        return [span for span in self.truth if span.label != SILENCE]


def background(seconds: float, level: float, colour: Colour, seed: int) -> Float32:
    """Generate the noise of a scene at 16 kHz: seconds, more than 0, of a level in dBFS.

    The seed is not negative.
    """
    rng, noise = np.random.default_rng(seed), np.empty(int(seconds * SAMPLE_RATE), np.float32)
    for part in _parts(noise):
        part[:] = rng.standard_normal(len(part))
    if colour != "white":
        noise = _coloured(noise, _SLOPES[colour])
    power = sum(np.square(part, dtype=np.float64).sum() for part in _parts(noise)) / len(noise)
    noise *= 10.0 ** (level / 20.0) / np.sqrt(power)
    return noise


def _parts(noise: Float32) -> list[Float32]:
    return [noise[start : start + _AT_ONCE] for start in range(0, len(noise), _AT_ONCE)]


def _coloured(noise: Float32, slope: float) -> Float32:
    """Shape the amplitude of noise to fall with a power of the frequency, in place."""
    spectrum = rfft(noise, overwrite_x=True)  # single precision, because an hour of noise is large
    frequencies = np.arange(len(spectrum), dtype=np.float32) * np.float32(SAMPLE_RATE / len(noise))
    spectrum /= np.maximum(frequencies, _LOWEST_HERTZ) ** np.float32(slope)
    return irfft(spectrum, len(noise), overwrite_x=True)


def compose(
    clips: Mapping[str, Sequence[Clip]],
    read: Callable[[Clip], Float32],
    noise: Float32,
    seed: int,
    gain: float = 0.0,
) -> Scene:
    """Place clips over noise, 0.5, 2 or 6 s apart, at most 3 to 10 s of each.

    There is at least one label, each with a clip; labels are equally likely. `read` returns the
    samples of a clip at 16 kHz, at least one; one clip is in memory at a time. The noise, as from
    `background`, is overwritten; `gain` of the clips is in dB. Raise `DataError` if the scene is
    too short for a sound.
    """
    rng = random.Random(seed)  # noqa: S311  no secret

    def sounds() -> Iterator[tuple[str, Float32, float]]:
        while True:
            label = rng.choice(sorted(clips))
            sound = read(rng.choice(clips[label]))
            sound = sound[: int(rng.uniform(*_SECONDS) * SAMPLE_RATE)]
            yield label, sound, rng.choice(_PAUSES)

    return _laid(sounds(), noise, gain)


def compose_single(  # noqa: PLR0913, PLR0917
    label: str,
    clips: Sequence[Clip],
    read: Callable[[Clip], Float32],
    noise: Float32,
    seed: int,
    gain: float = 0.0,
) -> Scene:
    """Place up to 120 single short sounds of one label over noise, 2 to 8 s apart.

    Each is the loudest 0.3 s of one of the clips, at least one. The noise is overwritten; `gain` is
    in dB. Raise `DataError` if the scene is too short for a sound.
    """
    rng = random.Random(seed)  # noqa: S311  no secret

    def sounds() -> Iterator[tuple[str, Float32, float]]:
        while True:
            rng.choice([label])  # same random draws as for a scene
            sound = loudest(read(rng.choice(clips)), _SINGLE_SECONDS)
            yield label, sound, rng.uniform(*_SINGLE_PAUSES)

    return _laid(islice(sounds(), _MOST_SINGLE), noise, gain)


def loudest(sound: Float32, seconds: float) -> Float32:
    """Return the loudest part of a sound at 16 kHz with fades at both ends."""
    count = int(seconds * SAMPLE_RATE)
    if len(sound) <= count:
        return sound
    energy = np.cumsum(np.concatenate([[0.0], np.square(sound, dtype=np.float64)]))
    start = int(np.argmax(energy[count:] - energy[:-count]))
    part = sound[start : start + count] * np.hanning(count) ** _TAPER
    return part.astype(np.float32)


def _laid(sounds: Iterator[tuple[str, Float32, float]], noise: Float32, gain: float) -> Scene:
    """Place (label, samples, seconds of pause after it) over noise until the scene is full."""
    last, now = len(noise) / SAMPLE_RATE - _LAST, _BEFORE
    if last <= now:
        raise DataError(
            f"a scene of {len(noise) / SAMPLE_RATE:g} s has no time for a sound; make it longer "
            f"than {_BEFORE + _LAST:g} s"
        )
    truth: list[Span] = []
    end = 0.0  # end of the previous sound
    while now < last and (drawn := next(sounds, None)):
        label, sound, pause = drawn
        start = int(now * SAMPLE_RATE)
        noise[start : start + len(sound)] += sound * np.float32(10.0 ** (gain / 20.0))
        length = len(sound) / SAMPLE_RATE
        truth += [Span(end, now, SILENCE), Span(now, now + length, label)]
        end = now + length
        now += length + pause
    samples = noise[: int((now + _AFTER) * SAMPLE_RATE)]
    np.clip(samples, -1.0, 1.0, out=samples)
    return Scene(samples, [*truth, Span(end, len(samples) / SAMPLE_RATE, SILENCE)])


_START = 1_772_323_200 * NANOSECONDS  # of every scene; any full hour works
_APART = 24 * 3600 * NANOSECONDS
_WRITTEN_AT_ONCE = 1 << 20  # samples
_HOURS_A_DAY = 24
_MOST_SECONDS = 60  # read from a clip

Clips = dict[str, list[LabelledClip]]


@dataclass(frozen=True)
class SceneOptions:
    """Options of scene composition."""

    scenes: int = 3
    seconds: float = 1800.0
    floor: float = -70.0  # of the noise, in dBFS
    colour: Colour = "white"
    gain: float = 0.0  # of the clips, in dB
    seed: int = 10


@dataclass(frozen=True)
class SceneScores:
    """Scores of the labels of one scene."""

    seed: int
    macro_f1: float  # of frames
    event_f1: float  # macro
    false_alarms_per_hour: float  # of all classes


@dataclass(frozen=True)
class SingleCoughs:
    """Detection of single coughs of 0.3 s."""

    coughs: int
    found: float  # share of coughs that overlap a label of coughing
    median_seconds: float | None
    others: float


@dataclass(frozen=True)
class ScenesEvaluation:
    """Scores of a model on scenes."""

    scores: Scores  # of frames of 50 ms; the groups are blocks of five minutes
    detections: Detections
    scenes: list[SceneScores]
    coughs: SingleCoughs | None  # None without a class or a clip of coughing
    evaluated_seconds: float
    sounds: int
    clips: int
    sources: int
    sources_learned: int
    lacking: tuple[str, ...]
    skipped: Mapping[str, int]
    left_out: Sequence[SkippedClip]
    truth: Labelling  # of the first scene, for plots; in nanoseconds from its start
    found: Labelling  # likewise


def evaluate_scenes(  # noqa: PLR0913, PLR0917
    path: Path,
    model: Model,
    clips: Sequence[LabelledClip],
    scenario: Scenario,
    options: SceneOptions,
    progress: Progress,
) -> ScenesEvaluation:
    """Compose scenes, record them with a model, and compare its labels with the truth.

    `progress` receives the completed share of the scenes, 0 to 1. Raise `DataError` if the classes
    of the model are not those of the scenario, if no clip can be placed, or if a scene is too short
    for a sound; `LogError` or `OSError` if there is no room for a scene in the folder of temporary
    files.
    """
    check_classes(model, scenario)
    by_label, skipped, left_out = _usable(clips, scenario)
    used = {scenario.find(label) for label in by_label}
    wanted = [name for name in scenario.classes if name not in {UNKNOWN, scenario.find(SILENCE)}]
    if not by_label:
        raise DataError(
            f"no clip can be laid into a scene ({why_skipped(skipped)}{example_of(left_out)}); "
            f"give clips of {', '.join(wanted)[:300]}"
        )
    laid = [clip for same in by_label.values() for clip in same]
    silence = scenario.find(SILENCE) or SILENCE
    coughs = [clip for clip in laid if scenario.find(clip.label) == COUGHING]
    scenes: list[tuple[Labelling, Labelling]] = []
    singles: list[tuple[list[Span], Labelling]] = []
    sounds = 0
    with closing(ModelWatch(path, SimpleQueue())) as watch:
        recorder = _Recorder(watch, progress, options.scenes * (2 if coughs else 1))
        for seed in range(options.seed, options.seed + options.scenes):
            noise = partial(background, options.seconds, options.floor, options.colour, seed)
            # Created in the call, so that one scene is in memory at a time.
            spans, found = recorder.record(compose(by_label, _read, noise(), seed, options.gain))
            sounds += len(_without_silence(spans))
            truth = [span._replace(label=scenario.find(span.label) or silence) for span in spans]
            scenes.append((_labelling(truth), found))
            if coughs:
                singles.append(
                    recorder.record(
                        compose_single(COUGHING, coughs, _read, noise(), seed, options.gain)
                    )
                )
    each = [evaluate_labelling(truth, found, model.classes) for truth, found in scenes]
    true, predicted = (_apart(same) for same in zip(*scenes, strict=True))
    overall = evaluate_labelling(true, predicted, model.classes)
    return ScenesEvaluation(
        scores=overall.scores,
        detections=overall.detections,
        scenes=[
            SceneScores(
                seed=options.seed + number,
                macro_f1=one.scores.macro_f1,
                event_f1=one.detections.event_based.macro_f1 or 0.0,
                false_alarms_per_hour=alarms_per_hour(one.detections),
            )
            for number, one in enumerate(each)
        ],
        coughs=_single_coughs(singles, silence) if singles else None,
        evaluated_seconds=overall.evaluated_seconds,
        sounds=sounds,
        clips=len(laid),
        sources=len({clip.source_group for clip in laid}),
        sources_learned=_sources_learned(model, laid, scenario),
        lacking=tuple(name for name in wanted if name not in used),
        skipped=skipped,
        left_out=left_out,
        truth=scenes[0][0],
        found=scenes[0][1],
    )


def alarms_per_hour(detections: Detections) -> float:
    """Return the false alarms of all classes per hour."""
    return sum(detections.false_alarms_per_day.values()) / _HOURS_A_DAY


def _usable(
    clips: Sequence[LabelledClip], scenario: Scenario
) -> tuple[Clips, dict[str, int], list[SkippedClip]]:
    """Return usable clips by label, the number of other clips, and the faulty clips."""
    chosen: Clips = {}
    left_out: list[SkippedClip] = []
    skipped: Counter[str] = Counter()
    silence = scenario.find(SILENCE)
    for clip in clips:
        name = scenario.find(clip.label)
        if name is None:
            skipped[f"label {clip.label} is not in the scenario"] += 1
        elif name in {UNKNOWN, silence}:
            skipped[f"class {name} is not laid"] += 1
        elif fault := _fault(clip):
            skipped[UNREADABLE] += 1
            left_out.append(SkippedClip(UNREADABLE, fault))
        elif min(audio_seconds(clip.path), clip.end) - clip.start < FRAME_SECONDS:
            skipped[f"shorter than a frame of {1000 * FRAME_SECONDS:g} ms"] += 1
        else:
            chosen.setdefault(clip.label, []).append(clip)
    return chosen, dict(sorted(skipped.items())), left_out


def _fault(clip: LabelledClip) -> str:
    """Return the read error of the used part of a clip; empty if there is none."""
    faults: list[str] = []
    end = min(clip.end, clip.start + _MOST_SECONDS)
    try:
        for _ in read_audio(clip.path, clip.start, end, incomplete=faults.append):
            pass
    except SourceError as error:
        return str(error)
    return faults[0] if faults else ""


def _read(clip: LabelledClip) -> Float32:
    blocks, length = [], 0
    for block in read_audio(clip.path, clip.start, clip.end):
        blocks.append(np.nan_to_num(block))
        length += len(block)
        if length >= _MOST_SECONDS * SAMPLE_RATE:
            break
    return np.concatenate(blocks)


def _sources_learned(model: Model, clips: Sequence[LabelledClip], scenario: Scenario) -> int:
    """Count the source groups with a segment in a model's training set."""
    features = feature_set(model.description.feature_set)
    recordings = clip_recordings(clips, scenario, ignore_progress, features)
    return len(learned_groups(model, cut_recordings(recordings, scenario, features)))


class _Recorder:
    """Records scenes with one model, and reports the progress over all scenes."""

    def __init__(self, watch: ModelWatch, progress: Progress, scenes: int) -> None:
        self._watch = watch
        self._progress = progress
        self._scenes = scenes
        self._done = 0

    def record(self, scene: Scene) -> tuple[list[Span], Labelling]:
        """Return the true and the predicted labels of a scene, in ns from its start."""

        def report(share: float) -> None:
            self._progress((self._done + share) / self._scenes)

        with tempfile.TemporaryDirectory(prefix="hearthlog-scene-") as folder:
            sound, logs = Path(folder) / "scene.wav", Path(folder) / "logs"
            _write(sound, scene.samples)
            options = {"output": logs, "keep_audio": "off", "feature_set": ""}
            settings = load_settings(None, options, {})
            source = FileSource([sound], _START, progress=report)
            microphone = settings.microphone[0].name
            models = {microphone: LabellingModels(self._watch)}
            recording = RecordingSession(settings, {microphone: source}, models)
            try:
                for event in source.events(Flag()):
                    recording.add(microphone, event)
            finally:
                recording.finish()
            found = read_labelling(logs).labelling
        self._done += 1
        return scene.truth, _moved(found, -_START)


def _write(path: Path, samples: Float32) -> None:
    with wave.open(str(path), "wb") as file:
        file.setparams((1, 2, SAMPLE_RATE, len(samples), "NONE", ""))
        for start in range(0, len(samples), _WRITTEN_AT_ONCE):
            part = samples[start : start + _WRITTEN_AT_ONCE]
            file.writeframes(np.rint(part * np.float32(32767)).astype("<i2").tobytes())


def _without_silence(spans: Sequence[Span]) -> list[Span]:
    return [span for span in spans if span.label != SILENCE]


def _labelling(spans: Sequence[Span]) -> Labelling:
    times = np.array([(start, end) for start, end, _ in spans])
    starts, ends = np.rint(times * NANOSECONDS).astype(np.int64).T
    return Labelling(starts, ends, np.array([label for _, _, label in spans], object))


def _moved(labelling: Labelling, by: int) -> Labelling:
    return replace(labelling, starts=labelling.starts + by, ends=labelling.ends + by)


def _apart(labellings: Sequence[Labelling]) -> Labelling:
    """Merge the labellings of several scenes into one, without overlap in time."""
    moved = [_moved(one, number * _APART) for number, one in enumerate(labellings)]
    starts, ends, labels = (
        np.concatenate([getattr(one, name) for one in moved])
        for name in ("starts", "ends", "labels")
    )
    return Labelling(starts, ends, labels)


def _single_coughs(scenes: Sequence[tuple[list[Span], Labelling]], silence: str) -> SingleCoughs:
    """Find single coughs in a labelling."""
    count, others, lengths = 0, 0, []
    for spans, found in scenes:
        coughs = _without_silence(spans)
        same = found.labels == COUGHING
        starts, ends = found.starts[same] / NANOSECONDS, found.ends[same] / NANOSECONDS
        for begin, end, _ in coughs:
            near = np.flatnonzero((starts < end) & (ends > begin))
            lengths += (ends - starts)[near[:1]].tolist()
        count += len(coughs)
        others += int((~same & (found.labels != silence)).sum())
    return SingleCoughs(
        coughs=count,
        found=len(lengths) / count,
        median_seconds=float(np.median(lengths)) if lengths else None,
        others=others / count,
    )
