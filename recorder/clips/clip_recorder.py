"""Keeping clips: what may be kept of the sound, into layers beside the log, and not for ever."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hearthlog.recorder.clips.clip_choice import ClipFinder, Labelled
from hearthlog.recorder.clips.clip_layer import ClipLog
from hearthlog.recorder.clips.clip_retention import Retention
from hearthlog.recorder.config import Settings
from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.events import Event, Frames, Gap
from hearthlog.recorder.pipeline import Pipeline
from hearthlog.schemas.frames import FRAME_NANOSECONDS
from hearthlog.schemas.times import NANOSECONDS


class ClipKeeper:
    """Keeps the clips of one recording, if it was asked to, and deletes old ones in any case.

    What its methods return is to be said, with its level of `diagnostic_msgs`.

    Parameters
    ----------
    settings : Settings
    pipeline : Pipeline
        Of the microphone whose sound it is.
    file_at : callable
        Gives the log that has a time, and when that ends, in nanoseconds of UTC.

    Raises
    ------
    ConfigurationError
        If sound is to be kept and the model cannot tell what must not be.
    """

    def __init__(
        self,
        settings: Settings,
        pipeline: Pipeline,
        file_at: Callable[[int], tuple[Path, int]],
    ) -> None:
        self._keep = settings.keep_audio
        self._never = settings.never_keep
        self._retention = Retention(settings.output, settings.node, settings.clip_retention_days)
        frames = round(settings.clip_pre_roll_seconds * NANOSECONDS / FRAME_NANOSECONDS)
        self._finder = ClipFinder(
            self._keep, self._never, frames, pipeline.feature_set.window_frames
        )
        self._log = ClipLog(settings, pipeline.microphone, file_at)
        self._classes: Sequence[str] | None = pipeline.classes
        self._reason = self._refusal()
        if self._reason:
            raise ConfigurationError(self._reason)

    def before(self, event: Event) -> list[tuple[int, str]]:
        """Attend to what will come into the log now: a gap ends the sound before it."""
        if isinstance(event, Gap) and not self._reason:
            return self._log.write(self._finder.close())
        return []

    def after(self, event: Event, labelled: Labelled | None) -> list[tuple[int, str]]:
        """Attend to what is in the log now, and to how its last frames were labelled."""
        now = time_of(event)
        said = self._retention.attend(now)
        if self._keep == "off":
            return said
        said += self._log.attend(now)
        if isinstance(event, Frames):
            if labelled is not None and labelled.classes != self._classes:
                said += self._change_classes(labelled.classes)
            if not self._reason:
                said += self._log.write(self._finder.push(event, labelled))
        return said

    def _change_classes(self, classes: Sequence[str]) -> list[tuple[int, str]]:
        """Go on with the labels of another model, unless it does not know what is never kept."""
        before, self._classes = self._reason, classes
        self._reason = self._refusal()
        if self._reason == before:
            return []
        if not self._reason:
            return [(0, "clips are kept again")]
        return [*self._log.write(self._finder.close()), (1, f"no clips: {self._reason}")]

    def finish(self) -> list[tuple[int, str]]:
        """Keep what is left to be kept, and complete the layer."""
        said = [] if self._reason else self._log.write(self._finder.close())
        return [*said, *self._log.finish()]

    def _refusal(self) -> str:
        """Tell why no sound may be kept."""
        if self._keep == "off":
            return ""
        asked = f'keep_audio = "{self._keep}" needs a model'
        known = self._classes or ()
        unknown = [name for name in self._never if name not in known]
        if unknown:
            names = ", ".join(repr(name) for name in unknown)
            what = f"this one tells apart {', '.join(known)}" if known else "there is none"
            return (
                f"{asked} that knows {names}, which is never kept ({what}); take one that does, "
                "or set never_keep = [] to keep that too"
            )
        if not known and self._keep != "always":
            return f"{asked}, which says what to keep; give one, or keep it always"
        return ""


def time_of(event: Event) -> int:
    """Return the time of the last that an event tells of, in nanoseconds of UTC."""
    if isinstance(event, Frames):
        return int(event.stamps[-1])
    return event.end if isinstance(event, Gap) else event.stamp
