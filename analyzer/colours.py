"""The colour of a class: the same wherever it is shown, on a screen or on paper.

Those that are listed were optimised together: any two differ by at least 19 (CIE 1976, in L*a*b*)
for eyes that see all colours and for protanopia, deuteranopia and tritanopia (as Machado et al.,
2009, simulate them), and by 3 in lightness, which is what is left on a grey print.
"""

import hashlib

Colour = tuple[int, int, int]

GAP: Colour = (200, 40, 40)

_COLOURS: dict[str, Colour] = {
    "silence": (112, 120, 130),
    "speech": (103, 166, 255),
    "music": (200, 129, 194),
    "phone_ring": (246, 241, 66),
    "coughing": (210, 94, 1),
    "crying": (11, 112, 196),
    "yelling": (232, 160, 0),
    "laughing": (0, 158, 82),
    "objects_activity": (141, 76, 28),
    "flushing_water": (107, 72, 224),
    "tap_water": (169, 222, 251),
    "shower": (69, 215, 144),
    "bathroom_other": (93, 83, 63),
    "other_negative": (195, 202, 199),
    "unknown": (255, 255, 255),
}
_SAME = {  # what AudioSet calls them
    "cough": "coughing",
    "crying_sobbing": "crying",
    "laughter": "laughing",
    "shout": "yelling",
    "telephone_bell_ringing": "phone_ring",
    "toilet_flush": "flushing_water",
    "water_tap": "tap_water",
    "yell": "yelling",
}


def colour(name: str) -> Colour:
    """Return the colour of a class; one that is not listed gets a bright one from its name.

    Returns
    -------
    tuple of int
        Red, green and blue, 0 to 255.
    """
    name = _SAME.get(name, name)
    if name in _COLOURS:
        return _COLOURS[name]
    red, green, blue, *_ = hashlib.sha256(name.encode()).digest()
    return 70 + red % 186, 70 + green % 186, 70 + blue % 186
