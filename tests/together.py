"""Several microphones recorded into one log, in the order of time."""

import heapq
from collections.abc import Mapping
from contextlib import ExitStack, closing
from itertools import repeat
from pathlib import Path
from threading import Event as Flag
from typing import Any

from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import SoundSource, event_time
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch, ReloadRequests
from hearthlog.recorder.recording_session import RecordingSession


def record_together(
    folder: Path,
    sources: Mapping[str, SoundSource],
    models: Mapping[str, Path] | None = None,
    **settings: Any,
) -> Path:
    """Record microphones, whichever source is quicker, and return the folder.

    Logs are of a minute, unless the settings say something else.
    """
    microphones = [{"name": name, "device": name} for name in sources]
    wanted = {"max_bag_duration": 60, "microphone": microphones} | settings
    requested = Settings(output=folder, **wanted)
    labelling = dict.fromkeys(sources, LabellingModels())
    with ExitStack() as stack:
        for name, path in (models or {}).items():
            watch = stack.enter_context(closing(ModelWatch(path, ReloadRequests().queue())))
            labelling[name] = LabellingModels(watch)
        session = RecordingSession(requested, sources, labelling)
        streams = [zip(repeat(name), each.events(Flag())) for name, each in sources.items()]
        for name, event in heapq.merge(*streams, key=lambda one: event_time(one[1])):
            session.add(name, event)
        session.finish()
    return folder
