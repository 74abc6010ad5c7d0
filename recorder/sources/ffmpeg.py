"""Sound by ffmpeg: from network addresses, and from files that libsndfile cannot read.

As the capture process of an address, it writes the blocks of `recorder.sources.capture`, with
arrival times only. The address comes on standard input, as all users can read arguments.
"""

import ctypes
import fcntl
import json
import math
import os
import re
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
from array import array
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from hearthlog.recorder.addresses import public_name
from hearthlog.recorder.sources.capture import BLOCK, BLOCK_SECONDS, ArrivalPace, CaptureFormat
from hearthlog.schemas.errors import DeviceError, SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_ANSWER_SECONDS = 10
_MOST_BYTES = 256_000_000  # memory limit, for any input from a server
_PROTOCOLS = {"rtsp": "tcp", "http": "http,https,tls,tcp", "https": "http,https,tls,tcp"}
# No playlists: these refer to other addresses and to files.
_FORMATS = "rtsp,sdp,wav,w64,aiff,au,mp3,aac,flac,ogg,matroska,mov,mpegts"
# For files. No playlists either, nor formats that combine several files.
_FILE_FORMATS = (
    "w64,wav,aiff,au,caf,voc,mp3,aac,ac3,eac3,flac,ogg,matroska,mov,mpeg,mpegts,asf,amr,amrnb,"
    "amrwb,avi,flv,wv,tta,ape,dsf"
)
_FILE_SECONDS = 30.0  # without more sound, until a file is given up
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG
AU_HEADER = struct.Struct(
    ">4s5I"
)  # magic, offset of the samples, their bytes, kind, rate, channels
_AU_FLOAT = 6
_PIPE_BYTES = 1 << 16
_KEPT_BYTES = 4000  # of standard error
_SAMPLE_BYTES = 4

# Patterns in ffmpeg's messages, first match first: meaning and remedy.
_MEANINGS = {
    "401 Unauthorized": "",  # depends on whether the address has a password
    "403 Forbidden": "refuses access (403 Forbidden)",
    "404 Not Found": "does not exist (404 Not Found); check the part after the host",
    "Failed to resolve hostname": "has an unknown host; check its name",
    "Connection refused": "refuses the connection; check whether it is on, and its port",
    "timed out": "does not answer; check whether it is on and in this network",
    "No route to host|Network is unreachable": "cannot be reached; check the network",
    "certificate": "has a certificate that this machine does not trust",
    "TLS": "does not speak https; try http://",
    "matches no streams|454 Session": "has no sound; check whether its microphone is on",
    "unknown keyword 'option'": "needs a newer ffmpeg, 5.0 at least",
    "Invalid|prematurely|whitelist|not permitted|End of file|moov|Output file": (
        "sends no sound of a known format; check the part after the host"
    ),
}


def check_ffmpeg() -> None:
    """Raise `SourceError` with an installation hint if ffmpeg is not installed."""
    if shutil.which("ffmpeg") is None:
        raise SourceError(
            "ffmpeg, which reads sound from the network, is missing: install it (Debian: apt "
            "install ffmpeg)"
        )


