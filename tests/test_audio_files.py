"""Audio files begin when they say, are read as far as they go, and in any format with ffmpeg."""

import io
import os
import shutil
import struct
import subprocess
import tracemalloc
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from threading import Event
from zoneinfo import ZoneInfo

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from logs import features, read

from hearthlog.recorder.events import Frames, Gap
from hearthlog.recorder.sources import ffmpeg
from hearthlog.recorder.sources.audio_files import FileSource, find_audio
from hearthlog.recorder.sources.decoding import read_audio
from hearthlog.recorder.sources.file_times import (
    GUESS,
    METADATA,
    NAME,
    FileTime,
    arrange,
    check_pattern,
    doubts,
    file_time,
)
from hearthlog.recorder.sources.open_audio import _mp3_frame, audio_seconds, is_audio
from hearthlog.schemas.errors import ConfigurationError, SourceError
from hearthlog.schemas.frames import NANOSECONDS, read_time

pytestmark = pytest.mark.fast

BERLIN = ZoneInfo("Europe/Berlin")
RATE = 16_000
CLOSED = read_time("2026-03-01T09:00:00")  # when files were written last
needs_ffmpeg = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="no ffmpeg")


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(run, capfd)


@pytest.fixture(scope="module")
def sound():
    """Two seconds of noise, which 16 bits hold exactly."""
    noise = np.random.default_rng(1).integers(-3000, 3000, 2 * RATE)
    return (noise / 32768).astype(np.float32)


@pytest.fixture
def wav(tmp_path, sound):
    """Write the sound to a file of this name, last changed at a time (ns)."""

    def write(name, seconds=2.0, closed=CLOSED, **options):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        samples = np.resize(sound, round(seconds * RATE))
        soundfile.write(path, samples, RATE, format="WAV", **options)
        os.utime(path, ns=(closed, closed))
        return path

    return write


def recorded(path, **options):
    return np.concatenate([np.empty(0, np.float32), *read_audio(path, **options)])


def started(path, zone=UTC, pattern=""):
    """Return when a file begins, as text, and by what."""
    found = file_time(path, zone, pattern)
    return datetime.fromtimestamp(found.start / NANOSECONDS, UTC).isoformat(), found.origin


@pytest.mark.parametrize(
    ("name", "begin"),
    [
        ("20260301_070000.WAV", "2026-03-01T06:00:00"),
        ("20260301_070000T.WAV", "2026-03-01T06:00:00"),
        ("24E144085F256908_20260301_070000.WAV", "2026-03-01T06:00:00"),
        ("SM_20260301_070000.wav", "2026-03-01T06:00:00"),
        ("S4U01_20260301$070000.wav", "2026-03-01T06:00:00"),
        ("20240716-140000-ST4037-XM.wav", "2024-07-16T12:00:00"),
        ("20260301070000.wav", "2026-03-01T06:00:00"),
        ("20260301_070000.3gp", "2026-03-01T06:00:00"),
        ("20260301T070000Z.wav", "2026-03-01T07:00:00"),
        ("mic_20260301T070000.250000Z.wav", "2026-03-01T07:00:00.250000"),
        ("20260301T070000+1000_Owner.flac", "2026-02-28T21:00:00"),
        ("20260301_070000_UTC.wav", "2026-03-01T07:00:00"),
        ("20260301_070000-0001.wav", "2026-03-01T06:00:00"),
        ("2026-03-01_07-00-00.wav", "2026-03-01T06:00:00"),
        ("2026-03-01T07:00:00-05:00.wav", "2026-03-01T12:00:00"),
        ("2026-03-01T07:00:00.500+01:00.wav", "2026-03-01T06:00:00.500000"),
        ("2026-03-01T07_00_00.125Z.wav", "2026-03-01T07:00:00.125000"),
        ("2026-03-01T07:00Z.wav", "2026-03-01T07:00:00"),
        ("2026-03-01-birdnet-07:00:00.wav", "2026-03-01T06:00:00"),
        ("Eurasian_Wren-85-2026-03-01-birdnet-RTSP_1-07:00:00.mp3", "2026-03-01T06:00:00"),
        ("turdus_merula_85p_20260301T070000Z.wav", "2026-03-01T07:00:00"),
        ("WhatsApp Audio 2026-03-01 at 7.00.00 PM.ogg", "2026-03-01T18:00:00"),
        ("Recording 2026-03-01 at 7.00.00 p.m..wav", "2026-03-01T18:00:00"),
        ("2026-03-01 07.00.00 p. m..wav", "2026-03-01T18:00:00"),
        ("2026-03-01 12.00.00 a.m.wav", "2026-02-28T23:00:00"),
        ("2026-03-01 07.00.00\u202fp.\u00a0m. kitchen.wav", "2026-03-01T18:00:00"),
        ("20260301_070000-0015.wav", "2026-03-01T06:00:00"),
        ("20260301_070000-0100.wav", "2026-03-01T06:00:00"),
        ("2026-03-01_07-00-00-0930_kitchen.wav", "2026-03-01T06:00:00"),
        ("20260301T070000-0500.wav", "2026-03-01T12:00:00"),
        ("2026-03-01 07:00:00-0500.wav", "2026-03-01T12:00:00"),
        ("20260301_070000_UTC-05.wav", "2026-03-01T12:00:00"),
        ("5E90A4D4.WAV", "2020-04-10T16:54:44"),
        ("12345678_20260301_070000.wav", "2026-03-01T06:00:00"),
        ("20260329_033000.wav", "2026-03-29T01:30:00"),
    ],
)
def test_the_name_of_a_file_says_when_it_begins(wav, name, begin):
    assert started(wav(name), BERLIN) == (f"{begin}+00:00", NAME)


