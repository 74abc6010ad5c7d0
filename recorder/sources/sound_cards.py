"""Sound cards that come and go, as Linux tells it."""

import time
from pathlib import Path
from threading import Event as Flag

_CARDS = Path("/dev/snd")
_LOOK_SECONDS = 0.25


def cards_change(stop: Flag, seconds: float) -> bool:
    """Wait, but no longer than until a sound card comes or goes; return whether one does."""
    cards, end = _sound_cards(), time.monotonic() + seconds
    while time.monotonic() < end and not stop.wait(min(_LOOK_SECONDS, seconds)):
        if _sound_cards() != cards:
            return True
    return False


def _sound_cards() -> int:
    """Return what changes with the sound cards that Linux has; 0 elsewhere."""
    try:
        return _CARDS.stat().st_mtime_ns
    except OSError:
        return 0
