"""Supervised microphone: its capture process is monitored and restarted."""

import math
import time
from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import replace
from threading import Event as Flag

import numpy as np

from hearthlog.models.features.floor import decibels
from hearthlog.models.features.infrasound import InfrasoundFilter
from hearthlog.recorder.addresses import check_address, is_address, is_topic, public_name
from hearthlog.recorder.events import (
    ERROR,
    LISTENING,
    OK,
    WARNING,
    Event,
    Frames,
    Gap,
    SourceHealth,
)
from hearthlog.recorder.pause_schedule import PauseSchedule
from hearthlog.recorder.sources.capture import LATENCY_SECONDS, LONG_LATENCY_SECONDS
from hearthlog.recorder.sources.decoding import StreamMixer
from hearthlog.recorder.sources.ffmpeg import check_ffmpeg
from hearthlog.recorder.sources.framing import STEP_SECONDS, Framer, SampleBlock, WallClock
from hearthlog.recorder.sources.process import (
    Capture,
    ReturnWatch,
    cards_change,
    check_ros,
    open_address,
    open_device,
)
from hearthlog.recorder.stream.sound_watch import DEAD_STEPS
from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import NANOSECONDS

_FIRST_BLOCK_SECONDS = 5.0  # PulseAudio wakes a sleeping source
_RETRY_SECONDS = (0.5, 1.0, 2.0, 5.0, 10.0)
_HEALTH_SECONDS = 10.0
_LOOK_SECONDS = 0.25  # between looks at the end of a pause
_BLOCK_WAIT_SECONDS = 0.7  # for a block: more than its length, as each wake-up costs
_OVERFLOWS, _OVERFLOW_SECONDS = 5, 60.0  # so many in this time require a longer buffer
_SILENT_FRAMES = 200  # ten seconds
_FALLBACK_SECONDS = 10.0  # from the loss of the device to the fallback


def check_device(device: str) -> None:
    """Check a device as far as possible before opening it.

    Raise `SourceError` if it is an invalid address, or needs ffmpeg or ROS and these are missing.
    """
    if is_address(device):
        check_address(device)
        if is_topic(device):
            check_ros()
        else:
            check_ffmpeg()


