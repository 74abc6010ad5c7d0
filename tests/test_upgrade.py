"""A home of every released version goes on under this one, and one of a later version is named.

`golden/<version>` has what that version wrote; those with a `home.toml` are whole homes, which
`golden_home.py` writes.
"""

import hashlib
import json
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import soundfile
from golden_home import CONFIGURATION, entries, following, write_secrets
from grown_schema import NEXT
from log_fixtures import Result
from log_fixtures import run as run_here
from prometheus_client.parser import text_string_to_metric_families
from receivers import server
from rewriting import Log
from waiting import wait_for

from hearthlog import __version__
from hearthlog.analyzer.bridge.state import BridgeError, BridgeState
from hearthlog.schemas.logs.columns import read_columns
from hearthlog.schemas.logs.files import find_logs, is_layer

GOLDEN = sorted((Path(__file__).parent / "golden").iterdir())
HOMES = [each for each in GOLDEN if (each / CONFIGURATION).exists()]
LATER = "99.1.0"
# Apprise asks for it where there is one.
pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")
of_every_version = pytest.mark.parametrize("version", GOLDEN, ids=lambda path: path.name)
of_every_home = pytest.mark.parametrize("version", HOMES, ids=lambda path: path.name)

DAY = ["--day", "2026-03-01"]
MERGED = ["--model", "models/merged.safetensors", "--workers", "1"]
READING = [
    ["info", "logs"],
    ["info", "left"],
    ["cat", "logs"],
    ["events", "logs"],
    ["report", "logs", *DAY, "-o", "out/day.html"],
    ["report", "logs", *DAY, "--labels", "merged", "-o", "out/merged.html"],
    ["relabel", "logs", *MERGED],
    ["replay", "logs", "--model", "models/smoothed.safetensors"],
    ["diff", "logs", "live", "merged"],
    ["annotate", "export", "logs", "-o", "out/marks.csv"],
    ["evaluate", "log", "logs", "--reference", "review"],
    ["review", "logs", "--save", "out/day.rrd"],
    ["export", "logs", "-o", "out/clips", "--format", "wav"],
    ["models", "list"],
    ["doctor", "logs", "left"],
]
READING_OF_HOMES = [
    ["models", "show", "champion"],
    ["review", "logs", "--groups", "logs/groups.safetensors", "--save", "out/groups.rrd"],
    ["config", "--config", CONFIGURATION],
    ["alerts", "replay", "logs", "--config", CONFIGURATION, "--start", "2026-03-01T06:59:00"],
    ["doctor", "home"],
]


@pytest.fixture
def home(version, tmp_path, monkeypatch) -> Path:
    """A copy of a home, as the current folder; private, which Git does not keep."""
    folder = tmp_path / "home"
    shutil.copytree(version, folder, symlinks=True)
    for path in folder.rglob("*"):
        if not path.is_symlink():
            path.chmod(0o700 if path.is_dir() else 0o600)
    (folder / "out").mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.delenv("HEARTHLOG_MODEL")
    return folder


@pytest.fixture
def run(capfd):
    """Run a command that must succeed; return its result."""

    def run(*arguments: object) -> Result:
        done = run_here(capfd, *arguments)
        assert done.returncode in {0, 3}, done
        return done

    return run


def contents(folder: Path) -> dict[str, tuple[str, int]]:
    """Return digest and time of each file that a version wrote."""
    return {
        str(path.relative_to(folder)): (
            hashlib.sha256(path.read_bytes()).hexdigest(),
            path.stat().st_mtime_ns,
        )
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.relative_to(folder).parts[0] != "out"
    }


@of_every_version
def test_all_of_a_home_is_read_and_nothing_is_written_anew(home, run):
    before = contents(home)
    for arguments in [*READING, *(READING_OF_HOMES if CONFIGURATION.exists() else [])]:
        warnings = run(*arguments).stderr
        assert not re.search("damaged|newer|cannot|version", warnings), (arguments, warnings)
        assert contents(home) == before, arguments


@of_every_version
def test_the_doctor_finds_nothing_but_the_gaps_that_were_recorded(home, run):
    found = json.loads(run("doctor", "logs", "--json").stdout)["findings"]
    assert {each["rule"] for each in found} == {"gap"}
    for folder in {"home"} & {path.name for path in home.iterdir()}:
        assert run("doctor", folder).returncode == 0


@of_every_home
@pytest.mark.usefixtures("home")
def test_a_configuration_is_accepted_and_each_line_about_it_names_an_end(run):
    done = run("config", "check", CONFIGURATION)
    assert done.stdout == f"{CONFIGURATION}: valid\n"
    assert done.stderr.count("\n") == 1
    assert "home.prom; write readable_by" in done.stderr
    assert "hearthlog 0.4.0 will use" in done.stderr


@of_every_home
@pytest.mark.usefixtures("home")
def test_names_of_recurring_sounds_and_earlier_champions_are_known(run):
    before = contents(Path("logs"))
    groups = json.loads(run("discover", "logs", "--json").stdout)["groups"]
    assert [each["name"] for each in groups] == ["", "bell"]
    after = contents(Path("logs"))
    last_run = "groups.safetensors.json"
    assert {name for name in after if after[name] != before.get(name)} <= {last_run}
    assert "smoothed" in run("models", "rollback").stdout
    assert Path("models/champion.safetensors").readlink() == Path("smoothed.safetensors")


