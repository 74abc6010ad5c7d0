"""Lines of `hearthlog watch --text`: the current sound of each microphone."""

import math
import sys
import time
from datetime import tzinfo
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.tools.cli.terminal import ReportOnce, bar_of, cropped

if TYPE_CHECKING:
    from hearthlog.analyzer.review.current_sounds import CurrentSound, CurrentSounds

_SECONDS = 1.0  # between two updates
_LONGEST = 60.0  # seconds between two lines of a microphone, without a terminal
_QUIETEST, _LOUDEST = -70.0, -10.0  # dBFS at the ends of the bar of the level
_UP_AND_CLEAR = "\x1b[{}F\x1b[J"  # to the first of so many lines; clear from there


def print_sounds(logs: Path, newest: int | None, timezone: str | None, stop: Event) -> bool:
    """Print the current sounds until stopped; return whether something could not be read."""
    from hearthlog.analyzer.logs.layers import zone_of
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.analyzer.review.current_sounds import CurrentSounds
    from hearthlog.schemas.logs.follow import follow_messages

    home_zone(timezone)
    damaged, zone = ReportOnce(), None
    sounds = CurrentSounds(logs, damaged)
    lines = _SoundLines(sounds)
    start = None if newest is None else newest - _EARLIER_SECONDS * NANOSECONDS
    due = 0.0
    for path, batch in follow_messages(logs, start=start, stop=stop, damaged=damaged, ticks=True):
        sounds.is_live |= path == logs
        try:
            sounds.push(path, batch)
        except LogError as error:
            damaged(error)
        if sounds.is_live and sounds.microphones and time.monotonic() >= due:
            due = time.monotonic() + _SECONDS
            sounds.hide()
            zone = zone or zone_of([logs], timezone)
            lines.update(zone)
        if stop.is_set():
            break
    return bool(damaged)


_EARLIER_SECONDS = 300  # read at the start, for how long a sound has lasted


class _SoundLines:
    """Lines of microphones: redrawn in place on a terminal, else printed at changes."""

    def __init__(self, sounds: "CurrentSounds") -> None:
        self._sounds = sounds
        self._shown: dict[str, str] = {}  # by microphone: the line on the screen
        self._states: dict[str, str] = {}  # by microphone: the sound
        self._printed: dict[str, float] = {}  # by microphone: when, by CLOCK_MONOTONIC

    def update(self, zone: tzinfo) -> None:
        """Write what has changed."""
        sounds = self._sounds.microphones
        width = max(len(self._name(one)) for one in sounds.values())
        lines = {name: self._line(one, zone, width) for name, one in sorted(sounds.items())}
        states = {name: self._state(one) for name, one in sounds.items()}
        changed = [name for name in lines if self._states.get(name) != states[name]]
        if sys.stdout.isatty():
            ended = [self._shown[name] for name in changed if name in self._shown]
            back = _UP_AND_CLEAR.format(len(self._shown)) if self._shown else ""
            own = [cropped(line) for line in lines.values()]
            print(f"{back}{chr(10).join([*ended, *own])}", flush=True)
            self._shown = dict(zip(lines, own, strict=True))
        else:
            now = time.monotonic()
            for name, line in lines.items():
                if name in changed or now - self._printed[name] >= _LONGEST:
                    print(line, flush=True)
                    self._printed[name] = now
        self._states = states

    def _name(self, sound: "CurrentSound") -> str:
        from hearthlog.analyzer.review.current_sounds import microphone_words

        return microphone_words(sound.microphone)

    def _state(self, sound: "CurrentSound") -> str:
        return self._sounds.words(sound) if sound.is_listening() else ""

    def _line(self, sound: "CurrentSound", zone: tzinfo, width: int) -> str:
        from hearthlog.analyzer.logs.local_time import local_time
        from hearthlog.analyzer.review.current_sounds import lasting, silent_since

        is_listening = sound.is_listening()
        moment = local_time(sound.time if is_listening else time.time_ns(), zone)
        start = f"{moment:%H:%M:%S}  {self._name(sound):{width}}  "
        if not is_listening:
            return start + silent_since(sound, zone)
        words = f"{self._sounds.words(sound)} {sound.confidence:.0%} {lasting(sound)}"
        words = words.replace("%", " %", 1)
        if math.isnan(sound.level_dbfs):
            return start + words
        share = (sound.level_dbfs - _QUIETEST) / (_LOUDEST - _QUIETEST)
        return f"{start}{words:32}  {bar_of(share)} {sound.level_dbfs:.0f} dBFS"
