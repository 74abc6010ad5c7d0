"""A model is judged in the home before it labels there: damage is refused, and it is said why."""

import json
import os
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import Event as Flag

import numpy as np
import pytest
from log_fixtures import run

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.evaluation import compare_labellings
from hearthlog.analyzer.logs.labelling import Labelling, NamedLabelling, find_labellings
from hearthlog.analyzer.logs.spans import Spans, intersection
from hearthlog.analyzer.marks.marks import PERSON, QUEUE, RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.promotion import (
    Verdict,
    clearly_better,
    find_champion,
    regressions,
)
from hearthlog.analyzer.promotion.comparison import (
    HomeComparison,
    NamedSounds,
    PairedAccuracy,
    _named,
    _Outcome,
    _outcomes,
    _right,
    _taught,
    gather_evidence,
)
from hearthlog.analyzer.promotion.paired_labels import (
    LabelChanges,
    PairedFrames,
    TwoModels,
    changes_of_frames,
    changes_of_labellings,
)
from hearthlog.analyzer.promotion.recent_time import (
    LogSpan,
    RecentLog,
    ReferenceSound,
    choose,
    minutes_a_day,
    recent_logs,
    sample,
)
from hearthlog.analyzer.review.review_list import ReviewSpan, read_spans
from hearthlog.analyzer.review.review_queue import queue_spans, review_items
from hearthlog.models.classifiers.model import Amount, Description
from hearthlog.models.modelfile import load_model, save_model
from hearthlog.models.registry import (
    Judgement,
    judgement_path,
    override_judgement,
    promote,
    read_judgement,
    rollback,
    target,
    write_judgement,
)
from hearthlog.recorder.config import Settings
from hearthlog.recorder.labelling.model_watch import ModelWatch
from hearthlog.recorder.recording import record
from hearthlog.recorder.sources.audio_files import FileSource
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.promotion import print_verdict
from hearthlog.tools.home.simulate import write_day

OLD_MODEL = Path(__file__).parent / "golden/0.1.0/models/merged.safetensors"
SECOND = 1_000_000_000
MINUTE = 60 * SECOND
START = 1_772_348_400 * SECOND
MINUTES = 12


@pytest.fixture(scope="session")
def lived(tmp_path_factory, model_file):
    """A folder with `logs` by the champion of `models`; what is true of them beside it."""
    folder = tmp_path_factory.mktemp("lived")
    (folder / "models").mkdir()
    shutil.copy(model_file, folder / "models" / "one.safetensors")
    (folder / "models" / "champion.safetensors").symlink_to("one.safetensors")
    sound = folder / "day.flac"
    write_day(sound, MINUTES, seed=33, manifest=None)
    settings = Settings(output=folder / "logs", model=folder / "models" / "one.safetensors")
    record(settings, FileSource([sound], START), Flag())
    return folder