@of_every_home
@pytest.mark.usefixtures("home")
def test_a_bridge_goes_on_with_its_totals_and_delivers_no_alert_twice(broker):
    before, token = entries(Path("bridge")), Path("bridge/page-token").read_text()
    (waiting,) = (json.loads(before[name]) for name in before if name.startswith("outbox/"))
    figures = Path("home.prom")
    with server() as (one, delivered), server() as (two, waiting_target):
        write_secrets(one, two)
        with following("2026-03-01T23:20:00", broker.port) as bridge:
            wait_for(lambda: waiting_target, what=lambda: bridge.problems)
            wait_for(lambda: not bridge.state.names("outbox/"))
            wait_for(figures.exists)
            wait_for(lambda: "hearthlog_events_total{" in figures.read_text())
            families = list(text_string_to_metric_families(figures.read_text()))
    assert delivered == []
    assert len(waiting_target) == 1
    assert waiting["text"] in waiting_target[0]
    samples = (sample for family in families for sample in family.samples)
    totals = [
        [each.labels["microphone"], each.labels["label"], each.value]
        for each in samples
        if each.name == "hearthlog_events_total"
    ]
    assert totals == [each[:3] for each in json.loads(before["totals"])["totals"]]
    after = entries(Path("bridge"))
    assert after["totals"] == before["totals"]
    assert Path("bridge/page-token").read_text() == token
    assert not [line for line in bridge.problems if "damaged" in line or "twice" in line]


@of_every_version
def test_the_recorder_completes_what_a_killed_one_left_and_goes_on(home, run):
    (left,) = find_logs(Path("left"))
    (finished,) = Path("logs").rglob("*T070000Z.mcap")
    for path in Path("logs").rglob("*T070000Z.*"):
        path.unlink()
    shutil.move(left, finished.parent)
    before = contents(home)
    rng = np.random.default_rng(1)
    soundfile.write("out/room.wav", rng.normal(0, 0.001, 48_000), 16_000)
    is_home = CONFIGURATION.exists()
    about = ["--config", CONFIGURATION] if is_home else ["--model", "models/smoothed.safetensors"]
    run("record", "out/room.wav", "--start", "2026-03-01T08:30:00", "--name", "hall", *about)
    logs = [path for path in find_logs(Path("logs")) if not is_layer(path)]
    assert finished in logs
    assert [path.suffix for path in logs] == 3 * [".mcap"]
    info = read_columns([logs[-1]], ["/hall/info"])["/hall/info"]
    assert list(info["model"]) == ["adapted" if is_home else "smoothed"]
    found = json.loads(run("doctor", "logs", "--json").stdout)
    assert {each["rule"] for each in found["findings"]} == {"gap"}
    after = contents(home)
    assert [name for name in before if after.get(name) != before[name]] == [
        str(finished.parent / left.name)
    ]


@of_every_home
@pytest.mark.usefixtures("home")
def test_a_log_of_a_later_version_says_which_release_reads_it(run):
    path = next(log for log in find_logs(Path("logs")) if not is_layer(log))
    log = Log(path)
    log.metadata("hearthlog").metadata |= {"schema_version": str(NEXT), "version": LATER}
    log.write(path)
    (line,) = run("cat", path, "--topics", "/hall/segment").stderr.splitlines()
    assert line.startswith(f"hearthlog: {path}: is of schema version '{NEXT}'")
    assert line.endswith(f"what is newer in it is not read; update hearthlog to {LATER} or later")


@of_every_home
@pytest.mark.usefixtures("home")
def test_a_model_of_a_later_version_is_refused_with_its_release(capfd):
    path = Path("models/smoothed.safetensors")
    data = path.read_bytes()
    size = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:size])
    about = json.loads(header["__metadata__"]["hearthlog"])
    del header["__metadata__"]["sha256"]
    about |= {"format": 99, "versions": {"hearthlog": LATER}}
    header["__metadata__"]["hearthlog"] = json.dumps(about)
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data[size:])
    done = run_here(capfd, "models", "show", "smoothed")
    assert done.returncode == 1
    assert done.stderr.endswith(
        f"is of format 99, newer than this version of hearthlog; update hearthlog to {LATER} or "
        "later\n"
    )


@of_every_home
@pytest.mark.parametrize(
    ("writer", "advice"),
    [(LATER, f"update hearthlog to {LATER} or later"), ("\x1b", "update hearthlog"), ("", "")],
    ids=["its release", "nonsense", "no release"],
)
def test_a_state_of_a_later_version_is_refused_and_stays(home, writer, advice):
    path = Path("bridge/state.sqlite3")
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 99")
        if writer:
            database.execute("CREATE TABLE writer (hearthlog TEXT NOT NULL)")
            database.execute("INSERT INTO writer VALUES (?)", (writer,))
        database.commit()
    before = contents(home)
    with pytest.raises(BridgeError) as refused:
        BridgeState(Path("bridge"), "home", pytest.fail).claim(Path("logs"))
    assert f"later version of hearthlog; {advice or 'update hearthlog'}, or name" in str(
        refused.value
    )
    assert contents(home) == before


def test_a_new_state_names_the_release_that_a_later_format_will_need(tmp_path):
    with closing(BridgeState(tmp_path, "home", pytest.fail)) as state:
        state.write("rules", "{}")
    with closing(sqlite3.connect(tmp_path / "state.sqlite3")) as database:
        assert database.execute("SELECT hearthlog FROM writer").fetchall() == [(__version__,)]


@of_every_home
@pytest.mark.parametrize(
    "key", ["dream_of = 'sheep'\n", "[bridge.page]\ndream_of = 'sheep'\n"], ids=["top", "table"]
)
@pytest.mark.usefixtures("home")
def test_a_key_of_a_later_version_is_refused_with_this_release(capfd, key):
    text = CONFIGURATION.read_text()
    text = text.replace("[bridge.page]\n", key) if key[0] == "[" else key + text
    CONFIGURATION.write_text(text)
    done = run_here(capfd, "config", "check", CONFIGURATION)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "dream_of'" in done.stderr
    assert f"hearthlog {__version__}\n" in done.stderr
