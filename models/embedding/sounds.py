"""Synthetic sounds that a network is tried with, the same on every machine."""

from functools import lru_cache

import numpy as np

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.frames import SAMPLE_RATE

SILENCE, TONE, NOISE, BURSTS = "silence", "tone", "noise", "bursts"
_SEED = 20_261_126


@lru_cache(maxsize=2)
def synthetic_sounds(samples: int) -> dict[str, Float32]:
    """Return silence, a tone of 1 kHz, steady noise and four bursts of noise a second, by name.

    Parameters
    ----------
    samples : int
        So many at 16 kHz, from -1 to 1.
    """
    seconds = np.arange(samples) / SAMPLE_RATE
    noise = 2.0 * np.random.default_rng(_SEED).random(samples) - 1.0
    sounds = {
        SILENCE: np.zeros(samples),
        TONE: 0.3 * np.sin(2.0 * np.pi * 1000.0 * seconds),
        NOISE: 0.1 * noise,
        BURSTS: 0.5 * noise * np.exp(-(seconds % 0.25) / 0.02),
    }
    return {name: sound.astype(np.float32) for name, sound in sounds.items()}
