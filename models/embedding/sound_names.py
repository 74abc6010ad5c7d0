"""Names of AudioSet: events, hints, and groups that are logged with an embedding."""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hearthlog.models.embedding import HOP_FRAMES, WINDOW_FRAMES, Embeddings, Projection
from hearthlog.schemas.arrays import Float64, Int64

_FILE = Path(__file__).with_name("audioset_names.csv")
RELEASE = 1.0  # logits below the threshold down to which a sound continues
_PAUSE_FRAMES = 2 * HOP_FRAMES  # between windows of one sound, at most
_MARGIN = (WINDOW_FRAMES - HOP_FRAMES) // 2  # frames of a window before and after its middle


class SoundName(NamedTuple):
    """A name of a sound, and its detection accuracy.

    The table `audioset_names.csv` contains the names, as measured by `hearthlog.tools.lab.names`.
    """

    name: str
    words: str
    group: str
    seconds: float
    windows: int
    threshold: float = 0.0
    # whether its measured precision is sufficient for an event; else it is a hint
    is_event: bool = False
    clips: int = 0
    sources: int = 0
    # for an event, on sources not used to choose its threshold; for a hint, on all sources; NaN for
    # too few sources
    precision: float = math.nan
    recall: float = math.nan
    false_an_hour: float = math.nan


@cache
def audioset_names() -> tuple[SoundName, ...]:
    """Return the names in hearthlog's table."""
    return tuple(read_names(_FILE))


def read_names(path: Path) -> list[SoundName]:
    """Read a CSV table with the fields of `SoundName` as columns; numbers may be missing."""
    types = SoundName.__annotations__
    with path.open(newline="", encoding="utf-8") as stream:
        rows = [{key: text for key, text in row.items() if text} for row in csv.DictReader(stream)]
    return [SoundName(**{key: _VALUES[types[key]](row[key]) for key in row}) for row in rows]


