"""A candidate labels beside the model in use: it comes, speaks, goes, and is only a candidate."""

import json
import shutil
import signal
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from log_fixtures import run
from logreader import LogReader
from logs import read
from model_folders import keep_models
from test_model_changes import block, count, labels_by, output, recording, wait_for

from hearthlog.analyzer.logs.layers import find_coverage
from hearthlog.analyzer.marks.marks import RANDOM, Mark, ReviewedSpan, write_marks
from hearthlog.analyzer.promotion.comparison import compare_on_trial, gather_evidence
from hearthlog.analyzer.promotion.recent_time import recent_logs
from hearthlog.models.features.installed import DEFAULT
from hearthlog.models.modelfile import load_model
from hearthlog.models.registry import promote, target
from hearthlog.recorder.config import Settings
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import CandidateWatch, ModelWatch
from hearthlog.recorder.recording_session import RecordingSession
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.messages.message_types import nanoseconds

MICROPHONE = SimpleNamespace(device="test")
OLD_MODEL = Path(__file__).parent / "golden/0.1.0/models/merged.safetensors"
OF_CANDIDATE = ["/mic/candidate/label", "/mic/candidate/segment"]


@pytest.fixture
def folder(tmp_path, model_file):
    return keep_models(tmp_path / "models", model_file)


@pytest.fixture
def logs(folder, tmp_path, day, capfd):
    """A log in which a candidate spoke from the first frame on."""
    promote(folder, "one")
    promote(folder, "two", "candidate")
    record(folder, tmp_path / "logs", day, capfd)
    return tmp_path / "logs"


def record(folder, logs, day, capfd):
    begin = ["--start", "2026-03-01T07:00:00", "--model", folder / "champion.safetensors"]
    done = run(capfd, "record", day, "-o", logs, *begin)
    assert done.returncode == 0, done.stderr
    return done


def candidate_labels(log):
    messages = list(LogReader(log).messages(OF_CANDIDATE[:1]))
    return {item.decode().frame: item.data for item in messages}


def test_a_candidate_speaks_beside_the_champion_as_it_would_alone(
    folder, logs, day, tmp_path, capfd
):
    (log,) = find_logs(logs)
    assert candidate_labels(log) == labels_by(folder / "two.safetensors", logs)
    about = LogReader(log).metadata["hearthlog"]
    assert (about["model"], about["candidate"]) == ("one", "two")
    assert about["candidate_sha256"] == load_model(folder / "two.safetensors").sha256
    assert [info.model for info in read(logs, "info")] == ["one"]
    (folder / "candidate.safetensors").unlink()
    record(folder, tmp_path / "alone", day, capfd)
    (alone,) = find_logs(tmp_path / "alone")
    rest = [m for m in LogReader(log).messages() if m.topic not in OF_CANDIDATE]
    assert [(m.topic, m.log_time, m.data) for m in rest] == [
        (m.topic, m.log_time, m.data) for m in LogReader(alone).messages()
    ]


def test_relabelling_with_the_candidate_gives_its_segments(folder, logs, capfd):
    (log,) = find_logs(logs)
    done = run(capfd, "relabel", logs, "--model", folder / "two.safetensors")
    assert done.returncode == 0, done.stderr
    layer = next(logs.rglob("*.relabel-two.mcap"))
    spoken = [m.data for m in LogReader(log).messages(OF_CANDIDATE[1:])]
    assert spoken == [m.data for m in LogReader(layer).messages(["/mic/relabel/two/segment"])]
    assert spoken


def test_a_candidate_comes_changes_and_goes_while_the_recorder_runs(folder, tmp_path, day, capfd):
    promote(folder, "one")
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00") as process:
        wait_for(lambda: count(logs, "label") > 20)
        promote(folder, "two", "candidate")
        wait_for(lambda: count(logs, "candidate/label") > 20)
        (folder / "candidate.safetensors").unlink()
        wait_for(lambda: count(logs, "info") == 3)
        before = count(logs, "label")
        wait_for(lambda: count(logs, "label") > before + 10)
    assert (process.returncode, process.errors) == (0, "")
    assert "), was on trial: " in run(capfd, "info", logs).stdout
    first, second, third = find_logs(logs)
    assert [bool(candidate_labels(log)) for log in (first, second, third)] == [False, True, False]
    found, wanted = candidate_labels(second), labels_by(folder / "two.safetensors", logs)
    assert found == {frame: wanted[frame] for frame in found}
    own = labels_by(folder / "one.safetensors", logs)
    spoken = {m.decode().frame: m.data for log in find_logs(logs)
              for m in LogReader(log).messages(["/mic/label"])}  # fmt: skip
    assert spoken == {frame: own[frame] for frame in spoken}
    assert len(spoken) == len(range(min(spoken), max(spoken) + 1)), "it was never interrupted"
    digest = load_model(folder / "two.safetensors").sha256[:12]
    assert any(line.startswith(f"candidate two ({digest}) from frame ") for line in output(logs))
    assert any(line.startswith("no candidate from frame ") for line in output(logs))