class MicrophoneSource:
    """One microphone as one stream of frames.

    After the first successful start only the same device is used again, or the fallback.

    Raise `SourceError` if this machine cannot capture microphones, or cannot capture this one and
    `waits` is false; if an address is invalid.

    Parameters
    ----------
    device : str
        As `hearthlog devices` lists it, empty for the default one, or a network address.
    fallback : str, optional
        Another device, used while this one is missing; by default none. It is no array.
    waits : bool, optional
        Whether to wait at the start for a missing device, as later. A device that lacks the
        channels of the array is an error without a fallback.
    channels : int or None
        Channels of an array; None for a single microphone.
    channel : int or None
        Channel of the device, counted from 1; by default, and for the fallback, the first one, or
        the best one if the first has much less sound.

    Attributes
    ----------
    device : str
        Name of the current or last device; before that, as given. Without the user and the password
        of an address.
    """

    def __init__(  # noqa: PLR0913
        self,
        device: str,
        *,
        fallback: str = "",
        waits: bool = True,
        rest: PauseSchedule | None = None,
        channels: int | None = None,
        channel: int | None = None,
    ) -> None:
        self._own = _Device(device, channels, channel)
        self._fallback = _Device(fallback) if fallback else None
        self._device_in_use = self._own
        self._return: ReturnWatch | None = None  # while the fallback is in use
        self._lost_at = -math.inf  # when the device was lost
        self._unfit = ""  # why a connected device cannot be used
        self.device = self._own.name
        self._rest = rest
        self._capture: Capture | None = None
        self._mixer: StreamMixer | None = None  # for several channels without an array
        self._framer = Framer()
        self._silent_frames = 0
        self._frames_lost = 0
        self._overruns = 0  # blocks with losses at the sound card
        self._last_block = time.monotonic()  # its arrival
        self._infrasound = InfrasoundFilter()
        self._level = _Level()
        self._health = (OK, "starting")
        waits_later = waits and is_address(device)  # the recorder does not wait for a network
        if not waits_later and not self._resting():
            self._try_at_the_start(waits=waits)
        self._last_health = self._health
        self._reported = -math.inf
        self._clock = WallClock()
        self._wall_offset = self._clock.offset()

    def events(self, stop: Flag) -> Iterator[Event]:
        """Yield events in the order of time until `stop` is set, even if the microphone is lost.

        Health comes every ten seconds, and on change.
        """
        reason = "the microphone was started"
        while not stop.is_set():
            reason = yield from self._rest_if_due(reason, stop)
            if self._capture is None:
                yield from self._wait_for_device(stop)
            if self._capture is None:
                continue
            if self._return is not None:
                reason = f"{reason}; {self.device} is heard in its place"
            reason = yield from self._capture_run(self._capture, reason, stop)
            if self._resting():
                self.close()
                continue
            returned = self._return.take() if self._return is not None else None
            self.close()
            if stop.is_set():
                if returned is not None:
                    returned.kill()
                return
            if returned is not None:
                self._on_samples(self._own, returned)
                reason = f"{self.device} is there again"
                continue
            self._lost_at = time.monotonic()
            self._health = (ERROR, reason)
            yield from self._report(self._now())

    def close(self) -> None:
        """End the capture process."""
        if self._capture is not None:
            self._capture.kill()
            self._capture = None
        if self._return is not None:
            self._return.close()
            self._return = None

    def _capture_run(
        self, capture: Capture, reason: str, stop: Flag
    ) -> Generator[Event, None, str]:
        """Yield the events of one run of the capture process; return the reason for its end."""
        form = capture.format
        channels = form.channels if self._mixer is None else None
        self._steps_clock()
        self._framer.begin(form.rate, self._wall_offset, reason, form.lost_reason, channels)
        stale = form.stale_seconds
        last_block = time.monotonic() + max(_FIRST_BLOCK_SECONDS - stale, 0.0)
        while not stop.is_set():
            try:
                blocks = capture.blocks(_BLOCK_WAIT_SECONDS)
            except DeviceError as error:
                return str(error)
            if blocks is None:
                return "the capture process ended"
            for block in blocks:
                last_block = self._last_block = block.arrival
                yield from self._frames_of(block, form.rate)
            if time.monotonic() - last_block > stale and not blocks:
                self._device_in_use.was_silent()
                return "the microphone went silent"
            if self._steps_clock():
                self._framer.step_clock(self._wall_offset)
            self._report_channel()
            if blocks:  # stamped with the frames' time, as the current time would be ahead of them
                yield from self._report(self._framer.last_stamp)
            if ending := self._reason_to_end():
                return ending
        return "the recorder was stopped"

    def _reason_to_end(self) -> str:
        """Return why a run of the capture process must end; empty if it need not."""
        if self._return is not None and self._return.is_there:
            return "its device is there again"
        if self._device_in_use.needs_longer_buffer():
            return "the sound card lost samples: it is opened again with a longer buffer"
        return self._resting()

    def _frames_of(self, block: SampleBlock, rate: int) -> Iterator[Event]:
        """Yield the frames completed by a block, and the gap before them."""
        self._overruns += block.overflowed
        self._device_in_use.add(block)
        if not len(block.samples):
            return
        if self._mixer is not None:
            block = replace(block, samples=self._mixer(block.samples, rate))
        # Before resampling, which turns noise of one step into noise like that of a quiet room.
        first = block.samples if block.samples.ndim == 1 else block.samples[:, 0]
        is_flat = int(first.max()) - int(first.min()) <= DEAD_STEPS
        for event in self._framer.add(block):
            yield self._watched(event, is_flat=is_flat)

    def _report_channel(self) -> None:
        """Report a change of the selected channels once; the sound itself is fine."""
        if self._mixer is not None and self._mixer.news and self._health[0] != ERROR:
            self._health = (WARNING, self._mixer.news)
            self._mixer.news = ""

    def _try_at_the_start(self, *, waits: bool) -> None:
        try:
            self._on_samples(self._own, self._open(self._own, Flag()))
        except SourceError as error:
            self._miss(error)
            if not waits or (self._unfit and not self._falls_back(Flag())):
                raise

    def _miss(self, error: SourceError) -> None:
        self._unfit = "" if isinstance(error, DeviceError) else str(error)
        self._health = (ERROR, f"{error}; waiting for it")

    def _open(self, device: "_Device", stop: Flag) -> Capture:
        if is_address(device.wanted):
            return open_address(device.wanted, stop, device.channel)
        try:
            return open_device(
                device.wanted,
                exact=device.was_opened,
                channels=device.channels,
                channel=device.channel,
                latency=device.latency,
            )
        except SourceError:
            device.could_not_be_opened()
            raise

    def _on_samples(self, device: "_Device", capture: Capture) -> None:
        self._capture = capture
        device.opened(capture)
        self._device_in_use = device
        self.device = device.name
        self._mixer = None
        if device.channels is None and capture.format.channels is not None:
            self._mixer = StreamMixer(takes_first=not is_address(device.wanted))

    def _wait_for_device(self, stop: Flag) -> Iterator[Event]:
        pauses = iter(_RETRY_SECONDS)
        while not stop.is_set() and not self._resting():
            try:
                self._on_samples(self._own, self._open(self._own, stop))
            except SourceError as error:
                if stop.is_set():
                    return
                self._miss(error)
            else:
                return
            if self._falls_back(stop):
                return
            yield from self._report(self._now())
            if cards_change(stop, next(pauses, _RETRY_SECONDS[-1])):
                pauses = iter(_RETRY_SECONDS)  # a new device may need a moment

    def _resting(self) -> str:
        return "" if self._rest is None else self._rest.reason()

    def _rest_if_due(self, reason: str, stop: Flag) -> Generator[Event, None, str]:
        """Close the device during a pause; return the reason for the gap."""
        while self._rest is not None and (resting := self._rest.reason()):
            self.close()
            if resting not in reason:
                reason = f"{reason}; {resting}"
            self._health = (OK, self._rest.describe())
            yield from self._report(self._now())
            if stop.wait(_LOOK_SECONDS):
                break
        return reason

    def _falls_back(self, stop: Flag) -> bool:
        """Switch to the fallback if there is one and it is due; return whether it is in use."""
        if self._fallback is None or time.monotonic() - self._lost_at < _FALLBACK_SECONDS:
            return False
        try:
            self._on_samples(self._fallback, self._open(self._fallback, stop))
        except SourceError as error:
            self._health = (ERROR, f"{self._health[1]}; nor is its fallback heard: {error}")
            return False
        self._return = ReturnWatch(lambda stop: self._open(self._own, stop))
        return True

    def _watched(self, event: Frames | Gap, *, is_flat: bool) -> Frames | Gap:
        """Update the health; return the event, filtered."""
        if isinstance(event, Gap):
            self._frames_lost += event.frames_lost
            self._infrasound.restart()
            return event
        filtered = self._infrasound(event.samples)
        self._level.add(filtered)
        is_dead = ~event.samples.any(axis=1)
        if is_flat and filtered is not event.samples:  # it has an offset
            is_dead |= (filtered != event.samples).any(axis=1)
        sounding = np.flatnonzero(~is_dead)
        zeros = len(event.samples) - 1 - sounding[-1] if len(sounding) else len(event.samples)
        self._silent_frames = int(zeros) if len(sounding) else self._silent_frames + int(zeros)
        if self._silent_frames >= _SILENT_FRAMES:
            what = "nothing but an offset" if event.samples[-1].any() else "digital silence"
            self._health = (ERROR, f"the microphone gives {what}: is it muted or dead?")
        elif self._clock.trouble:
            self._health = (ERROR, self._clock.trouble)
        elif self._return is not None:
            lost = self._unfit or f"{self._own.name or 'the default microphone'} is not there"
            self._health = (WARNING, f"{lost}; {self.device} is heard in its place")
        else:
            self._health = (OK, LISTENING)
        return replace(event, filtered=filtered)

    def _steps_clock(self) -> bool:
        """Check the time of day; return whether it was set."""
        offset = self._clock.offset()
        if abs(offset - self._wall_offset) <= STEP_SECONDS * NANOSECONDS:
            return False
        self._wall_offset = offset
        return True

    def _now(self) -> int:
        self._steps_clock()
        return time.monotonic_ns() + self._wall_offset

    def _report(self, stamp: int) -> Iterator[SourceHealth]:
        """Yield the health every ten seconds, and on change."""
        now = time.monotonic()
        if self._health != self._last_health or now - self._reported >= _HEALTH_SECONDS:
            level, summary = self._last_health = self._health
            self._reported = now
            values = {
                "device": self.device,
                "frames_lost": str(self._frames_lost),
                "overruns": str(self._overruns),
                "clock_ppm": f"{self._framer.ppm:.1f}",
                "block_age_seconds": f"{now - self._last_block:.1f}",
                **self._level.take(),
            }
            yield SourceHealth(stamp, level, summary, values)