@pytest.fixture
def place(lived, tmp_path, monkeypatch):
    """The current folder, which has a copy of them."""
    for name in ("logs", "models"):
        shutil.copytree(lived / name, tmp_path / name, symlinks=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    return tmp_path


def truth(lived):
    rows = (line.split("\t") for line in (lived / "day.txt").read_text().splitlines())
    return [(START + round(float(a) * SECOND), START + round(float(b) * SECOND), c)
            for a, b, c in rows]  # fmt: skip


def keep(name, **changes):
    """Put a model into the folder that is the champion but for some of its description."""
    one = load_model(Path("models/one.safetensors"))
    about = one.description.model_copy(update=changes)
    save_model(replace(one, description=about), Path(f"models/{name}.safetensors"))
    return load_model(Path(f"models/{name}.safetensors"))


def keep_deaf(name="deaf"):
    return keep(name, gate=0.0, decision_bias={"silence": -30.0})


def keep_swapped(first="speech", second="silence", name="swapped", **changes):
    classes = list(load_model(Path("models/one.safetensors")).classes)
    i, j = classes.index(first), classes.index(second)
    classes[i], classes[j] = second, first
    return keep(name, classes=classes, **changes)


def keep_alike():
    """Put a model into the folder that says what the champion says, and is another file."""
    return keep("alike", scenario_name="general of the home")


def champion():
    return target(Path("models"), "champion")


@pytest.mark.usefixtures("place")
def test_a_model_that_is_deaf_to_silence_is_refused_and_it_is_said_what_would_change(capfd):
    model = keep_deaf()
    done = run(capfd, "models", "promote", "deaf")
    assert done.returncode == 1
    assert " min from silence to " in done.stdout
    assert "deaf in place of one would change of the 12 min recorded, judged by " in done.stdout
    refused = done.stderr.splitlines()[-1]
    assert refused.startswith("hearthlog: deaf refused: silence falls from ")
    assert "`hearthlog models promote deaf --anyway`" in refused
    assert champion() == "one"
    judgement = read_judgement(Path("models"), model.sha256)
    assert judgement.champion == load_model(Path("models/one.safetensors")).sha256
    assert not judgement.may_label


@pytest.mark.usefixtures("place")
def test_who_insists_gets_the_model_and_it_stays_refused_for_the_next(capfd):
    model = keep_deaf()
    assert run(capfd, "models", "promote", "deaf").returncode == 1
    assert run(capfd, "models", "promote", "deaf", "--anyway").returncode == 0
    assert champion() == "deaf"
    judgement = read_judgement(Path("models"), model.sha256)
    assert judgement.insisted
    assert judgement.reasons[0].startswith("silence falls from ")


@pytest.mark.usefixtures("place")
def test_models_that_each_lose_a_little_may_not_lose_what_the_first_one_had(lived, capfd):
    """The champion is as bad as what would replace it; the home began with a better one."""
    review(lived, RANDOM, marked=False)
    keep_swapped("coughing", "laughing")
    keep_swapped("coughing", "laughing", name="worse", scenario_name="general of the home")
    link = Path("models/champion.safetensors")
    link.unlink()
    link.symlink_to("swapped.safetensors")
    done = run(capfd, "models", "promote", "worse")
    assert "would change less than half a minute" in done.stdout
    assert done.returncode == 1
    assert re.search("it is right about [0-9]+, one about [0-9]+;", done.stderr)
    Path("models/one.safetensors").unlink()
    assert run(capfd, "models", "promote", "worse").returncode == 0


@pytest.mark.usefixtures("place")
def test_a_model_that_does_no_harm_is_promoted_and_judged_once(capfd):
    keep_alike()
    done = run(capfd, "models", "promote", "alike")
    assert done.returncode == 0, done.stderr
    assert "alike in place of one would change less than half a minute of the 12" in done.stdout
    assert champion() == "alike"
    assert run(capfd, "models", "promote", "alike").stdout == "alike is the champion already\n"


@pytest.mark.usefixtures("place")
def test_classes_that_change_places_are_refused(capfd):
    keep_swapped()
    done = run(capfd, "models", "promote", "swapped")
    assert done.returncode == 1
    assert "of silence of which one is sure" in done.stderr


def review(lived, chosen, *, marked=True, first=0, count=8):
    """Look at some minutes, and mark in them what is true."""
    (log,) = find_logs(Path("logs"))
    reviewed = [
        ReviewedSpan("mic", START + i * MINUTE, START + (i + 1) * MINUTE, chosen=chosen)
        for i in range(first, first + count)
    ]
    end = START + (first + count) * MINUTE
    marks = [
        Mark("mic", a, min(b, end), "unknown" if c == "other_negative" else c)
        for a, b, c in truth(lived)
        if START + first * MINUTE <= a < end
    ]
    write_marks(log, marks if marked else [], reviewed=reviewed)


@pytest.mark.usefixtures("place")
def test_what_is_right_in_fewer_sounds_that_were_drawn_at_random_is_refused(lived, capfd):
    """Nothing is marked, so the champion is right throughout."""
    review(lived, RANDOM, marked=False)
    keep_swapped("coughing", "laughing")
    done = run(capfd, "models", "promote", "swapped")
    assert done.returncode == 1
    assert "sounds of the minutes that were drawn at random it is right about" in done.stderr


@pytest.mark.usefixtures("place")
def test_who_repairs_what_the_champion_was_sure_of_is_let_if_random_minutes_say_so(lived, capfd):
    keep_swapped()
    folder, link = Path("models"), Path("models/champion.safetensors")
    (folder / "one.safetensors").rename(folder / "good.safetensors")
    link.unlink()
    link.symlink_to("swapped.safetensors")
    refused = run(capfd, "models", "promote", "good")
    assert "of which swapped is sure" in refused.stderr
    assert "wrong marks go unnoticed" in refused.stdout
    review(lived, RANDOM)
    let = run(capfd, "models", "promote", "good")
    assert let.returncode == 0, let.stderr
    assert "other marked sounds" not in let.stdout  # none outside of these minutes
    assert champion() == "good"


@pytest.mark.usefixtures("place")
def test_time_that_a_model_has_learned_from_does_not_speak_for_it(capfd):
    one = load_model(Path("models/one.safetensors"))
    end = START + (MINUTES - 4) * MINUTE
    training = one.description.training_data.model_copy(update={"home_spans": [[START, end]]})
    keep("learned", training_data=training)
    done = run(capfd, "models", "promote", "learned")
    assert done.returncode == 1
    assert done.stdout.splitlines()[-1:] != ["learned is the champion"]
    assert "only 4.0 min are recorded and not learned from, and it takes 10 min" in done.stderr
    assert "record 7 more minutes, then promote it" in done.stderr


@pytest.mark.usefixtures("place")
def test_a_model_that_does_not_say_what_it_learned_from_has_learned_from_all_marks(lived, capfd):
    review(lived, PERSON, first=0, count=9)
    one = load_model(Path("models/one.safetensors"))
    amount = next(iter(one.description.training_data.classes.values()))
    home = {"speech": amount}
    keep("old", training_data=one.description.training_data.model_copy(update={"home": home}))
    done = run(capfd, "models", "promote", "old")
    assert "are recorded and not learned from" in done.stderr
    assert "other marked sounds" not in done.stdout
    keep_alike()
    assert "other marked sounds" in run(capfd, "models", "promote", "alike").stdout


@pytest.mark.usefixtures("place")
def test_what_cannot_be_judged_is_refused_in_a_line(capfd, tmp_path):
    def refusal(*options):
        done = run(capfd, "models", "promote", "alike", *options)
        assert done.returncode == 1
        return done.stderr.splitlines()[-1]

    keep_alike()
    assert "only 0.0 min are recorded and not learned from" in refusal(
        "--logs", tmp_path / "nowhere"
    )
    Path("models/champion.safetensors").unlink()
    assert "no labels in" in refusal("--logs", tmp_path / "nowhere")
    for path in (Path("models/one.safetensors"),):
        path.rename(tmp_path / "kept")
    assert "one (" in (gone := refusal())
    assert "which labels now, is neither in models nor a starter" in gone


@pytest.mark.usefixtures("place")
def test_the_champion_itself_is_compared_with_what_labelled_the_logs():
    model = keep_alike()
    champion = Path("models/champion.safetensors")
    champion.unlink()
    champion.symlink_to("alike.safetensors")
    other = find_champion(Path("models"), [Path("logs")], model)
    assert other is not None
    assert other.name == "one"


@pytest.mark.usefixtures("place")
def test_a_candidate_is_not_judged(capfd):
    model = keep_deaf()
    assert run(capfd, "models", "promote", "deaf", "--to", "candidate").returncode == 0
    assert read_judgement(Path("models"), model.sha256) is None


@pytest.mark.usefixtures("place")
def test_a_model_for_another_feature_set_is_refused_and_its_set_named(capfd):
    shutil.copy(OLD_MODEL, "models/old.safetensors")
    done = run(capfd, "models", "promote", "old")
    assert done.returncode == 1
    assert "it is for feature set auros21, and one, which labels now, for home33" in done.stderr
    assert champion() == "one"


def judged(folder, model, *, reasons=(), insisted=False):
    write_judgement(
        folder,
        Judgement(model=model.sha256, champion="", judged=1, reasons=reasons, insisted=insisted),
    )


def refusals(watch, count=1):
    found, deadline = [], time.monotonic() + 120
    while len(found) < count:
        assert time.monotonic() < deadline
        found += watch.refusals()
        time.sleep(0.02)
    return found


def test_a_recorder_takes_over_only_what_was_judged(place, monkeypatch, capfd):
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 0.05)
    folder = place / "models"
    model = keep_deaf()
    watch = ModelWatch(folder / "champion.safetensors", SimpleQueue())
    promote(folder, "deaf")
    (line,) = refusals(watch)
    assert line == (
        "model deaf refused: it was not checked in this home; `hearthlog models promote deaf` "
        "checks it; going on with one"
    )
    assert capfd.readouterr().err == f"hearthlog: {line}\n"
    judged(folder, model, reasons=("silence falls from 10 h to 1.0 min a day",))
    (line,) = refusals(watch)
    assert line.startswith("model deaf refused: silence falls from 10 h to 1.0 min a day; ")
    assert "`hearthlog models promote deaf --anyway` overrides this" in line
    time.sleep(0.3)
    assert (list(watch.refusals()), watch.ready) == ([], None)  # said once
    override_judgement(folder, model.sha256)
    deadline = time.monotonic() + 120
    while watch.ready is None:
        assert time.monotonic() < deadline
        assert not list(watch.refusals())
        time.sleep(0.02)
    watch.close()
    assert watch.ready.model.name == "deaf"


