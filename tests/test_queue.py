"""A queue that is worth a person's ten minutes: spans that teach, and minutes drawn at random."""

import re
import shutil
from datetime import UTC
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hearthlog.tools.lab.home", reason="the wheel leaves the lab out")

import soundfile
from log_fixtures import run
from viewers import display, reviewing

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.http import free_port
from hearthlog.analyzer.logs.clips import kept_time
from hearthlog.analyzer.logs.labelling import Labelling, find_labellings
from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.logs.spans import NONE, cut, intersection_rows, joined, single_span
from hearthlog.analyzer.marks.marks import QUEUE, RANDOM, Mark, read_marks, read_reviewed
from hearthlog.analyzer.review import review_list as requested
from hearthlog.analyzer.review.candidates import (
    MINUTE,
    RecordedMinutes,
    complete_minutes,
    draw_minutes,
)
from hearthlog.analyzer.review.marking import Marking
from hearthlog.analyzer.review.ranking import cover, sample, worth
from hearthlog.analyzer.review.review_list import ReviewSpan, read_spans
from hearthlog.analyzer.review.review_queue import queue_spans, review_items
from hearthlog.analyzer.review.spans import JudgeableSpans, labelling_model, span_sounds
from hearthlog.analyzer.review.timeline import no_spans
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder.config import Settings
from hearthlog.recorder.log.clips import ClipWriter, KeptSound
from hearthlog.schemas.frames import FRAME_NANOSECONDS, FRAME_SAMPLES, NANOSECONDS, read_time
from hearthlog.schemas.logs.files import active_path, find_logs, is_layer
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.home.composition import Composition, Rooms
from hearthlog.tools.home.routine import plan_short_day
from hearthlog.tools.lab.home.recording import record_composition

__all__ = ["display"]  # a fixture

