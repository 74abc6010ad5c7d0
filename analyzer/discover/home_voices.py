"""The voices of a home: those that are known, found again in each conversation, and new ones."""

import hashlib
from dataclasses import dataclass, field, replace

import numpy as np

from hearthlog.analyzer.discover.read_speech import HomeSpeech
from hearthlog.analyzer.discover.voice_space import HOP_FRAMES, voice_space
from hearthlog.analyzer.discover.voices import Evidence, joined, same_voice
from hearthlog.analyzer.errors import DataError
from hearthlog.schemas.arrays import Float64, Int64
from hearthlog.schemas.frames import FRAME_SECONDS

NO_VOICE = -1
MOST_VOICES = 1_000  # in a file
LEAST_SECONDS = 20.0  # of speech, in which voices are looked for
_LEAST_WINDOWS = 20  # of a voice: ten seconds
_MOST = 2_000  # voices of conversations, among which those of the home are looked for


@dataclass(frozen=True)
class Voices:
    """The voices of a home.

    Attributes
    ----------
    numbers : np.ndarray [shape=(g,)], int64
        A number is never used again.
    names : list of str
        That a person gave; empty where nobody did.
    """

    numbers: Int64
    evidence: Evidence
    names: list[str] = field(default_factory=list)
    id: str = ""


def find_voices(speech: HomeSpeech, known: Voices | None) -> tuple[Voices, Int64]:
    """Find the voices of a home in its conversations.

    Parameters
    ----------
    known : Voices or None
        Those of an earlier time, which are not changed; None if there are none.

    Returns
    -------
    of : np.ndarray [shape=(n,)], int64
        The row of the voice of each voice of a conversation; `NO_VOICE` for one that is of none.

    Raises
    ------
    DataError
        If none is known and there is too little speech to tell voices apart.
    """
    if known is None and speech.seconds < LEAST_SECONDS:
        raise DataError(
            f"{speech.seconds:.0f} s of speech are too few to tell voices apart: it takes "
            f"{LEAST_SECONDS:.0f} s"
        )
    spread = voice_space().spread
    voices = known or Voices(
        np.empty(0, np.int64), Evidence(np.empty(0), np.empty((0, len(spread))))
    )
    while True:
        of = _known_again(speech.voices, voices.evidence, spread)
        added = _with_new(voices, speech.voices.rows(of == NO_VOICE), spread)
        if len(added.numbers) == len(voices.numbers):
            break
        voices = added
    return (voices if voices.id else _identified(voices)), of


def seconds_of(counts: Float64) -> Float64:
    """Return how long so many windows are."""
    return counts * (HOP_FRAMES * FRAME_SECONDS)


def _known_again(evidence: Evidence, known: Evidence, spread: Float64) -> Int64:
    """Return the known voice that each is likeliest of, if one voice is likelier than two."""
    best = np.zeros(len(evidence.counts))
    of = np.full(len(best), NO_VOICE)
    for row in range(len(known.counts)):
        ratio = same_voice(known.rows(np.array([row])), evidence, spread)
        better = ratio > best
        best[better], of[better] = ratio[better], row
    return of


def _with_new(voices: Voices, rest: Evidence, spread: Float64) -> Voices:
    """Add the voices of what is of none, if one of them speaks for long enough."""
    largest = np.sort(np.argsort(-rest.counts, kind="stable")[:_MOST])
    rest = rest.rows(largest)
    if not len(rest.counts):
        return voices
    of = joined(rest, spread)
    own = (of == np.arange(of.max() + 1)[:, np.newaxis]).astype(np.float64)
    found = Evidence(own @ rest.counts, own @ rest.sums)
    order = np.argsort(-found.counts, kind="stable")
    order = order[found.counts[order] >= _LEAST_WINDOWS][: MOST_VOICES - len(voices.numbers)]
    new = found.rows(order)
    first = voices.numbers.max(initial=0) + 1
    return replace(
        voices,
        numbers=np.append(voices.numbers, np.arange(first, first + len(order))),
        evidence=Evidence(
            np.append(voices.evidence.counts, new.counts),
            np.concatenate([voices.evidence.sums, new.sums]),
        ),
        names=[*voices.names, *[""] * len(order)],
    )


def _identified(voices: Voices) -> Voices:
    digest = hashlib.sha256(b"".join(each.tobytes() for each in voices.evidence)).hexdigest()
    return replace(voices, id=digest[:8])