def test_a_model_that_is_returned_to_may_label(place):
    folder = place / "models"
    keep_alike()
    promote(folder, "alike")
    model, _ = rollback(folder)
    assert read_judgement(folder, model.sha256).may_label


def hostile(path, kind, good):
    path.unlink()
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a folder":
        path.mkdir()
    else:
        path.write_bytes({
            "no JSON": b"\x00\xff{",
            "of another model": good.replace(b"a" * 64, b"0" * 64),
            "endless": good + b" " * (1 << 17),
            "more than it may say": good.replace(b"}", b', "x": 1}'),
            "no list of reasons": good.replace(b"[]", b'"none"'),
            "a word for yes": good.replace(b"false", b'"yes"'),
            "too many reasons": good.replace(b"[]", json.dumps(["x"] * 40).encode()),
            "a reason of two lines": good.replace(b"[]", b'["a\\nb"]'),
        }[kind])  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [
        "no JSON", "of another model", "endless", "more than it may say", "no list of reasons",
        "a word for yes", "too many reasons", "a reason of two lines", "a pipe", "a folder",
    ],
)  # fmt: skip
def test_a_judgement_that_is_none_lets_no_model_speak(tmp_path, kind):
    sha256 = "a" * 64
    judgement = Judgement(model=sha256, champion="", judged=1)
    write_judgement(tmp_path, judgement)
    assert read_judgement(tmp_path, sha256) == judgement
    hostile(judgement_path(tmp_path, sha256), kind, judgement.model_dump_json().encode())
    assert read_judgement(tmp_path, sha256) is None


