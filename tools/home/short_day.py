"""A day compressed into some minutes: sounds of natural length, in a plausible order."""

import numpy as np

from hearthlog.models.classes import (
    COUGHING,
    CRYING,
    FLUSHING_WATER,
    LAUGHING,
    MUSIC,
    OBJECTS_ACTIVITY,
    PHONE_RING,
    SHOWER,
    SPEECH,
    TAP_WATER,
    YELLING,
)
from hearthlog.schemas.frames import FRAME_SECONDS
from hearthlog.tools.home.cast import Cast, Voices
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.plan import (
    BATHROOM,
    BEDROOM,
    FRIDGE,
    KITCHEN,
    LIVING_ROOM,
    PHONE,
    RADIO,
    RESIDENT,
    STREET,
    TELEVISION,
    Plan,
    SteadyNoise,
)
from hearthlog.tools.home.sounds import SimulationError, generator

_MAX_MINUTES = 1440.0
_MIN_SILENCE = 1.0  # before a sound, in seconds
_FRIDGE_SECONDS = (60.0, 120.0), (150.0, 250.0)  # on and off
_EVENT_SECONDS = {
    SPEECH: (10.0, 40.0),
    MUSIC: (30.0, 60.0),
    PHONE_RING: (4.0, 12.0),
    COUGHING: (0.5, 3.0),
    CRYING: (6.0, 15.0),
    YELLING: (2.0, 8.0),
    LAUGHING: (2.0, 7.0),
    OBJECTS_ACTIVITY: (4.0, 20.0),
    FLUSHING_WATER: (8.0, 14.0),
    SHOWER: (30.0, 60.0),
    TAP_WATER: (4.0, 15.0),
}
# Parts of the day: their seconds in a day of 24 minutes, the room, and what is heard there.
_DAY = (
    ("night", 110, BEDROOM, RESIDENT, "coughing"),
    ("getting up", 110, BATHROOM, RESIDENT, "flushing_water tap_water shower"),
    (
        "breakfast",
        100,
        KITCHEN,
        RESIDENT,
        "objects_activity tap_water coughing objects_activity objects_activity",
    ),
    ("call", 80, LIVING_ROOM, RESIDENT, "phone_ring speech"),
    ("radio", 150, KITCHEN, RADIO, "music objects_activity music"),
    (
        "tidying",
        130,
        LIVING_ROOM,
        RESIDENT,
        "objects_activity tap_water objects_activity coughing objects_activity tap_water",
    ),
    ("nap", 110, BEDROOM, RESIDENT, "coughing flushing_water"),
    (
        "television",
        190,
        LIVING_ROOM,
        TELEVISION,
        "speech laughing speech laughing music laughing speech",
    ),
    (
        "supper",
        130,
        KITCHEN,
        RESIDENT,
        "objects_activity tap_water objects_activity coughing objects_activity",
    ),
    ("call", 80, LIVING_ROOM, RESIDENT, "phone_ring speech laughing"),
    ("despair", 110, LIVING_ROOM, RESIDENT, "yelling crying yelling crying crying speech"),
    ("going to bed", 70, BATHROOM, RESIDENT, "flushing_water tap_water coughing"),
    ("night", 70, BEDROOM, RESIDENT, "coughing"),
)
_ROOMS = {FLUSHING_WATER: BATHROOM, SHOWER: BATHROOM}
_DEVICES = {SPEECH, MUSIC, LAUGHING}  # what comes from a television


def plan_short_day(minutes: float, library: ClipLibrary, seed: int) -> Plan:
    """Plan a day in the life of a person living alone, compressed into some minutes.

    A shorter day has less silence between the sounds, and then fewer of them (10 minutes hold about
    three quarters of what 24 do).

    Parameters
    ----------
    minutes : float
        At least a frame, at most 1440.
    seed : int
        Not negative.

    Raises
    ------
    SimulationError
        If `minutes` or `seed` lies beyond its limits.
    """
    frames = round(minutes * 60.0 / FRAME_SECONDS) if 0 < minutes <= _MAX_MINUTES else 0
    if frames < 1:
        raise SimulationError(f"a day lasts more than 0 and at most 1440 minutes, not {minutes}")
    rng = generator(seed)
    voices = Voices(Cast(library, rng), rng, frames)
    share = frames * FRAME_SECONDS / sum(part[1] for part in _DAY)
    begin = 0.0
    for activity, seconds, room, origin, sounds in _DAY:
        for start, length, label in _placed(rng, seconds * share, sounds.split()):
            voices.wait_until(round((begin + start) / FRAME_SECONDS))
            whose = PHONE if label == PHONE_RING else origin if label in _DEVICES else RESIDENT
            voices.sound(label, _ROOMS.get(label, room), activity, length, whose)
        begin += seconds * share
    return Plan(frames, voices.sounds, _steady(rng, frames))


def _placed(
    rng: np.random.Generator, seconds: float, labels: list[str]
) -> list[tuple[float, float, str]]:
    """Place the sounds that fit, in their order, with random silences between them."""
    chosen, left = [], seconds - _MIN_SILENCE
    for label in labels:
        length = rng.uniform(*_EVENT_SECONDS[label])
        if length + _MIN_SILENCE <= left:
            chosen.append((length, label))
            left -= length + _MIN_SILENCE
    silences = _MIN_SILENCE + max(left, 0.0) * rng.dirichlet(np.full(len(chosen) + 1, 2.0))
    ends = np.cumsum(silences[:-1] + [length for length, _ in chosen])
    return [
        (end - length, length, label) for end, (length, label) in zip(ends, chosen, strict=True)
    ]


def _steady(rng: np.random.Generator, frames: int) -> list[SteadyNoise]:
    """Let the street be heard by day, and the fridge come and go."""
    steady = [SteadyNoise(STREET, round(0.08 * frames), round(0.9 * frames))]
    begin = round(rng.uniform(10.0, 60.0) / FRAME_SECONDS)
    while begin < frames:
        on, off = (round(rng.uniform(*spread) / FRAME_SECONDS) for spread in _FRIDGE_SECONDS)
        steady.append(SteadyNoise(FRIDGE, begin, begin + on))
        begin += on + off
    return sorted(steady, key=lambda noise: noise.start)
