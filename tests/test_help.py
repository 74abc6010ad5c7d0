"""The command says what it is, what its options are, and what is missing where it cannot run."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from hearthlog import __version__
from hearthlog.analyzer.errors import missing
from hearthlog.recorder.config import Settings
from hearthlog.tools.cli.main import PANELS, make_app

_WIDE = {"COLUMNS": "300", "TERMINAL_WIDTH": "300"}
_TRAIN = ("train", "--data", "none", "--scenario", "general", "-o", "made.safetensors")
_WAYS = ("log", "model", "scenes", "method")
_HEAVY = {"numpy", "rosbags", "mcap", "soundfile", "sounddevice"}


def commands(command, name=()):
    """Every verb, by its words, and the command itself."""
    yield name, command
    for word, verb in getattr(command, "commands", {}).items():
        yield from commands(verb, (*name, word))


def test_help_before_a_verb_lists_all_of_them(hearthlog):
    assert hearthlog("--help", "discover").stdout == hearthlog("--help").stdout


VERBS = dict(commands(typer.main.get_command(make_app())))


def help_of(*verb):
    """What --help says, without frames and line breaks."""
    result = CliRunner().invoke(make_app(), [*verb, "--help"], env=_WIDE)
    assert result.exit_code == 0, result.output
    return " ".join(re.sub("[│╭╮╰╯─]", " ", result.output).split())


def shown_default(option):
    """The default that a verb has, or says that it has, as text."""
    if isinstance(option.show_default, str):
        return option.show_default
    default = option.default
    if callable(default) or default in (None, False, (), []) or not option.show_default:
        return None
    return str(getattr(default, "value", default))


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: " ".join(verb) or "hearthlog")
def test_the_help_of_a_verb_shows_the_defaults_that_it_documents(verb):
    text = help_of(*verb)
    for option in VERBS[verb].params:
        default = shown_default(option)
        if default is not None:
            assert f"[default: {default}]" in text or f"[default: ({default})]" in text
        assert "[" not in (getattr(option, "help", None) or "")  # would be taken for markup


@pytest.mark.parametrize(
    ("verb", "default"),
    [
        ("record", "from their names or metadata, else a guess"),
        ("recover", "LOG.recovered.mcap"),
        ("review", "the login name"),
        ("review", "the zone in the logs, else UTC"),
        ("watch", "the zone in the logs, else UTC"),
        ("models list", "that of the configured model, else models"),
    ],
)
def test_a_default_that_is_found_out_later_is_shown_in_words(verb, default):
    assert f"[default: ({default})]" in help_of(*verb.split())


def test_the_help_of_record_shows_the_defaults_of_the_configuration(monkeypatch):
    for name in [name for name in os.environ if name.upper().startswith("HEARTHLOG_")]:
        monkeypatch.delenv(name)
    text, settings = help_of("record"), Settings()
    for field in ("output", "node", "max_bag_duration", "keep_audio"):
        assert f"[default: ({getattr(settings, field)})]" in text
    assert f"[default: ({settings.microphone[0].name})]" in text


def test_the_version_is_told_and_nothing_is_done(hearthlog, tmp_path):
    result = hearthlog("--version", "record", "-o", tmp_path / "logs")
    assert (result.returncode, result.stdout) == (0, f"hearthlog {__version__}\n")
    assert not (tmp_path / "logs").exists()


def completed(*words):
    """What bash would offer behind these words, by the script that the command gives it."""
    typed = " ".join(f"'{word}'" for word in words)
    script = (
        'eval "$(_HEARTHLOG_COMPLETE=source_bash hearthlog)"\n'
        f"COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}\n"
        '_hearthlog_completion hearthlog; printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    result = subprocess.run(
        ["bash", "-c", script],
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stderr == ""
    return result.stdout.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (
            ("hearthlog", "re"),
            ["record", "resume", "recover", "retain", *["review", "report", "replay", "relabel"]],
        ),
        (("hearthlog", "models", "pro"), ["promote"]),
        (("hearthlog", "evaluate", ""), [*_WAYS]),
        (("hearthlog", "evaluate", "--model", "m", "--he"), ["--help"]),
        (("hearthlog", "evaluate", "method", "--fo"), ["--folds"]),
        (
            ("hearthlog", "record", "--max-bag"),
            ["--max-bag-duration", "--max-bag-files", "--max-bag-size"],
        ),
        (("hearthlog", "cat", "--format", ""), ["text", "ndjson", "csv"]),
    ],
)
def test_bash_completes_verbs_options_and_choices(words, offered):
    assert sorted(completed(*words)) == sorted(offered)


def test_completing_a_word_imports_nothing_that_takes_long():
    code = (
        "import sys\n"
        "from hearthlog.tools.cli.main import main\n"
        "sys.argv = ['hearthlog']\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)\n"
    )
    requested = {"COMP_WORDS": "hearthlog rec", "COMP_CWORD": "1"}
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | requested | {"_HEARTHLOG_COMPLETE": "complete_bash"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.startswith("record\nrecover")
    loaded = set(result.stdout.split())
    assert not loaded & _HEAVY
    packages = tuple(f"hearthlog.{name}" for name in ("analyzer", "recorder", "models"))
    # Names and suffixes, for help texts.
    tables = ("hearthlog.analyzer.marks.formats", "hearthlog.analyzer.export")
    for name in filter(lambda name: name.startswith(packages), loaded):
        assert any(table.startswith(name) for table in tables), name


@pytest.mark.parametrize(
    ("missing", "extra", "verb"),
    [
        ("rerun", "viewer", ("review", "none", "--save", "day.rrd")),
        ("distributed", "cluster", (*_TRAIN, "--scheduler", "tcp://127.0.0.1:1")),
        ("upath", "cluster", ("info", "s3://homes/anna")),
        ("sklearn", "headless", _TRAIN),
    ],
)
def test_what_is_not_installed_is_named_with_a_command_that_installs_it(
    hearthlog, tmp_path, missing, extra, verb
):
    (tmp_path / "sitecustomize.py").write_text(f"import sys\nsys.modules[{missing!r}] = None\n")
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    result = hearthlog(*verb, env={"PYTHONPATH": path})
    assert result.returncode == 1
    assert re.search(rf"; try: \S.* '\S+\[{extra}\]'", result.stderr)
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "verb"),
    [
        ("evaluate --model m.safetensors --data clips", "evaluate model"),
        ("evaluate --data=clips --model=m.safetensors", "evaluate model"),
        ("evaluate logs --reference review", "evaluate log"),
        ("evaluate --data clips --scenario general --folds source", "evaluate method"),
        ("info homes --catalog", "catalog"),
    ],
)
def test_what_a_verb_was_called_before_names_the_verb_of_now(hearthlog, words, verb):
    result = hearthlog(*words.split())
    assert (result.returncode, result.stdout) == (2, "")
    assert f"use `hearthlog {verb} " in result.stderr
    assert result.stderr.count("\n") == 1
    assert tuple(verb.split()) in VERBS


@pytest.mark.parametrize(
    ("words", "module"),
    [
        ("evaluate paper --data clips", "paper"),
        ("evaluate robustness general --data clips", "robustness"),
        ("evaluate search paper --data clips --scenario bathroom", "grid_search"),
        ("evaluate --data clips --scenario general --folds source --search", "grid_search"),
        ("evaluate --data clips --scenario general --adaptation", "adaptation_curve"),
    ],
)
def test_a_verb_that_went_to_the_lab_names_its_module(hearthlog, words, module):
    result = hearthlog(*words.split())
    assert (result.returncode, result.stdout) == (2, "")
    assert f"run `python -m hearthlog.tools.lab.{module} " in result.stderr
    assert result.stderr.count("\n") == 1


def test_the_help_shows_every_verb_in_its_panel():
    shown = CliRunner().invoke(make_app(), ["--help"], env=_WIDE).output
    parts = re.split(r"╭─ ([\w ]+) ─", shown)
    panels = dict(zip(parts[1::2], parts[2::2], strict=True))
    del panels["Options"]
    assert list(panels) == list(PANELS)
    for panel, verbs in PANELS.items():
        first = re.findall(r"^│ ([a-z-]+) ", panels[panel], re.MULTILINE)
        assert sorted(first) == sorted(verb.replace("_", "-") for verb in verbs)


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: " ".join(verb) or "hearthlog")
def test_the_help_names_no_type_of_python_and_breaks_no_sentence(verb):
    shown = CliRunner().invoke(make_app(), [*verb, "--help"], env=_WIDE).output
    assert not re.search(r"<\w+>|list\[|\b(bool|str|int|float|Path)\b  ", shown)
    text = shown.partition("╭")[0]
    lines = [line.rstrip() for line in text.splitlines() if line.strip()][1:]
    assert [line for line in lines if line[-1] not in ".…"] == []


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        (
            {"url": "file:///tmp", "dir_info": {"editable": True}},
            "install --editable '/tmp[headless]'",
        ),
        ({"url": "file:///tmp", "dir_info": {}}, "install '/tmp[headless]'"),
        (
            {"url": "file:///nowhere", "dir_info": {}},
            "install '.[headless]' in a clone of hearthlog",
        ),
        (
            {"url": "https://example.org/h.git", "vcs_info": {"vcs": "git"}},
            "install 'hearthlog[headless] @ git+https://example.org/h.git'",
        ),
        (None, "install '.[headless]' in a clone of hearthlog"),
    ],
)
def test_what_is_missing_is_installed_as_hearthlog_was(origin, command, tmp_path, monkeypatch):
    about = tmp_path / "hearthlog-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hearthlog\nVersion: 1\n")
    if origin is not None:
        (about / "direct_url.json").write_text(json.dumps(origin))
    monkeypatch.syspath_prepend(tmp_path)
    assert missing("sklearn.svm").startswith("scikit-learn is not installed; try: ")
    assert missing("sklearn.svm").endswith(command)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    (tmp_path / "pipx_metadata.json").touch()
    assert "try: pipx install --force " in missing("sklearn")
    (tmp_path / "pipx_metadata.json").rename(tmp_path / "uv-receipt.toml")
    assert "try: uv tool install " in missing("sklearn")