class _Level:
    """Sound level since the last report."""

    def __init__(self) -> None:
        self._power = self._peak = 0.0
        self._samples = 0

    def add(self, samples: Float32) -> None:
        self._power += float(np.square(samples, dtype=np.float64).sum())
        self._peak = max(self._peak, float(np.abs(samples).max()))
        self._samples += samples.size

    def take(self) -> dict[str, str]:
        """Return the level in decibels of full scale, and reset; empty without sound."""
        if not self._samples:
            return {}
        mean = float(decibels(np.array(self._power / self._samples)))
        peak = float(decibels(np.square(np.array(min(self._peak, 1.0)))))
        self._power = self._peak = 0.0
        self._samples = 0
        return {"level_dbfs": f"{mean:.1f}", "peak_dbfs": f"{peak:.1f}"}


class _Device:
    """A wanted device: by its name, and after the first start by its identity."""

    def __init__(
        self, device: str, channels: int | None = None, channel: int | None = None
    ) -> None:
        check_device(device)
        self.name = public_name(device)
        self.wanted = device
        self.channels = channels
        self.channel = channel
        self.was_opened = False
        self.latency = LATENCY_SECONDS
        self._may_take_longer = True
        self._last = self._longest_pause = 0.0  # last arrival in this run, longest interval
        self._overflows: deque[float] = deque(maxlen=_OVERFLOWS)  # arrival times

    def opened(self, capture: Capture) -> None:
        opened = capture.format
        self.name, self.wanted, self.was_opened = opened.device, opened.identity, True
        self._last = self._longest_pause = 0.0
        self._overflows.clear()

    def add(self, block: SampleBlock) -> None:
        if self._last:
            self._longest_pause = max(self._longest_pause, block.arrival - self._last)
        self._last = block.arrival
        if block.overflowed:
            self._overflows.append(block.arrival)

    def could_not_be_opened(self) -> None:
        """Record that the device may refuse the longer buffer, to request it only once."""
        if self.latency != LATENCY_SECONDS:
            self.latency, self._may_take_longer = LATENCY_SECONDS, False

    def was_silent(self) -> None:
        """Record that the sound stopped: without any sound a longer buffer may be needed."""
        if not self._last and self._may_take_longer:
            self.latency = LONG_LATENCY_SECONDS
        elif self._longest_pause < LATENCY_SECONDS:
            self.latency = LATENCY_SECONDS

    def needs_longer_buffer(self) -> bool:
        """Return whether to reopen with a longer buffer, as sound arrives in longer pieces."""
        often = len(self._overflows) == _OVERFLOWS
        often = often and self._overflows[-1] - self._overflows[0] < _OVERFLOW_SECONDS
        if not often or self.latency == LONG_LATENCY_SECONDS or not self._may_take_longer:
            return False
        self.latency = LONG_LATENCY_SECONDS
        return True