@pytest.mark.parametrize(
    ("name", "doubt"),
    [
        ("20260301_070000-0900.wav", "are taken for a number (a zone is read by --start-pattern"),
        ("20260301_070000-0015.wav", ""),
        ("20260301_070000-0001.wav", ""),
        ("20260301_070000-0930_kitchen.wav", "are taken for a number"),
        ("20260301 070000 nachm.wav", "may be a half of the day"),
        ("2026-03-01_07-00-00_PM2.wav", "may be a half of the day"),
        ("2026-03-01 07.00.00 下午.wav", "may be a half of the day"),
        ("2026-03-01 19.00.00 PM2.wav", ""),
        ("20260301_070000 CET.wav", "may be a zone"),
        ("20260301_070000_PDT.wav", "may be a zone"),
        ("20260301_070000 (MESZ).wav", "may be a zone"),
        ("20260301_070000 WESTEND.wav", ""),
        ("20260301_070000 UTC.wav", ""),
        ("2026-03-01 07.00.00 amber.wav", ""),
        ("2026-03-01 07.00.00 p.m..wav", ""),
        ("5E90A4D4.WAV", "of old AudioMoths"),
    ],
)
def test_a_time_in_a_name_that_may_be_read_wrongly_is_doubted(wav, name, doubt):
    path = wav(name)
    lines = doubts(*arrange([path], BERLIN))
    assert [doubt in line for line in lines] == ([True] if doubt else [])


