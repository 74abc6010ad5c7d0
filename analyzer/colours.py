"""Colours of classes, the same on screen and on paper."""

import hashlib

from hearthlog.models.classes import find_class

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


def colour_on_paper(name: str) -> Colour:
    """Return the colour of a class on a white background."""
    shade = colour(name)
    return _LIGHT if shade == _WHITE else shade