def test_a_sample_is_of_all_days_and_all_times_of_day_and_no_more_than_was_asked_for():
    hour = 3600 * SECOND
    parts = [
        LogSpan(Path(f"{i}"), START + i * hour, START + (i + 1) * hour) for i in range(14 * 24)
    ]
    chosen = sample(parts, 36, 300 * SECOND)
    assert {part.end - part.start for part in chosen} == {300 * SECOND}
    begins = np.array([part.start for part in chosen])
    assert len(np.unique((begins - START) // (24 * hour))) == 14
    assert len(np.unique((begins - START) % (24 * hour) // (6 * hour))) == 4
    assert sample(parts, 36, 300 * SECOND) == chosen
    assert sample(parts[:2], 36, 300 * SECOND) == parts[:2]


def test_a_home_that_is_mostly_quiet_is_heard_where_it_is_not():
    hour = 3600 * SECOND
    parts = [
        LogSpan(Path(f"{i}"), START + i * hour, START + (i + 1) * hour) for i in range(14 * 24)
    ]
    starts = START + np.arange(14 * 24) * hour + 600 * SECOND
    sounding = Spans(starts, starts + 60 * SECOND)
    chosen = choose(parts, sounding)
    lengths = np.array([part.end - part.start for part in chosen])
    weights = np.array([part.weight for part in chosen])
    recorded = [intersection(Spans(np.array([part.start]), np.array([part.end])), sounding).length
             for part in chosen]  # fmt: skip
    assert lengths.sum() < 1.4 * hour
    assert sum(recorded) > 1500 * SECOND
    assert (lengths * weights).sum() == pytest.approx(14 * 24 * hour)
    assert np.array(recorded) @ weights == pytest.approx(sounding.length, rel=0.1)


def test_what_is_told_is_of_a_mean_day_if_a_day_is_recorded_and_else_of_all():
    hour = 3600 * SECOND
    hours = [RecentLog(Path(f"{i}"), START + i * hour, START + (i + 1) * hour) for i in range(48)]
    assert minutes_a_day(hours[:2]) is None
    assert minutes_a_day(hours) == pytest.approx(48 * 60 / 3)  # from one morning to another


def test_changes_are_the_minutes_of_a_day_for_each_pair():
    before = np.array([0, 0, 0, 1], np.intp)
    after = np.array([0, 1, 1, 1], np.intp)
    found = changes_of_frames(["silence", "speech"], before, after, np.full(4, 360.0))
    assert found.minutes.tolist() == [[360, 720], [0, 360]]
    assert list(map(str, found.pairs())) == ["12 h 00 min a day from silence to talking"]


def test_two_labellings_in_logs_are_compared_in_minutes_a_day():
    def labelling(name, *labels):
        day, minute = np.divmod(np.arange(len(labels)), 2)
        starts = START + day * 24 * 60 * MINUTE + minute * MINUTE
        own = Labelling(starts, starts + MINUTE, np.array(labels, object))
        return NamedLabelling(name, tuple(dict.fromkeys(labels)), own)

    a = labelling("live", "silence", "silence", "silence", "speech")
    b = labelling("candidate", "silence", "speech", "speech", "speech")
    found = changes_of_labellings(compare_labellings(a, b))
    assert [str(change) for change in found.pairs()] == ["1.0 min a day from silence to talking"]


def test_logs_that_cannot_be_read_or_are_weeks_old_are_passed_over(place):
    (log,) = recent_logs([place / "logs"])
    broken = log.path.with_name("home_20260301T090000Z.mcap")
    broken.write_bytes(b"garbage")
    shutil.copy(log.path, log.path.with_name("home_20260201T090000Z.mcap"))
    assert recent_logs([place / "logs"]) == [log]
    assert recent_logs([place / "nowhere"]) == []


def test_right_is_better_only_beyond_chance():
    assert clearly_better(PairedAccuracy(30, 10, 20, 12, 2))
    assert not clearly_better(PairedAccuracy(30, 10, 12, 6, 4))
    assert not clearly_better(PairedAccuracy())


NO_PAIRS = PairedAccuracy()


def evidence(minutes, right=NO_PAIRS, sure=None):
    """Make evidence of a home with silence, speech and music, in minutes of a day."""
    table = np.array(minutes, float)
    certain = np.zeros_like(table) if sure is None else np.array(sure, float)
    changes = LabelChanges(["silence", "speech", "music"], table)
    return HomeComparison(60.0, 14 * 1440.0, changes, certain, right, PairedAccuracy(), [])


@pytest.mark.parametrize(("minutes", "more"), [(9.6, "1 more minute,"), (8.2, "2 more minutes,")])
def test_how_much_more_has_to_be_recorded_is_said(minutes, more):
    short = replace(evidence([[1, 0], [0, 1]]), minutes=minutes)
    (line,) = regressions(short, "one")
    assert f" judge it: record {more} then promote it" in line


def test_a_model_that_changes_much_has_to_be_right_about_more():
    much = [[1300, 0, 0], [0, 70, 30], [0, 0, 40]]
    (output,) = regressions(evidence(much, PairedAccuracy(40, 30, 30, 3, 3)), "one")
    assert "it is right about 30, one about 30, and 30 min a day would change: " in output
    assert regressions(evidence(much, PairedAccuracy(40, 30, 33, 6, 3)), "one") == []
    assert regressions(evidence(much), "one") == []  # nothing was drawn at random
    little = [[1300, 0, 0], [0, 80, 20], [0, 0, 40]]
    assert regressions(evidence(little, PairedAccuracy(40, 30, 30, 3, 3)), "one") == []


def test_marks_that_agree_with_the_champion_less_than_by_chance_are_said_to_be_wrong():
    better = evidence([[1300, 0, 0], [0, 20, 80], [0, 0, 40]], PairedAccuracy(55, 3, 50, 48, 1))
    (output,) = regressions(replace(better, named=NamedSounds(55, 3, 5)), "one")
    assert output.startswith(
        "of 55 sounds of the minutes that were drawn at random, one gives 3 the"
    )
    assert "the marks are wrong" in output
    for few in (NamedSounds(19, 0, 5), NamedSounds(55, 3, 2), NamedSounds(55, 6, 5), NamedSounds()):
        assert regressions(replace(better, named=few), "one") == []


def test_a_sound_is_named_if_a_person_and_the_champion_give_it_classes_that_the_champion_has():
    classes = ["silence", "speech", "music", "unknown"]
    pairs = [("speech", "speech"), ("speech", "music"), ("music", "unknown"), ("dog", "speech")]
    pairs += [("silence", "speech"), ("music", "silence"), ("music", ""), ("unknown", "music")]
    found = _named((_Outcome(True, label, before, "music") for label, before in pairs), classes)
    assert found == NamedSounds(sounds=2, right=1, classes=1)


def test_a_day_of_which_hours_were_recorded_is_said_to_be_one(capsys):
    for hours, words in (
        (13, " (a day: the 13 h 00 min that a mean day with logs has):"),
        (24, ":"),
    ):
        table = [[hours * 60.0 - 40, 0, 0], [0, 10, 30], [0, 0, 0]]
        print_verdict(Verdict(None, "new", "one", evidence(table)), [], "new")
        first = capsys.readouterr().out.splitlines()[1]
        assert first.endswith(f"that it was not trained on{words}")


COUGHING_BECOMES_NEW = [[1300, 0, 0, 0], [0, 10, 0, 50], [0, 0, 40, 0], [0, 0, 0, 0]]


def with_new_class(known):
    """Make evidence of a home whose marks teach laughing, which takes most of the coughing."""
    table = np.array(COUGHING_BECOMES_NEW, float)
    changes = LabelChanges(["silence", "coughing", "music", "laughing"], table)
    nothing = PairedAccuracy()
    return HomeComparison(
        60.0, 14 * 1440.0, changes, table, nothing, nothing, [], nothing, {"laughing"}, known
    )


@pytest.mark.parametrize(
    ("known", "harmless"),
    [
        ({("laughing", "coughing", "laughing"): 4}, True),
        (
            {
                ("laughing", "coughing", "laughing"): 4,
                ("coughing", "coughing", "coughing"): 9,
                ("coughing", "coughing", "laughing"): 1,
            },
            True,
        ),
        ({}, False),  # no mark says that coughing was wrong
        ({("laughing", "coughing", "laughing"): 2}, False),  # and nothing is known of coughing
        ({("laughing", "music", "laughing"): 4}, False),
        (
            {
                ("laughing", "coughing", "laughing"): 4,
                ("coughing", "coughing", "coughing"): 1,
                ("coughing", "coughing", "laughing"): 1,
            },
            False,
        ),
    ],
)
def test_a_new_class_may_take_what_marks_say_was_wrong_and_not_what_a_person_left(known, harmless):
    reasons = regressions(with_new_class(known), "one")
    assert harmless or "most becomes laughing" in reasons[0]
    assert len(reasons) == (not harmless)


def test_an_old_class_may_take_what_marks_say_was_wrong_where_what_was_right_is_known_and_stays():
    def reasons(known):
        table = [[1300, 0, 0], [0, 40, 40], [0, 0, 60]]
        return regressions(replace(evidence(table, sure=table), known=known), "one")

    wrong = {("music", "speech", "music"): 3}
    right = {("speech", "speech", "speech"): 3}
    assert reasons(wrong | right) == [], "talking was a telephone, say, and talk stays talk"
    assert reasons(wrong | right | {("speech", "speech", "music"): 1}) == []
    assert reasons(wrong | right | {("speech", "speech", "music"): 2}) != []
    assert reasons(wrong) != [], "all of it may be wrong marks: nothing is known to be talking"
    assert reasons(wrong | {("speech", "music", "speech"): 9}) != [], "nor was that called so"
    assert reasons(right | {("music", "speech", "music"): 2}) != [], "a slip, or two"
    assert reasons(right | {("music", "music", "music"): 9}) != []


def test_a_new_class_that_swallows_what_was_right_or_silence_or_the_day_is_refused():
    def reasons(known, column=(0, 0, 0, 20), each=" a day"):
        table = np.diag([1200.0, 100.0, 100.0, 0.0])
        table[:, 3] = column
        changes = LabelChanges(["silence", "speech", "music", "hum"], table, each)
        nothing = PairedAccuracy()
        home = 60.0, 1440.0, changes, np.zeros((4, 4)), nothing, nothing, [], nothing
        return regressions(HomeComparison(*home, {"hum"}, known), "one")

    marks = {("hum", "silence", "hum"): 9, ("hum", "speech", "hum"): 9}
    assert reasons(marks | {("music", "music", "music"): 12, ("music", "music", "hum"): 4}) == []
    (output,) = reasons(marks | {("music", "music", "music"): 8, ("music", "music", "hum"): 4})
    assert output.startswith(
        "hum takes 4 of 12 sounds of other classes that one had right: hear its"
    )
    assert reasons(marks | {("music", "speech", "hum"): 40}) == [], "which were wrong before, too"
    many = {("music", "music", "music"): 40, ("speech", "speech", "hum"): 3}
    (output,) = reasons(marks | many)
    assert output.startswith("hum takes 3 of 3 sounds of talking that one had right")
    unsure = {("unknown", "unknown", "unknown"): 6, ("unknown", "unknown", "hum"): 4}
    assert reasons(marks | unsure) == [], "what nobody was sure of was not right"
    (output,) = reasons(marks | {("silence", "silence", "hum"): 3})
    assert output.startswith("hum takes 3 of 3 silences that one had right")

    (output,) = reasons(marks, (30, 0, 9, 0))
    assert output.startswith("30 min a day of hum is silence for one: if that is the sound of the")
    stays = {("silence", "silence", "silence"): 9}
    assert reasons(marks | stays, (30, 0, 9, 0)) == [], "a faint sound that a person marked"
    assert reasons(stays, (30, 0, 9, 0)) != [], "no mark says that silence was wrong"
    assert reasons({}, (9, 0, 1, 0)) == [], "hardly anything"
    assert reasons(marks, (100, 500, 100, 0)) == [], "a television for hours"
    (output,) = reasons(marks, (100, 900, 600, 0))
    assert output.startswith("hum is 26 h 40 min a day, more than half of the time")
    assert reasons(marks, (100, 900, 600, 0), each="") == [], "half an hour is no day"


@pytest.mark.usefixtures("place")
def test_what_a_new_class_takes_over_is_judged_by_marks_that_were_learned_from(lived):
    """Another name for talking: right where marks say so, wrong where they say talking."""
    (log,) = find_logs(Path("logs"))
    one = load_model(Path("models/one.safetensors"))
    classes = ["giggle" if name == "speech" else name for name in one.classes]
    text = one.description.model_dump_json().replace('"speech"', '"giggle"')
    training = Description.model_validate_json(text).training_data
    amounts = {**training.classes, "giggle": Amount(sources=0, segments=0, seconds=0.0)}
    home = {"giggle": Amount(sources=2, segments=20, seconds=20.0)}
    update = {"classes": amounts, "home": home, "home_spans": [[START, START + MINUTE]]}
    about = Description.model_validate_json(text).model_copy(
        update={"classes": classes, "training_data": training.model_copy(update=update)}
    )
    after = replace(one, description=about)
    talking = [(a, b) for a, b, name in truth(lived) if name == "speech" and b - a > SECOND]
    write_marks(log, [Mark("mic", *span, "giggle") for span in talking[:2]])
    amount = Amount(sources=1, segments=1, seconds=1.0)
    unnamed = training.model_copy(update={**update, "home": {**home, "no_class": amount}})
    hostile = replace(after, description=about.model_copy(update={"training_data": unnamed}))
    assert _taught(TwoModels(one, hostile), hostile) == {"giggle"}
    found = gather_evidence(one, after, recent_logs([Path("logs")]))
    assert found.taught == {"giggle"}
    right = sum(n for (true, _, new), n in found.known.items() if true == new == "giggle")
    assert 0 < right <= 2
    looked_at = ReviewedSpan("mic", START, START + MINUTES * MINUTE, chosen=QUEUE)
    write_marks(log, [Mark("mic", *span, "speech") for span in talking[2:]], reviewed=[looked_at])
    found = gather_evidence(one, after, recent_logs([Path("logs")]))
    assert sum(n for (true, _, new), n in found.known.items()
               if (true, new) == ("speech", "giggle")) > 0  # fmt: skip


def test_right_is_said_of_sounds_and_a_model_is_wrong_about_a_class_that_it_lacks():
    frames = PairedFrames(
        np.arange(40) * 50_000_000, np.repeat([0, 1, 1, 1], 10), np.repeat([0, 1, 1, 2], 10),
        np.ones(40, np.float32), np.ones(40),
    )  # fmt: skip
    names = ["silence", "speech", "dog"]
    known = [("silence", 0), ("speech", 10), ("cat", 20), ("dog", 30)]
    sounds = [
        ReferenceSound(i * 50_000_000, (i + 10) * 50_000_000, name, True, "mic")
        for name, i in known
    ]
    outcomes = list(_outcomes(sounds, frames, names))
    assert _right(one for one in outcomes if one.label != "silence") == (3, 1, 2, 1, 0)


def test_fewer_right_by_chance_is_no_damage():
    same = [[1300, 0, 0], [0, 100, 0], [0, 0, 40]]
    assert regressions(evidence(same, PairedAccuracy(40, 30, 29, 4, 5)), "one") == []
    assert regressions(evidence(same, PairedAccuracy(40, 30, 25, 2, 7)), "one") != []
    recorded = replace(evidence(same), quiet=PairedAccuracy(9, 9, 3, 0, 6))
    assert regressions(recorded, "one") == [
        "of 9 silences of the minutes that were drawn at random it leaves 3 silent, one 9"
    ]


def test_sound_that_vanishes_and_a_class_that_multiplies_are_damage_unless_random_minutes_say_not():
    deaf = [[1300, 0, 0], [60, 40, 0], [20, 0, 20]]
    assert regressions(evidence(deaf), "one") == [
        "what is not silence falls from 2 h 20 min a day to 1 h 00 min"
    ]
    music = [[1290, 0, 10], [0, 30, 70], [0, 0, 15]]
    assert regressions(evidence(music), "one") == ["music rises from 15 min a day to 1 h 35 min"]
    assert regressions(evidence(music, PairedAccuracy(60, 20, 50, 32, 2)), "one") == []
    quiet = replace(evidence(music), quiet=PairedAccuracy(40, 0, 40, 40, 0))
    assert regressions(quiet, "one") == ["music rises from 15 min a day to 1 h 35 min"]


def test_what_the_champion_is_sure_of_stays():
    table = [[1300, 0, 0], [0, 85, 15], [0, 0, 40]]
    (output,) = regressions(evidence(table, sure=[[900, 0, 0], [0, 5, 10], [0, 0, 0]]), "one")
    assert output == (
        "of 15 min a day of talking of which one is sure 5.0 min are left, most becomes music"
    )
    assert regressions(evidence(table, sure=[[900, 0, 0], [0, 9, 3], [0, 0, 0]]), "one") == []
    assert regressions(evidence(table, sure=[[900, 0, 0], [0, 1, 4], [0, 0, 0]]), "one") == []


# What would change, as spans to look at


def requested_of(model, count=10, limits=(None, None)):
    """Return the spans that are asked of what a model would change."""
    return queue_spans(model, find_labellings(Path("logs")), ("mic", "live"), limits, count)


def most_of(labelling, span):
    """Return the label of most of a span."""
    named = find_labellings(Path("logs")).read("mic", labelling, span.start, span.end).labelling
    seconds = {}
    for start, end, label in zip(named.starts, named.ends, named.labels, strict=True):
        seconds[label] = seconds.get(label, 0) + end - start
    return max(seconds, key=seconds.get)


@pytest.mark.usefixtures("place")
def test_what_a_model_would_change_is_asked_where_it_says_something_else_than_the_recorder(capfd):
    keep_swapped("speech", "music")
    requested = requested_of("swapped")
    assert len(requested) == 10
    assert run(capfd, "relabel", "logs", "--model", "models/swapped.safetensors").returncode == 0
    for span in requested:
        assert SECOND // 2 <= span.end - span.start <= 10 * SECOND
        assert most_of("live", span) == span.label_a
        assert most_of("relabel/swapped", span) == span.label_b != span.label_a
    assert sorted(requested_of("models/swapped")) == sorted(requested)


@pytest.mark.usefixtures("place")
def test_the_largest_changes_are_asked_first_and_others_too():
    one = load_model(Path("models/one.safetensors"))
    sounds = [name for name in one.classes if name != "silence"]
    after = dict(zip(sounds, [*sounds[1:], sounds[0]], strict=True)) | {"silence": "silence"}
    new = keep("turned", classes=[after[name] for name in one.classes])
    changes = gather_evidence(one, new, recent_logs([Path("logs")])).changes.pairs()
    spans = requested_of("turned")
    requested = [(span.label_a, span.label_b) for span in spans]
    for each in set(requested):
        same = [b.end - b.start for b, pair in zip(spans, requested, strict=True) if pair == each]
        assert same == sorted(same, reverse=True)
    assert requested[0] == changes[0][:2]
    assert set(requested) >= {change[:2] for change in changes[:3]}
    assert all(after[before] == other for before, other in requested)


@pytest.mark.usefixtures("place")
def test_what_was_looked_at_or_lies_elsewhere_is_not_asked_though_a_model_would_change_it(lived):
    keep_swapped("speech", "music")
    review(lived, RANDOM, count=6)
    requested = requested_of("swapped", count=100)
    assert requested
    assert all(span.start >= START + 6 * MINUTE for span in requested)
    later = START + 9 * MINUTE
    assert all(span.start >= later for span in requested_of("swapped", limits=(later, None)))


@pytest.mark.usefixtures("place")
def test_when_all_that_a_model_would_change_was_looked_at_that_is_said(lived):
    keep_swapped("speech", "music")
    review(lived, RANDOM, count=MINUTES)
    with pytest.raises(DataError, match="swapped: no span is left in which it differs from"):
        requested_of("swapped")


@pytest.mark.usefixtures("place")
def test_where_the_recorder_says_something_else_than_the_champion_by_now_nothing_is_asked():
    keep_swapped("speech", "music")
    Path("models/champion.safetensors").unlink()
    Path("models/champion.safetensors").symlink_to("swapped.safetensors")
    with pytest.raises(DataError, match="one: no span is left in which it differs from"):
        requested_of("one")


@pytest.mark.usefixtures("place")
def test_who_reads_what_would_change_is_told_how_to_hear_it(capfd, tmp_path):
    keep_swapped("speech", "music")
    lines = run(capfd, "models", "promote", "swapped", "--logs", "logs").stdout.splitlines()
    assert "listen to the changes: `hearthlog review logs --queue swapped`" in lines
    saved = run(capfd, "review", "logs", "--queue", "swapped", "--save", tmp_path / "ten.csv")
    assert saved.returncode == 0, saved.stderr
    listed = read_spans(tmp_path / "ten.queue.csv")
    assert sorted(listed) == sorted(requested_of("swapped"))
    (again,) = review_items(listed[:1])
    assert re.fullmatch("swapped says (talking|music), the recorder (talking|music)", again.text)
    keep_alike()
    assert "listen to the changes" not in run(capfd, "models", "promote", "alike").stdout


def test_a_change_is_said_in_words_and_in_minutes_of_a_day():
    span = ReviewSpan("mic", START, START + SECOND, "live", "music", "relabel/new", "speech", 41.2,
                      "change")  # fmt: skip
    (item,) = review_items([span])
    assert item.text == "new says talking, the recorder music: 41 min a day"
    assert item.label == "music"


@pytest.mark.usefixtures("place")
def test_a_model_whose_changes_cannot_be_told_is_said_in_a_line():
    with pytest.raises(
        DataError, match=r"or a model \(models/none.safetensors: no such model file"
    ):
        requested_of("none")
    with pytest.raises(DataError, match="one labels here already"):
        requested_of("champion")
    shutil.copy(OLD_MODEL, "models/old.safetensors")
    with pytest.raises(DataError, match="old: it is for feature set auros21, and one"):
        requested_of("old")