def test_four_digits_behind_the_times_are_a_zone_if_all_files_have_the_same(wav):
    def starts(*names, doubted=0):
        _, times = arrange([wav(name) for name in names], BERLIN)
        assert sum(bool(time.remark) for time in times) == doubted
        return [datetime.fromtimestamp(time.start / NANOSECONDS, UTC).hour for time in times]

    assert starts("20260301_070000-0500.wav", "20260301_080000-0500.wav") == [12, 13]
    assert starts("20260301_070000-0500.wav", "20260301_080000-0900.wav", doubted=2) == [6, 7]
    assert starts("20261101_013000-0400.wav", "20261101_013000-0500.wav") == [5, 6]
    assert starts("20260301_070000-0500.wav", "20260301_080000.wav", doubted=1) == [6, 7]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("kitchen.wav", "neither its name nor its metadata"),
        ("20261301_070000.wav", "'20261301_070000' in its name is no date"),
        ("20260301_250000.wav", "is no date"),
        ("19800101_000012.wav", "a clock that was not set"),
        ("20000101_000012.wav", "a clock that was not set"),
        ("20620301_070000.wav", "in the future"),
        ("20260301_0001.wav", "may be a time, or a number"),
        ("202603010700.wav", "may be a time, or a number"),
        ("20260301.wav", "neither"),
        ("01-03-2026_07-00-00.wav", "neither"),
        ("260301_070000.wav", "neither"),
        ("123456789012345678.wav", "neither"),
        ("59384712.WAV", "neither"),
        ("5e90a4d4.wav", "neither"),
    ],
)
def test_numbers_that_are_no_time_are_not_taken_for_one_and_the_guess_says_so(wav, name, why):
    found = file_time(wav(name), BERLIN)
    assert (found.start, found.origin) == (CLOSED - 2 * NANOSECONDS, GUESS), "closed at its end"
    assert why in found.remark


def test_a_pattern_of_ones_own_says_when_files_begin(wav):
    names = {
        "Garden 01032026-0700.wav": "%d%m%Y-%H%M",
        "20260301/070000.wav": "%Y%m%d/%H%M%S",
        "260301_07h00AM.wav": "%y%m%d_%Ih%M%p",
        "x2026-03-01 07:00+0100.wav": "%Y-%m-%d %H:%M%z",
    }
    for name, pattern in names.items():
        check_pattern(pattern)
        assert started(wav(name), BERLIN, pattern) == ("2026-03-01T06:00:00+00:00", NAME)
    with pytest.raises(SourceError, match="name does not fit '%Y%m%d-%H%M'"):
        file_time(wav("kitchen.wav"), BERLIN, "%Y%m%d-%H%M")
    for name in ("00010101_000000.wav", "99991231_235959.wav"):
        with pytest.raises(SourceError, match=f"'{name[:15]}' in its name is "):
            file_time(wav(name), BERLIN, "%Y%m%d_%H%M%S")
    for wrong in ("%Y%m%d_%H%M-%H%M", "%d%m%Y", "%H%M%S", "%Y%m%d_%H%M%Q", "", "%Y%m%d%H%M%"):
        with pytest.raises(ConfigurationError):
            check_pattern(wrong)


def test_a_file_of_a_folder_that_does_not_fit_a_pattern_is_left_out(hearthlog, wav, tmp_path):
    wav("card/01032026-0700.wav")
    other = wav("card/notes.wav")
    options = ("--start-pattern", "%d%m%Y-%H%M", "--model", "none", "-o", tmp_path / "logs")
    result = hearthlog("record", tmp_path / "card", *options)
    assert result.returncode == 3
    assert f"left out: {other}: its name does not fit '%d%m%Y-%H%M'" in result.stderr
    assert len(features(tmp_path / "logs")[0]) == 40
    result = hearthlog("record", other, *options[:-1], tmp_path / "more")
    assert result.returncode == 1


def test_the_time_that_no_log_can_have_is_said(wav):
    paths = [wav("a.wav"), wav("b.wav")]
    times = [FileTime(read_time(f"{year}-01-02T00:00:00"), 0, NAME) for year in (2026, 2040)]
    with pytest.raises(SourceError, match="sound of 2040-01-02"):
        FileSource(paths, times[0].start, times=times)


def with_chunk(path, name, content):
    """Put a chunk into a WAV file, before its sound."""
    data = path.read_bytes()
    place = data.index(b"data")
    chunk = name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)
    path.write_bytes(data[:place] + chunk + data[place:])


def comment(text):
    content = text.encode() + b"\0"
    content += b"\0" * (len(content) % 2)
    return b"INFO" + b"ICMT" + struct.pack("<I", len(content)) + content


AUDIOMOTH = "Recorded at 07:00:00 01/03/2026 (UTC{}) by AudioMoth 24E144085F256908 at gain 2"