def test_a_candidate_that_cannot_be_used_is_refused_and_the_champion_goes_on(
    folder, tmp_path, day, capfd
):
    promote(folder, "one")
    (folder / "candidate.safetensors").write_bytes(b"no model")
    begin = ["--start", "2026-03-01T07:00:00", "--model", folder / "champion.safetensors"]
    done = run(capfd, "record", day, "-o", tmp_path / "logs", *begin)
    assert done.returncode == 3
    assert done.stderr.count("candidate refused: ") == 1
    assert count(tmp_path / "logs", "label")
    assert any(line.startswith("candidate refused: ") for line in output(tmp_path / "logs"))


def test_the_champion_is_no_candidate(folder, tmp_path, day, capfd):
    promote(folder, "one")
    promote(folder, "one", "candidate")
    record(folder, tmp_path / "logs", day, capfd)
    assert count(tmp_path / "logs", "candidate/label") == 0


class CountingWatch(CandidateWatch):
    """Counts what it has told."""

    reported = 0

    def news(self):
        found = super().news()
        self.reported += len(found)
        return found


def test_only_another_candidate_begins_a_log(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.recorder.labelling.model_watch.LOOK_SECONDS", 0.01)
    promote(folder, "two", "candidate")
    watch = ModelWatch(folder / "champion.safetensors", SimpleQueue())
    candidates = CountingWatch(folder, DEFAULT)
    session = RecordingSession(
        Settings(output=tmp_path), {"mic": MICROPHONE}, {"mic": LabellingModels(watch, candidates)}
    )
    frames = iter(range(0, 100_000, 30))

    def reported():
        session.add("mic", block(next(frames), 30))
        return candidates.reported

    shutil.copy(folder / "two.safetensors", folder / "copy")
    (folder / "copy").replace(folder / "two.safetensors")
    wait_for(lambda: reported() == 1)
    reported()
    assert len(list(tmp_path.rglob("*.mcap*"))) == 1
    promote(folder, "broad", "candidate")
    wait_for(lambda: reported() == 2)
    reported()
    session.finish()
    watch.close()
    candidates.close()
    assert len(session.summary.logs) == 2


def test_a_microphone_is_heard_on_while_candidates_fail_and_the_champion_vanishes(
    folder, tmp_path, labmic, capfd
):
    rng = np.random.default_rng(5)
    labmic.configure(data=rng.normal(0, 3000, 16_000 * 7 + 311).astype(np.int16))
    logs = tmp_path / "logs"
    shutil.copy(OLD_MODEL, folder / "old.safetensors")
    promote(folder, "two", "candidate")
    with recording(folder, logs, "--device", labmic.device, env=labmic.env) as process:
        wait_for(lambda: count(logs, "candidate/label") > 10)
        promote(folder, "old", "candidate")
        wait_for(lambda: count(logs, "info") == 2)
        promote(folder, "broad", "candidate")
        wait_for(lambda: count(logs, "info") == 3)
        (folder / "one.safetensors").unlink()
        before = count(logs, "label")
        wait_for(lambda: len(output(logs, level=30)) == 2 and count(logs, "label") > before + 10)
        refused = run(capfd, "models", "promote", "broad", "--folder", folder, "--logs", logs)
        assert (refused.returncode, target(folder, "champion")) == (1, "one")
        (line,) = refused.stderr.splitlines()
        assert "one (" in line
        assert "which labels now, is neither in" in line
        assert "`hearthlog models promote broad --anyway`" in line
        run(capfd, "models", "promote", "--anyway", "--folder", folder)
        wait_for(lambda: count(logs, "info") == 4)
        before = count(logs, "label")
        wait_for(lambda: count(logs, "label") > before + 10)
    assert process.returncode == 3
    assert output(logs, level=30) == [
        "candidate refused: it is for feature set auros21, not home33",
        f"model champion refused: {folder}/one.safetensors: no such model file; going on with one",
    ]
    about = [LogReader(log).metadata["hearthlog"] for log in find_logs(logs)]
    assert [(one["model"], one.get("candidate")) for one in about] == [
        ("one", "two"), ("one", None), ("one", "broad"), ("broad", None),
    ]  # fmt: skip
    assert [bool(candidate_labels(log)) for log in find_logs(logs)] == [True, False, True, False]
    frames = [message.frame for message in read(logs, "features")]
    assert frames == list(range(len(frames)))


def test_a_champion_that_is_returned_to_has_its_candidate_again(folder, tmp_path, day):
    promote(folder, "two", "candidate")
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00"):
        wait_for(lambda: count(logs, "candidate/label") > 10)
        promote(folder, "two")
        wait_for(lambda: count(logs, "info") == 2)
        promote(folder, "one")
        wait_for(lambda: count(logs, "info") == 3)
    about = [LogReader(log).metadata["hearthlog"] for log in find_logs(logs)]
    assert [(one["model"], one.get("candidate")) for one in about] == [
        ("one", "two"), ("two", None), ("one", "two"),
    ]  # fmt: skip


def test_a_model_that_could_not_label_beside_the_champion_becomes_no_candidate(folder, capfd):
    shutil.copy(OLD_MODEL, folder / "old.safetensors")
    done = run(capfd, "models", "promote", "old", "--to", "candidate", "--folder", folder)
    assert (done.returncode, target(folder, "candidate")) == (1, None)
    assert done.stderr == (
        "hearthlog: old is for feature set auros21, and one, the champion, for home33: it cannot "
        "label beside it\n"
    )
    (folder / "one.safetensors").unlink()
    done = run(capfd, "models", "promote", "old", "--to", "candidate", "--folder", folder)
    assert done.returncode == 0  # the recorder says what it makes of it


def test_a_candidate_of_a_killed_recorder_is_recovered(folder, tmp_path, day, capfd):
    promote(folder, "one")
    promote(folder, "two", "candidate")
    logs = tmp_path / "logs"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00") as process:
        wait_for(lambda: count(logs, "candidate/label") > 40)
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
        process.wait()
    active = max(logs.rglob("*.active"))
    assert run(capfd, "recover", active).returncode in {0, 3}
    log = next(log for log in find_logs(logs) if log != active)
    wanted = labels_by(folder / "two.safetensors", log)
    found = candidate_labels(log)
    assert len(found) > 20
    assert found == {frame: wanted[frame] for frame in found}


def test_a_candidate_is_shown_as_one_and_taken_for_nothing_else(logs, tmp_path, capfd):
    (log,) = find_logs(logs)
    info = json.loads(run(capfd, "info", logs, "--json").stdout)
    assert info["streams"][-1]["model"] == "one"
    (line,) = (one for one in run(capfd, "info", logs).stdout.splitlines() if "trial" in one)
    assert line.startswith("candidate: two (")
    assert line.endswith(f"), on trial: `hearthlog models compare --live --logs {logs}`")
    assert set(info["segments"]) == {"mic", "mic/candidate"}
    assert run(capfd, "doctor", logs).returncode == 0
    apart = run(capfd, "diff", logs, "live", "candidate")
    assert apart.returncode == 0, apart.stderr
    for command in (
        ["catalog", logs],
        ["report", logs, "-o", tmp_path / "page.html"],
        ["review", logs, "--save", tmp_path / "day.rrd"],
        ["review", logs, "--labels", "candidate", "--queue", "--save", tmp_path / "ten.txt"],
        ["cut", log, "-o", tmp_path / "part.mcap", "--start", "2026-03-01T07:00:10"],
        ["export", log, "-o", tmp_path / "part.csv", "--topics", OF_CANDIDATE[1]],
    ):
        done = run(capfd, *command)
        assert done.returncode in {0, 3}, (command, done.stderr)
    assert LogReader(tmp_path / "part.mcap").messages(OF_CANDIDATE)


def test_logs_with_a_candidate_are_replayed_as_they_were_without_it(folder, logs, tmp_path, capfd):
    done = run(
        capfd, "replay", logs, "-o", tmp_path / "again", "--model", folder / "one.safetensors"
    )
    assert done.returncode == 0, done.stderr
    (log,), (again,) = find_logs(logs), find_logs(tmp_path / "again")
    rest = [(m.topic, m.data) for m in LogReader(log).messages() if m.topic not in OF_CANDIDATE]
    assert rest == [(m.topic, m.data) for m in LogReader(again).messages()]


def test_the_champion_goes_on_in_a_replay_where_a_candidate_comes_and_goes(
    folder, tmp_path, day, capfd
):
    logs, again = tmp_path / "logs", tmp_path / "again"
    with recording(folder, logs, day, "--realtime", "--start", "2026-03-01T07:00:00"):
        wait_for(lambda: count(logs, "label") > 20)
        promote(folder, "two", "candidate")
        wait_for(lambda: count(logs, "info") == 2)
        (folder / "candidate.safetensors").unlink()
        wait_for(lambda: count(logs, "info") == 3)
    done = run(capfd, "replay", logs, "-o", again, "--model", folder / "one.safetensors")
    assert done.returncode == 0, done.stderr
    for kind in ("label", "segment"):
        old, new = (
            [m.data for log in find_logs(f) for m in LogReader(log).messages([f"/mic/{kind}"])]
            for f in (logs, again)
        )
        assert old == new
    assert all("candidate" not in LogReader(log).metadata["hearthlog"] for log in find_logs(again))


def test_what_was_said_at_one_time_is_compared_by_what_was_reviewed(logs, capfd):
    first = json.loads(run(capfd, "models", "compare", "--live", "--logs", logs, "--json").stdout)
    assert (first["champion"], first["candidate"]) == ("one", "two")
    assert first["minutes"] > 0.5
    assert sum(one[0] for one in first["minutes_a_day"].values()) == pytest.approx(
        sum(one[1] for one in first["minutes_a_day"].values())
    )
    assert "neither can be called better" in first["verdict"]
    review_as_the_candidate_says(logs)
    again = json.loads(run(capfd, "models", "compare", "--live", "--logs", logs, "--json").stdout)
    known = again["random"]
    assert known["gained"] - known["lost"] == known["after"] - known["before"]
    assert known["after"] == known["sounds"] > known["before"] > 0
    assert again["marks"]["sounds"] == 0  # that of which nothing is known is none
    output = run(capfd, "models", "compare", "--live", "--logs", logs)
    assert output.returncode == 0, output.stderr
    assert "two is better: right where one is not" in output.stdout
    assert "`hearthlog models promote two` makes it champion" in output.stdout


def test_a_minute_in_a_quiet_that_ends_hours_later_is_known(folder, tmp_path, capfd):
    promote(folder, "two", "candidate")
    quiet = np.random.default_rng(2).normal(0, 1e-4, 16_000 * 240)
    soundfile.write(tmp_path / "quiet.wav", quiet, 16_000)
    begin = ["--start", "2026-03-01T07:00:00", "--model", folder / "champion.safetensors"]
    wav, logs = tmp_path / "quiet.wav", tmp_path / "logs"
    run(capfd, "record", wav, "-o", logs, *begin, "--max-bag-duration", 60)
    log = find_logs(logs)[1]
    start = find_coverage(log)["mic"].starts[0] + 10 * NANOSECONDS
    drawn = ReviewedSpan("mic", start, start + 40 * NANOSECONDS, chosen=RANDOM)
    write_marks(log, [], reviewed=[drawn])
    trial = compare_on_trial([logs])
    assert (trial.quiet.sounds, trial.random.sounds, trial.losses) == (1, 0, [])
    models = (load_model(folder / f"{name}.safetensors") for name in ("one", "two"))
    evidence = gather_evidence(*models, recent_logs([logs]))
    assert (evidence.quiet.sounds, evidence.random.sounds) == (1, 0)


def review_as_the_candidate_says(logs):
    """Go through a minute in which the candidate is right about everything."""
    (log,) = find_logs(logs)
    start = find_coverage(log)["mic"].starts[0]
    minute = ReviewedSpan("mic", start, start + 60 * NANOSECONDS, chosen=RANDOM)
    segments = [
        (nanoseconds(m.header.stamp), nanoseconds(m.duration), m.label)
        for m in read(logs, "candidate/segment")
    ]
    marks = [
        Mark("mic", begin, begin + length, label)
        for begin, length, label in segments
        if minute.start <= begin and begin + length <= minute.end
    ]
    end = minute.end + NANOSECONDS
    marks.append(Mark("mic", end, end + NANOSECONDS, "unknown"))
    write_marks(log, marks, reviewed=[minute])


def test_logs_in_which_no_candidate_spoke_say_what_lets_one_speak(folder, tmp_path, day, capfd):
    promote(folder, "one")
    record(folder, tmp_path / "logs", day, capfd)
    done = run(capfd, "models", "compare", "--live", "--logs", tmp_path / "logs")
    assert done.returncode == 1
    assert "`hearthlog models promote NAME --to candidate`" in done.stderr
    wrong = run(capfd, "models", "compare", "one", "two", "--live")
    assert wrong.returncode == 2


def test_a_candidate_that_has_just_begun_cannot_be_compared_yet(folder, tmp_path, capfd):
    promote(folder, "two", "candidate")
    watch = ModelWatch(folder / "champion.safetensors", SimpleQueue())
    candidates = CandidateWatch(folder, DEFAULT)
    session = RecordingSession(
        Settings(output=tmp_path), {"mic": MICROPHONE}, {"mic": LabellingModels(watch, candidates)}
    )
    session.add("mic", block(0, 30))
    done = run(capfd, "models", "compare", "--live", "--logs", tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("hearthlog: nothing to compare two with one by yet: /mic/")
    session.finish()
    watch.close()
    candidates.close()


def test_a_candidate_of_the_folder_models_speaks_beside_a_starter(
    folder, tmp_path, day, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    promote(folder, "two", "candidate")
    begin = ["--start", "2026-03-01T07:00:00", "--model", "general"]
    done = run(capfd, "record", day, "-o", tmp_path / "logs", *begin)
    assert done.returncode == 0, done.stderr
    assert count(tmp_path / "logs", "candidate/label")
