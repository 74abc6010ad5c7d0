"""The documents agree with the command line, with the files, and with each other."""

import ast
import importlib
import re
import shlex
import shutil
import tomllib
from importlib.resources import files
from itertools import chain, pairwise
from pathlib import Path

import collectionfolders as made
import numpy as np
import pytest
import soundfile
import typer
from log_fixtures import run
from typer.testing import CliRunner

pytest.importorskip("hearthlog.tools.lab.month", reason="the wheel leaves what developers run out")

from hearthlog.analyzer.review.viewer import drawing
from hearthlog.schemas.logs.files import find_logs
from hearthlog.tools.cli.main import make_app
from hearthlog.tools.home.simulate import write_day, write_training_set
from hearthlog.tools.lab.classifiers import classifiers as compare_classifiers
from hearthlog.tools.lab.home.__main__ import home as simulate_home
from hearthlog.tools.lab.month.__main__ import month as simulate_month
from hearthlog.tools.lab.pictures.__main__ import outdated
from hearthlog.tools.lab.pictures.__main__ import pictures as make_pictures
from hearthlog.tools.lab.routine import main as judge_routines

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path
    for path in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("examples/**/*.md")]
    if not path.is_symlink()
)
TEXT = "\n".join(path.read_text("utf-8") for path in PAGES)
CODE = re.compile(r"^(?P<fence>```)(?P<language>\w*)\n(?P<fenced>.*?)^```|`(?P<inline>[^`\n]+)`|"
                  r"^ {4}(?P<indented>\S[^\n]*)$", re.DOTALL | re.MULTILINE)  # fmt: skip
# Options of dask, rerun, mcap and systemd that pages name alone.
FOREIGN = {"--host", "--dashboard-address", "--no-dashboard", "--nworkers", "--nthreads"} | {
    "--memory-limit",
    "--base-paths",
}
# What is in a code block and cannot run here: it wants a microphone, a screen, a cluster, a bucket,
# a second program, or sound of many collections.
NOT_HERE = re.compile(
    r"hearthlog( record( --model \S+)?( --keep-audio \w+)?( --config \S+)?$| devices| watch| demo"
    r"| models fetch yamnet| install-service| setup| bridge|.*--start 2026-03-10 "
    r"|.* s3://|.*tcp:|.* --web"
    r"|.* --microphone USB|.* --folds collection| discover| voices|.* speakers |.* mood.toml"
    r"|.* --live|.*octaves|.*--method (plp|speech-embedding|logistic|forest) |.*--queue spans.csv$"
    r"| review(?!.* --save))"
)


def commands(command, name=()):
    """Every verb, by its words, and the command itself."""
    yield name, command
    for word, verb in getattr(command, "commands", {}).items():
        yield from commands(verb, (*name, word))


VERBS = dict(commands(typer.main.get_command(make_app())))
LEAVES = {name: verb for name, verb in VERBS.items() if not hasattr(verb, "commands")}


def options_of(verb):
    """The long options of a verb, without those that are hidden, and --help."""
    shown = [one for one in verb.params if not getattr(one, "hidden", False)]
    names = {name for one in shown for name in one.opts if name.startswith("--")}
    return names - {"--help"}


DEVELOPERS = typer.Typer()  # what is no verb
DEVELOPERS.command()(simulate_home)
DEVELOPERS.command()(simulate_month)
DEVELOPERS.command()(judge_routines)
DEVELOPERS.command()(compare_classifiers)
DEVELOPERS.command()(make_pictures)
OPTIONS = {
    name
    for verb in (*VERBS.values(), *typer.main.get_command(DEVELOPERS).commands.values())
    for name in options_of(verb)
} | {"--help"}


def snippets(text):
    """What a page has in code: whole lines of blocks, and words within sentences."""
    for match in CODE.finditer(text):
        if match["fenced"] is not None:
            if match["language"] not in {"python", "xml", "toml", "sql"}:
                yield from match["fenced"].splitlines()
        else:
            yield match["inline"] or match["indented"]


