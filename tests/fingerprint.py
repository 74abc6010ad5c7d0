"""Hashes of all that hearthlog makes of real sound, to be compared before and after a change.

    python tests/fingerprint.py CLIPS --command "hearthlog" > before.txt

runs the verbs on a folder of labelled clips and prints one line for every topic of every log and
layer, array of a model, page and table. It reads them with mcap and rosbags alone, field by field:
what is appended to a message is not hashed unless both sides have it, and whatever names the
version, or the time and the folder of the run, is left out.
"""

import argparse
import csv
import hashlib
import json
import re
import shlex
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from safetensors.numpy import load_file

_START = "2026-03-01T07:00:00"
_CLIPS_PER_CLASS = 24
_HEADER = ("classes", "scenario", "cost", "gamma", "inverse_temperature", "smoothing", "metrics")
_NOT_FIELDS = {"__msgtype__", "made"}  # a mark says when it was made
# What differs from run to run, or is not the content: versions, digests, times, folders.
_NOT_CONTENT = re.compile(
    r"\b(\d+\.\d+\.\d+|[0-9a-f]{12,64}|\d+\.\d+ MB)\b|\"took_seconds\": [\d.e-]+"
)


def main() -> None:
    """Run everything and print the hashes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clips", type=Path, help="folder of a manifest.csv")
    parser.add_argument("--command", default="hearthlog")
    parser.add_argument("--folder", type=Path, required=True, help="new folder to work in")
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    texts = run_verbs(shlex.split(options.command), options.clips.resolve(), options.folder)
    lines = [f"{digest(text)}  stdout of {name}" for name, text in texts.items()]
    for path in sorted(options.folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(options.folder)
            lines += [f"{value}  {name} {part}" for part, value in parts_of(path)]
    sys.stdout.write("\n".join(lines) + "\n")


def run_verbs(command: list[str], clips: Path, folder: Path) -> dict[str, str]:
    """Train, record, mark, relabel, adapt, compare, report; return what was printed."""
    manifest, sounds, others = _divide(clips, folder)
    labels = folder / "labels.txt"
    labels.write_text("2.0\t9.0\tspeech\n11.0\t14.5\tcoughing\n30.0\t33.0\tsilence\n")
    texts = {}

    def run(name: str, *arguments: object) -> None:
        words = [*command, *map(str, arguments)]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode not in {0, 3}:
            sys.exit(f"{name}: {done.stderr}")
        texts[name] = f"{done.returncode}\n{done.stdout}"

    scenario = ("--data", manifest, "--scenario", "general")
    run("train", "train", *scenario, "-o", "general.safetensors")
    merging = ("--cost", 1, "--smoothing", "merge")
    run("train merging", "train", *scenario, "-o", "merging.safetensors", *merging)
    run("train paper", "train", *scenario, "-o", "paper.safetensors", "--method", "paper")
    start = ("--start", _START, "-o", "logs", "--keep-audio", "events")
    run("record", "record", *sounds, *start, "--model", "general.safetensors", "-d", 300)
    run("annotate", "annotate", "import", "logs", labels)
    run("relabel", "relabel", "logs", "--model", "merging.safetensors")
    adapted = ("--base", "general.safetensors", "--home", "logs", "-o", "home.safetensors")
    run("adapt", "train", *adapted)
    run("replay", "replay", "logs", "--json")
    run("replay merging", "replay", "logs", "--model", "merging.safetensors", "-o", "again")
    by_paper = ("-o", "paper", "--model", "paper.safetensors")
    run("record paper", "record", *sounds, *start[:2], *by_paper)
    run("replay paper", "replay", "paper", "--json")
    run("diff", "diff", "logs", "live", "merging", "--json")
    run("queue", "diff", "logs", "live", "--queue", "--list", "queue.csv")
    run("report", "report", "logs", "--day", "2026-03-01", "-o", "day.html")
    run("evaluate log", "evaluate", "log", "logs", "--reference", "review", "--json")
    run("evaluate model", "evaluate", "model", "general.safetensors", "--data", others)
    run("compare", "models", "compare", "general", "merging", "--data", others, "--folder", ".")
    run("export", "export", "logs", "-o", "labels.csv", "--topics", "/mic/label")
    run("segments", "cat", "logs", "--topics", "/mic/segment", "--format", "ndjson")
    run("doctor", "doctor", "logs")
    return texts


def _divide(clips: Path, folder: Path) -> tuple[Path, list[Path], Path]:
    """Make a manifest to learn from, a list of sounds to record, and a manifest to score on."""
    by_label = defaultdict(list)
    with (clips / "manifest.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            by_label[row["label"]].append({**row, "path": str(clips / row["path"])})
    learn = [row for rows in by_label.values() for row in rows[::2][:_CLIPS_PER_CLASS]]
    rest = [row for rows in by_label.values() for row in rows[1::2][:_CLIPS_PER_CLASS]]
    sounds = [Path(row["path"]) for row in rest[::2]]
    return _manifest(folder / "learn.csv", learn), sounds, _manifest(folder / "rest.csv", rest)


def _manifest(path: Path, rows: list[dict[str, str]]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def parts_of(path: Path) -> list[tuple[str, str]]:
    """Hash the parts of a file that are its content."""
    if path.suffix == ".mcap":
        return topics_of(path)
    if path.suffix == ".safetensors":
        arrays = load_file(path)
        hashes = [(name, digest_bytes(_bits(arrays[name]))) for name in sorted(arrays)]
        with path.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            header = json.loads(json.loads(stream.read(length))["__metadata__"]["hearthlog"])
        header |= header.get("parameters", {})
        kept = {key: header[key] for key in _HEADER if key in header}
        return [*hashes, ("header", digest(json.dumps(kept, sort_keys=True)))]
    if path.suffix in {".csv", ".html", ".txt", ".json"}:
        return [("", digest(path.read_text()))]
    if path.suffix == ".png":
        return [("", digest_bytes(path.read_bytes()))]
    return []


def topics_of(path: Path) -> list[tuple[str, str]]:
    """Hash the messages of each topic, field by field, with their log times."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    hashes: dict[str, Any] = defaultdict(hashlib.sha256)
    counts: dict[str, int] = defaultdict(int)
    names = set()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            if schema.name not in names:
                names.add(schema.name)
                types = get_types_from_msg(schema.data.decode(), schema.name)
                store.register({k: v for k, v in types.items() if k not in store.fielddefs})
            content = store.deserialize_cdr(message.data, schema.name)
            counts[channel.topic] += 1
            hashes[channel.topic].update(b"%d" % message.log_time + _field_bits(content))
    return [(f"{topic} x{counts[topic]}", h.hexdigest()[:16]) for topic, h in hashes.items()]


def _field_bits(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        return _bits(value)
    if isinstance(value, list):
        return b"".join(map(_field_bits, value))
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is None:
        text = _NOT_CONTENT.sub("*", value) if isinstance(value, str) else repr(value)
        return text.encode() + b"\0"
    return b"".join(
        name.encode() + _field_bits(getattr(value, name))
        for name in fields
        if name not in _NOT_FIELDS
    )


def _bits(array: Any) -> bytes:
    return repr(array.shape).encode() + array.dtype.str.encode() + array.tobytes()


def digest(text: str) -> str:
    """Hash a text without what names versions, digests and sizes."""
    return digest_bytes(_NOT_CONTENT.sub("*", text).encode())


def digest_bytes(data: bytes) -> str:
    """Return the first half of a SHA-256's hexadecimal form, shortened to be read."""
    return hashlib.sha256(data).hexdigest()[:16]


if __name__ == "__main__":
    main()
