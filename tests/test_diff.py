"""Two labellings of the same sound are compared, and what is doubtful comes first in a queue."""

import json
import shutil
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_fixtures import record_logs, run
from model_folders import keep_models
from sklearn.metrics import cohen_kappa_score, confusion_matrix
from stores import put

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import Events, compare_labellings
from hearthlog.analyzer.logs.labelling import Labelling, NamedLabelling, find_labellings
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.analyzer.logs.spans import NONE
from hearthlog.analyzer.marks.marks import Mark, read_marks, write_marks
from hearthlog.analyzer.review.ranking import make_queue
from hearthlog.analyzer.review.review_list import (
    REASONS,
    ReviewSpan,
    queued,
    read_spans,
    write_spans,
)
from hearthlog.analyzer.review.spans import (
    border_pieces,
    judgeable_spans,
    other_labels,
    uncertainty,
)
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import FRAME_NANOSECONDS, NANOSECONDS, read_time, time_text
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic

CLASSES = ("silence", "speech", "coughing")
MIDNIGHT = read_time("2026-03-02T00:00:00")
DAY = 86_400 * NANOSECONDS
TIMES = st.integers(0, 1 << 62)


@pytest.fixture
def hearthlog(capfd):
    """Run the command and return what came of it."""
    return partial(run, capfd)


@pytest.fixture(scope="module")
def relabelled(recorded, sounds, model_file, tmp_path_factory):
    """Logs with the layers of another model, `two`, on the same sound."""
    folder = tmp_path_factory.mktemp("relabelled")
    models = keep_models(folder / "models", model_file)
    others = record_logs(sounds, folder / "other", models / "two.safetensors")
    logs = shutil.copytree(recorded, folder / "logs")
    for other in find_logs(others):
        write_layer(logs / other.relative_to(others), other, "two")
    return logs


@pytest.fixture
def logs(relabelled, tmp_path):
    return shutil.copytree(relabelled, tmp_path / "logs")


def write_layer(log, other, name, kinds=("label", "segment"), change=lambda _: {}):
    """Write the labels of another log as a layer, as `hearthlog relabel` does."""
    found = read_columns([other], {f"/mic/{kind}" for kind in kinds})
    columns = {kind: found[f"/mic/{kind}"] for kind in kinds}
    base = f"/mic/relabel/{name}"
    types = {"label": message_types.LABEL, "segment": message_types.SEGMENT}
    named = {
        kind: {"probabilities": array_names(own.metadata, "probabilities")}
        if kind == "label"
        else {}
        for kind, own in columns.items()
    }
    topics = [Topic(f"{base}/{kind}", types[kind], array_names=named[kind]) for kind in kinds]
    path = log.with_name(f"{log.name.removesuffix('.mcap')}.relabel-{name}.mcap")
    writer = LogWriter(path, topics, {"model": name, "log": log.name})
    for kind, own in columns.items():
        fields = own.fields | change(own)
        writer.write_columns([TopicBatch(f"{base}/{kind}", own.log_times, fields)])
        writer.flush()
    return writer.finish()


def side(name, rows, classes=CLASSES):
    starts, ends, labels = zip(*rows, strict=True)
    labelling = Labelling(np.array(starts), np.array(ends), np.array(labels, object))
    return NamedLabelling(name, classes, labelling)


def events(*rows):
    return Events(*(np.array(column) for column in zip(*rows, strict=True)))


def frames(name, labels):
    """Label frames; None is no label."""
    rows = [
        (MIDNIGHT + i * FRAME_NANOSECONDS, MIDNIGHT + (i + 1) * FRAME_NANOSECONDS, label)
        for i, label in enumerate(labels)
        if label
    ]
    return side(name, rows)


def segments(logs, topic="/mic/segment"):
    columns = read_columns(find_logs(logs), {topic})[topic]
    starts = columns["header.stamp"]
    columns = starts, starts + columns["duration"], columns["label"]
    return list(zip(*(column.tolist() for column in columns), strict=True))


def spans_of(result):
    return [(s["start"], s["end"], s["label_a"], s["label_b"]) for s in result["spans"]]


