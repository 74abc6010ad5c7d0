"""What the microphones of an array hear of a sound from far away, without an echo."""

import numpy as np

from hearthlog.recorder.stream.directions import SPEED_OF_SOUND
from hearthlog.schemas.frames import FRAME_SAMPLES, SAMPLE_RATE

SQUARE = [[0.032, 0.0], [0.0, 0.032], [-0.032, 0.0], [0.0, -0.032]]


def plane_wave(places, azimuth, sound):
    """How microphones hear a sound from far away: [shape=(n, c)]."""
    places = np.array(places)[:, :2]
    ahead = places @ [np.cos(azimuth), np.sin(azimuth)] / SPEED_OF_SOUND
    frequencies = np.fft.rfftfreq(len(sound), 1 / SAMPLE_RATE)
    turned = np.exp(2j * np.pi * frequencies[:, np.newaxis] * ahead)
    return np.fft.irfft(np.fft.rfft(sound)[:, np.newaxis] * turned, len(sound), axis=0)


def bursts(seconds, seed, every=1.0):
    """Bursts of noise of 0.4 s, the first after a second."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    return rng.normal(0, 0.1, len(time)) * ((time >= 1) & (time % every < 0.4))


def array_frames(places, azimuth, seconds=6, seed=1, hiss=1e-3):
    """Frames of an array that hears bursts from one direction, and its own hiss."""
    samples = plane_wave(places, azimuth, bursts(seconds, seed))
    samples += np.random.default_rng(seed + 1).normal(0, hiss, samples.shape)
    return samples.astype(np.float32).reshape(-1, FRAME_SAMPLES, len(places))