def write_names(names: Sequence[SoundName], path: Path) -> None:
    """Write a table of names in the format of `read_names`."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(SoundName._fields)
        writer.writerows(map(_text, row) for row in names)


class NamedSound(NamedTuple):
    """A sound named by the network."""

    name: SoundName
    first: int  # number of its first frame
    end: int  # number of the frame after its last
    logit: float


def named_sounds(
    embeddings: Embeddings, projection: Projection, names: Sequence[SoundName] | None = None
) -> list[NamedSound]:
    """Find named sounds in the windows of one stream.

    A sound begins with a window above the threshold, and continues while windows no more than a
    second apart are above the threshold or slightly below.

    Raise `ValueError` if the projection lacks the group of a name.
    """
    names = audioset_names() if names is None else names
    columns, sounds = _columns(projection, names), list[NamedSound]()
    if not len(embeddings.frames):
        return sounds
    logits = projection.values(embeddings.values)[:, columns]
    above_low = (projection.lows + projection.steps)[columns]  # the lower limit is no detection
    for place, name in enumerate(names):
        sounds += _named(name, logits[:, place], embeddings.frames, float(above_low[place]))
    return sorted(sounds, key=lambda sound: sound.first)


def _named(name: SoundName, logits: Float64, frames: Int64, above_low: float) -> list[NamedSound]:
    above = logits >= name.threshold
    rows = np.flatnonzero(above | (logits >= max(name.threshold - RELEASE, above_low)))
    if not len(rows):
        return []
    begins = np.flatnonzero(np.diff(frames[rows], prepend=-_PAUSE_FRAMES - 1) > _PAUSE_FRAMES)
    counts = np.add.reduceat(above[rows].astype(np.int64), begins)
    highest = np.maximum.reduceat(logits[rows], begins)
    never = len(frames)
    first = np.minimum.reduceat(np.where(above[rows], rows, never), begins)
    last = rows[np.append(begins[1:], len(rows)) - 1]
    found = np.flatnonzero((counts > 0) & (counts >= name.windows))
    return [
        NamedSound(
            name,
            int(frames[first[run]]) + _MARGIN,
            int(frames[last[run]]) + WINDOW_FRAMES - _MARGIN,
            float(highest[run]),
        )
        for run in found.tolist()
    ]


def _columns(projection: Projection, names: Sequence[SoundName]) -> list[int]:
    missing = {name.group for name in names}.difference(projection.names)
    if missing:
        raise ValueError(f"the projection has no group {', '.join(sorted(missing))}")
    return [projection.names.index(name.group) for name in names]


def _yes(text: str) -> bool:
    return text == "yes"


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:g}"
    return str(value)


_VALUES: Mapping[object, Callable[[str], Any]] = {str: str, float: float, int: int, bool: _yes}


# The first groups serve the classes of the scenarios; "outside" covers sounds foreign to a home.
GROUPS: Mapping[str, tuple[str, ...]] = {
    "silence": ("Silence",),
    "speech": (
        "Speech",
        "Child speech, kid speaking",
        "Conversation",
        "Narration, monologue",
        "Speech synthesizer",
    ),
    "music": ("Music", "Musical instrument", "Singing"),
    "phone_ring": (
        "Telephone",
        "Telephone bell ringing",
        "Ringtone",
        "Telephone dialing, DTMF",
        "Dial tone",
    ),
    "coughing": ("Cough", "Throat clearing"),
    "crying": ("Crying, sobbing", "Baby cry, infant cry", "Whimper", "Wail, moan"),
    "yelling": ("Shout", "Yell", "Screaming", "Children shouting", "Bellow", "Whoop"),
    "laughing": (
        "Laughter",
        "Baby laughter",
        "Giggle",
        "Chuckle, chortle",
        "Belly laugh",
        "Snicker",
    ),
    "objects_activity": (
        "Door",
        "Slam",
        "Knock",
        "Cupboard open or close",
        "Drawer open or close",
        "Dishes, pots, and pans",
        "Cutlery, silverware",
        "Chopping (food)",
        "Frying (food)",
        "Microwave oven",
        "Blender",
        "Keys jangling",
        "Typing",
        "Writing",
        "Chewing, mastication",
        "Computer keyboard",
        "Tick",
        "Clock",
        "Tick-tock",
        "Walk, footsteps",
        "Zipper (clothing)",
        "Crumpling, crinkling",
        "Vacuum cleaner",
        "Rustle",
        "Wood",
        "Coin (dropping)",
    ),
    "flushing_water": ("Toilet flush",),
    "shower": ("Bathtub (filling or washing)", "Spray", "Rain", "Water"),
    "tap_water": (
        "Water tap, faucet",
        "Sink (filling or washing)",
        "Liquid",
        "Pour",
        "Fill (with liquid)",
        "Trickle, dribble",
    ),
    "outside": (
        "Animal",
        "Dog",
        "Bark",
        "Cat",
        "Meow",
        "Chicken, rooster",
        "Bird",
        "Vehicle",
        "Car",
        "Vehicle horn, car horn, honking",
        "Siren",
        "Helicopter",
        "Aircraft",
        "Chainsaw",
        "Engine",
        "Rain",
        "Thunder",
        "Wind",
        "Ocean",
        "Waves, surf",
        "Fire",
        "Crackle",
        "Sneeze",
        "Snoring",
        "Alarm",
        "Doorbell",
        "Smoke detector, smoke alarm",
        "Fire alarm",
        "Throat clearing",
        "Crowing, cock-a-doodle-doo",
        "Water",
        "Train",
        "Fireworks",
        "Gunshot, gunfire",
    ),
    # Groups of single names.
    "conversation": ("Conversation",),
    "shout": ("Shout", "Yell", "Bellow", "Whoop"),
    "scream": ("Screaming",),
    "baby_cry": ("Baby cry, infant cry",),
    "sobbing": ("Crying, sobbing", "Whimper", "Wail, moan"),
    "groan": ("Groan", "Grunt", "Sigh"),
    "breathing": ("Breathing", "Wheeze", "Gasp", "Pant"),
    "snoring": ("Snoring", "Snort"),
    "cough": ("Cough",),
    "throat_clearing": ("Throat clearing",),
    "sneeze": ("Sneeze",),
    "sniff": ("Sniff",),
    "burp": ("Burping, eructation", "Hiccup"),
    "whistling": ("Whistling", "Whistle"),
    "chuckle": ("Chuckle, chortle", "Snicker"),
    "singing": ("Singing", "Humming", "Choir"),
    "clapping": ("Clapping", "Applause", "Finger snapping"),
    "crowd": ("Crowd", "Chatter", "Hubbub, speech noise, speech babble", "Cheering"),
    "footsteps": ("Walk, footsteps",),
    "thump": ("Thump, thud", "Thunk", "Bang"),
    "eating": ("Chewing, mastication", "Biting", "Crunch"),
    "dishes": ("Dishes, pots, and pans", "Cutlery, silverware"),
    "chopping": ("Chopping (food)", "Chop"),
    "frying": ("Frying (food)", "Sizzle"),
    "boiling": ("Boiling", "Steam"),
    "microwave": ("Microwave oven",),
    "blender": ("Blender",),
    "vacuum_cleaner": ("Vacuum cleaner",),
    "hair_dryer": ("Hair dryer",),
    "shaver": ("Electric shaver, electric razor", "Electric toothbrush"),
    "toothbrush": ("Toothbrush",),
    "sewing_machine": ("Sewing machine",),
    "power_tool": ("Power tool", "Drill", "Jackhammer", "Sawing"),
    "hammer": ("Hammer",),
    "fan": ("Mechanical fan", "Air conditioning"),
    "printer": ("Printer",),
    "keyboard": ("Computer keyboard", "Typing"),
    "writing": ("Writing",),
    "paper": ("Crumpling, crinkling", "Tearing"),
    "zipper": ("Zipper (clothing)",),
    "door": ("Door", "Slam", "Sliding door", "Creak"),
    "slam": ("Slam",),
    "knock": ("Knock",),
    "doorbell": ("Doorbell", "Ding-dong"),
    "bell": ("Bell", "Ding", "Chime", "Bicycle bell"),
    "cupboard": ("Cupboard open or close", "Drawer open or close"),
    "keys": ("Keys jangling", "Jingle, tinkle"),
    "glass": ("Glass", "Chink, clink"),
    "breaking": ("Shatter", "Breaking", "Smash, crash"),
    "clock": ("Clock", "Tick", "Tick-tock"),
    "alarm_clock": ("Alarm clock",),
    "smoke_alarm": ("Smoke detector, smoke alarm", "Fire alarm"),
    "alarm": ("Alarm",),
    # Without "Siren", which the network also gives to telephones and screams.
    "siren": (
        "Police car (siren)",
        "Ambulance (siren)",
        "Emergency vehicle",
        "Fire engine, fire truck (siren)",
    ),
    "civil_defense_siren": ("Civil defense siren",),
    "beep": ("Beep, bleep", "Buzzer", "Busy signal"),
    "television": ("Television",),
    "radio": ("Radio",),
    "dog": ("Dog", "Bark", "Bow-wow", "Yip", "Growling", "Howl"),
    "cat": ("Cat", "Meow", "Purr", "Caterwaul"),
    "bird": ("Bird", "Bird vocalization, bird call, bird song", "Chirp, tweet"),
    "rooster": ("Crowing, cock-a-doodle-doo", "Chicken, rooster"),
    "insect": ("Insect", "Cricket", "Fly, housefly"),
    "rain": ("Rain", "Raindrop", "Rain on surface"),
    "thunder": ("Thunder", "Thunderstorm"),
    "wind": ("Wind", "Wind noise (microphone)"),
    "waves": ("Ocean", "Waves, surf"),
    "stream": ("Stream", "Waterfall"),
    "drip": ("Drip",),
    "sink": ("Water tap, faucet", "Sink (filling or washing)"),
    "spray": ("Spray", "Gush"),
    "fire": ("Fire", "Crackle"),
    "vehicle": ("Vehicle", "Car", "Traffic noise, roadway noise", "Truck", "Motorcycle"),
    "car_horn": ("Vehicle horn, car horn, honking", "Car alarm"),
    "train": ("Train", "Rail transport"),
    "aircraft": ("Aircraft", "Helicopter", "Fixed-wing aircraft, airplane"),
    "chainsaw": ("Chainsaw", "Lawn mower"),
    "fireworks": ("Fireworks", "Gunshot, gunfire", "Explosion"),
}