@given(st.lists(st.tuples(*[st.sampled_from([None, *CLASSES])] * 2), min_size=1, max_size=60))
def test_agreement_is_that_of_scikit_learn_on_every_frame(pairs):
    a, b = ([pair[i] for pair in pairs] for i in (0, 1))
    if not any(a) or not any(b):
        return
    both = [(i, *pair) for i, pair in enumerate(pairs) if all(pair)]
    if not both:
        with pytest.raises(DataError, match="no time in common"):
            compare_labellings(frames("live", a), frames("relabel/two", b))
        return
    found = compare_labellings(frames("live", a), frames("relabel/two", b))
    _, true, output = zip(*both, strict=True)
    minutes = FRAME_NANOSECONDS / (60 * NANOSECONDS)
    expected = confusion_matrix(true, output, labels=CLASSES)
    assert np.allclose(found.confusion, expected * minutes)
    assert found.total.agreement == pytest.approx(np.trace(expected) / len(both))
    if found.total.kappa is None:
        assert len({*true, *output}) == 1
    else:
        assert found.total.kappa == pytest.approx(cohen_kappa_score(true, output), abs=1e-9)
    assert found.minutes_a == pytest.approx(sum(map(bool, a)) * minutes)
    for name, amounts in found.total.per_class.items():
        assert amounts.minutes_a == pytest.approx(true.count(name) * minutes)
        assert amounts.events_b == (name in output)  # within three seconds there is one at most


@given(st.lists(st.tuples(*[st.sampled_from(CLASSES)] * 2), min_size=1, max_size=60))
def test_successive_disagreements_of_one_pair_are_one_span_and_the_longest_comes_first(pairs):
    found = compare_labellings(
        *(frames(n, [p[i] for p in pairs]) for i, n in enumerate(("live", "b")))
    )
    expected = []
    for i, pair in enumerate(pairs):
        if pair[0] != pair[1]:
            if i and pairs[i - 1] == pair:
                expected[-1][1] += 1
            else:
                expected.append([i, 1, *(CLASSES.index(name) for name in pair)])
    expected.sort(key=lambda row: (-row[1], row[0]))
    runs = found.disagreements
    starts = (runs.starts - MIDNIGHT) // FRAME_NANOSECONDS
    lengths = (runs.ends - runs.starts) // FRAME_NANOSECONDS
    assert np.stack([starts, lengths, runs.a, runs.b], axis=1).tolist() == expected


def test_minutes_are_divided_at_midnight_and_an_event_is_of_the_day_it_begins_in():
    minute = 60 * NANOSECONDS
    a = side("live", [(MIDNIGHT - 2 * minute, MIDNIGHT + minute, "speech")])
    b = side(
        "relabel/two",
        [
            (MIDNIGHT - 3 * minute, MIDNIGHT - minute, "coughing"),
            (MIDNIGHT - minute, MIDNIGHT + 5 * minute, "speech"),
        ],
    )
    found = compare_labellings(a, b)
    before, after = found.days["2026-03-01"], found.days["2026-03-02"]
    assert (before.minutes, after.minutes) == (2.0, 1.0)
    assert (before.agreement, after.agreement) == (0.5, 1.0)
    speech = [day.per_class["speech"] for day in (before, after)]
    assert [(one.minutes_a, one.minutes_b, one.minutes_both) for one in speech] == [
        (2.0, 1.0, 1.0),
        (1.0, 1.0, 1.0),
    ]
    assert [(one.events_a, one.events_b) for one in speech] == [(1, 1), (0, 0)]
    assert found.total.per_class["coughing"].events_b == 1
    assert (found.minutes_a, found.minutes_b) == (3.0, 8.0)


def test_classes_that_only_one_side_knows_are_named():
    a = side("live", [(0, NANOSECONDS, "speech")], ("speech", "music"))
    b = side("relabel/two", [(0, NANOSECONDS, "tap_water")], ("speech", "tap_water"))
    found = compare_labellings(a, b)
    assert (found.only_a, found.only_b) == (["music"], ["tap_water"])
    assert found.classes == ["speech", "music", "tap_water"]


