"""A home that begins to use a network of sounds, changes it, or loses it: nothing is mixed."""

import shutil
from functools import partial

import pytest

pytest.importorskip("hearthlog.tools.lab.bench", reason="the wheel leaves the benchmarks out")

import log_fixtures
import numpy as np
from recurring import record_recurring

from hearthlog.analyzer.discover import NO_CLUSTER
from hearthlog.analyzer.discover.groups import load_groups, save_groups
from hearthlog.analyzer.discover.sounds import (
    discover,
    groups_of,
    read_log_sounds,
    read_sounds,
    unembedded_note,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import find_home_logs
from hearthlog.analyzer.logs.labelling import find_labellings
from hearthlog.analyzer.marks.marks import Mark, write_marks
from hearthlog.analyzer.review.spans import JudgeableSpans, span_sounds
from hearthlog.analyzer.training.home_recordings import read_reviewed_sound, training_recordings
from hearthlog.analyzer.training.home_training_set import read_home_training_set
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.models.starter import GENERAL, starter_file
from hearthlog.recorder import recording
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.topics import EmbeddingSource, EmbeddingSpace

START = 1_772_352_000 * NANOSECONDS
DAY = 86_400 * NANOSECONDS
WIDTH = 12


class Ear:
    """A small network: the levels of bands of a second, mixed at random, in integers."""

    def __init__(self, name, seed, projection="a"):
        names = (*(f"component_{n}" for n in range(1, WIDTH + 1)), "loud")
        steps = (0.05,) * len(names)
        self.source = EmbeddingSource(name, "c" * 64, projection * 64, names, steps)
        self._mix = np.random.default_rng(seed).normal(0, 0.5, (16, WIDTH + 1))

    def __call__(self, window):
        power = np.abs(np.fft.rfft(window.ravel()))[1:8001].reshape(16, 500)
        level = np.log(power.mean(axis=1) + 1e-3)
        values = 20 * (level - level.mean()) @ self._mix
        return np.clip(np.rint(values), -127, 127).astype(np.int8)


ONE, OTHER, PROJECTED = Ear("one", 1), Ear("other", 2), Ear("one", 3, "b")
EARS = (None, ONE, OTHER, PROJECTED, ONE)  # of the days of a home


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """Logs of minutes on five days, on each by another ear."""
    folder = tmp_path_factory.mktemp("ears") / "logs"
    with pytest.MonkeyPatch.context() as patch:
        for day, ear in enumerate(EARS):
            opened = partial(lambda ear, *_: (ear, ""), ear)
            patch.setattr(recording, "open_embedder", opened)
            record_recurring(folder, START + day * DAY, seed=day, seconds=240)
    return folder


@pytest.fixture
def home(days, tmp_path):
    """A copy of the logs."""
    return shutil.copytree(days, tmp_path / "logs")


@pytest.fixture
def hearthlog(capfd):
    """Run the command in this process and return what came of it."""
    return partial(log_fixtures.run, capfd)


def day_of(sounds):
    return (sounds.starts - START) // DAY


def test_sounds_are_described_by_the_embeddings_of_one_network_and_projection(days):
    with read_sounds(find_home_logs([days]), "all") as sounds:
        recorded = np.isfinite(sounds.embeddings).all(axis=1)
        assert sounds.embedding == ONE.source.space
        assert sounds.embeddings.shape[1] == WIDTH
        assert set(day_of(sounds)[recorded].tolist()) == {1, 4}
        assert len(sounds.unfit) == 3
        assert set(sounds.unfit) == {None, OTHER.source.space, PROJECTED.source.space}
        note = unembedded_note(sounds, discover(sounds, None)[0])
    assert note == (
        "3 of 5 logs are without embeddings of one as the groups are by (but of one, other, or of "
        "another projection): their sounds are known by their features alone"
    )


def test_groups_with_embeddings_know_their_sounds_on_days_without(days, tmp_path):
    home = find_home_logs([days])
    with read_sounds(home, "all", START + 4 * DAY) as last:
        groups, _, _ = discover(last, None)
    assert groups.embedding == ONE.source.space
    save_groups(groups, tmp_path / "groups")
    groups = load_groups(tmp_path / "groups")
    with read_sounds(home, "all", groups=groups) as sounds:
        again, of, _ = discover(sounds, groups)
        known = (of != NO_CLUSTER) & (of < len(groups.numbers))
        for day in range(len(EARS)):
            assert known[day_of(sounds) == day].mean() > 0.2
    assert again.numbers[: len(groups.numbers)].tolist() == groups.numbers.tolist()


def test_names_find_the_sounds_that_grouping_finds(days):
    home = find_home_logs([days])
    with read_sounds(home, "all") as sounds:
        groups, _, _ = discover(sounds, None)
        _, of, _ = discover(sounds, groups)
        expected = dict(zip(sounds.starts.tolist(), of.tolist(), strict=True))
    for log in find_logs(days):
        for one in read_log_sounds(log, "all"):
            found = groups_of(one, groups)
            assert found.tolist() == [expected[start] for start in one.spans.starts.tolist()]


def test_groups_of_a_time_without_a_network_go_on_by_features(days, hearthlog, tmp_path):
    file = tmp_path / "groups"
    for options in (["--end", "2026-03-02"], []):
        done = hearthlog("discover", days, "--groups", file, *options)
        assert done.returncode == 0, done.stderr
    assert load_groups(file).embedding is None
    assert (
        "these groups are by features alone, and logs have embeddings of one, other: another file "
        "with --groups groups by both"
    ) in done.stderr


def test_a_file_of_groups_whose_embeddings_do_not_fit_is_refused(days, tmp_path):
    with read_sounds(find_home_logs([days]), "all") as sounds:
        groups, _, _ = discover(sounds, None)
    groups.embedded.examples[0] = np.nan
    save_groups(groups, tmp_path / "groups")
    with pytest.raises(DataError, match="embedded_examples has numbers that are too large"):
        load_groups(tmp_path / "groups")


def test_marks_teach_only_by_the_embeddings_that_a_model_takes(home):
    for log in find_logs(home):
        (one,) = read_log_sounds(log, "all")
        middle = len(one.spans.starts) // 2
        span = int(one.spans.starts[middle]), int(one.spans.ends[middle])
        write_marks(log, [Mark("mic", *span, "yelling")])
    for ear in (ONE, OTHER, PROJECTED):
        found = list(read_reviewed_sound(home, DEFAULT, space=ear.source.space))
        assert [one.embedding for one in found] == [e and e.source.space for e in EARS]
        recorded = [len(one.embeddings.frames) > 0 for one in found]
        assert recorded == [each is ear for each in EARS]
        lessons = list(training_recordings(home, space=ear.source.space))
        assert [one.embedded is not None for one in lessons] == recorded
        assert [one.weight for one in lessons] == [1.0 if each else 3.0 for each in recorded]
    wider = EmbeddingSpace("one", "a" * 64, WIDTH)
    found = read_reviewed_sound(home, DEFAULT, space=wider)
    assert not any(len(one.embeddings.frames) for one in found)


def test_a_model_that_takes_no_embeddings_says_so_where_logs_have_them(home):
    (*_, log) = find_logs(home)
    (one,) = read_log_sounds(log, "all")
    write_marks(log, [Mark("mic", int(one.spans.starts[0]), int(one.spans.ends[0]), "yelling")])
    notes = read_home_training_set([home], load_model(starter_file(GENERAL))).notes
    assert any("the logs have embeddings of one, which general does not take" in n for n in notes)


def test_the_queue_compares_only_what_one_network_heard(days):
    sources = find_labellings(days)
    spans = []
    for log in find_logs(days):
        (one,) = read_log_sounds(log, "all")
        spans.append((one.spans.starts[:6], one.spans.ends[:6]))
    starts, ends = (np.concatenate(each) for each in zip(*spans, strict=True))
    chosen = JudgeableSpans(starts, ends, np.zeros(len(starts), np.int64), np.ones(len(starts)))
    points, _ = span_sounds(chosen, sources, "mic", None)
    day = (starts - START) // DAY
    own = points[:, -WIDTH:]
    assert (own[np.isin(day, [0, 2, 3])] == 0).all()
    assert (own[np.isin(day, [1, 4])] != 0).any(axis=1).all()


def test_doctor_and_report_say_when_a_home_began_changed_or_lost_its_network(
    days, hearthlog, tmp_path
):
    output = (
        "mic: heard without a network, …, from 2026-03-03 08:00 with other, from 2026-03-04"
        " 08:00 with one, from 2026-03-05 08:00 with another projection of one"
    )
    done = hearthlog("doctor", days)
    assert done.returncode == 0, done.stdout
    assert output in done.stderr
    done = hearthlog("report", days, "--day", "2026-03-05", "-o", tmp_path / "day.html")
    assert done.returncode == 0, done.stderr
    assert output in (tmp_path / "day.html").read_text()
