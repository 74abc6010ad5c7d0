"""How much of speech is understood: by a recogniser, and by a measure of intelligibility."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pocketsphinx import Decoder
from pystoi import stoi

from hearthlog.schemas.arrays import Float64
from hearthlog.schemas.frames import SAMPLE_RATE

DIGITS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_PAUSE = np.zeros(SAMPLE_RATE * 3 // 10)
_LOUDEST, _NOISE = 0.5, 1e-4  # of full scale
_SHORTEST = 0.6  # seconds: the measure needs 0.4 s that are not silent


class Recogniser:
    """PocketSphinx with its English model, and its dictionary.

    Parameters
    ----------
    digits : bool
        Whether it hears one digit; else sentences of any words.
    """

    def __init__(self, *, digits: bool) -> None:
        self._decoder: Any = Decoder(loglevel="FATAL")
        if digits:
            grammar = f"#JSGF V1.0; grammar digits; public <digit> = {' | '.join(DIGITS)};"
            self._decoder.add_jsgf_string("digits", grammar)
            self._decoder.activate_search("digits")

    def recognise(self, sound: Float64) -> str:
        """Return the words in a sound, as loud as speech is.

        Parameters
        ----------
        sound : np.ndarray [shape=(n,)], float64
            Samples at 16 kHz.
        """
        recognised = np.concatenate([_PAUSE, sound, _PAUSE])
        recognised = recognised * (_LOUDEST / max(np.abs(recognised).max(), 1e-9))
        recognised += np.random.default_rng(0).standard_normal(len(recognised)) * _NOISE
        self._decoder.start_utt()
        self._decoder.process_raw((recognised * 32767).astype("<i2").tobytes(), full_utt=True)
        self._decoder.end_utt()
        spoken = self._decoder.hyp()
        return spoken.hypstr if spoken else ""


def word_errors(spoken: Sequence[str], recognised: Sequence[str]) -> float:
    """Return the words that are wrong, missing or too many, as a share of those that were said.

    Parameters
    ----------
    spoken, recognised : sequence of str
        Texts of the same sounds.
    """
    wrong = sum(_distance(a.split(), b.split()) for a, b in zip(spoken, recognised, strict=True))
    return wrong / max(sum(len(text.split()) for text in spoken), 1)


def _distance(spoken: Sequence[str], recognised: Sequence[str]) -> int:
    """Count the least insertions, deletions and substitutions from one text to the other."""
    row = list(range(len(recognised) + 1))
    for number, word in enumerate(spoken, start=1):
        before, row[0] = row[0], number
        for place, other in enumerate(recognised, start=1):
            before, row[place] = (
                row[place],
                min(row[place] + 1, row[place - 1] + 1, before + (word != other)),
            )
    return row[-1]


def intelligibility(sounds: Sequence[Float64], recognised: Sequence[Float64]) -> float:
    """Return the mean extended short-time objective intelligibility (ESTOI), 0 to 1.

    It is that of Jensen and Taal, "An algorithm for predicting the intelligibility of speech masked
    by modulated noise maskers", 2016.

    Parameters
    ----------
    sounds, recognised : sequence of np.ndarray [shape=(n,)], float64
        Samples at 16 kHz, as they were and as they are heard; short ones do not count.
    """
    pairs = [
        (a, b) for a, b in zip(sounds, recognised, strict=True) if len(a) > _SHORTEST * SAMPLE_RATE
    ]
    return float(np.mean([stoi(a, b, SAMPLE_RATE, extended=True) for a, b in pairs]))
