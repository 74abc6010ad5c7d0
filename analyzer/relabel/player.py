"""Player of recorded features or clips through a pipeline, and the new log of its messages."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event as Flag

from hearthlog.analyzer.logs.recorder_info import RecorderInfo, check_model, features_of, models_for
from hearthlog.analyzer.relabel.recorded import Features, RecordedBatch, ReplayComparison
from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.network_names import is_by_names, without_classes
from hearthlog.models.features import FeatureSet
from hearthlog.models.features.installed import DEFAULT, entries_of, feature_set
from hearthlog.models.modelfile import CARD, DESCRIPTION, model_attachments
from hearthlog.recorder.events import Frames, Gap, SourceHealth
from hearthlog.recorder.labelling.labelling_models import class_conflict, shared_classes
from hearthlog.recorder.log.description import LogDescription, with_scenarios
from hearthlog.recorder.log.rolling_log import RollingLog
from hearthlog.recorder.stream import LOGGED_EVERY, EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SECONDS, NANOSECONDS
from hearthlog.schemas.logs.metadata import FEATURE_SET, provenance
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    LIVE,
    SCENARIO,
    scenario_labelling,
    topic,
    topics_of,
)


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay."""

    kind: str = "features"  # or "audio", for clips
    model: Callable[[RecorderInfo], Model | None] = lambda _: None  # None: no labels
    # Secondary models by scenario name.
    scenarios: Mapping[str, Model] = field(default_factory=dict)
    output: Path | None = None  # folder of the new log; None for no log
    start_offset: float = 0.0  # seconds from the first message
    duration: float | None = None  # seconds; None for all
    rate: float | None = None  # multiple of real time; None for as fast as possible
    loop: bool = False  # restart at the end, until stopped


@dataclass
class Replay:
    """Result of a replay.

    `missing` are times (ns of UTC) before which the logs lack recorded sound: the labels of the
    first second there, and the open segment, may differ from the recording.
    """

    sources: list[Path]  # replayed logs
    logs: list[Path] = field(default_factory=list)  # written logs
    frames: int = 0
    labels: int = 0
    segments: int = 0
    gaps: int = 0
    compared: ReplayComparison = field(default_factory=ReplayComparison)
    missing: list[int] = field(default_factory=list)
    unfinished: list[Path] = field(default_factory=list)  # truncated logs, replayed up to the cut
    interrupted: bool = False

    @property
    def seconds(self) -> float:
        """Seconds of replayed sound."""
        return self.frames * FRAME_SECONDS


_OF_RECORDER = (CANDIDATE, SCENARIO, FEATURE_SET)  # entries that the new log does not copy
# Name prefixes of attachments about the models of microphones.
_MODELS = tuple(name.partition(".")[0] + "." for name in (CARD, DESCRIPTION))


_PACED_FRAMES = 10  # 0.5 s
_MOST_FRAMES = 4096
_OF_OTHER_MODELS = CANDIDATE, SCENARIO
_LOST = "the log that was replayed does not have it"