def test_another_name_for_a_class_is_no_difference():
    second = NANOSECONDS
    a = side("live", [(0, second, "crying"), (second, 3 * second, "speech")], ("crying", "speech"))
    rows = [
        (0, second, "crying_sobbing"),
        (second, 2 * second, "shout"),
        (2 * second, 3 * second, "yell"),
    ]
    b = side("relabel/two", rows, ("crying_sobbing", "speech", "shout", "yell"))
    found = compare_labellings(a, b)
    assert found.classes == ["crying", "speech", "shout", "yell"]
    assert (found.only_a, found.only_b) == ([], ["shout", "yell"]), "b tells these apart"
    assert found.total.per_class["crying"].minutes_both == pytest.approx(1 / 60)
    assert found.total.agreement == pytest.approx(1 / 3)


def test_what_the_recorder_said_is_compared_with_a_relabel_layer(logs, hearthlog, tmp_path):
    listed = tmp_path / "list.csv"
    result = hearthlog("diff", logs, "live", "two", "--json", "--list", listed)
    assert result.returncode == 0
    found = json.loads(result.stdout)
    live, other = segments(logs), segments(logs, "/mic/relabel/two/segment")
    assert found["minutes_a"] == pytest.approx(sum(e - s for s, e, _ in live) / 60e9)
    assert 0.0 < found["total"]["agreement"] < 1.0
    assert np.sum(found["confusion"]) == pytest.approx(found["total"]["minutes"])
    for start, end, a, b in spans_of(found):
        middle = (read_time(start) + read_time(end)) // 2
        assert [la for s, e, la in live if s <= middle < e] == [a]
        assert [lb for s, e, lb in other if s <= middle < e] == [b] != [a]
    apart = sum(read_time(end) - read_time(start) for start, end, *_ in spans_of(found))
    total = found["total"]
    assert apart / 60e9 == pytest.approx(total["minutes"] * (1 - total["agreement"]), rel=0.01)
    assert [span.as_text() for span in read_spans(listed)] == found["spans"]
    text = hearthlog("diff", logs, "live", "two", "--spans", 3).stdout
    assert f"{total['agreement']:.1%}" in text
    assert f"{found['disagreements']} disagreements, longest first: 3 of them" in text
    assert max(map(len, text.splitlines())) <= 100


def test_the_only_relabelling_needs_no_name_and_a_wrong_name_lists_what_there_is(logs, hearthlog):
    same = {
        hearthlog("diff", logs, "live", name).stdout for name in ("two", "relabel", "relabel/two")
    }
    assert len(same) == 1
    result = hearthlog("diff", logs, "live", "general-2")
    assert result.returncode == 1
    assert result.stderr == (
        "hearthlog: mic: no labelling 'general-2'; there is live, relabel/two\n"
    )
    write_layer(find_logs(logs)[0], find_logs(logs)[0], "general_2")
    assert hearthlog("diff", logs, "live", "relabel").returncode == 1
    assert "there are no disagreements" in hearthlog("diff", logs, "live", "general-2").stdout


def test_a_review_is_compared_where_somebody_reviewed(logs, hearthlog):
    log = find_logs(logs)[0]
    start, end, label = max(segments(log), key=lambda row: row[1] - row[0])
    other = "speech" if label != "speech" else "music"
    middle = (start + end) // 2
    write_marks(log, [Mark("mic", start, middle, label), Mark("mic", middle, end, other)])
    found = json.loads(hearthlog("diff", logs, "live", "review", "--json").stdout)
    assert found["total"]["minutes"] == pytest.approx((end - start) / 60e9)
    assert found["total"]["agreement"] == pytest.approx(0.5, abs=1e-6)
    assert spans_of(found) == [(time_text(middle), time_text(end), label, other)]


def test_a_part_of_the_time_is_compared(logs, hearthlog):
    full = json.loads(hearthlog("diff", logs, "live", "two", "--json").stdout)
    start, end, *_ = max(spans_of(full), key=lambda row: read_time(row[1]) - read_time(row[0]))
    part = json.loads(
        hearthlog("diff", logs, "live", "two", "--json", "--start", start, "--end", end).stdout
    )
    assert part["total"]["agreement"] == 0.0
    assert part["total"]["minutes"] == pytest.approx((read_time(end) - read_time(start)) / 60e9)
    assert spans_of(part) == [spans_of(full)[0]]


