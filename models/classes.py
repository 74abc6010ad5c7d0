"""The classes of sound: one table of their names, colours and durations."""

import hashlib
import re
from collections.abc import Collection, Iterable
from typing import NamedTuple

from hearthlog.schemas.messages import topics
from hearthlog.schemas.messages.topics import spelt

SILENCE, SPEECH, MUSIC, PHONE_RING = topics.SILENCE, "speech", "music", "phone_ring"
COUGHING, CRYING, YELLING, LAUGHING = "coughing", "crying", "yelling", "laughing"
FLUSHING_WATER, SHOWER, TAP_WATER = "flushing_water", "shower", "tap_water"
RUNNING_WATER = "running_water"  # shown for the three, where a model does not tell them apart
OBJECTS_ACTIVITY, BATHROOM_OTHER = "objects_activity", "bathroom_other"
OTHER_NEGATIVE = "other_negative"  # rain, a dog, sirens …: in no built-in scenario
TELEVISION = "television"  # a person's answer: the sound was of no person here; never trained
OTHER, UNKNOWN = "other", topics.UNKNOWN  # for models and people; never trained
# Answers of a person that are neither right nor wrong for a model, and teach nothing.
UNDECIDED = frozenset({UNKNOWN, TELEVISION})
OF_EVERY_SCENARIO = frozenset({SILENCE, UNKNOWN, OTHER})  # classes without a name in the scenario
# Groups that counts and displays treat alike: a new class joins them here.
WORRYING = (COUGHING, CRYING, YELLING)  # a person must look at them, also where one is only likely
IMPORTANT = (*WORRYING, PHONE_RING)  # shown first
WATER = (FLUSHING_WATER, SHOWER, TAP_WATER)
# What counts only where the model is sure, or a person: in homes of known truth none of 15 rings
# below 0.7 was one, but 10 of 13 bouts of coughing were.
COUNTED_IF_SURE = (PHONE_RING,)
# What is in no count and no length beside a television: not water, nor a home's own classes.
ON_TELEVISION = (
    *IMPORTANT, LAUGHING, OBJECTS_ACTIVITY, SPEECH, MUSIC, OTHER_NEGATIVE, OTHER, UNKNOWN,
)  # fmt: skip
CLASS_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


class SoundClass(NamedTuple):
    """A class of sound."""

    name: str
    colour: tuple[int, int, int]  # red, green and blue, 0 to 255
    seconds: float
    words: str
    several: str = ""  # plural name of its events for counts; empty if events are not counted
    # names of the same class in other datasets, in the spelling of `find_class`; without subclasses
    aliases: tuple[str, ...] = ()


# In the order of displays, the most important first; a home's own classes come before television.
# Aliases are the names of AudioSet, and of FSD50K, which has "and" for their commas. The colours,
# except those of `other` and `television`, were optimised together: any two differ by at least 19
# (CIE 1976, in L*a*b*) in normal vision and in protanopia, deuteranopia and tritanopia (simulated
# as by Machado et al., 2009), and by 3 in lightness, which remains on a grey print.
# fmt: off
CLASSES = (
    SoundClass(COUGHING,         (210,  94,   1),   1.0, "Coughing",
               "Times of coughing", ("cough",)),
    SoundClass(CRYING,           ( 11, 112, 196),  10.0, "Crying",
               "Times of crying", ("crying_sobbing", "crying_and_sobbing")),
    SoundClass(YELLING,          (232, 160,   0),  10.0, "Shouting",
               "Times of shouting", ("shout", "yell")),
    SoundClass(PHONE_RING,       (246, 241,  66),  10.0, "Telephone ringing",
               "Times the telephone rang", ("telephone_bell_ringing", "ringtone")),
    SoundClass(SPEECH,           (103, 166, 255),  10.0, "Talking"),
    SoundClass(LAUGHING,         (  0, 158,  82),  10.0, "Laughing",
               "", ("laughter",)),
    SoundClass(MUSIC,            (200, 129, 194),  20.0, "Music"),
    SoundClass(OBJECTS_ACTIVITY, (141,  76,  28),  10.0, "Household sounds"),
    SoundClass(FLUSHING_WATER,   (107,  72, 224),  10.0, "Toilet flush",
               "Toilet flushes", ("toilet_flush",)),
    SoundClass(SHOWER,           ( 69, 215, 144),  60.0, "Shower", "Showers"),
    SoundClass(TAP_WATER,        (169, 222, 251),  10.0, "Water tap",
               "Water taps", ("water_tap", "water_tap_faucet", "water_tap_and_faucet")),
    SoundClass(BATHROOM_OTHER,   ( 93,  83,  63),  10.0, "Bathroom other"),
    SoundClass(TELEVISION,       (164, 140, 134),  10.0, "Television",
               "", ("tv", "from_the_television")),
    SoundClass(OTHER_NEGATIVE,   (195, 202, 199),  10.0, "Other negative"),
    SoundClass(OTHER,            (101, 111, 208),  10.0, "Other sounds"),
    SoundClass(UNKNOWN,          (255, 255, 255),  10.0, "Not recognised"),
    SoundClass(SILENCE,          (112, 120, 130),   2.5, "Quiet"),
)
# fmt: on