class Player:
    """Pushes recorded events to pipelines, one recorder run after the other.

    Messages before log time `start` are dropped; `progress` receives the time up to which frames
    were replayed; both in nanoseconds of UTC. It is `converged` if frames before the first one
    would not affect the messages to come, and `missing_before` if such frames were recorded, but
    are missing in the logs.
    """

    def __init__(
        self,
        options: ReplayOptions,
        start: int,
        result: Replay,
        stop: Flag,
        progress: Callable[[int], None],
    ) -> None:
        self.converged = self.missing_before = False
        self._options = options
        self._start = start
        self._result = result
        self._stop = stop
        self._progress = progress
        self._paced: int | None = None  # start of the last paced frames
        self._anchor = 0.0, 0  # a clock time, and the sound's time then
        self._info: RecorderInfo | None = None  # of the first log of this recorder run
        self._opened: Path | None = None
        self._log: RollingLog | None = None
        self._next = 0  # number of the next frame
        self._after_gap = False  # the next frame may then be any later one
        self._end: int | None = None  # end of the last frame of this run
        self._uncompared: list[EncodedMessage] = []

    def open(self, info: RecorderInfo) -> None:
        """Continue with another log, unless it is open; restart if it is of another recorder run.

        Raise `LogError` if its feature set is not installed, or differs from the model's, or if the
        new log cannot be written.
        """
        if info.path == self._opened:
            return
        self._opened = info.path
        if self._info is not None and self._continues(info):
            self._change_model(info)
        elif self._info is None or _is_new_run(info, self._info, self._next):
            self._close()
            self._begin(info)

    def push(self, event: Features | Frames | Gap | SourceHealth) -> bool:
        """Replay an event.

        Raise `LogError` if the new log cannot be written.
        """
        if isinstance(event, Features):
            self._join(event)
        if isinstance(event, Features | Frames):
            return self._push_frames(event)
        if isinstance(event, Gap):
            self.converged = self._after_gap = True
        self._write(self._pipeline.push(event))
        return True

    def compare(self, batch: RecordedBatch) -> None:
        """Compare the messages replayed since the last call with the recorded ones.

        Raise `LogError` if a recorded message does not have the type stated by its channel.
        """
        if self._info is None:
            return
        replayed, self._uncompared = self._uncompared, []
        label_topic = topic(self._pipeline.microphone, "label")
        labels = [message for message in replayed if message.topic == label_topic]
        segments = [message for message in replayed if message.topic != label_topic]
        end = self._end or 0
        self._result.compared.add_labels(batch.labels, labels, end)
        self._result.compared.add_segments(batch.segments, segments, end)

    def finish(self, *, cut: bool) -> None:
        """Complete the log and the comparison; raise `LogError` if the new log cannot be written.

        It is `cut` if the recorded sound continues: the last segment then differs from the
        recording.
        """
        self._close()
        if not cut and self._options.kind == "features":
            self.compare(RecordedBatch([], [], []))
        self._result.compared.finish(cut=cut)

    def _begin(self, info: RecorderInfo) -> None:
        model = self._options.model(info)
        configuration = info.configuration
        features = self._features(info, model)
        classifier = None if model is None else Classifier(model)
        clips = self._options.kind != "features"  # clips do not state how often
        every = LOGGED_EVERY if clips else configuration.statistics_every
        self._by_scenario = self._scenarios(info, features, model)
        by_scenario = {
            scenario_labelling(name): Classifier(one) for name, one in self._by_scenario.items()
        }
        self._pipeline = Pipeline(
            info.microphone, features, classifier, every, by_scenario, embedding=info.embedding
        )
        if self._options.output is not None:
            self._log = RollingLog(
                self._describe(info, model),
                configuration.max_bag_duration,
                configuration.flush_seconds,
                configuration.sync_seconds,
            )
        self._sha256 = _digest(model)
        self._info = info
        self._next, self._end, self._after_gap = 0, None, False

    def _features(self, info: RecorderInfo, model: Model | None) -> FeatureSet:
        """Return the feature set of the pipeline; clips work with any."""
        if self._options.kind != "features":
            return DEFAULT if model is None else feature_set(model.description.feature_set)
        if model is not None:
            check_model(info, model)
        return features_of(info)

    def _scenarios(
        self, info: RecorderInfo, features: FeatureSet, live: Model | None
    ) -> dict[str, Model]:
        """Return the secondary models by scenario name.

        A class of two models is refused, as by the recorder; names are left to the other model.
        """
        by_labelling = {} if live is None else {LIVE: live}
        by_scenario = {}
        for name, model in self._options.scenarios.items():
            if is_by_names(model):
                continue
            theirs = model.description.feature_set
            if theirs != features.name:
                raise LogError(
                    f"{info.path}: is replayed with feature set {features.name}; model "
                    f"{model.name} of scenario {name} is for {theirs}: {models_for(features.name)}"
                )
            if reason := class_conflict(model, by_labelling):
                where = f"model {model.name} of scenario {name}"
                raise LogError(f"{info.path}: cannot be replayed so: {where} {reason}")
            by_labelling[scenario_labelling(name)] = by_scenario[name] = model
        for name, model in self._options.scenarios.items():
            if is_by_names(model):
                own = without_classes(model, shared_classes(model, by_labelling.values()), features)
                if len(own.classes) > 1:
                    by_scenario[name] = own
        return {name: by_scenario[name] for name in self._options.scenarios if name in by_scenario}

    def _continues(self, info: RecorderInfo) -> bool:
        """Return whether a log is of the same recorder run, but of another model."""
        assert self._info is not None
        if info.first_frame is None or info.model_sha256 == self._info.model_sha256:
            return False
        first = info.first_frame[0]
        follows = first == self._next or (self._after_gap and first > self._next)
        models = "model", *_OF_OTHER_MODELS
        same = _without(info, *models) == _without(self._info, *models)
        return self._next > 0 and follows and same

    def _change_model(self, info: RecorderInfo) -> None:
        """Change the model where the recorder did, if the model differs here too."""
        self._info = info
        model = self._options.model(info)
        sha256 = _digest(model)
        if sha256 == self._sha256:
            return
        assert info.first_frame is not None
        before = self._by_scenario
        self._by_scenario = self._scenarios(info, self._features(info, model), model)
        changes = [(LIVE, model)]
        for name in self._options.scenarios:  # they may now have to exclude other classes
            own = self._by_scenario.get(name)
            if _digest(own) != _digest(before.get(name)):
                changes.append((scenario_labelling(name), own))
        closing: list[EncodedMessage] = []
        opening: list[EncodedMessage] = []
        for labelling, new in changes:
            classifier = None if new is None else Classifier(new)
            last, first = self._pipeline.change_model(new, classifier, *info.first_frame, labelling)
            closing, opening = [*closing, *last], [*opening, *first]
        self._write(closing)
        if self._log is not None:
            self._log.begin_anew(self._describe(info, model), [])
        self._sha256 = sha256
        self._write(opening)

    def _describe(self, info: RecorderInfo, model: Model | None) -> LogDescription:
        """Describe the new log as the recorder described the old one."""
        assert self._options.output is not None
        if model is not None and model.sha256 == info.model_sha256:
            model = replace(model, name=info.model)  # whatever the name of its file here
        features, scenarios = self._pipeline.feature_set, self._by_scenario
        stream = stream_info(info.microphone, info.device, features, model)
        attachments = [item for item in info.attachments if not item.name.startswith(_MODELS)]
        if model is not None:
            attachments += model_attachments(model)
        description = LogDescription(
            root=self._options.output,
            node=info.node,
            topics=topics_of(
                info.microphone,
                features.feature_names,
                None if model is None else list(model.classes),
                {scenario_labelling(name): list(one.classes) for name, one in scenarios.items()},
                directions=info.has_directions,
                embedding=info.embedding,
            ),
            infos=[stream],
            metadata={
                **{k: v for k, v in info.metadata.items() if not k.startswith(_OF_RECORDER)},
                **provenance(info.node),
                **entries_of(features),
                "model": stream.model,
                "model_sha256": stream.model_sha256,
                "replay_of": _name(self._result.sources),
                "replay_from": "clips" if self._options.kind == "audio" else self._options.kind,
            },
            attachments=attachments,
        )
        return with_scenarios(description, info.microphone, scenarios)

    def _join(self, event: Features) -> None:
        """Restart or add a gap where frames are not contiguous, as the recorder did."""
        if self._after_gap:
            self._after_gap = False
            return
        if event.first < self._next:
            assert self._info is not None
            self._close()
            self._begin(self._info)
        if self._end is None:
            self.converged |= event.first == 0
            self.missing_before |= event.first > 0
        elif event.first > self._next:
            self.converged = True
            lost = event.first - self._next
            gap = Gap(self._end, int(event.stamps[0]), _LOST, lost)
            self._write(self._pipeline.push(gap))
        if event.first > self._next and event.stamps[0] >= self._start:
            self._result.missing.append(int(event.stamps[0]))

    def _push_frames(self, event: Features | Frames) -> bool:
        size = _MOST_FRAMES if self._options.rate is None else _PACED_FRAMES
        for begin in range(0, len(event.stamps), size):
            block = slice(begin, begin + size)
            first, stamps = event.first + begin, event.stamps[block]
            end = int(stamps[-1]) + FRAME_NANOSECONDS
            if end > self._start:
                self._wait(int(stamps[0]), end)
            if self._stop.is_set():
                self._result.interrupted = True
                return False
            if isinstance(event, Features):
                part = event.part(block)
                messages = self._pipeline.push_features(part.values, first, stamps, part.auxiliary)
            else:
                messages = self._pipeline.push(Frames(first, event.samples[block], stamps))
            self._next, self._end = first + len(stamps), end
            self._result.frames += int((stamps >= self._start).sum())
            self._write(messages)
            if end > self._start:
                self._progress(end)
        if self._sha256 is None and not self._by_scenario:
            self.converged |= len(event.stamps) >= self._pipeline.feature_set.window_frames
        return True

    def _wait(self, start: int, end: int) -> None:
        """Wait until the end of frames from `start` to `end` (ns of UTC), or until stopped."""
        if self._options.rate is None:
            return
        if self._paced is None or start < self._paced:  # the clock was set back
            self._anchor = time.monotonic(), start
        self._paced = start
        began, first = self._anchor
        due = began + (end - first) / NANOSECONDS / self._options.rate
        while (left := due - time.monotonic()) > 0 and not self._stop.wait(min(left, 1.0)):
            pass

    def _write(self, messages: list[EncodedMessage]) -> None:
        messages = self._count(messages)
        if self._log is not None and messages:
            self._log.write(messages)

    def _count(self, messages: list[EncodedMessage]) -> list[EncodedMessage]:
        """Drop messages before the start, and count the others."""
        microphone = self._pipeline.microphone
        label, segment, gap = (topic(microphone, kind) for kind in ("label", "segment", "gap"))
        if messages and messages[0].log_time < self._start:
            messages = [message for message in messages if message.log_time >= self._start]
        counts = Counter(message.topic for message in messages)
        self._result.labels += counts[label]
        self._result.segments += counts[segment]
        self._result.gaps += counts[gap]
        if self._options.kind == "features":
            self.converged |= self._pipeline.segments_converged
            self._uncompared += [m for m in messages if m.topic in {label, segment}]
        return messages

    def _close(self) -> None:
        if self._info is None:
            return
        messages = self._count(self._pipeline.finish())
        if self._log is not None:
            self._log.finish(messages)
            self._result.logs += self._log.finished
            self._log = None


def _is_new_run(info: RecorderInfo, last: RecorderInfo, next_frame: int) -> bool:
    """Return whether a log is of another recorder run than the last one."""
    if info.first_frame is not None and info.first_frame[0] < next_frame:
        return True
    same = _without(info, *_OF_OTHER_MODELS) == _without(last, *_OF_OTHER_MODELS)
    return not same or info.model_sha256 != last.model_sha256


def _digest(model: Model | None) -> str | None:
    return None if model is None else model.sha256


def _without(info: RecorderInfo, *models: str) -> dict[str, str]:
    """Return the metadata without the entries about models that may change within a run."""
    return {key: text for key, text in info.metadata.items() if not key.startswith(models)}


def _name(paths: Sequence[Path]) -> str:
    """Return a short name of logs, since every new log repeats it."""
    if len(paths) == 1:
        return paths[0].name
    return f"{paths[0].name} … {paths[-1].name} ({len(paths)} logs)"
