"""Whether what is enrolled of somebody is one voice."""

from collections.abc import Iterable

import numpy as np

from hearthlog.analyzer.discover.read_speech import voices_of
from hearthlog.analyzer.discover.voice_space import WINDOW_FRAMES, has_voices, voice_space
from hearthlog.analyzer.discover.voices import same_voice, summed
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.dataset import Recording
from hearthlog.analyzer.training.speakers import is_voice
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import time_text

_QUIET = 10 ** (-30 / 10)  # of the loud frames
_MOST_FRAMES = 6_000  # of a voice
_SURELY = 2.0  # the logarithm by which two voices are likelier than one


def check_voices(recordings: Iterable[Recording], features: FeatureSet) -> None:
    """Check that nobody is enrolled with two voices.

    Raise `DataError` if two voices are heard in what is enrolled as one.
    """
    if not has_voices(features.feature_names):
        return
    by_name: dict[str, list[Recording]] = {}
    for one in recordings:
        if is_voice(one.label):
            by_name.setdefault(one.label, []).append(one)
    for name, own in by_name.items():
        if is_of_two(np.concatenate([_loud(one.features, features) for one in own]), features):
            times = ", ".join(sorted(time_text(one.span[0])[:19] for one in own if one.span))
            raise DataError(
                f"{name}: two voices are heard in what is enrolled ({times}); delete what is of "
                "another person, or enrol the other voice under a name of its own"
            )


def is_of_two(values: Float32, features: FeatureSet) -> bool:
    """Tell whether two voices are heard in speech; in less than a window there is one."""
    if len(values) < WINDOW_FRAMES:
        return False
    of, points = voices_of(values[:_MOST_FRAMES], features.feature_names)
    voices = summed(points, of, int(of.max()) + 1)
    for row in range(1, len(voices.counts)):
        rest = voices.rows(np.arange(row))
        ratio = same_voice(voices.rows(np.array([row])), rest, voice_space().spread)
        if ratio.min() < -_SURELY:
            return True
    return False


def _loud(values: Float32, features: FeatureSet) -> Float32:
    power = features.power(values)
    return values[power > np.percentile(power, 90) * _QUIET]
