"""Recording clips: sound that may be kept, in layers beside the log, for a limited time."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hearthlog.models.labels.labeller import FrameLabels
from hearthlog.recorder.clips.clip_choice import ClipFinder
from hearthlog.recorder.clips.clip_layer import CLIPS_AGAIN, ClipWriter
from hearthlog.recorder.clips.clip_retention import ClipRetention
from hearthlog.recorder.config import Settings
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.events import WARNING, Event, Frames, Gap, Notice, event_time
from hearthlog.recorder.stream.pipeline import Pipeline
from hearthlog.recorder.stream.veil import TOGETHER
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS


class ClipRecorder:
    """Keeps the clips of a recording, if that is configured, and always deletes old ones.

    Parameters
    ----------
    file_at : callable
        Told a time in nanoseconds of UTC; returns the log that contains it, and the end of that
        log; see `RollingLog.file_at`.

    Raises
    ------
    ConfigurationError
        If sound is to be kept and a model cannot tell what must not be.
    """

    def __init__(
        self,
        settings: Settings,
        pipelines: Sequence[Pipeline],
        file_at: Callable[[int], tuple[Path, int]],
    ) -> None:
        self._retention = ClipRetention(
            settings.output, settings.node, settings.clip_retention_days
        )
        names = [pipeline.microphone for pipeline in pipelines]
        self._writer = ClipWriter(settings, names, file_at)
        self._microphones = {
            pipeline.microphone: _MicrophoneClips(settings, pipeline, self._writer)
            for pipeline in pipelines
        }

    @property
    def kept_frames(self) -> int:
        """Frames of sound that were kept."""
        return self._writer.kept_frames

    def before(self, microphone: str, event: Event) -> list[Notice]:
        """Prepare for an event that is about to be logged: a gap ends the sound before it.

        Returns
        -------
        list of Notice
            What people should know: sound that cannot be kept, or is kept again.
        """
        return self._microphones[microphone].close() if isinstance(event, Gap) else []

    def after(self, microphone: str, event: Event, labels: FrameLabels | None) -> list[Notice]:
        """Keep the sound of an event that was logged, and delete what is old.

        Returns
        -------
        list of Notice
            What people should know: sound that cannot be kept or deleted, and what was deleted.
        """
        now = event_time(event)
        notices = [*self._retention.tick(now), *self._writer.tick(now)]
        if isinstance(event, Frames):
            notices += self._microphones[microphone].push(event, labels)
        return notices

    def finish(self) -> list[Notice]:
        """Write the remaining sound, and complete the layer.

        Returns
        -------
        list of Notice
            What people should know: sound that cannot be kept, or is kept again.
        """
        notices = [notice for each in self._microphones.values() for notice in each.close()]
        return [*notices, *self._writer.finish()]


class _MicrophoneClips:
    """Chooses the clips of one microphone."""

    def __init__(self, settings: Settings, pipeline: Pipeline, writer: ClipWriter) -> None:
        self._keep = settings.keep_audio
        self._never = settings.never_keep
        self._microphone = pipeline.microphone
        self._writer = writer
        frames = round(settings.clip_pre_roll_seconds * NANOSECONDS / FRAME_NANOSECONDS)
        self._finder = ClipFinder(
            self._keep,
            self._never,
            frames,
            pipeline.feature_set.window_frames,
            TOGETHER if settings.privacy else 0,
            pipeline.most_ahead,
        )
        self._classes: Sequence[str] | None = pipeline.classes
        self._refused = self._refusal()  # why no sound may be kept, or empty
        if self._refused:
            raise ConfigurationError(self._refused)

    def close(self) -> list[Notice]:
        """Write the sound that is held back."""
        if self._refused or self._keep == "off":
            return []
        return self._writer.write(self._microphone, self._finder.close())

    def push(self, frames: Frames, labels: FrameLabels | None) -> list[Notice]:
        """Write the sound of frames that is to be kept."""
        if self._keep == "off":
            return []
        notices = []
        if labels is not None and labels.classes != self._classes:
            notices = self._change_classes(labels.classes)
        if not self._refused:
            notices += self._writer.write(self._microphone, self._finder.push(frames, labels))
        return notices

    def _change_classes(self, classes: Sequence[str]) -> list[Notice]:
        """Go on with another model, unless it cannot tell what is never kept."""
        before, self._classes = self._refused, classes
        self._refused = self._refusal()
        if self._refused == before:
            return []
        if not self._refused:
            return [CLIPS_AGAIN]
        notices = self._writer.write(self._microphone, self._finder.close())
        return [*notices, Notice(WARNING, f"no clips: {self._refused}")]

    def _refusal(self) -> str:
        """Return why no sound may be kept, or an empty text."""
        if self._keep == "off":
            return ""
        problem = f'keep_audio = "{self._keep}" needs a model'
        classes = self._classes or ()
        missing = [name for name in self._never if name not in classes]
        if missing:
            names = ", ".join(repr(name) for name in missing)
            what = f"this one tells apart {', '.join(classes)}" if classes else "there is none"
            return (
                f"{problem} that knows {names}, which is never kept ({what}); take one that does, "
                "or set never_keep = [] to keep that too"
            )
        if not classes and self._keep != "always":
            return f"{problem}, which says what to keep; give one, or keep it always"
        return ""
