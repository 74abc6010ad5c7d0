"""One microphone of a recording, from its events to its messages."""

from hearthlog.models.embedding.networks import Embedder
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.recorder.config import Settings
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.events import Event, Frames, Gap, SoundSource
from hearthlog.recorder.labelling.labelling_models import Change, LabellingModels
from hearthlog.recorder.log.description import LogDescription, describe_log
from hearthlog.recorder.stream.messages import EncodedMessage, stream_info
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS


class MicrophoneStream:
    """One microphone of a recording.

    Raise `ModelError` if the configured feature set is not installed. Raise
    `ConfigurationError` if a model is for another feature set than the configured one, or does
    not know what is private.
    """

    def __init__(
        self,
        settings: Settings,
        microphone: str,
        source: SoundSource,
        models: LabellingModels,
        embedder: Embedder | None = None,
    ) -> None:
        self._settings = settings
        self._source = source
        self._device = source.device
        self._next_frame = 0
        self._end = 0  # of the last frame, in nanoseconds of UTC
        self._drops = False  # frames, for the log takes none
        self.models = models
        self.pipeline = Pipeline(
            microphone,
            _configured_features(settings, models),
            models.classifier,
            settings.statistics_every,
            {name: loaded.classifier for name, loaded in models.beside().items()},
            settings.privacy,
            settings.settings_of(microphone).geometry,
            embedder,
        )
        if unknown := self.pipeline.unknown_private():
            classes = self.pipeline.classes
            what = f"this one tells apart {', '.join(classes)}" if classes else "there is none"
            raise ConfigurationError(
                f"privacy needs a model that knows {', '.join(map(repr, unknown))} ({what}); take "
                "one that does, or set privacy = [] to log the features of everything"
            )

    def accepted(self, event: Event, *, log_is_full: bool) -> list[Event]:
        """Return what is to be recorded now.

        Parameters
        ----------
        log_is_full : bool
            Whether the log takes no sound now; what is dropped so is a gap later.
        """
        if isinstance(event, Frames):
            return self._accepted_frames(event, log_is_full=log_is_full)
        if log_is_full or (self._drops and isinstance(event, Gap)):
            return []
        return [event]

    def _accepted_frames(self, frames: Frames, *, log_is_full: bool) -> list[Event]:
        start = int(frames.stamps[0])
        if log_is_full:
            if not self._end:  # nothing was recorded yet
                self._next_frame, self._end = frames.first, start
            self._drops = True
            return []
        events: list[Event] = [frames]
        if self._drops:
            lost = frames.first - self._next_frame
            events.insert(0, Gap(self._end, start, "the disk took no more", lost))
            self._drops = False
        self._next_frame = frames.first + len(frames.stamps)
        self._end = int(frames.stamps[-1]) + FRAME_NANOSECONDS
        return events

    @property
    def device(self) -> str:
        """Name of what is heard."""
        return self._device

    def device_changes(self) -> bool:
        """Follow the source to another device; return whether there is one."""
        before, self._device = self._device, self._source.device
        return before != self._device

    def change_models(
        self, changes: list[Change], frames: Frames | None, now: int
    ) -> tuple[list[EncodedMessage], list[EncodedMessage]]:
        """Let other models label from the next frame on.

        Parameters
        ----------
        frames : Frames or None
            The next ones; None if they have not come yet.
        now : int
            Time at which those change whose sound has not begun, in nanoseconds of UTC.

        Returns
        -------
        closing, opening : list of EncodedMessage
            Last and first messages of the logs of the models before and now.
        """
        number, stamp = self._next_frame, self._end or now
        if frames is not None:
            number, stamp = frames.first, int(frames.stamps[0])
        closing: list[EncodedMessage] = []
        opening: list[EncodedMessage] = []
        for labelling, model, classifier in changes:
            last, first = self.pipeline.change_model(model, classifier, number, stamp, labelling)
            closing, opening = [*closing, *last], [*opening, *first]
        return closing, opening

    def describe(self) -> LogDescription:
        """Describe the logs of this microphone."""
        features, models = self.pipeline.feature_set, self.models
        info = stream_info(self.pipeline.microphone, self._device, features, models.model)
        beside = {name: loaded.model for name, loaded in models.beside().items()}
        return describe_log(
            self._settings, info, features, models.model, beside, self.pipeline.embedding
        )


def _configured_features(settings: Settings, models: LabellingModels) -> FeatureSet:
    """Return the configured feature set, which must be that of all models."""
    features = _features_of_model(settings, models)
    for labelling, (model, classifier) in models.beside().items():
        if classifier.feature_set != features:
            reason = (
                f"model {model.name} is for feature set {classifier.feature_set.name}, and what is "
                f"recorded is {features.name}; all models must be for the same one: train this one "
                f"for {features.name}"
            )
            models.leave_out(labelling, reason)
    return features


def _features_of_model(settings: Settings, models: LabellingModels) -> FeatureSet:
    if models.classifier is None:
        return feature_set(settings.feature_set or DEFAULT.name)
    name = models.classifier.feature_set.name
    if settings.feature_set not in {"", name}:
        raise ConfigurationError(
            f"the model is for feature set {name}, not {settings.feature_set!r} as feature_set "
            "says; leave that out, or take another model"
        )
    return models.classifier.feature_set