_RANKS: dict[str, float] = {row.name: number for number, row in enumerate(CLASSES)}
_RANKS[RUNNING_WATER] = _RANKS[TAP_WATER] + 0.5
_OWN_RANK = _RANKS[TELEVISION] - 0.5  # of a home's own classes

_BY_NAME = {name: row for row in CLASSES for name in (row.name, *row.aliases)}


def find_class(label: str) -> SoundClass | None:
    """Return the class of a label, its name or alias; None if the class is not in the table.

    Case is ignored, and spaces, commas and hyphens equal `_`: `Crying, sobbing` is
    `crying_sobbing`.
    """
    return _BY_NAME.get(spelt(label))


def in_words(label: str) -> str:
    """Return the display name of a class; that of an unknown class is the name without `_`."""
    row = find_class(label)
    return label.replace("_", " ").capitalize() if row is None else row.words


def class_name(label: str) -> str:
    """Return the class name of a label; the label itself if there is none."""
    row = find_class(label)
    return label if row is None else row.name


def ordered(labels: Iterable[str]) -> list[str]:
    """Return labels without duplicates in the order of all displays, the most important first.

    Classes of a home's own keep their order, in a set that of the alphabet.
    """
    if isinstance(labels, (set, frozenset)):
        labels = sorted(labels)
    return sorted(dict.fromkeys(labels), key=lambda label: _RANKS.get(class_name(label), _OWN_RANK))


def meant_by(label: str, names: Collection[str]) -> list[str]:
    """Return the `names`, in their order, that match a label in any spelling, or by its class.

    They are the label itself, or all of its class. Two names of one class in a dataset are distinct
    there, so a third name matches both.
    """
    if label in names:
        return [label]
    row = find_class(label)
    same = [name for name in names if row is not None and find_class(name) == row]
    return [name for name in same if spelt(name) == spelt(label)] or same


def translation(labels: Iterable[str], names: Collection[str]) -> dict[str, str]:
    """Return the matching name of each label; the label itself if none or several names match."""
    meant = {label: meant_by(label, names) for label in labels}
    return {label: same[0] if len(same) == 1 else label for label, same in meant.items()}


Colour = tuple[int, int, int]

GAP: Colour = (200, 40, 40)
_WHITE: Colour = (255, 255, 255)
_LIGHT: Colour = (205, 205, 205)


def colour(name: str) -> Colour:
    """Return the RGB colour of a class, 0 to 255; custom classes get a bright hash of the name."""
    row = find_class(name)
    if row is not None:
        return row.colour
    red, green, blue, *_ = hashlib.sha256(name.encode()).digest()
    return 70 + red % 186, 70 + green % 186, 70 + blue % 186


_DARK_BELOW, _LIGHTER = 0.2, (0.6, 0.25)  # relative luminance; share of white below it, and above


def colour_on_dark(shade: Colour) -> Colour:
    """Return a lighter colour for a dark background, of a dark one more than of a bright one.

    So those of one hue stay apart.
    """
    red, green, blue = ((part / 255) ** 2.2 for part in shade)
    white = _LIGHTER[0.21 * red + 0.72 * green + 0.07 * blue >= _DARK_BELOW]
    red, green, blue = (round((1 - white) * part + white * 255) for part in shade)
    return int(red), int(green), int(blue)


def colour_on_paper(name: str) -> Colour:
    """Return the colour of a class on a white background."""
    shade = colour(name)
    return _LIGHT if shade == _WHITE else shade