@pytest.mark.parametrize(
    ("name", "chunk", "begin", "origin"),
    [
        ("a.WAV", (b"LIST", comment(AUDIOMOTH.format(""))), "07:00:00", METADATA),
        ("a.WAV", (b"LIST", comment(AUDIOMOTH.format("-4:30"))), "11:30:00", METADATA),
        ("20260301_070000.WAV", (b"LIST", comment(AUDIOMOTH.format(""))), "07:00:00", NAME),
        ("20260301_083000.WAV", (b"LIST", comment(AUDIOMOTH.format(""))), "07:30:00", NAME),
        ("a.wav", (b"bext", bytes(320) + b"2026-03-0107:00:00" + bytes(264)), "06:00:00", METADATA),
        (
            "a.wav",
            (b"guan", b"GUANO|Version: 1.0\nTimestamp: 2026-03-01T07:00:00+03:00\n"),
            "04:00:00",
            METADATA,
        ),
        ("a.wav", (b"bext", bytes(320) + b"1980-01-0107:00:00" + bytes(264)), "08:59:58", GUESS),
    ],
)
def test_metadata_say_when_a_file_begins_where_its_name_does_not_and_in_which_zone(
    wav, name, chunk, begin, origin
):
    path = wav(name)
    with_chunk(path, *chunk)
    os.utime(path, ns=(CLOSED, CLOSED))
    assert started(path, BERLIN) == (f"2026-03-01T{begin}+00:00", origin)


def test_an_hour_that_a_clock_shows_twice_is_told_by_the_end_of_the_file_or_said(wav):
    second = read_time("2025-10-26T01:30:00Z")
    near = file_time(wav("20251026_023000.wav", closed=second + 3 * NANOSECONDS), BERLIN)
    assert (near.start, near.remark) == (second, "")
    copied = file_time(wav("20251026_023000.wav"), BERLIN)
    assert copied.start == second - 3600 * NANOSECONDS
    assert "showed 02:30 twice" in copied.remark


def events(paths, zone=UTC, start=None):
    ordered, times = arrange(paths, zone, start=start)
    source = FileSource(ordered, times[0].start, times=times)
    found = [each for each in source.events(Event()) if isinstance(each, Frames | Gap)]
    return source, found


def test_files_are_heard_in_the_order_of_time_with_a_gap_where_there_is_one(wav):
    late, early = wav("20260301_080000.WAV"), wav("20260301_070000.WAV", 2.03)
    source, (first, gap, second) = events([late, early])
    assert source.warnings == []
    assert len(first.samples) == len(second.samples) == 40
    begin = read_time("2026-03-01T07:00:00")
    end = begin + 2 * NANOSECONDS
    assert (first.stamps[0], gap.start) == (begin, end)
    assert gap.end == second.stamps[0] == read_time("2026-03-01T08:00:00")
    assert gap.frames_lost == 3598 * 20 == second.first - 40
    assert "20260301_070000.WAV and 20260301_080000.WAV" in gap.reason
    np.testing.assert_array_equal(second.samples, first.samples)


def test_files_that_follow_within_what_names_can_say_are_one_sound(wav, sound):
    names = ("20260301_070000.WAV", "20260301_070002.WAV", "20260301_070004.WAV")
    source, found = events([wav(name, 1.98) for name in names])
    assert source.warnings == []
    (frames,) = found
    samples = np.tile(sound[: round(1.98 * RATE)], 3)
    np.testing.assert_array_equal(frames.samples.ravel(), samples[: frames.samples.size])


def test_files_that_overlap_lose_nothing_and_time_never_runs_back(wav):
    names = ("20260301_070000.WAV", "20260301_070003.WAV", "20260301_070020.WAV")
    source, found = events([wav(name, 5) for name in names])
    first, gap, second = found
    assert len(first.samples) == 200
    assert gap.start == first.stamps[-1] + 50_000_000
    assert second.stamps[0] == read_time("2026-03-01T07:00:20")
    (warning,) = source.warnings
    assert "1 file begins before the end of the one before, up to 2.0 s" in warning
    assert "20260301_070003.WAV" in warning


