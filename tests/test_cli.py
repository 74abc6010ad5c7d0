"""The command line tells what is in a log, stays light where it must, and shows the whole way."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from datetime import date

import numpy as np
import pytest
import soundfile
from conftest import FRESH_HEARTHLOG, HEARTHLOG
from homelife import at, write_day
from mcap.writer import Writer as McapWriter

from hearthlog.analyzer.logs.hidden_classes import write_hidden_classes
from hearthlog.models.classes import SILENCE, in_words, ordered
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import find_logs
from hearthlog.schemas.logs.writer import LogWriter, TopicBatch
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.topics import Topic

needs_setpriv = pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv")
DAY = date(2026, 3, 2)
HEAVY = {"sklearn", "hmmlearn", "rerun", "dask", "matplotlib", "scipy", "pyarrow", "pandas"}


@pytest.fixture(scope="module")
def logs(tmp_path_factory, day, model_file):
    folder = tmp_path_factory.mktemp("logs")
    command = [*HEARTHLOG, "record", day, "--model", model_file]
    options = ["-o", folder, "--start", "2026-03-01T06:59:00", "--node", "flat", "--name", "hall"]
    subprocess.run([*map(str, command + options)], check=True, capture_output=True)
    return folder


def test_info_tells_span_topics_rates_labels_and_model(logs, hearthlog, model_file):
    result = hearthlog("info", logs, "--json")
    assert result.returncode == 0
    found = json.loads(result.stdout)
    assert len(found["files"]) == 2
    assert found["unfinished"] == found["gaps"] == []
    assert found["start"] == "2026-03-01T06:59:00.000Z"
    assert found["seconds"] == pytest.approx(180, abs=0.1)
    assert found["topics"]["/hall/features"]["messages"] == 3600
    assert found["topics"]["/hall/features"]["rate_hz"] == pytest.approx(20)
    assert found["topics"]["/hall/label"]["messages"] == 3586
    assert sum(found["labels"]["hall"].values()) == pytest.approx(3586 * 0.05 / 60, abs=1e-3)
    (stream,) = found["streams"]
    assert stream["model"] == model_file.stem
    assert len(stream["model_sha256"]) == 64
    assert found["size_bytes"] == sum(path.stat().st_size for path in logs.rglob("*.mcap"))


def test_info_for_people_has_the_same_figures(logs, hearthlog):
    text = hearthlog("info", logs, "--verbose").stdout
    assert "2 files" in text
    assert "2026-03-01T06:59:00.000Z to 2026-03-01T07:02:00.000Z in UTC" in text
    assert "hearthlog_msgs/msg/AudioFeatures" in text


def test_info_says_first_whether_all_is_well_then_what_was_labelled_and_what_to_do_next(
    logs, hearthlog
):
    figures = json.loads(hearthlog("info", logs, "--json").stdout)
    state, what, recorded, empty, title, head, *rest = hearthlog("info", logs).stdout.splitlines()
    assert (state, empty) == ("Everything is working", "")
    assert what.startswith("Home flat, microphone hall: 3 min, 2026-0")
    assert recorded == "Listened: 3 min of 3 min"
    assert title == "The 24 hours to 22:00 of Sunday, 2026-03-01, as labelled"
    assert re.fullmatch(r"sound +length  times  perhaps|sound +length  times", head)
    minutes = figures["day"]["minutes"]
    rows = rest[: len(minutes)]
    assert [row.split("  ")[0] for row in rows] == [in_words(name) for name in ordered(minutes)]
    for row, name in zip(rows, ordered(minutes), strict=True):
        found = re.fullmatch(r"\w[\w ]+?  +([^ \d]+) +(\d+) (s|min) +(\w+).*", row)
        bar, number, unit, times = found.groups()
        length = 60 * float(number) if unit == "min" else float(number)
        assert length == pytest.approx(60 * minutes[name], abs=30 if unit == "min" else 0.5)
        assert set(bar) <= set("█▏▎▍▌▋▊▉")
        own = figures["day"]["counts"][name]
        sure = own["counted"] - own["unsure"] * (name != "unknown")
        assert times == (str(sure) if sure else "none")
    assert max(row.count("█") for row in rows) == 24
    about, following, more = rest[len(rows) + 1 :]
    assert about.startswith("Microphone hall: ")
    assert following == f"Next: {figures['next']}"
    assert following == (
        "Next: to know how many labels are right in this home, review ten spans: "
        f"hearthlog review {logs} --queue"
    )
    assert more.endswith("--verbose")
    assert figures["streams"][0]["starter"] is False


def test_info_has_bars_of_all_time_and_what_is_in_doubt_behind_verbose(logs, hearthlog):
    figures = json.loads(hearthlog("info", logs, "--json").stdout)
    lines = hearthlog("info", logs, "--verbose").stdout.splitlines()
    title = "Microphone hall: time labelled as each sound, sure or not, also by a television"
    assert title not in hearthlog("info", logs).stdout
    minutes = figures["segment_minutes"]["hall"]
    first = lines.index(title) + 1
    rows = lines[first : first + len(minutes)]
    assert [row.split("  ")[1] for row in rows] == [in_words(name) for name in ordered(minutes)]
    for row, name in zip(rows, ordered(minutes), strict=True):
        amount, number, unit = row.split()[-3:]
        length = 60 * float(number) if unit == "min" else float(number)
        assert length == pytest.approx(60 * minutes[name], abs=30 if unit == "min" else 0.5)
        assert set(amount) <= (set("█▏▎▍▌▋▊▉") if name != SILENCE else set(in_words(name)))
    doubt = 60 * figures["unsure"]["hall"]["minutes"]
    assert lines[first + len(minutes)] == (
        f"Microphone hall: {doubt:.0f} s of these labels have less than half of the probability: "
        "another sound may be likelier"
    )


def test_info_has_bars_of_all_time_where_no_sound_was_before_22(hearthlog, tmp_path):
    write_day(tmp_path, DAY, [(at("22:30"), 60.0, "coughing", 0.9)], hours=[22])
    lines = hearthlog("info", tmp_path).stdout.splitlines()
    assert lines[4] == (
        "Microphone mic: time labelled as each sound, sure or not, also by a television"
    )
    assert lines[5].split()[0] == "Coughing"
    assert "24 hours" not in "".join(lines)


def test_info_tells_times_of_the_home_and_trouble_and_names_no_class_that_is_hidden(
    hearthlog, tmp_path
):
    events = [
        (at("09:00"), 600.0, "music", 0.9),
        (at("10:00"), 90.0, "coughing", 0.8),
        (at("11:00"), 9000.0, "speech", 0.8),
    ]
    gap = (at("20:00"), 3600.0, "paused")
    write_day(tmp_path, DAY, events, gaps=[gap], timezone="Europe/Vienna")
    write_hidden_classes(tmp_path, ["music"])
    result = hearthlog("info", tmp_path)
    assert result.returncode == 3
    state, what, recorded, _, _, apart, _, *rest = result.stdout.splitlines()
    assert state.startswith("Not heard: 1 gap, together 3600.000 s")
    assert re.search(r"24\.0 h, 2026-03-02 01:00 to 2026-03-03 01:00 \(Europe/Vienna\)", what)
    assert recorded == "Listened: 23.0 h of 24.0 h"
    assert apart.endswith("░ beside a television")
    assert re.fullmatch(r"Coughing +▎ +2 min +1", rest[0])
    assert re.fullmatch(r"Talking +░{18,} +none +1 +2 h 30 min", rest[1])
    assert not rest[2]
    assert "gap: mic 2026-03-02 21:00:00 3600.000 s" in result.stdout
    for words in ([], ["--verbose"]):
        assert "usic" not in hearthlog("info", tmp_path, *words).stdout
    assert "music" in json.loads(hearthlog("info", tmp_path, "--json").stdout)["segments"]["mic"]


def test_info_has_in_one_bar_what_is_counted_and_what_is_not_for_a_television(hearthlog, tmp_path):
    talking = [(at("18:00") + 20 * n, 15, "speech", 0.9) for n in range(360)]
    talking += [(at(f"{hour}:00"), 300.0, "speech", 0.9) for hour in (10, 11, 12)]
    things = [(at("09:00"), 200.0, "objects_activity", 0.9)]
    write_day(tmp_path, DAY, [*things, *talking], hours=range(22))
    lines = hearthlog("info", tmp_path).stdout.splitlines()
    talk, other = lines[7:9]
    assert re.fullmatch(r"Talking +█+[▏▎▍▌▋▊▉]?░+ +15 min +3 +1 +1 h 30 min", talk)
    assert re.fullmatch(r"Household sounds +[▏▎▍▌▋▊▉█]+ +3 min +1", other)
    assert 5 * talk.count("█") < talk.count("░") + 8
    assert max(map(len, lines[4:9])) <= 80
    env = os.environ | {"COLUMNS": "50", "PYTHONIOENCODING": "ascii"}
    narrow = subprocess.run(
        [*HEARTHLOG, "info", tmp_path], capture_output=True, text=True, check=True, env=env
    ).stdout.splitlines()
    assert not any("#" in line for line in narrow), "no room"
    env["COLUMNS"] = "80"
    plain = subprocess.run(
        [*HEARTHLOG, "info", tmp_path], capture_output=True, text=True, check=True, env=env
    ).stdout.splitlines()
    assert re.fullmatch(r"Talking +#+\.+ +15 min +3 +1 +1 h 30 min", plain[7])


def test_info_counts_only_the_telephone_of_which_the_model_is_sure(hearthlog, tmp_path):
    rings = [(at("09:00"), 30.0, "phone_ring", 0.9), (at("10:00"), 240.0, "phone_ring", 0.69)]
    rings += [(at("11:00"), 5.0, "phone_ring", 0.6), (at("11:00:05"), 5.0, "phone_ring", 0.8)]
    write_day(tmp_path, DAY, [*rings, (at("12:00"), 60.0, "phone_ring", 0.5)])
    row = hearthlog("info", tmp_path).stdout.splitlines()[6]
    assert re.fullmatch(r"Telephone ringing +█+[▏▎▍▌▋▊▉]? +40 s +2", row)


def test_info_never_says_that_more_was_listened_to_than_there_was(hearthlog, tmp_path):
    write_day(tmp_path / "one", DAY)
    lines = hearthlog("info", tmp_path / "one").stdout.splitlines()
    assert lines[1].endswith(": 24.0 h, 2026-03-02 00:00 to 2026-03-03 00:00 (UTC)")
    assert lines[2] == "Listened: 24.0 h of 24.0 h"
    for node in ("flat", "attic"):
        write_day(tmp_path / "two", DAY, node=node)
    assert hearthlog("info", tmp_path / "two").stdout.splitlines()[2] == (
        "Listened: 24.0 h of 24.0 h"
    )


def test_info_says_that_a_starter_labelled_and_leads_on_to_a_model_of_the_home(
    day, hearthlog, tmp_path
):
    logs, labels = tmp_path / "logs", tmp_path / "day.txt"
    hearthlog("record", day, "--model", "general", "-o", logs)
    found = hearthlog("info", logs).stdout
    assert re.search(r"model general \(\w{12}\), a starter model, not trained on this home", found)
    assert found.splitlines()[-2].endswith(f"hearthlog review {logs} --queue")
    hearthlog("export", logs, "-o", labels, "--topics", "/mic/segment")
    hearthlog("annotate", "import", logs, labels)
    assert hearthlog("info", logs).stdout.splitlines()[-2] == (
        "Next: train a model on the marks of this home (keep recording: the check "
        f"needs ten minutes that it was not trained on): hearthlog train --home {logs}"
    )
    soundfile.write(tmp_path / "quiet.wav", np.zeros(16_000 * 20), 16_000)
    hearthlog("record", tmp_path / "quiet.wav", "--model", "general", "-o", tmp_path / "quiet")
    assert hearthlog("info", tmp_path / "quiet").stdout.splitlines()[-2] == (
        "Next: only silence was recorded so far: leave it recording, or test the microphone"
    )
    (bare := tmp_path / "bare").mkdir()
    hearthlog("record", day, "--model", "none", "-o", bare)
    assert hearthlog("info", bare).stdout.splitlines()[-2] == (
        f"Next: nothing is labelled: hearthlog relabel {bare} --model general"
    )


def test_info_says_in_json_what_the_files_are_and_carry(logs, hearthlog):
    found = json.loads(hearthlog("info", logs, "--json").stdout)
    assert found["profiles"] == ["ros2"]
    assert found["libraries"] == ["hearthlog"]
    assert found["metadata"] == ["hearthlog", "hearthlog_contents", "rosbag2"]
    assert len(found["attachments"]) == 3
    assert found["chunks"] > 10
    assert found["compression_ratio"] > 1
    assert sum(found["segments"]["hall"].values()) == found["topics"]["/hall/segment"]["messages"]
    assert found["layers"] == []
    assert found["damaged"] == {}
    assert found["gap_seconds"] == 0
    assert found["health"]["level"] == "ok"
    assert found["health"]["name"] == "hearthlog: hall"


def gaps(path, count, reason="overrun"):
    """A log that has nothing but gaps, each of a quarter of a second."""
    times = 1_772_348_400 * NANOSECONDS + np.arange(count) * NANOSECONDS
    fields = {
        "header.stamp": times,
        "header.frame_id": "hall",
        "duration": np.full(count, NANOSECONDS // 4),
        "reason": reason,
        "frames_lost": np.full(count, 5, np.uint64),
    }
    writer = LogWriter(path, [Topic("/hall/gap", message_types.GAP)], {})
    writer.write_columns([TopicBatch("/hall/gap", times, fields)])
    return writer.finish()


def test_info_lists_the_first_gaps_and_json_all_of_them_with_status_3(hearthlog, tmp_path):
    log = gaps(tmp_path / "a.mcap", 15)
    text = hearthlog("info", log)
    assert text.returncode == 3
    total, _, first, *lines = text.stdout.splitlines()
    assert total == "Not heard: 15 gaps, together 3.750 s"
    assert first == "gap: hall 2026-03-01 07:00:00 0.250 s, 5 frames: overrun"
    more = lines[9]
    assert more == "gap: and 5 more (--json lists all)"
    result = hearthlog("info", log, "--json")
    assert result.returncode == 3
    found = json.loads(result.stdout)
    assert len(found["gaps"]) == 15
    assert found["gap_seconds"] == pytest.approx(3.75)


def test_info_of_an_unfinished_log_says_so_with_status_3(logs, hearthlog, tmp_path):
    full = min(logs.rglob("*.mcap"))
    cut = tmp_path / (full.name + ".active")
    cut.write_bytes(full.read_bytes()[:60_000])
    result = hearthlog("info", cut, "--json")
    assert result.returncode == 3
    assert json.loads(result.stdout)["unfinished"] == [str(cut)]


def test_info_names_what_is_damaged_and_shows_the_rest_with_status_3(logs, hearthlog, tmp_path):
    full, other = sorted(logs.rglob("*.mcap"))
    shutil.copy(full, tmp_path)
    bad = tmp_path / other.name
    data = bytearray(other.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    output = data.rindex(b"hearthlog_contents", 0, data.rindex(b'"topics"'))
    data[data.index(b"sha256", output)] ^= 1  # so that its messages are read
    bad.write_bytes(data)
    alone = json.loads(hearthlog("info", full, "--json").stdout)
    result = hearthlog("info", tmp_path, "--json")
    assert result.returncode == 3
    found = json.loads(result.stdout)
    both = json.loads(hearthlog("info", logs, "--json").stdout)
    for topic, one in alone["topics"].items():
        counts = [each["topics"][topic]["messages"] for each in (found, both)]
        assert one["messages"] <= counts[0] <= counts[1]
    assert one["messages"] < counts[1]
    for stderr in (result.stderr, hearthlog("info", tmp_path).stderr):
        assert f"{bad}: damaged at byte " in stderr
        assert "left out up to byte" in stderr
        assert stderr.count("\n") == 1


def test_info_of_nothing_but_damaged_logs_fails(hearthlog, tmp_path):
    for name in "ab":
        (tmp_path / f"{name}.mcap").write_bytes(b"no log")
    result = hearthlog("info", tmp_path)
    assert result.returncode == 1
    assert result.stdout == ""
    assert result.stderr.splitlines() == [
        f"hearthlog: {tmp_path / name}: is not an MCAP file" for name in ("a.mcap", "b.mcap")
    ]


def test_info_of_a_log_without_messages(hearthlog, tmp_path):
    log = LogWriter(tmp_path / "a.mcap", [Topic("/hall/gap", message_types.GAP)], {}).finish()
    result = hearthlog("info", log)
    assert result.returncode == 0
    assert "no messages" in result.stdout.splitlines()
    found = json.loads(hearthlog("info", log, "--json").stdout)
    assert found["start"] is found["end"] is found["compression_ratio"] is found["health"] is None
    assert found["topics"]["/hall/gap"]["messages"] == 0


def test_info_of_a_foreign_log_shows_its_topics(hearthlog, tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="", library="someone else's")
        channel = writer.register_channel("/reading", "json", 0)
        for time in range(5):
            writer.add_message(channel, time * NANOSECONDS, b"{}", 0)
        writer.finish()
    result = hearthlog("info", path)
    assert result.returncode == 0
    assert "written by someone else's" in result.stdout.splitlines()
    assert "1970-01-01T00:00:00.000Z to 1970-01-01T00:00:04.000Z in UTC (0:00:04)" in result.stdout
    topic = json.loads(hearthlog("info", path, "--json").stdout)["topics"]["/reading"]
    assert topic == {"type": "", "encoding": "json", "messages": 5, "rate_hz": 1.0, "bytes": None}


def test_info_sends_nothing_of_a_file_to_the_terminal_that_would_steer_it(hearthlog, tmp_path):
    log = gaps(tmp_path / "a.mcap", 1, reason="\x1b[2J[red]gone\r\n")
    result = hearthlog("info", log)
    assert result.stdout.splitlines()[2].endswith(" 5 frames:  [2J[red]gone  ")


def test_recording_imports_nothing_of_the_analyzer_but_its_tables(day, model_file, tmp_path):
    code = (
        "import sys\n"
        "from hearthlog.tools.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)\n"
    )
    command = [sys.executable, "-c", code, "record", day, "--model", model_file]
    result = subprocess.run(
        [*map(str, command), "-o", str(tmp_path)], capture_output=True, text=True, check=True
    )
    loaded = result.stdout.split()
    assert "hearthlog.recorder.recording" in loaded
    analyzer = {name for name in loaded if name.startswith("hearthlog.analyzer")}
    tables = {"hearthlog.analyzer.export", "hearthlog.analyzer.marks.formats"}
    assert analyzer <= {table.rsplit(".", n)[0] for table in tables for n in range(4)}
    assert not {name.partition(".")[0] for name in loaded} & HEAVY


@pytest.mark.parametrize("module", ["typer", "getpass"])  # of the entry point, of the subcommand
def test_ctrl_c_during_the_imports_leaves_no_traceback(tmp_path, module):
    text = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / f"{module}.py").write_text(text)
    paths = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    # A job in the background of a shell ignores the signal, and so would what it starts.
    heeding = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL)"
    program = f"{heeding}; os.execv(sys.executable, sys.argv[1:])"
    result = subprocess.run(
        [sys.executable, "-c", program, *FRESH_HEARTHLOG, "info", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (-signal.SIGINT, "")


def test_the_demo_goes_from_sound_to_a_timeline(hearthlog, tmp_path):
    folder = tmp_path / "demo"
    result = hearthlog("demo", "--output", folder, "--minutes", "4")
    assert result.returncode == 0, result.stderr
    assert (folder / "day.rrd").stat().st_size > 100_000
    assert len(list(folder.rglob("*.mcap"))) == 1
    assert result.stdout.splitlines()[-1].endswith("hearthlog record")
    shares = re.search(r"(\d+)% of all labels are correct, and (\d+)% of the labels", result.stdout)
    assert 60 < int(shares[1]) <= 100
    assert 30 < int(shares[2]) <= 100
    assert re.search(r"\d+ sounds, of \d+ recordings; made up: \d+", result.stdout)
    track = (folder / "day.txt").read_text().splitlines()
    assert track[-1].split("\t")[1] == "240.000000"
    assert "(a whole day in 4 minutes is as dense as the sound of a television" in result.stdout
    again = hearthlog("demo", "--output", folder)
    assert again.returncode == 1
    assert again.stderr.startswith(f"hearthlog: {folder}: already exists")


def test_a_demo_that_could_not_be_looked_at_is_refused_before_it_is_composed(hearthlog, tmp_path):
    environment = dict.fromkeys(("DISPLAY", "WAYLAND_DISPLAY"), "")
    result = hearthlog("demo", "--output", tmp_path / "demo", "--open", env=environment)
    assert (result.returncode, (tmp_path / "demo").exists()) == (1, False)
    assert "there is no display; run without --open" in result.stderr


def as_another_account(*command):
    """Run a command as somebody whom permissions bind, even where these tests are run by root."""
    bound = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if not os.geteuid() else []
    done = subprocess.run(
        [*bound, *HEARTHLOG, *map(str, command)], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stderr


@pytest.fixture
def denied(logs, tmp_path):
    """Two logs, and a function that lets nobody read a path; in the end it is as it was."""
    folder = shutil.copytree(logs, tmp_path / "denied")
    paths = []

    def deny(path):
        path.chmod(0)
        paths.append(path)

    yield folder, deny
    for path in paths:
        path.chmod(0o700)


@needs_setpriv
@pytest.mark.parametrize("verb", ["info", "doctor", "cat", "voices", "pause", "catalog", "watch"])
def test_no_permission_is_not_no_logs(denied, verb):
    folder, deny = denied
    deny(folder)
    status, output = as_another_account(verb, folder)
    assert status == 1
    assert output.startswith(f"hearthlog: {folder}: may not be read by you (owner ")
    assert output.count("\n") == 1


@needs_setpriv
def test_a_folder_that_may_not_be_read_leaves_the_others_to_the_doctor(denied, tmp_path):
    folder, deny = denied
    log = shutil.copy(find_logs(folder)[0], tmp_path)
    deny(folder)
    status, output = as_another_account("doctor", folder, log)
    (line,) = output.splitlines()
    assert status == 1
    assert line.startswith(f"hearthlog: {folder}: may not be read by you (owner ")


@needs_setpriv
def test_what_may_be_read_of_a_folder_is_used_and_the_rest_is_a_line(denied):
    folder, deny = denied
    first, second = find_logs(folder)
    deny(second)
    (folder / "inner").mkdir()
    deny(folder / "inner")
    status, output = as_another_account("cat", folder, "--topics", "/hall/segment")
    assert (status, output.count("\n")) == (3, 1)
    assert f"{folder}: 2 of its files and folders, left out, may not be read by you" in output
    deny(first)
    status, output = as_another_account("cat", folder)
    assert (status, output.count("\n")) == (1, 1)
    assert "what is in it may not be read by you" in output


def test_the_doctor_takes_many_paths_and_names_those_that_are_not_there(logs, hearthlog):
    first, second = find_logs(logs)
    both = hearthlog("doctor", first, second, second)
    assert (both.returncode, both.stdout) == (0, "2 files: 0 errors, 0 warnings\n")
    with_gone = hearthlog("doctor", "gone.mcap", first)
    assert with_gone.returncode == 1
    assert with_gone.stderr == "hearthlog: gone.mcap: no such log\n"
    assert with_gone.stdout == "1 file: 0 errors, 0 warnings\n"


def test_a_diff_and_an_import_may_leave_out_the_folder_of_logs(logs, hearthlog, tmp_path):
    own = {"HEARTHLOG_OUTPUT": str(logs)}
    assert "unsure" in hearthlog("diff", "live", "--queue", env=own).stdout
    alone = hearthlog("annotate", "import", tmp_path / "none.txt", env=own)
    assert alone.stderr == f"hearthlog: {tmp_path / 'none.txt'}: no such label file\n"


def test_a_model_of_another_folder_is_shown_by_its_path(model_file, hearthlog, tmp_path):
    shown = hearthlog("models", "show", model_file, "--folder", tmp_path)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "macro F1" in shown.stdout
