"""The command line tells what is in a log, stays light where it must, and shows the whole way."""

import json
import subprocess
import sys

import pytest

HEAVY = {"sklearn", "hmmlearn", "rerun", "dask", "matplotlib", "scipy", "pyarrow", "pandas"}


@pytest.fixture(scope="module")
def logs(tmp_path_factory, day, model_file):
    folder = tmp_path_factory.mktemp("logs")
    command = [sys.executable, "-m", "tools.cli.main", "record", day, "--model", model_file]
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
    assert found["topics"]["/hall/label"]["messages"] == 3581
    assert sum(found["labels"]["hall"].values()) == pytest.approx(3581 * 0.05 / 60, abs=1e-3)
    (stream,) = found["streams"]
    assert stream["model"] == model_file.stem
    assert len(stream["model_sha256"]) == 64
    assert found["size_bytes"] == sum(path.stat().st_size for path in logs.rglob("*.mcap"))


def test_info_for_people_has_the_same_figures(logs, hearthlog):
    text = hearthlog("info", logs).stdout
    assert "2 files" in text
    assert "2026-03-01T06:59:00.000Z to 2026-03-01T07:02:00.000Z" in text
    assert "hearthlog_msgs/msg/AudioFeatures" in text


def test_info_of_an_unfinished_log_says_so_with_status_3(logs, hearthlog, tmp_path):
    whole = min(logs.rglob("*.mcap"))
    cut = tmp_path / (whole.name + ".active")
    cut.write_bytes(whole.read_bytes()[:60_000])
    result = hearthlog("info", cut, "--json")
    assert result.returncode == 3
    assert json.loads(result.stdout)["unfinished"] == [str(cut)]


def test_recording_with_labels_imports_nothing_of_the_analyzer(day, model_file, tmp_path):
    code = (
        "import sys\n"
        "from tools.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)\n"
    )
    command = [sys.executable, "-c", code, "record", day, "--model", model_file]
    result = subprocess.run(
        [*map(str, command), "-o", str(tmp_path)], capture_output=True, text=True, check=True
    )
    loaded = {name.partition(".")[0] for name in result.stdout.split()}
    assert "recorder" in loaded
    assert not loaded & HEAVY


def test_the_demo_goes_from_sound_to_a_timeline(hearthlog, tmp_path):
    folder = tmp_path / "demo"
    result = hearthlog("demo", "--output", folder, "--minutes", "4", timeout=200)
    assert result.returncode == 0, result.stderr
    assert (folder / "day.rrd").stat().st_size > 100_000
    assert len(list(folder.rglob("*.mcap"))) == 1
    assert "hearthlog record --model" in result.stdout.splitlines()[-1]
    again = hearthlog("demo", "--output", folder)
    assert again.returncode == 1
    assert again.stderr.startswith(f"hearthlog: {folder}: exists already")
