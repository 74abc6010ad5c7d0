"""Standard output without room, without a reader, or closed: one line or none, whatever prints."""

import os
import subprocess
from pathlib import Path

import pytest
from conftest import HEARTHLOG
from log_fixtures import record_logs

VERBS = {
    "help": "--help",
    "info": "info LOGS",
    "info as JSON": "info LOGS --json",
    "cat": "cat LOGS",
    "cat as CSV": "cat LOGS --format csv --topics /mic/label",
    "doctor as JSON": "doctor LOGS --json",
    "diff": "diff LOGS live again",
    "evaluate": "evaluate log LOGS --reference LABELS",
    "models": "models show again --folder MODELS",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory, day, model_file):
    """Run a verb that prints results of logs with gaps; return its exit status and what it says."""
    folder = tmp_path_factory.mktemp("printed")
    places = {
        "LOGS": record_logs([day], folder / "logs", model_file),
        "LABELS": folder / "labels.txt",
        "MODELS": folder / "models",
    }
    places["LABELS"].write_text("1.0\t5.0\tspeech\n")
    places["MODELS"].mkdir()
    (places["MODELS"] / "again.safetensors").symlink_to(model_file)
    model = folder / "again.safetensors"
    model.write_bytes(model_file.read_bytes())
    subprocess.run(
        [*HEARTHLOG, "relabel", places["LOGS"], "--model", model], check=True, capture_output=True
    )

    def run(verb, stdout, *before):
        words = [str(places.get(word, word)) for word in VERBS[verb].split()]
        result = subprocess.run(
            [*before, *HEARTHLOG, *words],
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
            timeout=500,
            check=False,
        )
        return result.returncode, result.stderr

    return run


@pytest.mark.parametrize("verb", VERBS)
def test_results_for_which_there_is_no_room_are_one_line(run, verb):
    with Path("/dev/full").open("w") as full:
        assert run(verb, full) == (
            1,
            "hearthlog: standard output: cannot be written (No space left on device)\n",
        )


@pytest.mark.parametrize("verb", VERBS)
def test_a_reader_who_has_seen_enough_ends_any_verb_quietly(run, verb):
    reader, writer = os.pipe()
    os.close(reader)
    try:
        status, states = run(verb, writer)
    finally:
        os.close(writer)
    assert states == ""
    assert status in {0, run(verb, subprocess.DEVNULL)[0]}  # the latter if all was done by then


def test_closed_output_is_no_error(run):
    assert run("cat", None, "sh", "-c", '"$@" >&-', "sh") == (0, "")
    assert run("info", None, "sh", "-c", '"$@" >&- 2>&-', "sh") == (3, "")