def test_a_start_that_is_given_moves_all_files_and_keeps_their_distances(wav):
    paths = [wav("20260301_080000.WAV"), wav("20260301_070000.WAV")]
    start = read_time("2020-01-01")
    _, (first, gap, second) = events(paths, start=start)
    assert (first.stamps[0], second.stamps[0]) == (start, start + 3600 * NANOSECONDS)
    assert gap.frames_lost == 3598 * 20


def test_files_without_times_follow_each_other_in_the_given_order(wav):
    paths = [wav("b.wav", closed=CLOSED + 1), wav("a.wav")]
    ordered, times = arrange(paths, UTC)
    assert (ordered, times[1]) == (paths, None)
    _, (frames,) = events(paths)
    assert len(frames.samples) == 80
    assert frames.stamps[0] == CLOSED + 1 - 2 * NANOSECONDS


def test_a_recording_of_files_says_what_is_a_guess_and_what_was_not_heard(hearthlog, wav, tmp_path):
    options = ("--model", "none", "-o", tmp_path / "logs")
    wav("in/20260301_080000.WAV"), wav("in/deeper/20260301_070000.WAV")
    wav("in/._20260301_070000.WAV"), wav("in/.Trash/20260301_060000.WAV")
    (tmp_path / "in" / "notes.txt").write_text("none")
    (tmp_path / "in" / "bad.wav").write_text("no sound")
    result = hearthlog("record", tmp_path / "in", *options)
    assert result.returncode == 3
    left_out, gap = result.stderr.splitlines()
    assert left_out.startswith(f"hearthlog: left out: {tmp_path}/in/bad.wav: cannot be read")
    assert gap == "hearthlog: 1 gap, 71,960 frames lost"
    assert [one.frames_lost for one in read(tmp_path / "logs", "gap")] == [71_960]
    begin = features(tmp_path / "logs")[1][0]
    assert begin == read_time("2026-03-01T07:00:00")
    result = hearthlog("record", wav("kitchen.wav"), "--model", "none", "-o", tmp_path / "guess")
    assert result.returncode == 0
    assert result.stderr.count("\n") == 1
    assert "kitchen.wav: the start 2026-03-01T08:59:58.000Z is a guess" in result.stderr
    assert "--start-pattern" in result.stderr


def test_the_zone_of_the_home_is_that_of_the_names(hearthlog, wav, tmp_path):
    environment = {"HEARTHLOG_TIMEZONE": "Europe/Berlin"}
    path = wav("20260301_070000.WAV")
    result = hearthlog("record", path, "--model", "none", "-o", tmp_path / "a", env=environment)
    assert (result.returncode, result.stderr) == (0, "")
    assert features(tmp_path / "a")[1][0] == read_time("2026-03-01T06:00:00")
    pattern = ("--start-pattern", "%Y%m%d_%H%M%S")
    assert (
        hearthlog("record", path, *pattern, "--model", "none", "-o", tmp_path / "b").returncode == 0
    )
    assert features(tmp_path / "b")[1][0] == read_time("2026-03-01T07:00:00")
    assert hearthlog("record", path, "--start-pattern", "%H", "-o", tmp_path / "c").returncode == 2


def test_a_folder_without_audio_is_refused_in_a_line(refused, tmp_path):
    assert refused("record", tmp_path) == (
        f"{tmp_path}: no readable audio file in this folder, such as a.wav or a.flac"
    )


def test_a_sound_too_short_for_a_label_is_said_so(hearthlog, wav, tmp_path, model_file):
    start = ("--start", "2026-03-01", "-o", tmp_path / "logs")
    result = hearthlog("record", wav("short.wav", 0.7), "--model", model_file, *start)
    assert result.returncode == 0
    assert "too short for a label" in result.stderr
    result = hearthlog(
        "record", wav("long.wav", 2), "--model", model_file, *start[:2], "-o", tmp_path / "more"
    )
    assert (result.returncode, result.stderr) == (0, "")


