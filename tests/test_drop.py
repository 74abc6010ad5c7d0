"""A log of ours, dropped on Rerun's viewer as it is, shows what happened."""

from io import BytesIO
from threading import Event as Flag

import matplotlib.image
import numpy as np
import pytest
from lossy_source import LossySource
from viewers import shown, viewer

from hearthlog.recorder.config import Settings
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource

__all__ = ["viewer"]  # a fixture

START = 1_772_348_400_000_000_000  # a full hour: it makes one log


@pytest.mark.parametrize("with_model", [True, False])
def test_a_bare_log_opens_with_a_list_of_what_was_heard(
    tmp_path, viewer, day, model_file, with_model
):
    settings = Settings(output=tmp_path / "logs", model=model_file if with_model else None)
    (log,) = record(settings, LossySource(FileSource([day], START), {5: 7}), Flag()).logs

    picture, state = shown(viewer, log, views=1)

    (view,) = state.views
    assert (view.view_class, view.visible, view.reports) == ("TextLog", True, [])
    (loaded,) = state.recordings
    assert loaded.current_timeline == "message_log_time"
    pixels = matplotlib.image.imread(BytesIO(picture))
    height, width, _ = pixels.shape
    middle = pixels[height // 8 : height // 2, width // 4 : width // 2]
    colours = np.unique(middle.reshape(-1, 3), axis=0)
    assert len(colours) > 100  # text; where there is no view it is one colour
