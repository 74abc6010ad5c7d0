"""Labels that name no sound, in whatever spelling."""

import re

SILENCE, UNKNOWN = "silence", "unknown"


def spelt(label: str) -> str:
    """Spell a label as the names of classes are: `Crying, sobbing` as `crying_sobbing`."""
    return re.sub("[ ,-]+", "_", label.lower())


def is_sound(label: str) -> bool:
    """Tell whether a label names a sound, and neither silence nor what the model does not know."""
    return spelt(label) not in {SILENCE, UNKNOWN}