def streamed(flac):
    """Return a FLAC file without its length and its digest, as one is that went through a pipe."""
    data = bytearray(flac)
    data[21] &= 0xF0  # the length are the last 36 bits before the digest
    data[22:42] = bytes(20)
    return bytes(data)


def bytes_of(sound, kind="WAV"):
    stream = io.BytesIO()
    soundfile.write(stream, sound, RATE, format=kind, subtype="PCM_16")
    return stream.getvalue()


def test_a_flac_file_without_a_length_is_read_to_its_end(hearthlog, sound, tmp_path):
    path = tmp_path / "20260301_070000.flac"
    path.write_bytes(streamed(bytes_of(sound, "FLAC")))
    assert soundfile.info(path).frames > 1 << 62
    np.testing.assert_array_equal(recorded(path), sound)
    np.testing.assert_array_equal(recorded(path, start=0.5, end=1.25), sound[8000:20_000])
    assert audio_seconds(path) == 2.0
    result = hearthlog("record", path, "--model", "none", "-o", tmp_path / "logs")
    assert (result.returncode, result.stderr) == (0, "")
    assert len(features(tmp_path / "logs")[0]) == 40


@pytest.mark.parametrize("claimed", [b"\xff" * 4, b"\0" * 4])
def test_a_wav_file_that_was_never_completed_is_read_to_its_end(sound, tmp_path, claimed):
    data = bytes_of(sound)
    place = data.index(b"data") + 4
    path = tmp_path / "a.wav"
    path.write_bytes(data[:4] + claimed + data[8:place] + claimed + data[place + 4 :])
    before = path.read_bytes()
    faults = []
    np.testing.assert_array_equal(recorded(path, incomplete=faults.append), sound)
    assert faults == []
    assert path.read_bytes() == before


def test_a_large_wav_file_that_was_never_completed_is_read_to_its_end(sound, tmp_path):
    path = tmp_path / "a.wav"
    data = bytes_of(sound, "RF64")
    assert data[12:16] == b"ds64"
    path.write_bytes(data[:20] + bytes(24) + data[44:])
    np.testing.assert_array_equal(recorded(path)[: len(sound)], sound)
    assert len(recorded(path)) < len(sound) + 100, "libsndfile writes a chunk behind it"


def test_a_wav_file_of_no_samples_is_not_taken_for_one_that_was_not_completed(tmp_path):
    path = tmp_path / "a.wav"
    path.write_bytes(bytes_of(np.empty(0)) + b"LIST\x04\0\0\0INFO")
    with pytest.raises(SourceError, match="holds no audio"):
        recorded(path)


