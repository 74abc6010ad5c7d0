"""Opening of audio files, by libsndfile or, for formats without its support, by ffmpeg."""

import math
import mmap
import os
import re
import shlex
import shutil
import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import soundfile

from hearthlog.schemas.arrays import Float32
from hearthlog.schemas.errors import SourceError

if TYPE_CHECKING:
    from hearthlog.recorder.sources.ffmpeg import FileDecoder

BLOCK_SECONDS = 10.0
RATES = range(1_000, 768_001)  # Hz: covers recordings, and soxr converts in bounded memory

_SUFFIXES = frozenset(
    {".wav", ".wave", ".bwf", ".flac", ".ogg", ".oga", ".opus", ".mp3", ".aif", ".aiff", ".aifc"}
    | {".au", ".caf"}
    | {".w64", ".rf64", ".voc", ".snd", ".paf", ".svx", ".nist", ".sph", ".ircam", ".sf", ".pvf"}
    | {".htk", ".sds", ".avr", ".sd2", ".wve"}
    | {".m4a", ".m4b", ".aac", ".mp4", ".m4v", ".mov", ".3gp", ".3g2", ".amr", ".awb", ".webm"}
    | {".mka", ".mkv", ".wma", ".wmv", ".asf", ".avi", ".mp2", ".mpga", ".ac3", ".wv", ".tta"}
    | {".eac3", ".ec3", ".flv", ".f4v", ".mpg", ".mpeg", ".vob", ".ts", ".mts", ".m2ts", ".3gpp"}
    | {".ape", ".dsf"}
)
_NO_LENGTH = 1 << 62  # libsndfile reports more frames if a header has no length
_MOST_BYTES = 0x7FFF_0000  # a header that claims more has no length
_LEAST_BYTES = 1600  # smaller differences come from programs' own counting and padding
_LEAST_SECONDS = 0.1  # accuracy of lengths in headers
_CLAIMED = re.compile(r"^ *(?:data|SSND|Data Size|riff) *: (\d+) \(should be (\d+)\)", re.MULTILINE)
_CLAIMED_RF64 = re.compile(r"frame count (\d+) does not match value from 'ds64' chunk of (\d+)")
_NOT_MP3 = {b"RIFF", b"RF64", b"riff", b"fLaC", b"OggS", b"FORM", b"caff", b".snd"}  # first bytes
_OF_MPG123 = re.compile(rb"\[[^]]*mpg123|(?:Note|Warning): |mpg123|\s*$")
_BROKEN_MP3 = re.compile(rb"error:|Xing stream size off|resync")
_MP3_SEARCHED = 65_536  # bytes searched for the first frame
_MP3_BIT_RATES = (  # kbit/s: MPEG 2 and 2.5, then MPEG 1
    (8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
    (32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
)
_OGG_PAGE = 65_307  # bytes, at most
_OGG_END = 4  # flag of the last page
_INT16_STEP = np.float32(1 / 32768)  # full scale is 1
_MOST_SAMPLES = 1 << 25  # of all channels of a block
_MOST_CHUNKS = 10_000
_MOST_FAILED_SYNCS = 10_000
_STDERR = 2
_MOST_COMPLAINTS = 10  # kept
_REDIRECTED = RLock()


class OpenAudio(NamedTuple):
    """An open audio file."""

    rate: int
    channels: int
    # samples per channel according to the header; None if the header has no length
    frames: int | None
    # `blocks(first, last)` yields the readable samples of a range as float32 of shape (n,
    # channels). Call it once
    blocks: Callable[[int, float], Iterator[Float32]]
    # after the blocks were read, returns why they end before the sound does; empty if they do not
    fault: Callable[[], str]


@contextmanager
def open_audio(path: Path) -> Iterator[OpenAudio]:
    """Open an audio file.

    Raise `SourceError` if the file is missing, is not audio, is empty, or has a sample rate below 1
    kHz or above 768 kHz.
    """
    with _readable(path), _open(path) as audio:
        yield audio


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert OS errors, such as out of memory, to `SourceError`."""
    try:
        yield
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from error


@contextmanager
def _open(path: Path) -> Iterator[OpenAudio]:
    _check_file(path)
    complaints: list[bytes] = []
    try:
        sound = _opened(path, complaints)
    except soundfile.LibsndfileError as error:
        sound, reason = None, error.error_string.rstrip(".") or "it is damaged"
        if "regular file" in reason:  # libsndfile's message for an MP3 file without a frame
            reason = "Format not recognised"
    if sound is None:
        with _decoder(path, reason) as decoder:
            yield _by_ffmpeg(path, decoder)
        return
    with sound:
        if not sound.frames:
            raise SourceError(f"{path}: holds no audio")
        hidden = _hidden_seconds(path, sound)
        if hidden and _has_ffmpeg():
            with _decoder(path, "") as decoder:
                yield _by_ffmpeg(path, decoder)
            return
        yield _by_libsndfile(path, sound, complaints, hidden)


def audio_seconds(path: Path) -> float:
    """Return the length in seconds from the header; without one, decode the complete file.

    Raise `SourceError` as `open_audio`.
    """
    with open_audio(path) as audio:
        if audio.frames is not None:
            return float(audio.frames / audio.rate)
    status = path.stat()
    return _decoded_seconds(path, status.st_mtime_ns, status.st_size)


@lru_cache(256)
def _decoded_seconds(path: Path, _time: int, _size: int) -> float:
    """Return the length of a file by decoding it; cached per version of the file."""
    with open_audio(path) as audio:
        return float(sum(len(block) for block in audio.blocks(0, math.inf)) / audio.rate)


def is_audio(name: str) -> bool:
    """Whether a file name has the suffix of a supported audio format."""
    suffix = os.path.splitext(name)[1].lower()  # noqa: PTH122
    return suffix in _SUFFIXES and not name.startswith(".")


def text_fields(path: Path) -> list[str]:
    """Return the texts that libsndfile finds, such as a comment.

    Raise `SourceError` if the file is missing or unreadable.
    """
    _check_file(path)
    with _readable(path), suppress(soundfile.LibsndfileError), _opened(path, []) as sound:
        return list(sound.copy_metadata().values())
    return []


class _Unseekable(soundfile.SoundFile):  # type: ignore[misc]  # soundfile has no types
    """A file without a length: libsndfile cannot seek in it, but claims that it can."""

    def seekable(self) -> bool:
        return False


def _check_file(path: Path) -> None:
    if not path.exists():
        raise SourceError(f"{path}: no such file")
    if path.is_dir():
        raise SourceError(f"{path}: is a folder; name the audio files in it")
    if not path.is_file():
        raise SourceError(f"{path}: cannot be read as audio (Not a regular file)")
    with _readable(path), path.open("rb"):
        pass
    if not path.stat().st_size:
        raise SourceError(f"{path}: holds no audio; the file is empty")


def _check_rate(path: Path, rate: int) -> None:
    if rate not in RATES:
        raise SourceError(f"{path}: a sample rate of {rate} Hz is not supported")


def _opened(path: Path, complaints: list[bytes]) -> soundfile.SoundFile:
    with _without_mpg123(path, complaints):
        sound = soundfile.SoundFile(os.fsencode(path))
    if sound.frames >= _NO_LENGTH:
        sound.close()
        return _Unseekable(os.fsencode(path))
    if sound.frames == 0 and (mended := _mended_wav(path)) is not None:
        sound.close()
        return soundfile.SoundFile(mended)
    return sound


class _View(mmap.mmap):
    """Bytes of a file, some of them replaced on reading."""

    change = 0, b""  # position, and the bytes read there

    def read(self, n: int | None = None) -> bytes:
        """Read the next bytes, as from a file."""
        begin, data = self.tell(), super().read(n)
        place, content = self.change
        if begin >= place + len(content) or place >= begin + len(data):
            return data
        changed = bytearray(data)
        for number, byte in enumerate(content, place - begin):
            if 0 <= number < len(changed):
                changed[number] = byte
        return bytes(changed)

    def seek(self, pos: int, whence: int = os.SEEK_SET) -> None:
        """Seek, limited to the end of the file, as libsndfile expects."""
        base = (0, self.tell(), len(self))[whence]
        super().seek(min(max(base + pos, 0), len(self)))


def _mended_wav(path: Path) -> _View | None:
    """Mend the view of a WAV file with an empty data size, as of a recorder switched off."""
    with path.open("rb") as file:
        view = _View(file.fileno(), 0, access=mmap.ACCESS_READ)
    place = 12
    for _ in range(_MOST_CHUNKS):
        if view[:4] not in {b"RIFF", b"RF64"} or place + 8 >= len(view):
            break
        name, size = view[place : place + 4], int.from_bytes(view[place + 4 : place + 8], "little")
        if name == b"data" and view[:4] == b"RF64" and view[12:16] == b"ds64":
            view.change = 20, struct.pack("<QQ", len(view) - 8, len(view) - place - 8)
            return view
        if name == b"data" and size == 0 and not _is_chunk(view, place + 8):
            view.change = place + 4, b"\xff" * 4
            return view
        place += 8 + size + size % 2
    view.close()
    return None


def _is_chunk(view: _View, place: int) -> bool:
    size = int.from_bytes(view[place + 4 : place + 8], "little")
    return view[place : place + 4].isalnum() and place + 8 + size <= len(view)


def _by_libsndfile(
    path: Path, sound: soundfile.SoundFile, complaints: list[bytes], hidden: float
) -> OpenAudio:
    _check_rate(path, sound.samplerate)
    frames = None if isinstance(sound, _Unseekable) else sound.frames
    is_mp3 = sound.subtype.startswith("MPEG")  # its length may be an estimate
    place, begin, end, is_broken = 0, 0, 0.0, False

    def blocks(first: int, last: float) -> Iterator[Float32]:
        nonlocal place, begin, end, is_broken
        begin, end = first, last
        if frames is not None and first:
            place, is_broken = _sought(sound, min(first, frames))
        last = last if is_mp3 else min(last, sound.frames)
        size = _block_frames(sound.samplerate, sound.channels)
        while not is_broken and (count := int(min(size, last - place))) > 0:
            block, is_broken = _read(path, sound, count, complaints)
            if not len(block):
                return
            place += len(block)
            skipped = max(first - (place - len(block)), 0)  # without seeking
            if skipped < len(block):
                yield block[skipped:]

    def fault() -> str:
        if place >= end:  # no more was requested
            return ""
        if hidden:
            return f"does not say how long it is; install ffmpeg, which reads {hidden:.0f} s more"
        missing = 0 if frames is None or is_mp3 else frames - place
        is_short = missing > _LEAST_SECONDS * sound.samplerate
        if is_broken or is_short or (is_mp3 and any(map(_BROKEN_MP3.search, complaints))):
            return _damage(place / sound.samplerate, begin / sound.samplerate)
        return _cut(path, sound, place / sound.samplerate)

    return OpenAudio(sound.samplerate, sound.channels, frames, blocks, fault)


def _sought(sound: soundfile.SoundFile, place: int) -> tuple[int, bool]:
    """Seek in a file; return the position, and whether libsndfile failed."""
    try:
        return sound.seek(place), False
    except soundfile.LibsndfileError:
        return 0, True


def _block_frames(rate: int, channels: int) -> int:
    """Return the samples per channel of one block, bounded for any number of channels."""
    return max(min(int(rate * BLOCK_SECONDS), _MOST_SAMPLES // channels), 1)


def _read(
    path: Path, sound: soundfile.SoundFile, count: int, complaints: list[bytes]
) -> tuple[Float32, bool]:
    """Read up to `count` samples; return them, and whether libsndfile cannot continue."""
    if sound.format == "WAV" and sound.subtype == "PCM_16" and sound.seekable():
        place = sound.tell()
        try:  # bit-equal to libsndfile's own conversion, which takes four times as long
            samples = sound.read(count, "int16", always_2d=True)
            return np.multiply(samples, _INT16_STEP, dtype=np.float32), False
        except soundfile.LibsndfileError:  # samples before the fault are read below
            _sought(sound, place)
    block = np.full((count, sound.channels), np.nan, np.float32)
    try:
        with _without_mpg123(path, complaints):
            return sound.read(count, out=block), False
    except soundfile.LibsndfileError:
        # libsndfile does not report how many samples it read before the error.
        filled = np.flatnonzero(~np.isnan(block).all(axis=1))
        return block[: int(filled[-1]) + 1 if len(filled) else 0], True


def _cut(path: Path, sound: soundfile.SoundFile, seconds: float) -> str:
    """Return the fault of a file that ends before its sound does, or an empty text."""
    if _claims_more(sound.extra_info) or _is_cut(path):
        return f"is cut short: its sound ends at {seconds:.2f} s"
    return ""


def _damage(seconds: float, begin: float = 0.0) -> str:
    """Return the fault of a file requested from `begin` and readable up to `seconds`."""
    if not seconds and begin:
        return f"is damaged or cut short before {begin:.2f} s"
    if not seconds:
        return "is damaged, and none of its sound can be read"
    return f"is damaged or cut short after {seconds:.2f} s"


def _hidden_seconds(path: Path, sound: soundfile.SoundFile) -> float:
    """Return the seconds of an MP3 file that libsndfile omits.

    Without a table at the start, it estimates the length from the first bit rate, which may change.
    """
    if sound.format != "MP3":
        return 0.0
    status = path.stat()
    samples = _mp3_samples(path, status.st_mtime_ns, status.st_size)
    hidden = (samples - sound.frames) / sound.samplerate
    return hidden if hidden > 0.5 + 0.01 * sound.frames / sound.samplerate else 0.0


@lru_cache(256)
def _mp3_samples(path: Path, _time: int, _size: int) -> int:
    """Count the samples of an MP3 file by its frames; 0 if it begins with a table of them."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
        place = 0
        if view[:3] == b"ID3":
            place = 10 + sum(
                byte << shift for byte, shift in zip(view[6:10], (21, 14, 7, 0), strict=False)
            )
        place = view.find(b"\xff", place, place + _MP3_SEARCHED)
        head = view[place : place + 200]
        if place < 0 or any(table in head for table in (b"Xing", b"Info", b"VBRI")):
            return 0
        samples = failed = 0
        while place >= 0 and place + 4 <= len(view) and failed < _MOST_FAILED_SYNCS:
            length, count = _mp3_frame(view[place : place + 4])
            samples += count
            failed += not length
            place = place + length if length else view.find(b"\xff", place + 1, place + 65_536)
    return samples


def _mp3_frame(head: bytes) -> tuple[int, int]:
    """Return the bytes and the samples of a layer III frame from its header; 0 if it is none."""
    version, rate, speed = head[1] >> 3 & 3, head[2] >> 2 & 3, head[2] >> 4
    if head[0] != 0xFF or head[1] >> 5 != 7 or head[1] >> 1 & 3 != 1 or version == 1 or rate == 3:
        return 0, 0
    if speed in {0, 15}:
        return 0, 0
    is_first = version == 3
    bits = 1000 * _MP3_BIT_RATES[is_first][speed - 1]
    per_second = (44_100, 48_000, 32_000)[rate] >> (0 if is_first else 1 if version == 2 else 2)
    samples = 1152 if is_first else 576
    return samples // 8 * bits // per_second + (head[2] >> 1 & 1), samples


def _claims_more(log: str) -> bool:
    """Whether a file's header claims more sound than there is, according to libsndfile's log."""
    for claimed, found in _CLAIMED.findall(log):
        if int(claimed) - int(found) >= _LEAST_BYTES and int(claimed) < _MOST_BYTES:
            return True
    return any(int(claimed) > int(found) for found, claimed in _CLAIMED_RF64.findall(log))


def _is_cut(path: Path) -> bool:
    """Whether an Ogg file lacks its last page, or a CAF file is shorter than its header claims."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
        if view[:4] == b"OggS":
            place = view.rfind(b"OggS", len(view) - min(len(view), _OGG_PAGE))
            flags = view[place + 5 : place + 6] if place >= 0 else b""
            return not flags or not flags[0] & _OGG_END
        place = 8
        for _ in range(_MOST_CHUNKS):
            if view[:4] != b"caff" or place + 12 > len(view):
                break
            size = int.from_bytes(view[place + 4 : place + 12], signed=True)
            if size < 0:  # unknown
                return False
            if view[place : place + 4] == b"data":
                return place + 12 + size > len(view)
            place += 12 + size
    return False


@contextmanager
def _without_mpg123(path: Path, complaints: list[bytes]) -> Iterator[None]:
    """Redirect libmpg123's messages from standard error; it has no other channel for them."""
    with path.open("rb") as file:
        if file.read(4) in _NOT_MP3:
            yield
            return
    with _REDIRECTED, tempfile.TemporaryFile() as kept:
        sys.stderr.flush()
        original = os.dup(_STDERR)
        os.dup2(kept.fileno(), _STDERR)
        try:
            yield
        finally:
            os.dup2(original, _STDERR)
            kept.seek(0)
            for line in kept:
                if _OF_MPG123.match(line):
                    complaints[:] = [*complaints, line][-_MOST_COMPLAINTS:]
                else:  # from another thread
                    os.write(_STDERR, line)
            os.close(original)


def _has_ffmpeg() -> bool:
    return shutil.which("ffmpeg") is not None


@contextmanager
def _decoder(path: Path, reason: str) -> Iterator["FileDecoder"]:
    """Start ffmpeg for a file that libsndfile cannot read."""
    unreadable = f"{path}: cannot be read as audio"
    if not _has_ffmpeg():
        target = f"{path.stem}{'-2' if path.suffix.lower() == '.wav' else ''}.wav"
        raise SourceError(
            f"{unreadable} ({reason}); install ffmpeg (Debian: apt install ffmpeg), or convert it "
            f"elsewhere: ffmpeg -i {shlex.quote(path.name)} {shlex.quote(target)}"
        )
    from hearthlog.recorder.sources.ffmpeg import FileDecoder  # noqa: PLC0415  for few files

    try:
        decoder = FileDecoder(path)
    except SourceError as error:
        why = str(error) or f"{reason}; not by ffmpeg either"
        raise SourceError(f"{unreadable} ({why})") from error
    with closing(decoder):
        yield decoder


def _by_ffmpeg(path: Path, decoder: "FileDecoder") -> OpenAudio:
    _check_rate(path, decoder.rate)
    place, end, reason = 0, 0.0, ""

    def blocks(first: int, last: float) -> Iterator[Float32]:
        nonlocal place, end, reason
        end = last
        size = _block_frames(decoder.rate, decoder.channels)
        while (count := int(min(size, last - place))) > 0:
            try:
                data = decoder.read(count)
            except SourceError as error:
                reason = str(error)
                return
            block = np.frombuffer(data, ">f4").astype(np.float32).reshape(-1, decoder.channels)
            if not len(block):
                return
            place += len(block)
            skipped = max(first - (place - len(block)), 0)
            if skipped < len(block):
                yield block[skipped:]

    def fault() -> str:
        if place >= end:
            return ""
        if reason or decoder.fault():
            return _damage(place / decoder.rate)
        return (
            f"is cut short: its sound ends at {place / decoder.rate:.2f} s" if _is_cut(path) else ""
        )

    return OpenAudio(decoder.rate, decoder.channels, None, blocks, fault)
