"""The colour of a class: the same wherever it is shown, on a screen or on paper."""

import hashlib

from hearthlog.models.classes import find_class

Colour = tuple[int, int, int]

GAP: Colour = (200, 40, 40)
_WHITE: Colour = (255, 255, 255)
_LIGHT: Colour = (205, 205, 205)


def colour(name: str) -> Colour:
    """Return the colour of a class; one of somebody's own gets a bright one from its name.

    Returns
    -------
    tuple of int
        Red, green and blue, 0 to 255.
    """
    row = find_class(name)
    if row is not None:
        return row.colour
    red, green, blue, *_ = hashlib.sha256(name.encode()).digest()
    return 70 + red % 186, 70 + green % 186, 70 + blue % 186


def colour_on_paper(name: str) -> Colour:
    """Return the colour of a class on a white ground."""
    shade = colour(name)
    return _LIGHT if shade == _WHITE else shade