def shown_commands(text):
    """The commands of hearthlog in the code blocks of a page."""
    for match in CODE.finditer(text):
        for line in (match["fenced"] or match["indented"] or "").splitlines():
            command = re.split(r"\s{2,}| # | > | \| (?=\w)", line.strip())[0]
            if re.match(r"(\w+=\S+ )*(\.venv/bin/)?hearthlog ", line):
                yield re.sub(r"^(\w+=('[^']*'|\S+) )*(\.venv/bin/)?", "", command)


SHOWN = sorted({line for path in PAGES for line in shown_commands(path.read_text("utf-8"))})


def unknown_options(text):
    """Options that pages name and no verb has."""
    codes = (code.removeprefix("sudo ") for code in snippets(text))
    ours = [code for code in codes if re.match(r"(hearthlog|make|-|[a-z ]+ -)", code)]
    named = {name for code in ours for name in re.findall(r"(?<![\w-])--[a-z][a-z-]*", code)}
    others = {
        "rsync",
        "rerun",
        "dask",
        "ssh",
        "pip",
        "mcap",
        "apt",
        "apt-get",
        "dpkg",
        "systemctl",
        "useradd",
        "docker",
        "pactl",
        "podman",
    }
    foreign = {
        name
        for code in ours
        if code.split()[0] in others
        for name in re.findall(r"--[a-z][a-z-]*", code)
    }
    return named - foreign - OPTIONS - FOREIGN


def unknown_verbs(text):
    """Verbs behind `hearthlog` that there are none of."""
    unknown = set()
    for code in snippets(text):
        for words in re.findall(r"\bhearthlog ((?:[a-z-]+ ?)+)", code):
            group, *rest = words.split()
            if group.startswith("-"):
                continue
            if (group,) not in VERBS:
                unknown.add(group)
            elif rest and rest[0].startswith("-"):
                continue
            elif (group,) not in LEAVES and rest and (group, rest[0]) not in VERBS:
                unknown.add(f"{group} {rest[0]}")
    return unknown