@pytest.mark.parametrize("kind", ["WAV", "FLAC", "OGG", "MP3", "W64", "AIFF", "AU", "RF64"])
def test_a_cut_file_is_read_as_far_as_it_goes_with_a_word(sound, tmp_path, kind, capfd):
    full = tmp_path / f"whole.{kind.lower()}"
    soundfile.write(full, np.tile(sound, 6), RATE, format=kind)
    faults = []
    assert len(recorded(full, incomplete=faults.append)) == 12 * RATE
    assert faults == []
    path = tmp_path / f"cut.{kind.lower()}"
    path.write_bytes(full.read_bytes()[: full.stat().st_size // 2 + 1])
    samples = recorded(path, incomplete=faults.append)
    assert 4 * RATE < len(samples) < 8 * RATE
    (fault,) = faults
    assert fault.startswith(f"{path}: is ")
    assert "cut short" in fault
    assert capfd.readouterr() == ("", ""), "not a word of a library"
    if kind not in {"MP3", "OGG"}:
        np.testing.assert_array_equal(samples, np.tile(sound, 6)[: len(samples)])


def test_a_part_that_begins_behind_the_cut_of_a_file_is_said_not_to_be_there(sound, tmp_path):
    cut = tmp_path / "a.flac"
    cut.write_bytes(bytes_of(np.tile(sound, 3), "FLAC")[:-80_000])
    faults = []
    assert not len(recorded(cut, start=5.0, end=5.5, incomplete=faults.append))
    assert faults == [f"{cut}: is damaged or cut short before 5.00 s"]


def test_a_header_with_many_channels_takes_no_memory_for_sound_that_is_not_there(tmp_path):
    path = tmp_path / "a.wav"
    soundfile.write(path, np.zeros((1, 1024)), 768_000)
    tracemalloc.start()
    try:
        recorded(path)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_a_recording_that_is_stopped_reads_no_more_of_what_is_no_sound(tmp_path):
    path = tmp_path / "a.wav"
    soundfile.write(path, np.full(60 * RATE, np.nan), RATE, subtype="FLOAT")
    stop = Event()
    stop.set()
    assert list(FileSource([path], CLOSED).events(stop)) == []
    events = FileSource([path], CLOSED).events(Event())
    assert next(events).frames_lost == 1200, "one gap"
    with pytest.raises(SourceError, match="not finite"):
        next(events)


def test_a_recording_of_a_cut_file_goes_on_with_the_next(hearthlog, sound, wav, tmp_path):
    cut = tmp_path / "20260301_070000.flac"
    cut.write_bytes(bytes_of(np.tile(sound, 3), "FLAC")[:-20_000])
    options = ("--model", "none", "-o", tmp_path / "logs")
    result = hearthlog("record", cut, wav("20260301_070100.wav"), *options)
    assert result.returncode == 3
    assert f"{cut}: is damaged or cut short after" in result.stderr
    assert features(tmp_path / "logs")[1][-1] > read_time("2026-03-01T07:01:01.9")


def converted(path, target, *options):
    command = ["ffmpeg", "-loglevel", "error", "-i", path, *options, target]
    subprocess.run(list(map(str, command)), check=True)
    return target


@needs_ffmpeg
@pytest.mark.parametrize("suffix", ["m4a", "aac", "webm", "wma", "mka", "oga"])
def test_what_libsndfile_cannot_read_is_read_by_ffmpeg(wav, sound, tmp_path, suffix):
    path = converted(wav("a.wav"), tmp_path / f"b.{suffix}")
    assert is_audio(path.name)
    faults = []
    samples = recorded(path, incomplete=faults.append)
    assert faults == []
    assert abs(len(samples) - len(sound)) < 0.15 * RATE
    assert audio_seconds(path) == pytest.approx(len(samples) / RATE)
    if suffix == "oga":  # FLAC in Ogg
        np.testing.assert_array_equal(samples, sound)
        np.testing.assert_array_equal(recorded(path, start=0.5, end=1.0), sound[8000:16_000])


@needs_ffmpeg
@pytest.mark.parametrize("suffix", ["aac", "caf", "mka", "oga"])
def test_what_ffmpeg_reads_of_a_cut_file_is_said_to_be_cut(wav, tmp_path, suffix):
    path = converted(wav("a.wav", 8), tmp_path / f"b.{suffix}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 + 1])
    faults = []
    assert 2 * RATE < len(recorded(path, incomplete=faults.append)) < 6 * RATE
    assert "cut short" in faults[0]


@needs_ffmpeg
def test_a_file_that_leads_ffmpeg_elsewhere_is_refused(wav, tmp_path):
    other = wav("a.wav")
    path = tmp_path / "playlist.wav"
    for text in (
        f"ffconcat version 1.0\nfile '{other}'\n",
        f"#EXTM3U\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n",
        f"<smil><body><audio src='{other}'/></body></smil>",
    ):
        path.write_text(text)
        with pytest.raises(SourceError, match="cannot be read as audio"):
            recorded(path)


@pytest.mark.parametrize(
    "script", ["exec sleep 60", "sleep 60 & wait", "while :; do echo trouble >&2; done"]
)
def test_an_ffmpeg_that_gives_no_sound_is_ended(tmp_path, monkeypatch, script):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(ffmpeg, "_FILE_SECONDS", 0.3)
    path = tmp_path / "a.m4a"
    path.write_text("anything")
    with pytest.raises(SourceError, match="ffmpeg finds no more sound in it within"):
        recorded(path)


def test_an_ffmpeg_that_cannot_be_run_ends_one_file(tmp_path, monkeypatch):
    program = tmp_path / "ffmpeg"
    program.write_bytes(b"\x7fELF of another machine")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "a.m4a"
    path.write_text("anything")
    with pytest.raises(SourceError, match=r"a.m4a: cannot be read \(Exec format error\)"):
        recorded(path)


def test_without_ffmpeg_the_line_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "my voice.m4a"
    path.write_bytes(b"\0\0\0\x1cftypM4A \0\0\0\0M4A mp42isom")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SourceError) as caught:
        recorded(path)
    assert str(caught.value).endswith(
        "install ffmpeg (Debian: apt install ffmpeg), or convert it elsewhere: "
        "ffmpeg -i 'my voice.m4a' 'my voice.wav'"
    )


def without_table(path, sound, rate):
    """Write an MP3 file and return its frames, but for the one that says how many they are."""
    soundfile.write(path, sound, RATE, compression_level=rate, bitrate_mode="CONSTANT")
    data = path.read_bytes()
    return data[_mp3_frame(data[:4])[0] :]


def test_an_mp3_file_of_several_bit_rates_is_read_to_its_end_or_said_to_be_longer(
    sound, tmp_path, monkeypatch
):
    path = tmp_path / "a.mp3"
    long = np.tile(sound, 5)
    path.write_bytes(without_table(path, sound, 0.0) + without_table(path, long, 0.9))
    assert soundfile.info(path).duration < 8
    faults = []
    if shutil.which("ffmpeg"):
        assert len(recorded(path, incomplete=faults.append)) == pytest.approx(12 * RATE, rel=0.03)
        assert faults == []
    monkeypatch.setenv("PATH", str(tmp_path))
    assert len(recorded(path, incomplete=faults.append)) < 8 * RATE
    assert "install ffmpeg, which reads" in faults[0]


def test_other_words_on_standard_error_are_kept_while_mp3_is_read(sound, tmp_path, capfd):
    soundfile.write(tmp_path / "a.mp3", np.tile(sound, 3), RATE)
    for _ in read_audio(tmp_path / "a.mp3"):
        os.write(2, b"hearthlog: said\n")
    assert capfd.readouterr().err == "hearthlog: said\n"


def test_a_name_that_is_not_utf_8_is_recorded(hearthlog, wav, tmp_path):
    path = wav("a.wav").rename(
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff_20260301_070000.wav"))
    )
    result = hearthlog("record", path, "--model", "none", "-o", tmp_path / "logs")
    assert (result.returncode, result.stderr) == (0, "")
    assert features(tmp_path / "logs")[1][0] == read_time("2026-03-01T07:00:00")


def test_hidden_files_and_folders_are_not_looked_at(wav, tmp_path):
    kept = wav("b/a.wav")
    wav("b/._a.wav"), wav("b/.c/a.wav")
    (tmp_path / "b" / "loop").symlink_to(tmp_path / "b")
    assert find_audio([tmp_path / "b"]) == ([kept], [])
    assert find_audio([kept, Path("none.wav")]) == ([kept, Path("none.wav")], [])


@needs_ffmpeg
def test_a_folder_has_the_files_of_all_formats_that_are_read(wav, tmp_path):
    path = wav("source.wav")
    folder = tmp_path / "folder"
    folder.mkdir()
    for suffix in ("flv", "eac3", "mpg", "ts", "vob", "m2ts", "wv"):
        converted(path, folder / f"a.{suffix}", "-ar", "44100")
    samples, rate = soundfile.read(path)
    for name, suffix in (("WAV", "wave"), ("W64", "w64"), ("NIST", "sph"), ("PAF", "paf")):
        soundfile.write(folder / f"b.{suffix}", samples, rate, format=name, subtype="PCM_16")
    (folder / "notes.txt").write_text("no sound")
    found, refused = find_audio([folder])
    assert [file.name for file in found] == sorted(
        file.name for file in folder.iterdir() if file.suffix != ".txt"
    )
    assert not refused
    for file in found:
        assert len(recorded(file)) > RATE
