"""Another microphone in a simulated home."""

import numpy as np
from scipy.signal import butter, sosfilt

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE
from hearthlog.tools.home.composition import Rooms

_BAND_HERTZ = 200.0, 4000.0
_GAIN = 0.1  # -20 dB


class NarrowRooms(Rooms):
    """The same rooms, as a microphone hears them that passes 200 to 4000 Hz, 20 dB weaker.

    Parameters
    ----------
    microphone : str
        The room that it stands in.
    seed : int
        The home.
    """

    def __init__(self, microphone: str, seed: int) -> None:
        super().__init__(microphone, seed)
        self.floor = _steady(self.floor)
        self.steady = {name: _steady(noise) for name, noise in self.steady.items()}

    def received(self, sound: Float32, room: str) -> Float32:
        """Return a sound of a room as the microphone hears it.

        Parameters
        ----------
        sound : np.ndarray [shape=(n * FRAME_SAMPLES,)], float32
        room : str

        Returns
        -------
        np.ndarray [shape=((n + TAIL_FRAMES) * FRAME_SAMPLES,)], float32
        """
        return _passed(super().received(sound, room))


def _passed(sound: Float32) -> Float32:
    sos = butter(4, _BAND_HERTZ, "bandpass", fs=SAMPLE_RATE, output="sos")
    return (_GAIN * sosfilt(sos, sound)).astype(np.float32)


def _steady(noise: Float32) -> Float32:
    """Pass a noise that repeats itself, so that its end is followed by its beginning."""
    twice = _passed(np.concatenate([noise.ravel()] * 2))
    return twice[noise.size :].reshape(-1, FRAME_SAMPLES)