class FileDecoder:
    """The first audio stream of a file, decoded by ffmpeg, which may open only this file.

    Raise `SourceError` if ffmpeg finds no sound; its text is only the reason, empty for an unknown
    format.
    """

    def __init__(self, path: Path) -> None:
        self.rate = self.channels = 0
        self._messages = b""
        self._held = b""
        self._process = _start_decoding(path)
        try:
            reason = self._read_header()
        except SourceError:
            self.close()
            raise
        if reason:
            self.close()
            raise SourceError("" if reason == _NO_SOUND else reason)

    def _read_header(self) -> str:
        """Read up to the first sample; return the reason if there is none."""
        head = self._read(AU_HEADER.size)
        if len(head) == AU_HEADER.size:
            _, place, _, kind, self.rate, self.channels = AU_HEADER.unpack(head)
            self._read(place - AU_HEADER.size)
            if kind == _AU_FLOAT and self.channels:
                self._held = self._read(_SAMPLE_BYTES * self.channels)
        return "" if self._held else self.fault() or _NO_SOUND

    def read(self, frames: int) -> bytes:
        """Return big-endian float32 samples, fewer at the end.

        Raise `SourceError` if ffmpeg stalls.
        """
        size = _SAMPLE_BYTES * self.channels
        data = self._read(frames * size)
        return data[: len(data) // size * size]

    def fault(self) -> str:
        """Return why the sound ended before the file did; empty if it did not."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._keep_messages()
        text = self._messages.decode(errors="replace")
        if not text.strip() and not self._process.returncode:
            return ""
        found = (meaning for pattern, meaning in _FILE_MEANINGS.items() if re.search(pattern, text))
        return next(found, _NO_SOUND)

    def close(self) -> None:
        """Kill ffmpeg."""
        if self._process.returncode is None:
            with suppress(ProcessLookupError, PermissionError):  # the process group has ended
                os.killpg(self._process.pid, signal.SIGKILL)
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()
        self._process.wait()

    def _read(self, size: int) -> bytes:
        """Return `size` bytes, or the rest."""
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        sound, messages = self._process.stdout.fileno(), self._process.stderr.fileno()
        parts = [self._held]
        length, self._held = len(self._held), b""
        until = time.monotonic() + _FILE_SECONDS
        pipes = [sound, messages]
        while length < size:
            left = until - time.monotonic()
            ready = select.select(pipes, [], [], max(left, 0.0))[0]
            if sound in ready:
                if not (part := os.read(sound, min(size - length, 1 << 20))):
                    break
                parts.append(part)
                length += len(part)
                until = time.monotonic() + _FILE_SECONDS
            elif left <= 0:
                raise SourceError(f"ffmpeg finds no more sound in it within {_FILE_SECONDS:.0f} s")
            if messages in ready and not self._keep_messages():
                pipes = [sound]
        return b"".join(parts)

    def _keep_messages(self) -> bool:
        """Keep a limited part of ffmpeg's standard error; return whether more may come."""
        assert self._process.stderr is not None
        os.set_blocking(self._process.stderr.fileno(), False)
        with suppress(BlockingIOError):
            part = os.read(self._process.stderr.fileno(), _PIPE_BYTES)
            self._messages = (self._messages + part)[:_KEPT_BYTES]
            return bool(part)
        return True


_NO_SOUND = "ffmpeg finds no sound in it"
_FILE_MEANINGS = {
    "matches no streams|does not contain any stream": "there is no sound in it",
    "moov atom not found": "it was not completed: the table at its end is missing (moov)",
    "[Dd]ecoder .*not found|[Uu]nknown decoder|Decoding requested, but no decoder": (
        "this ffmpeg cannot decode its sound"
    ),
    "Cannot allocate memory": "ffmpeg needs too much memory for it",
}


def _start_decoding(path: Path) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(  # noqa: S603
        [
            *("ffmpeg", "-nostdin", "-hide_banner", "-nostats", "-loglevel", "error"),
            *("-protocol_whitelist", "file,pipe", "-format_whitelist", _FILE_FORMATS),
            *("-threads", "1", "-i", f"file:{path.absolute()}", "-map", "0:a:0"),
            *("-c:a", "pcm_f32be", "-f", "au", "pipe:1"),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        env=os.environ | {"LC_ALL": "C"},
        start_new_session=True,  # Ctrl-C is for the recorder
    )
    if hasattr(resource, "prlimit"):  # macOS has none
        with suppress(ProcessLookupError):  # not between fork and exec: this process has threads
            resource.prlimit(process.pid, resource.RLIMIT_DATA, (_MOST_BYTES, _MOST_BYTES))
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, 0))
    return process