def unknown_targets(text):
    """Targets of make that pages name and the Makefile does not have."""
    targets = re.findall(r"^([\w.-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    named = {name for code in snippets(text) for name in re.findall(r"^make ([\w.-]+)", code)}
    return named - set(targets)


def anchors(path):
    """The places of a page that links lead to."""
    titles = re.findall(r"^#+ (.*)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def broken_links(path, text):
    """Links of a page to files and titles that are not there."""
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(CODE, "", text)):
        name, _, anchor = target.partition("#")
        if "://" in target:
            continue
        file = (path.parent / name).resolve() if name else path
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    return broken


def missing_paths(text):
    """Files, folders, modules and names of ours that pages speak of and that are not there."""
    folders = r"(?:analyzer|models|recorder|schemas|tools|tests|docs|examples)/[\w./*-]*"
    missing = [
        path
        for path in re.findall(rf"`({folders})`", text)
        if re.search(r"[a-z_]{2,}/|\.\w+$", path) and not list(ROOT.glob(path.rstrip("/")))
        if not path.endswith((".safetensors", ".mcap"))
    ]
    outside = re.sub(r"^```toml\n.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    names = set(re.findall(r"(?<!/)\bhearthlog(?:\.[a-z_]\w*)+(?:\.[A-Z]\w*)?", outside))
    return missing + [name for name in sorted(names) if not is_importable(name)]


def is_importable(name):
    """Whether a dotted name is a module, or something in one."""
    module, *rest = [name]
    while module.count(".") >= 0:
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            rest.insert(0, last)
            if not module:
                return False
            continue
        for part in rest:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


@pytest.mark.parametrize("verb", LEAVES, ids=" ".join)
def test_a_verb_and_its_options_are_documented(verb):
    assert f"hearthlog {' '.join(verb)}" in TEXT
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", TEXT))
    assert options_of(LEAVES[verb]) - named == set()


def test_the_options_of_the_command_itself_are_documented():
    assert options_of(VERBS[()]) == {
        "--version",
        "--debug",
        "--install-completion",
        "--show-completion",
    }
    for name in options_of(VERBS[()]):
        assert name in TEXT


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_page_speaks_of_what_there_is(path):
    text = path.read_text("utf-8")
    history = path.name == "CHANGELOG.md"  # which names what was
    assert (unknown_verbs(text) | unknown_options(text)) == set() or history
    assert unknown_targets(text) == set()
    assert broken_links(path, text) == []
    assert missing_paths(text) == []


def test_what_is_wrong_in_a_page_is_noticed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A title\n")
    assert unknown_verbs("`hearthlog sing`, `hearthlog evaluate song`") == {"sing", "evaluate song"}
    assert unknown_options("    hearthlog info logs --louder\n\n`--softer`") == {
        "--louder",
        "--softer",
    }
    assert unknown_targets("    make tea\n\n`make check`") == {"tea"}
    text = "[a](page.md#a-title) [b](page.md#b-title) [c](gone.md) [d](https://example.org)"
    assert broken_links(page, text) == ["page.md#b-title", "gone.md"]
    text = "`schemas/gone.py` `docs/log.md` `hearthlog.schemas.frames` `hearthlog.schemas.gone.f`"
    assert missing_paths(text) == ["schemas/gone.py", "hearthlog.schemas.gone.f"]


@pytest.mark.parametrize("command", SHOWN)
def test_a_command_that_is_shown_can_be_parsed(command):
    words = shlex.split(command.replace("…", "logs"))[1:]
    verb, name = VERBS[()], ()
    while (*name, *words[:1]) in VERBS and words:
        name, words = (*name, words[0]), words[1:]
        verb = VERBS[name]
    assert name in LEAVES or words[0].startswith("--")
    verb.make_context("hearthlog", words)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_what_an_example_imports_is_there(path):
    for match in CODE.finditer(path.read_text("utf-8")):
        if match["language"] != "python":
            continue
        for node in ast.parse(match["fenced"]).body:
            if isinstance(node, ast.ImportFrom) and node.module.startswith("hearthlog"):
                module = importlib.import_module(node.module)
                assert all(hasattr(module, one.name) for one in node.names)


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder that has what the documents name: sounds, models, logs, layers, label files."""
    folder = tmp_path_factory.mktemp("documented")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        make_home(folder)
    return folder


def make_home(folder):
    write_training_set(folder / "clips", clips_per_class=3, seed=1)
    rows = (folder / "clips" / "manifest.csv").read_text()
    (folder / "clips" / "test.csv").write_text(rows)
    head, *lines = rows.splitlines()
    (folder / "MANIFEST.csv").write_text(
        "\n".join([head, *(f"clips/{line}" for line in lines)]) + "\n"
    )
    do("train --data clips --scenario general -o general.safetensors")
    write_day(folder / "day.flac", 2, seed=2, manifest=None)
    cough = next((folder / "clips" / "coughing").iterdir())
    hours = ("20260301_070000.WAV", "20260301_080000.WAV")
    for name in ("cough.flac", "cough.wav", "anna.wav", "a.wav", "b.flac", *hours):
        do_copy(cough, folder / name)
    (folder / "card").mkdir()
    do_copy(cough, folder / "card" / "01-03-2026_07h00.wav")
    (folder / "models").mkdir()
    for name in ("general-1", "general-2", "new", "home", "home-1"):
        shutil.copy("general.safetensors", f"{name}.safetensors")
        shutil.copy("general.safetensors", f"models/{name}.safetensors")
    do("train --data clips --scenario general --cost 2 -o models/home-2.safetensors")
    do("models promote general-1 --anyway")
    do("models promote general-2")
    do("models promote home-2 --to candidate")
    recorded = "record day.flac --model models/home.safetensors --start 2026-03-01T06:59 -o logs"
    do(f"{recorded} --scenario water=bathroom")
    do("models promote general-1 --to candidate")
    for model in ("general-2", "new"):
        do(f"relabel logs --model {model}.safetensors")
    (folder / "home.toml").write_text(
        'node = "home"\n[[bridge.alert]]\nname = "coughs"\nrule = "more_than"\nclass = "coughing"\n'
        'count = 3\nwindow = "2h"\n[bridge.mqtt]\nhost = "127.0.0.1"\n'
    )
    (folder / "labels.txt").write_text("2.0\t9.0\tspeech\n11.0\t14.5\tcoughing\n")
    for name in ("day.txt", "ten.txt"):
        shutil.copy("labels.txt", name)
    (folder / "water.txt").write_text("2.0\t9.0\ttap_water\n")
    write_foreign_labels(folder)
    do("annotate import logs labels.txt")
    do("annotate import logs water.txt --scenario water")
    shutil.copytree("logs", "homes/anna")
    made.write_esc50(folder / "ESC-50-master")
    made.write_fsd50k(folder / "FSD50K")
    made.write_urbansound8k(folder / "UrbanSound8K")
    made.write_desed(folder / "DESED")
    made.write_vocalsound(folder / "vocalsound")
    made.write_audioset_strong(folder / "AudioSet")
    made.write_ravdess(folder / "RAVDESS")
    made.write_emodb(folder / "EmoDB")
    made.write_voxceleb(folder / "VoxCeleb")
    for number, clip in enumerate(sorted((folder / "clips").glob("*/*.flac"))):
        place = folder / "mine" / clip.parent.name / f"room {number}" / "1.flac"
        place.parent.mkdir(parents=True)
        shutil.copy(clip, place)
    for words in ("esc50 ESC-50-master", "fsd50k FSD50K", "vocalsound vocalsound", "folder mine"):
        name = words.split()[0].replace("folder", "mine")
        do(f"manifest {words} -o {name}.csv")
    shutil.copy(files("hearthlog.analyzer.collections") / "maps" / "fsd50k.toml", "map.toml")
    log = min(find_logs(folder / "logs"))
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(log, name)
    (folder / "damaged.mcap").write_bytes(log.read_bytes()[:-5000])


def write_foreign_labels(folder):
    """Write label files of other programs, and what their labels mean."""
    (folder / "labels.toml").write_text('Cough = "coughing"\nSPEAKER_00 = "speech"\n')
    (folder / "noises.txt").write_text("2,0\t9,0\tCough\n")
    (folder / "day.BirdNET.results.csv").write_text(
        "Start (s),End (s),Scientific name,Common name\n2,5,,Cough\n"
    )
    (folder / "regions.csv").write_text("2.0,1,7.0,speech\n")
    (folder / "day.rttm").write_text("SPEAKER day 1 2.0 7.0 <NA> <NA> SPEAKER_00 <NA> <NA>\n")
    times = "".join(
        f'<TIME_SLOT TIME_SLOT_ID="t{time}" TIME_VALUE="{time}000"/>' for time in (2, 9)
    )
    (folder / "sounds.eaf").write_text(
        f"<ANNOTATION_DOCUMENT><TIME_ORDER>{times}</TIME_ORDER>"
        '<TIER TIER_ID="sounds"><ANNOTATION><ALIGNABLE_ANNOTATION ANNOTATION_ID="a" '
        'TIME_SLOT_REF1="t2" TIME_SLOT_REF2="t9"><ANNOTATION_VALUE>speech</ANNOTATION_VALUE>'
        "</ALIGNABLE_ANNOTATION></ANNOTATION></TIER></ANNOTATION_DOCUMENT>"
    )


def do_copy(source, target):
    samples, rate = soundfile.read(source)
    soundfile.write(target, np.tile(samples, 3)[: 4 * rate], rate)


def do(words):
    result = CliRunner().invoke(make_app(), shlex.split(words))
    assert result.exit_code in {0, 3}, f"{words}: {result.output} {result.exception}"


@pytest.mark.parametrize("command", [line for line in SHOWN if not NOT_HERE.match(line)])
def test_a_command_that_is_shown_can_be_run(home, command, tmp_path, monkeypatch, capfd):
    shutil.copytree(home, tmp_path / "copy", symlinks=True)
    monkeypatch.chdir(tmp_path / "copy")
    words = shlex.split(command)[1:]
    if words[0] == "record" and "-o" not in words:
        shutil.rmtree("logs")
    for word, following in pairwise(words):
        if word in {"-o", "--output", "--save", "--list", "--plot"}:
            place = Path(following)
            if place.is_dir():
                shutil.rmtree(place)
            place.unlink(missing_ok=True)
    result = run(capfd, *words)
    assert result.returncode in {0, 3}, result.stderr
    assert "Traceback" not in result.stderr


def test_most_of_the_shown_commands_are_run():
    skipped = [line for line in SHOWN if NOT_HERE.match(line)]
    assert len(skipped) < len(SHOWN) / 2


def contributions():
    """Yield what each row of the table of changes adds, and the files that it names."""
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("| to add |")[2]
    for row in table.partition("\n\n")[0].splitlines()[2:]:
        what, *cells = (cell.strip() for cell in row.strip("|").split("|"))
        path = re.compile(r"`([\w./-]+/[\w./-]*)`( or)?")
        yield what, [path.findall(cell) for cell in cells]


@pytest.mark.parametrize(("what", "paths"), [*contributions()])
def test_a_typical_change_touches_at_most_three_files_that_exist(what, paths):
    *changed, tested = paths
    assert 1 <= sum(not other for _, other in chain(*changed)) <= 3, "of alternatives, one"
    assert tested
    for path, _ in chain(*paths):
        assert (ROOT / path).exists(), f"{what}: {path}"


REPORTS = {"error", "warning", "rows", "report", "_report", "_error", "_check_array"}


def doctor_rules():
    """The rules of findings in the code: first arguments of what reports a finding."""
    for path in sorted((ROOT / "analyzer/doctor").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and node.args:
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                rule = getattr(node.args[0], "value", None)
                if name in REPORTS and isinstance(rule, str):
                    yield rule


def test_every_rule_of_the_doctor_has_a_row_in_its_page():
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs/doctor.md").read_text(), re.MULTILINE)
    documented = {rule for row in rows for rule in re.findall("`([a-z0-9-]+)`", row)}
    rules = {*doctor_rules()}
    assert len(rules) > 50
    assert rules <= documented, rules - documented


def rooms():
    """Yield package and line of each room in the table of the design."""
    package = ""
    table = (ROOT / "docs" / "design.md").read_text().partition("| package | room |")[2]
    for line, row in enumerate(table.partition("\n\n")[0].splitlines()[2:]):
        name, own, _ = (cell.strip() for cell in row.strip("|").split("|", 2))
        package = name.strip("`") or package
        for room in re.findall("`([^`]+)`", own):
            yield package, room, line


def layers():
    """Yield package and layer of each room in the import contracts."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    for contract in contracts["contracts"]:
        for package in contract.get("containers", ()):
            for layer, own in enumerate(contract["layers"]):
                for room in own.split(" | "):
                    yield package.removeprefix("hearthlog."), room, layer


def test_the_design_names_every_room_in_the_order_of_the_import_contracts():
    lines = {(package, room): line for package, room, line in rooms()}
    for package in dict.fromkeys(package for package, _ in lines):
        own = {room for other, room in lines if other == package}
        entries = [*(ROOT / package).iterdir()]
        folders = {each.name for each in entries if each.is_dir()} - {"__pycache__"}
        modules = {each.stem for each in entries if each.suffix == ".py"} - {"__init__"}
        assert own == {name for name in folders | modules if not name.startswith(".")}, package
        order = [(layer, room) for other, room, layer in layers() if other == package]
        placed = [lines[package, room] for _, room in sorted(order)]
        assert placed == sorted(placed), f"{package}: {order}"


def test_the_pictures_show_the_program_of_today():
    lines = outdated(ROOT)
    if lines:
        pytest.fail("\n".join(lines), pytrace=False)


def test_a_picture_is_older_than_what_it_shows_once_that_is_drawn_otherwise(monkeypatch):
    monkeypatch.setattr(drawing, "_THICKNESS", 99.0)
    reviews = "review-day", "first-evening-review", "first-evening-queue"
    text = "shows an earlier program: run `make pictures`"
    assert outdated(ROOT) == [f"docs/images/{name}.png {text}" for name in reviews]