@pytest.mark.parametrize("names", [("live",), ("live", "two"), ("two", "live")])
def test_a_queue_has_spans_to_be_judged_that_do_not_overlap(logs, hearthlog, names):
    results = [
        hearthlog("diff", logs, *names, "--queue", "--spans", 15, "--json") for _ in range(2)
    ]
    assert results[0] == results[1]
    found = json.loads(results[0].stdout)
    times = sorted((read_time(s["start"]), read_time(s["end"])) for s in found["spans"])
    assert len(times) == min(15, found["candidates"]) > 3
    assert all(NANOSECONDS // 2 <= end - start <= 10 * NANOSECONDS for start, end in times)
    assert all(one[1] <= other[0] for one, other in pairwise(times))
    assert {s["reason"] for s in found["spans"]} <= set(REASONS)
    assert {bool(s["label_b"]) for s in found["spans"]} == {len(names) == 2}


def test_a_queue_of_the_logs_here_needs_no_name_of_them(logs, hearthlog, monkeypatch):
    monkeypatch.chdir(logs.parent)
    named = hearthlog("diff", "logs", "live", "two", "--queue", "--json")
    assert named.returncode == 0
    assert hearthlog("diff", "live", "two", "--queue", "--json") == named


def test_what_was_reviewed_is_no_more_in_the_queue(logs, hearthlog, tmp_path):
    listed = tmp_path / "queue.csv"
    hearthlog("diff", logs, "live", "--queue", "--spans", 5, "--list", listed)
    reviewed = read_spans(listed)
    labels = tmp_path / "labels.csv"
    lines = [f"{time_text(s.start)},{time_text(s.end)},{s.label_a},mic\n" for s in reviewed]
    labels.write_text("start,end,label,microphone\n" + "".join(lines))
    assert hearthlog("annotate", "import", logs, labels).returncode == 0
    again = json.loads(hearthlog("diff", logs, "live", "--queue", "--json").stdout)["spans"]
    assert again
    marks = [mark for log in find_logs(logs) for mark in read_marks(log)]
    for span in again:
        start, end = read_time(span["start"]), read_time(span["end"])
        assert not any(mark.start < end and start < mark.end for mark in marks)


def test_when_all_is_reviewed_nothing_is_left(logs, hearthlog):
    log = find_logs(logs)[0]
    write_marks(log, [Mark("mic", *row) for row in segments(log)])
    result = hearthlog("diff", log, "live", "--queue")
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "hearthlog: live: nothing is left to review\n"


def doubtful(start, end, own, *, uncertain):
    """Make a model doubt all of one segment, and nothing else; or only find it new."""

    def change(columns):
        if columns.type != message_types.LABEL:
            return {}
        stamps = columns["header.stamp"]
        here = (stamps >= start) & (stamps < end)
        if not uncertain:
            unknown = np.full_like(columns["probabilities"], np.nan)
            return {"probabilities": unknown, "novelty": here.astype(np.float32)}
        sure = np.zeros_like(columns["probabilities"])
        names = array_names(columns.metadata, "probabilities")
        for first, last, label in own:
            place = (names.index(label) + (first == start)) % len(names)
            sure[(stamps >= first) & (stamps < last), place] = 1.0
        return {"probabilities": sure, "novelty": np.full(len(here), np.nan, np.float32)}

    return change


@pytest.mark.parametrize(("uncertain", "reason"), [(True, "uncertainty"), (False, "novelty")])
def test_what_the_model_is_unsure_of_or_finds_new_comes_first(logs, uncertain, reason):
    log = find_logs(logs)[0]
    own = segments(log)
    lengths = [end - start for start, end, _ in own]
    start, end, _ = own[int(np.argsort(lengths)[-2])]
    write_layer(log, log, "odd", change=doubtful(start, end, own, uncertain=uncertain))
    sources = find_labellings(log)
    found = sources.read("mic", "relabel/odd")
    queue = make_queue(sources, "mic", found, other=None, reviewed=NONE, count=5)
    assert start <= queue.spans.starts[0] < queue.spans.ends[0] <= end
    assert REASONS[int(np.argmax(queue.weighted[:, 0]))] == reason
    assert queue.scores[0] == pytest.approx(1.0 if uncertain else 0.5)
    assert queue.scores[1] < queue.scores[0]


def write_home(path, rows, probabilities, novelty=np.nan):
    """Write a log of segments, in seconds from midnight on, with a label at every second."""
    seconds = np.concatenate([np.arange(start, end) for start, end, _ in rows])
    stamps = MIDNIGHT + seconds * NANOSECONDS
    starts, ends, labels = zip(*rows, strict=True)
    starts, ends = (MIDNIGHT + np.array(each) * NANOSECONDS for each in (starts, ends))
    output = [label for start, end, label in rows for _ in range(start, end)]
    frames = {
        "header.stamp": stamps,
        "header.frame_id": "mic",
        "frame": seconds.astype(np.uint64),
        "label": output,
        "confidence": np.full(len(stamps), 0.5, np.float32),
        "novelty": np.full(len(stamps), novelty, np.float32),
        "probabilities": np.array(
            [probabilities(*each) for each in zip(seconds, output, strict=True)], "f4"
        ),
    }
    spans = {
        "header.stamp": starts,
        "header.frame_id": "mic",
        "duration": ends - starts,
        "label": list(labels),
        "confidence": np.full(len(rows), 0.5, np.float32),
    }
    topics = [
        Topic("/mic/label", message_types.LABEL, array_names={"probabilities": CLASSES}),
        Topic("/mic/segment", message_types.SEGMENT),
    ]
    writer = LogWriter(path, topics, {})
    batch = [TopicBatch("/mic/label", stamps, frames), TopicBatch("/mic/segment", ends, spans)]
    writer.write_columns(batch)
    return writer.finish()


def queue_of(log, count):
    sources = find_labellings(log)
    live = sources.read("mic", "live")
    return make_queue(sources, "mic", live, other=None, reviewed=NONE, count=count)


def test_another_name_for_a_class_is_no_reason_to_review_it(tmp_path):
    rows = [(0, 4, "speech"), (4, 8, "coughing"), (8, 12, "speech")]
    sources = find_labellings(write_home(tmp_path / "home.mcap", rows, lambda *_: [0.0, 1.0, 0.0]))
    output = [
        *((MIDNIGHT + 4 * NANOSECONDS, MIDNIGHT + 8 * NANOSECONDS, "cough"),),
        *((MIDNIGHT + 8 * NANOSECONDS, MIDNIGHT + 12 * NANOSECONDS, "laughter"),),
    ]
    other = side("relabel/two", output, ("cough", "laughter"))
    live = sources.read("mic", "live")
    queue = make_queue(
        sources, "mic", live, other=other, reviewed=NONE, count=9, ranking="disagreeing"
    )
    assert list(zip(queue.labels, queue.others, strict=True)) == [("speech", "laughter")]


def test_a_queue_is_of_many_days_and_classes(tmp_path):
    """All is in doubt, on each of two days twenty segments of speech and two coughs."""
    labels = (["speech"] * 10 + ["coughing"]) * 2
    rows = [(2 * i, 2 * i + 2, label) for i, label in enumerate(labels)]
    rows += [(start + 86_400, end + 86_400, label) for start, end, label in rows]
    queue = queue_of(write_home(tmp_path / "home.mcap", rows, lambda *_: [1 / 3] * 3), 8)
    days = (queue.spans.starts - MIDNIGHT) // DAY
    assert min(np.bincount(days)) >= 3
    assert queue.labels.count("coughing") == queue.labels.count("speech") == 4


def test_what_is_mostly_silence_is_not_uncertain(tmp_path):
    """Silence to the gate that smoothing calls speech, silence in doubt, and two doubtful words."""

    def probabilities(second, _):
        if second < 20:
            return [1.0, 0.0, 0.0] if second < 10 else [0.6, 0.4, 0.0]
        return [0.4, 0.3, 0.3]

    rows = [(0, 10, "speech"), (10, 20, "silence"), (20, 24, "speech"), (24, 28, "silence")]
    sources = find_labellings(write_home(tmp_path / "home.mcap", rows, probabilities))
    live = sources.read("mic", "live")
    options = {"other": None, "reviewed": NONE, "count": 9, "ranking": "uncertain"}
    queue = make_queue(sources, "mic", live, **options)
    assert sorted(queue.labels) == ["silence", "speech"]
    assert ((queue.spans.starts - MIDNIGHT) / NANOSECONDS).min() == 20.0


def test_of_a_long_segment_the_ten_worst_seconds_are_in_the_queue(tmp_path):
    def probabilities(second, _):
        return [0.0, 0.2, 0.8] if 30 <= second < 40 else [0.0, 1.0, 0.0]

    queue = queue_of(write_home(tmp_path / "home.mcap", [(0, 60, "speech")], probabilities), 5)
    assert ((queue.spans.starts - MIDNIGHT) / NANOSECONDS).tolist() == [30.0]
    assert ((queue.spans.ends - MIDNIGHT) / NANOSECONDS).tolist() == [40.0]
    assert queue.uncertainty == pytest.approx([0.8])


def test_flicker_is_one_span_and_what_is_too_short_to_be_judged_is_none():
    edges = np.array([0.0, 25.0, 25.3, 25.9, 26.3, 30.0, 30.4, 35.0])
    times = (edges * 10).astype(np.int64) * (NANOSECONDS // 10)
    windows = judgeable_spans(Events(times[:-1], times[1:], np.array([0, 1, 2, 1, 0, 1, 0])))
    third = 25 / 3
    assert (windows.starts / NANOSECONDS).tolist() == pytest.approx(
        [0.0, third, 2 * third, 25.0, 26.3, 30.4]
    )
    assert (windows.ends / NANOSECONDS).tolist() == pytest.approx(
        [third, 2 * third, 25.0, 26.3, 30.0, 35.0]
    )
    assert windows.labels.tolist() == [0, 0, 0, 2, 0, 0]


def test_a_short_piece_of_a_border_is_no_span_to_judge_and_a_cough_in_silence_is():
    silence, water, ring, cough = range(4)
    windows = judgeable_spans(
        events(
            (0, 4 * NANOSECONDS, water),
            (4 * NANOSECONDS, 47 * NANOSECONDS // 10, ring),
            (47 * NANOSECONDS // 10, 6 * NANOSECONDS, silence),
            (6 * NANOSECONDS, 67 * NANOSECONDS // 10, cough),
            (67 * NANOSECONDS // 10, 9 * NANOSECONDS, silence),
        )
    )
    pieces = border_pieces(windows, np.array([True, False, False, False]))
    assert windows.labels[pieces].tolist() == [ring]


def test_the_reason_of_each_span_is_what_the_queue_is_ranked_by(tmp_path):
    """Speech is in doubt, and at once as novel as can be."""
    rows = [(0, 4, "speech"), (4, 8, "coughing")]
    sources = find_labellings(
        write_home(tmp_path / "home.mcap", rows, lambda *_: [0.0, 0.6, 0.4], novelty=1.0)
    )
    live = sources.read("mic", "live")
    for ranking, reason in (("uncertain", "uncertainty"), ("novel", "novelty")):
        queue = make_queue(
            sources, "mic", live, other=None, reviewed=NONE, count=9, ranking=ranking
        )
        assert {span.reason for span in queued(queue, "mic", "live")} == {reason}


def test_disagreement_is_the_share_of_the_span_in_which_the_other_says_something_else():
    second = NANOSECONDS
    windows = judgeable_spans(events((0, 4 * second, 1), (4 * second, 8 * second, 1)))
    others = events((0, second, 2), (second, 3 * second, 1), (3 * second, 4 * second, 1))
    labels, differing = other_labels(windows, others)
    assert labels.tolist() == [1, -1]
    assert differing.tolist() == [0.25, 0.0]


def test_uncertainty_is_how_far_another_class_comes_up_to_the_label():
    rows = np.array([[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0.4, 0.3, 0.3], [0.2, 0.2, 0.6]])
    output = np.array([0, 0, 0, 0, -1])
    assert uncertainty(rows, output) == pytest.approx([0.0, 0.5, 1.0, 0.45, 0.8])


def test_without_probabilities_a_queue_needs_a_second_labelling(logs, hearthlog):
    for log in find_logs(logs):
        if "relabel" not in log.name:
            write_layer(log, log, "bare", kinds=("segment",))
    alone = hearthlog("diff", logs, "bare", "--queue")
    assert alone.returncode == 1
    assert alone.stderr == (
        "hearthlog: relabel/bare: its labels have no probabilities; name a second labelling to "
        "compare it with\n"
    )
    found = hearthlog("diff", logs, "bare", "two", "--queue", "--spans", 3, "--json")
    assert found.returncode == 0
    assert "the score leaves uncertainty out" in found.stderr
    assert {span["reason"] for span in json.loads(found.stdout)["spans"]} == {"disagreement"}


def spans():
    labels = st.sampled_from([*CLASSES, "x" * 64])
    microphones = st.from_regex(r"[a-z](_?[a-z0-9]){0,20}", fullmatch=True)
    names = st.sampled_from(["live", "review", "relabel/General_2"])
    others = st.one_of(st.just(("", "")), st.tuples(names, st.one_of(st.just(""), labels)))
    scores = st.one_of(st.none(), st.floats(0, 2).map(lambda score: round(score, 3)))
    times = st.lists(TIMES, min_size=2, max_size=2, unique=True).map(sorted)
    reasons = st.sampled_from(REASONS)
    return st.builds(
        lambda mic, time, a, label, b, score, why: ReviewSpan(mic, *time, a, label, *b, score, why),
        *(microphones, times, names, labels, others, scores, reasons),
    )


@given(st.lists(spans(), min_size=1, max_size=10))
def test_a_list_comes_back_as_it_was(tmp_path_factory, found):
    path = tmp_path_factory.mktemp("list") / "list.csv"
    write_spans(path, found)
    assert read_spans(path) == found


GOOD = "mic,2026-03-01T08:00:00Z,2026-03-01T08:00:01Z,live,speech,,,0.5,uncertainty"


@pytest.mark.parametrize(
    ("line", "output"),
    [
        (GOOD.replace("mic", "=cmd()"), "cannot be a topic"),
        (GOOD.replace("mic", "m" * 10_000), "cannot be a topic"),
        (GOOD.replace("08:00:01Z", "08:00:00Z"), "is no span of time"),
        (GOOD.replace("2026-03-01T08:00:01Z", "9999-01-01"), "is no span of time"),
        (GOOD.replace("2026-03-01T08:00:00Z", "1950-01-01"), "is no span of time"),
        (GOOD.replace("2026-03-01T08:00:00Z", "soon"), "'soon' is no time"),
        (GOOD.replace("live", "../../etc"), "is no labelling"),
        (GOOD.replace("speech,", "Speech!,"), "cannot be the name of a class"),
        (GOOD.replace("speech,", ","), "cannot be the name of a class"),
        (GOOD.replace("speech,,", "speech,,music"), "is no labelling"),
        (GOOD.replace("0.5", "nan"), "is no score"),
        (GOOD.replace("0.5", "1e999"), "is no score"),
        (GOOD.replace("uncertainty", "whim"), "is no reason"),
        (GOOD + ",more", "has 10 fields, not 9"),
        (GOOD + '\n"', "is not CSV"),
        (GOOD + "\0" * 200_000, "is not CSV|is no reason"),
    ],
)
def test_a_list_that_cannot_be_is_refused_with_its_line(tmp_path, line, output):
    path = tmp_path / "list.csv"
    path.write_text(",".join(ReviewSpan._fields) + f"\n{GOOD}\n{line}\n")
    with pytest.raises(DataError, match=rf"list\.csv:[34]: .*({output})") as error:
        read_spans(path)
    assert len(str(error.value)) < 400 + len(str(path))


@pytest.mark.parametrize("text", ["", "start,end\n", ",".join(ReviewSpan._fields) + "\n"])
def test_what_is_no_list_of_spans_is_refused(tmp_path, text):
    path = tmp_path / "list.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=r"list of spans|must name the columns"):
        read_spans(path)


def no_log(path):
    path.write_text("no log")


def damage_chunks(path):
    content = path.read_bytes()
    third = len(content) // 3
    path.write_bytes(content[:third] + bytes(third) + content[2 * third :])


def cut_off(path):
    path.write_bytes(path.read_bytes()[:100])


DAMAGE = [no_log, damage_chunks, cut_off]


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_log_is_said_and_the_others_are_compared(logs, hearthlog, damage):
    first = find_logs(logs)[0]
    minutes = json.loads(hearthlog("diff", logs, "live", "two", "--json").stdout)["minutes_a"]
    damage(first)
    result = hearthlog("diff", logs, "live", "two", "--json")
    assert result.returncode == 3
    assert result.stderr.startswith(f"hearthlog: {first}: ")
    assert len(result.stderr.splitlines()) == 1
    assert 0 < json.loads(result.stdout)["minutes_a"] < minutes
    assert hearthlog("diff", logs, "live", "two", "--queue").returncode == 3


@pytest.mark.parametrize("damage", DAMAGE)
def test_where_nothing_can_be_read_it_fails_with_one_line(logs, hearthlog, damage):
    for log in find_logs(logs):
        damage(log)
    result = hearthlog("diff", logs, "live", "two")
    assert (result.returncode, result.stdout) == (1, "")
    assert len(result.stderr.splitlines()) == 1


def test_a_damaged_layer_is_said_where_it_is_missed(logs, hearthlog):
    layers = [log for log in find_logs(logs) if "relabel" in log.name]
    for layer in layers:
        no_log(layer)
    result = hearthlog("diff", logs, "live", "two")
    assert result.returncode == 1
    assert str(layers[0]) in result.stderr


def test_of_an_unfinished_log_what_is_there_is_compared(recorded, hearthlog, tmp_path):
    path = tmp_path / "unfinished.mcap.active"
    shutil.copy(recorded.parent / "unfinished.mcap.active", path)
    full = segments(path)
    half = (full[0][0] + full[-1][1]) // 2
    write_marks(path, [Mark("mic", full[0][0], half, "speech")])
    result = hearthlog("diff", path, "live", "review")
    assert result.returncode == 3
    assert result.stderr == (f"hearthlog: unfinished, read up to the last whole chunk: {path}\n")
    assert "b: review" in result.stdout


def test_logs_of_two_homes_are_refused(logs, hearthlog):
    shutil.copytree(logs, logs / "other")
    result = hearthlog("diff", logs, "live", "two")
    assert result.returncode == 1
    assert "segments overlap; is a log there twice, or those of two homes?" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_labellings_of_different_times_are_refused(logs, hearthlog):
    recorders = [log for log in find_logs(logs) if "relabel" not in log.name]
    for log in find_logs(logs):
        first = log.name.startswith(recorders[0].name.removesuffix(".mcap"))
        if ("relabel" in log.name) == first:
            log.unlink()
    first, *_ = segments(logs)
    end = time_text(segments(logs, "/mic/relabel/two/segment")[0][0])
    result = hearthlog("diff", logs, "live", "two")
    if "no time in common" not in result.stderr:  # a segment may cross from one log to the next
        result = hearthlog("diff", logs, "live", "two", "--end", end)
    assert result.returncode == 1


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (lambda n: {"label": ["Speech!"] * n}, "'Speech!' cannot be the name of a class"),
        (lambda n: {"header.stamp": np.arange(-n, 0) * 10**12}, "has a segment before 1970"),
        (lambda n: {"duration": np.zeros(n, np.int64)}, "there is no segment"),
    ],
)
def test_segments_that_cannot_be_are_refused(logs, hearthlog, change, output):
    log = find_logs(logs)[0]
    write_layer(log, log, "odd", kinds=("segment",), change=lambda own: change(len(own)))
    result = hearthlog("diff", logs, "live", "odd")
    assert (result.returncode, result.stdout) == (1, "")
    assert output in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_logs_in_a_store_are_compared(logs, hearthlog, in_memory):
    put(logs, in_memory)
    expected = hearthlog("diff", logs, "live", "two", "--queue")
    assert hearthlog("diff", in_memory, "live", "two", "--queue") == expected
    assert expected.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["live"], "name a second labelling, or use --queue"),
        (["live", "live"], "live and live are the same"),
        (["live", "two", "--list", "list.txt"], "a list of spans is named *.csv"),
    ],
)
def test_wrong_use_is_one_line(logs, hearthlog, arguments, output):
    result = hearthlog("diff", logs, *arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert output in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_list_is_never_written_over_a_file(logs, hearthlog, tmp_path):
    path = tmp_path / "list.csv"
    path.write_text("precious")
    result = hearthlog("diff", logs, "live", "two", "--list", path)
    assert (result.returncode, result.stdout) == (1, "")
    with pytest.raises(LogError, match="exists already"):
        write_spans(path, [])
    assert "exists already" in result.stderr
    assert path.read_text() == "precious"