def start_ffmpeg(address: str) -> subprocess.Popen[bytes]:
    """Start to read the first audio stream of an address: AU, int16, 16 kHz, all channels.

    Sound is on standard output, errors are on standard error. ffmpeg ends with the thread that
    starts it, even if that is killed.
    """
    process = subprocess.Popen(  # noqa: S603
        [
            *("ffmpeg", "-nostdin", "-hide_banner", "-nostats", "-loglevel", "error"),
            *("-protocol_whitelist", f"pipe,{_PROTOCOLS[urlsplit(address).scheme]}"),
            *("-format_whitelist", f"concat,{_FORMATS}", "-threads", "1"),
            *("-f", "concat", "-safe", "0", "-i", "pipe:0", "-map", "0:a:0"),
            *("-ar", str(SAMPLE_RATE), "-c:a", "pcm_s16be", "-f", "au", "pipe:1"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        start_new_session=True,  # Ctrl-C is for the recorder
        preexec_fn=_confine,  # noqa: PLW1509  it has one thread
    )
    # A playlist of one entry: all users of the machine can read arguments, and the address may
    # have a password.
    assert process.stdin is not None
    process.stdin.write(_list_of_one(address).encode())
    process.stdin.close()
    return process


def explain(address: str, message: str) -> str:
    """Return why ffmpeg found no sound, from its standard error, which may contain the address."""
    message = message.replace(address, "")
    found = next((meaning for text, meaning in _MEANINGS.items() if re.search(text, message)), None)
    if found == "":
        found = (
            "refuses the user name or the password"
            if urlsplit(address).username is not None
            else "needs a user name and a password, as in rtsp://user:password@camera/stream"
        )
    return f"{public_name(address)} {found or 'cannot be read by ffmpeg'}"


def _list_of_one(address: str) -> str:
    scheme = urlsplit(address).scheme
    options = {"protocol_whitelist": _PROTOCOLS[scheme], "format_whitelist": _FORMATS}
    limit = str(_ANSWER_SECONDS * 1_000_000)
    if scheme == "rtsp":
        options |= {"rtsp_transport": "tcp", "allowed_media_types": "audio", "timeout": limit}
    else:
        options |= {"rw_timeout": limit, "tls_verify": "1"}
    quoted = address.replace("'", r"'\''")
    lines = ["ffconcat version 1.0", f"file '{quoted}'"]
    lines += [f"option {name} {value}" for name, value in options.items()]
    return "\n".join(lines) + "\n"


def _confine() -> None:
    """Limit the memory of this process, and end it with its parent."""
    resource.setrlimit(resource.RLIMIT_DATA, (_MOST_BYTES, _MOST_BYTES))
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)


_STALE_SECONDS = 20.0  # without blocks; this process ends by itself earlier
_PATIENCE_SECONDS = 15.0  # longer than ffmpeg's timeout: a server may send data without sound
_SETTLE_SECONDS = 3.0  # until a server has sent its buffered sound
_READ_BYTES = 1 << 18  # 8 s of sound
_INT16_BYTES = 2
_MESSAGE_BYTES = 4000


def main() -> None:
    """Capture from the address on standard input, until killed or without a parent.

    The last line of standard error is the reason for the end.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a logout is no reason to end
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the recorder decides when this ends
    address = sys.stdin.read()
    try:
        sound = _Sound(address, int(sys.argv[1]) or None)
        _capture(sound, address, os.fdopen(1, "wb", buffering=0))
    except DeviceError as error:
        sys.exit(str(error))
    except BrokenPipeError:
        pass


class _Sound:
    """Output of ffmpeg, read every 0.6 s: a wake-up costs more than the samples."""

    def __init__(self, address: str, channel: int | None) -> None:
        self.began = self.arrival = time.monotonic()
        self._address = address
        self._channel = channel
        self._held = b""
        self._there = 0  # channels of the sound; 0 before its header
        self._process = start_ffmpeg(address)
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._pipe, self._errors = self._process.stdout.fileno(), self._process.stderr.fileno()
        fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _READ_BYTES)
        for pipe in (self._pipe, self._errors):
            os.set_blocking(pipe, False)
        self._error_text = b""
        self._has_sounded = False
        self._parent = os.getppid()

    @property
    def channels(self) -> int:
        """Number of channels of the samples, after the first read."""
        return self._there if self._channel is None else 1

    def read(self) -> bytes:
        """Wait for samples; raise DeviceError if there will be no more.

        `arrival` is their arrival in seconds of CLOCK_MONOTONIC, until the next call.
        """
        while True:
            time.sleep(BLOCK_SECONDS)
            if os.getppid() != self._parent:
                sys.exit()
            self._listen()
            with suppress(BlockingIOError):
                data = os.read(self._pipe, _READ_BYTES)
                if not data:
                    raise DeviceError(self._reason())
                self._held += data
                if samples := self._take():
                    self.arrival, self._has_sounded = time.monotonic(), True
                    return samples
            if time.monotonic() - self.arrival > _PATIENCE_SECONDS:
                name = public_name(self._address)
                raise DeviceError(f"{name} has sent no sound for {_PATIENCE_SECONDS:.0f} s")

    def _take(self) -> bytes:
        """Return the complete samples received so far, as int16."""
        if not self._there:
            if len(self._held) < AU_HEADER.size:
                return b""
            _, place, _, _, _, channels = AU_HEADER.unpack_from(self._held)
            if len(self._held) < place:
                return b""
            self._held, self._there = self._held[place:], channels
            if self._channel is not None and self._channel > channels:
                from hearthlog.recorder.sources.decoding import (  # noqa: PLC0415  no numpy else
                    missing_channel,
                )

                name = public_name(self._address)
                raise DeviceError(f"{name} {missing_channel(channels, self._channel)}")
        size = _INT16_BYTES * self._there
        end = len(self._held) // size * size
        samples, self._held = array("h", self._held[:end]), self._held[end:]
        samples.byteswap()
        if self._channel is not None:
            samples = samples[self._channel - 1 :: self._there]
        return samples.tobytes()

    def _listen(self) -> None:
        with suppress(BlockingIOError):
            self._error_text = (self._error_text + os.read(self._errors, _READ_BYTES))[
                -_MESSAGE_BYTES:
            ]

    def _reason(self) -> str:
        if self._has_sounded:
            return f"{public_name(self._address)} has stopped sending"
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=1.0)
        self._listen()
        return explain(self._address, self._error_text.decode(errors="replace"))


def _capture(sound: _Sound, address: str, output: Any) -> None:
    pace = ArrivalPace(sound.began)
    samples, arrival = _first_live(sound, pace)
    name = public_name(address)
    several = sound.channels if sound.channels > 1 else None
    answer = CaptureFormat(name, address, SAMPLE_RATE, _STALE_SECONDS, channels=several)
    output.write(json.dumps(asdict(answer)).encode() + b"\n")
    index, size = 0, _INT16_BYTES * sound.channels
    while True:
        count = len(samples) // size
        output.write(BLOCK.pack(index, count, 0, math.inf, arrival))
        output.write(samples)
        index += count
        samples = sound.read()
        arrival = sound.arrival
        pace.add(len(samples) // size, arrival)
        trouble = pace.trouble()
        if trouble:
            raise DeviceError(f"{name} {trouble}")


def _first_live(sound: _Sound, pace: ArrivalPace) -> tuple[bytes, float]:
    """Return the first samples captured after the call, and the capture time of the last one."""
    held = b""
    settled = math.inf
    while sound.arrival < settled:
        samples = sound.read()
        settled = min(settled, sound.arrival + _SETTLE_SECONDS)
        size = _INT16_BYTES * sound.channels
        pace.add(len(samples) // size, sound.arrival)
        most = math.ceil((sound.arrival - sound.began) * SAMPLE_RATE)
        held = (held + samples)[-most * size :]
    older, now = pace.settle()
    return held[len(held) - (pace.count - older) * size :], now


if __name__ == "__main__":
    main()