START = 1_772_323_200 * NANOSECONDS
LENGTH = 24  # minutes
LIVE = ("mic", "live")
EVER = (None, None)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Twenty-four minutes as the starter labels them."""
    library = ClipLibrary()
    composition = Composition(plan_short_day(LENGTH, library, 3), library, Rooms("living_room", 3))
    logs = tmp_path_factory.mktemp("home") / "logs"
    settings = Settings(output=logs, model=starter_file(GENERAL), timezone="UTC")
    record_composition(composition, settings, START)
    return logs


@pytest.fixture
def home(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "home")


@pytest.fixture
def captured(recorded, tmp_path):
    """With the sound of the first half, which was kept."""
    home = shutil.copytree(recorded, tmp_path / "heard")
    (log,) = find_logs(home)
    settings = Settings(output=home, keep_audio="always")
    clips = ClipWriter(settings, ["mic"], lambda stamp: (log, stamp + MINUTE))
    frames = LENGTH // 2 * 1200
    stamps = START + np.arange(frames) * FRAME_NANOSECONDS
    samples = np.random.default_rng(0).integers(-3000, 3000, (frames, FRAME_SAMPLES), np.int16)
    assert clips.write("mic", [KeptSound(stamps, samples)]) == []
    clips.finish()
    return home


def items(home, queue="useful", count=10, models="none"):
    return review_items(queue_spans(queue, find_labellings(home), LIVE, EVER, count, home / models))


def written(home, read):
    return [row for log in find_logs(home) if not is_layer(log) for row in read(log)]


def marking(home):
    return Marking("mic", find_coverage(home)["mic"], "Ann", "live", no_spans())


def test_the_queue_of_a_window_begins_with_what_can_be_heard(captured, display):
    (layer,) = captured.rglob("*.audio.mcap")
    kept = kept_time([layer], "/mic/audio", START, START + LENGTH * MINUTE)
    options = ("--queue", "--port", free_port(), "--spans", "5", "--timezone", "UTC")
    with reviewing(captured, *options, DISPLAY=display) as review:
        for number in range(1, 6):
            review.wait_for(f"{number} of 5: ")
            review.press("n")
        review.process.wait(60)
    pattern = re.compile(r" of 5: (.*)\? \w+ \d+ \w+ (\d\d):(\d\d):(\d\d), ([\d.]+) s; ")
    shown = [found.groups() for found in map(pattern.search, review.lines) if found]
    assert len(shown) == 5
    shares = []
    for text, hours, minutes, seconds, length in shown:
        if "minute" in text:
            continue
        clock = (int(hours) * 60 + int(minutes)) * 60 + int(seconds)
        start = START - START % (24 * 60 * MINUTE) + clock * NANOSECONDS
        end = start + round(float(length) * NANOSECONDS)
        shares.append(cut(kept, start, end).length / (end - start))
    assert len(shares) == 4
    assert min(shares) > 0.5


def test_what_is_partly_heard_goes_before_what_is_not_and_is_cut_to_its_sound(recorded):
    spans = queue_spans("useful", find_labellings(recorded), LIVE, EVER, 8)
    loud = max((one for one in spans if one.reason != RANDOM), key=lambda one: one.end - one.start)
    middle = (loud.start + loud.end) // 2
    kept = joined(
        np.array([middle, middle + 3 * MINUTE]),
        np.array([middle + NANOSECONDS, middle + 3 * MINUTE + FRAME_NANOSECONDS]),
    )
    found = queue_spans("useful", find_labellings(recorded), LIVE, EVER, 8, audible=kept)
    first = found[0]
    assert first.start <= middle
    assert first.end >= middle + NANOSECONDS
    assert first.end - first.start == 3 * NANOSECONDS // 2
    assert [item.is_audible for item in review_items(found, kept)] == [True] + [False] * 7


# Minutes


def labelled(*spans):
    starts, ends, labels = zip(*spans, strict=True)
    times = (np.array(each) * NANOSECONDS for each in (starts, ends))
    return Labelling(*times, np.array(labels, object))


def test_a_minute_is_one_of_the_clock_that_is_labelled_from_start_to_end():
    found = complete_minutes(
        labelled(
            (30, 200, "silence"),
            (200, 240, "speech"),
            (300, 359, "speech"),
            (370, 480, "silence"),
        )
    )
    assert (found.starts // NANOSECONDS).tolist() == [60, 120, 180, 420]
    assert found.has_sound.tolist() == [False, False, True, False]


def test_a_minute_with_a_television_counts_as_one_without_sound():
    talk = [(60 * minute, 60 * minute + 30, "speech") for minute in range(60, 90)]
    pauses = [(end, end + 30, "silence") for _, end, _ in talk]
    evening = sorted([*talk, *pauses])
    found = complete_minutes(
        labelled((0, 1200, "silence"), (1200, 1205, "coughing"), (1205, 3600, "silence"), *evening)
    )
    assert np.flatnonzero(found.has_sound).tolist() == [20]


def test_three_of_four_minutes_that_are_drawn_have_a_sound():
    night = RecordedMinutes(np.arange(1000) * MINUTE, np.arange(1000) % 20 == 0)
    drawn = draw_minutes(night, 20)
    assert night.has_sound[drawn // MINUTE].sum() == 15
    assert len(draw_minutes(night, 2000)) == 1000


def test_no_minute_is_drawn_twice_nor_one_that_is_reviewed_and_the_draw_repeats_itself():
    minutes = RecordedMinutes(np.arange(60) * MINUTE, np.arange(60) % 3 > 0)
    seen = []
    for _ in range(10):
        taken = joined(np.array([*seen, 5 * MINUTE + 7]), np.array([*seen, 5 * MINUTE]) + MINUTE)
        drawn = draw_minutes(minutes, 4, seen, taken).tolist()
        assert drawn == draw_minutes(minutes, 4, seen, taken).tolist()
        seen += drawn
    assert len(set(seen)) == len(seen) == 40
    assert 5 * MINUTE not in seen
    assert minutes.has_sound[np.array(seen) // MINUTE].sum() == 30


def test_every_minute_of_a_kind_is_as_likely():
    minutes = RecordedMinutes(np.arange(40) * MINUTE, np.ones(40, bool))
    first = [int(draw_minutes(minutes, 1, range(k))[0]) // MINUTE for k in range(400)]
    assert np.bincount(first, minlength=40).max() <= 24
    assert len(set(first)) == 40


# Spans that teach


def test_one_of_each_group_of_alike_points_is_chosen_the_heaviest_group_first():
    rng = np.random.default_rng(0)
    group = np.repeat([0, 1, 2], [50, 30, 20])
    points = 10.0 * np.eye(3)[group] + 0.1 * rng.standard_normal((100, 3))
    everything = np.ones(100, bool)
    assert group[cover(points, 1.0, np.ones(100), everything, 3)].tolist() == [0, 1, 2]
    assert group[cover(points, 1.0, np.where(group == 2, 9.0, 1.0), everything, 1)].tolist() == [2]
    assert group[cover(points, 1.0, np.ones(100), group > 0, 5)].min() == 1
    unknown = np.where(group[:, np.newaxis] == 0, np.nan, points)
    assert group[cover(unknown, 1.0, np.ones(100), everything, 2)].tolist() == [1, 2]


def test_of_too_many_spans_those_that_weigh_more_are_kept_more_often():
    weights = np.tile([0.0, 1.0, 3.0], 3000)
    kept, shares = sample(weights, 1000)
    assert len(kept) <= 1000
    assert shares.sum() == pytest.approx(weights.sum())
    share = np.bincount(kept % 3, shares, 3) / shares.sum()
    assert share == pytest.approx([0.0, 0.25, 0.75], abs=0.03)
    assert np.histogram(kept, 10, (0, 9000))[0] == pytest.approx(np.full(10, 98), abs=4)
    rows, shares = sample(np.array([0.0, 2.0, 1.0]), 9)
    assert (rows.tolist(), shares.tolist()) == ([1, 2], [2.0, 1.0])


def test_a_span_of_a_rare_class_weighs_more_and_all_of_a_common_class_too():
    starts = np.arange(10) * 10 * NANOSECONDS
    labels = np.repeat([0, 1], [8, 2])
    spans = JudgeableSpans(starts, starts + 2 * NANOSECONDS, labels, np.arange(10))
    common, rare = np.split(worth(spans, np.zeros(10)), [8])
    assert rare == pytest.approx(np.full(2, 2 * common[0]))
    assert common.sum() == pytest.approx(2 * rare.sum())
    assert worth(spans, np.where(labels, 0.1, 0.9))[0] > worth(spans, np.full(10, 0.1))[0]


def test_alike_sounds_are_near_with_the_model_and_without_it(recorded):
    sources = find_labellings(recorded)
    output = sources.read(*LIVE).labelling
    long = np.flatnonzero((output.ends - output.starts) > 3 * NANOSECONDS)
    middles = (output.starts[long] + output.ends[long]) // 2
    halves = np.sort(np.concatenate([middles - NANOSECONDS, middles]))
    numbers = np.arange(len(halves))
    spans = JudgeableSpans(halves, halves + NANOSECONDS, numbers, numbers)
    model = labelling_model(sources.with_topic("/mic/segment"), "mic", recorded)
    assert model is not None
    for each in (model, None):
        points, gamma = span_sounds(spans, sources, "mic", each)
        assert np.isfinite(points).all()
        distance = np.square(points[:, np.newaxis] - points).mean(axis=2)
        own = np.mean([distance[i, i + 1] for i in range(0, len(halves), 2)])
        assert own < 0.5 * distance[0::2, 1::2].mean()
        assert gamma * points.shape[1] == pytest.approx(0.5, rel=0.1)


def test_what_was_not_recorded_is_like_nothing(recorded):
    start, zero = np.array([START + 9 * 3600 * NANOSECONDS]), np.zeros(1, int)
    spans = JudgeableSpans(start, start + NANOSECONDS, zero, zero)
    points, _ = span_sounds(spans, find_labellings(recorded), "mic", None)
    assert np.isnan(points).all()


@pytest.mark.parametrize("models", ["none", "file"])
def test_a_queue_has_long_enough_spans_and_every_fifth_item_is_a_minute(home, models):
    if models == "file":
        for log in find_logs(home):
            assert labelling_model(find_labellings(log).logs, "mic", home) is not None
    found = items(home)
    assert len(found) == 10
    assert [item.chosen for item in found] == [*[QUEUE] * 4, RANDOM] * 2
    spans = sorted(found)
    assert all(a.end <= b.start for a, b in pairwise(spans))
    for item in found:
        length = item.end - item.start
        if item.chosen == RANDOM:
            assert (length, item.start % MINUTE) == (MINUTE, 0)
        else:
            assert 1.5 * NANOSECONDS <= length <= 10 * NANOSECONDS
    assert items(home) == found


def test_what_was_looked_at_is_not_asked_again_whether_it_was_right_or_not(home):
    seen = []
    for _ in range(2):
        found = items(home, count=5)
        assert all(b.end <= a.start or b.start >= a.end for a in found for b in seen)
        for item in found:
            marking(home).review(item.start, item.end, item.chosen)
        seen += found
    minutes = items(home, "random", 99)
    assert {RANDOM} == {item.chosen for item in minutes}
    assert len(minutes) + 2 <= LENGTH
    assert not {item.start for item in minutes} & {item.start for item in seen}


def test_in_a_short_log_most_is_left_for_spans(home):
    limits = (START, START + 9 * MINUTE)
    found = review_items(queue_spans("useful", find_labellings(home), LIVE, limits, 10))
    assert {item.chosen for item in found} == {QUEUE}


def test_when_all_is_reviewed_that_is_said(home):
    marking(home).review(START, START + LENGTH * MINUTE, QUEUE)
    for queue in ("useful", "random"):
        with pytest.raises(DataError, match=r"nothing is left to review|no whole minute is left"):
            items(home, queue)


# Without a display


def test_a_label_file_of_a_queue_tells_the_import_what_was_looked_at_and_how_it_was_chosen(
    home, tmp_path, capfd
):
    path = tmp_path / "ten.txt"
    done = run(capfd, "review", home, "--queue", "--save", path)
    assert done.returncode == 0, done.stderr
    assert "no sound of these lines is kept" in done.stderr
    assert not (tmp_path / "ten").exists()
    requested = items(home)
    cannot_judge = requested[0]

    def keep(line):
        return not cannot_judge.start <= read_time(line.split("\t")[0]) < cannot_judge.end

    lines = path.read_text().splitlines()
    kept = [line for line in lines if keep(line)]
    assert len(kept) == len(lines) - 1
    path.write_text("\n".join(kept) + "\n")
    done = run(capfd, "annotate", "import", home, path)
    assert "7 spans of the queue, 2 minutes drawn at random" in done.stderr
    looked = written(home, read_reviewed)
    assert {(span.start, span.end, span.chosen) for span in looked} == {
        (item.start, item.end, item.chosen) for item in requested[1:]
    }
    assert {(span.corrects, bool(span.reviewer), bool(span.made)) for span in looked} == {
        ("live", True, True)
    }
    output = find_labellings(home).read(*LIVE).labelling
    for item in requested:
        if item.chosen == RANDOM:
            parts, rows, _ = intersection_rows(output, single_span(item.start, item.end))
            marks = [m for m in written(home, read_marks) if item.start <= m.start < item.end]
            assert [mark.label for mark in marks] == output.labels[rows].tolist()
            assert [mark.start for mark in marks] == pytest.approx(parts.starts.tolist(), abs=1e6)
    before = written(home, read_reviewed)
    again = run(capfd, "annotate", "import", home, path)
    assert (again.returncode, written(home, read_reviewed)) == (0, before)


def test_beside_the_label_file_of_a_queue_lies_the_sound_that_was_kept_line_by_line(
    captured, tmp_path, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    done = run(
        capfd, "review", captured, "--queue", "--save", "ten.txt", "--timezone", "Asia/Tokyo"
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split("\t") for line in Path("ten.txt").read_text().splitlines()]
    (layer,) = captured.rglob("*.audio.mcap")
    kept = kept_time([layer], "/mic/audio", START, START + LENGTH * MINUTE)
    folder = Path("ten")
    assert oct(folder.stat().st_mode)[-3:] == "700"
    for number, (start, end, _, *note) in enumerate(lines, 1):
        assert start.endswith("+09:00")
        span = read_time(start), read_time(end)
        length = cut(kept, *span).length
        file = folder / f"{number:02}.wav"
        assert file.exists() == (length >= NANOSECONDS // 10) == (str(file) in "".join(note))
        if file.exists():
            assert oct(file.stat().st_mode)[-3:] == "600"
            sound, rate = soundfile.read(file)
            assert len(sound) / rate == pytest.approx((span[1] - span[0]) / NANOSECONDS, abs=1e-3)
            assert np.abs(sound).max() > 0
    assert "the others have no sound" in done.stderr
    begins = [n for n, line in enumerate(lines, 1) if "a minute drawn at random" in line[-1]]
    assert len(begins) == 2
    table = [row for row in done.stdout.splitlines() if re.search(r" a minute, to \d+", row)]
    assert [int(row.split()[0]) for row in table] == begins
    for first in begins:
        start = read_time(lines[first - 1][0])
        reported_of_it = cut(kept, start, start + MINUTE).length > 0
        assert bool(list(folder.glob(f"{first:02}-*.wav"))) == reported_of_it
    spans = [line for line in read_spans(Path("ten.queue.csv")) if line.reason != RANDOM]
    requested = [cut(kept, span.start, span.end).length / (span.end - span.start) for span in spans]
    assert sum(share > 0.5 for share in requested) == len(spans)
    assert run(capfd, "annotate", "import", captured, "ten.txt").returncode == 0
    marks = {(m.start, m.end, m.label) for m in written(captured, read_marks)}
    assert marks == {(read_time(a), read_time(b), c) for a, b, c, *_ in lines}
    again = run(capfd, "review", captured, "--queue", "--save", "ten.csv")
    assert (again.returncode, Path("ten.csv").exists()) == (1, False)


def test_the_sound_of_the_hour_that_is_being_recorded_is_found(captured, tmp_path):
    (layer,) = captured.rglob("*.audio.mcap")
    before = requested.find_kept_sound(captured, "mic", EVER, [])
    active = layer.rename(active_path(layer))
    with active.open("r+b") as stream:
        stream.truncate(active.stat().st_size - 8)  # without its end
    after = requested.find_kept_sound(captured, "mic", EVER, [])
    assert (list(after.layers), after.time.length) == ([active], before.time.length)
    file = requested.SoundFile(1, 1, START, START + NANOSECONDS)
    requested.write_sounds(tmp_path / "ten", [file], 1, after)
    assert len(soundfile.read(tmp_path / "ten/01.wav")[0]) == 16_000


def test_a_minute_whose_log_is_gone_has_no_lines():
    middle, end = START + MINUTE // 2, START + MINUTE
    minutes = [(START, end), (end, end + MINUTE)]
    spans = [ReviewSpan("mic", *each, "live", "", "", "", None, RANDOM) for each in minutes]
    marks = [Mark("mic", START, middle, "speech"), Mark("mic", middle, end, "music")]
    kept = requested.KeptSoundLayers({}, "/mic/audio", single_span(START, end + MINUTE))
    files = requested.sound_files(marks, spans, kept)
    assert [(file.first, file.last) for file in files] == [(1, 1), (2, 2), (1, 2)]
    lines = requested.label_lines(marks, spans, files, "ten", UTC).splitlines()
    assert [line.count("a minute drawn at random, to line 2") for line in lines] == [1, 0]


def test_labels_where_a_queue_did_not_ask_are_told_apart(home, tmp_path, capfd):
    path = tmp_path / "ten.txt"
    run(capfd, "review", home, "--queue", "--save", path)
    zero = find_coverage(home)["mic"].starts[0]
    first = min(item.start for item in items(home))
    end = (first - zero) / NANOSECONDS
    assert end > 0.5
    path.write_text(f"{end - 0.5}\t{end}\tmusic\n{path.read_text()}")
    done = run(capfd, "annotate", "import", home, path)
    assert f"1 mark outside the spans of {path.with_suffix('.queue.csv')}: your own" in done.stderr
    assert "8 spans of the queue, 2 minutes drawn at random" in done.stderr


def test_a_list_of_a_saved_queue_is_gone_through_as_it_was_chosen(home, tmp_path, capfd):
    run(capfd, "review", home, "--queue", "--save", tmp_path / "ten.csv")
    listed = items(home, str(tmp_path / "ten.queue.csv"), None)
    assert [(item[:2], item.chosen) for item in listed] == [
        (item[:2], item.chosen) for item in items(home)
    ]
    done = run(capfd, "review", home, "--queue", "--save", tmp_path / "ten.txt")
    assert done.returncode == 1
    assert "ten.queue.csv" in done.stderr
    assert not (tmp_path / "ten.txt").exists()


def test_fewer_spans_than_asked_are_said(home, tmp_path, capfd):
    path = tmp_path / "many.txt"
    done = run(capfd, "review", home, "--queue", "random", "--spans", "99", "--save", path)
    assert f"{len(items(home, 'random', 99))} of the 99 requested" in done.stderr


def test_of_no_minutes_none_is_drawn():
    nothing = RecordedMinutes(np.empty(0, np.int64), np.empty(0, bool))
    assert draw_minutes(nothing, 5, (), NONE).tolist() == []
