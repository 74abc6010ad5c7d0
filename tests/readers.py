"""What each reader makes of golden files, in a form that can be compared.

They read `logs`, `left` and `models` in the current folder, and get what runs the command line.
"""

import csv
import json
from collections import Counter
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from grown_schema import plain
from log_fixtures import Result
from logreader import LogReader
from rosbags import rosbag1, rosbag2

from hearthlog.analyzer.marks.marks import read_marks
from hearthlog.analyzer.review.live import LiveTimeline
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.models.modelfile import load_model
from hearthlog.schemas.logs.columns import decode, iterate_columns, read_columns
from hearthlog.schemas.logs.contents import CONTENTS_METADATA
from hearthlog.schemas.logs.files import find_logs, is_layer
from hearthlog.schemas.logs.follow import follow_messages
from hearthlog.schemas.logs.merged_reading import iterate_messages
from hearthlog.schemas.messages import message_types

Run = Callable[..., Result]
_NO_SOUND = ["--topics", "/hall/[!a]*", "--topics", "/[dr]*"]


def by_info(run: Run) -> Any:
    output = json.loads(run("info", "logs", "--json").stdout)
    sizes = {"size_bytes", "compression_ratio", "chunks", "schema_versions"}
    topics = {
        name: (about["type"], about["messages"], round(about["rate_hz"], 9))
        for name, about in output.pop("topics").items()
    }
    output["metadata"] = [each for each in output["metadata"] if each != CONTENTS_METADATA]
    return {key: value for key, value in output.items() if key not in sizes} | {"topics": topics}


def by_cat(run: Run) -> Any:
    lines = run("cat", "logs", "--format", "ndjson").stdout.splitlines()
    return [json.loads(line) for line in lines]


def by_messages(_: Run) -> Any:
    return {
        path.name: [(m.topic, m.log_time, plain(m.decode())) for m in LogReader(path).messages()]
        for path in [*find_logs(Path("logs")), *find_logs(Path("left"))]
    }


def by_columns(_: Run) -> Any:
    read = read_columns(find_logs(Path("logs")))
    for batch in iterate_columns(find_logs(Path("logs"))):
        assert all(columns.fields.keys() == read[columns.topic].fields.keys() for columns in batch)
    return {topic: plain(columns.fields) for topic, columns in read.items()}


def by_follow(_: Run) -> Any:
    frames: Counter[str] = Counter()
    labels = []
    for folder in (Path("logs"), Path("left")):
        followed = follow_messages(folder, start=0, ticks=True)
        for _, messages in takewhile(lambda read, folder=folder: read[0] != folder, followed):
            for columns in decode(messages):
                frames[f"{folder} {columns.topic}"] += len(columns)
                if columns.type == message_types.LABEL:
                    labels += columns["label"].tolist()
    return frames, labels


def by_parquet(run: Run) -> Any:
    run("export", "logs", "-o", "parquet", "--format", "parquet", *_NO_SOUND)
    return {path.name: plain(pq.read_table(path).to_pylist()) for path in files_in("parquet")}


def by_csv(run: Run) -> Any:
    run("export", "logs", "-o", "csv", "--format", "csv", *_NO_SOUND)
    return {
        path.name: list(csv.DictReader(path.read_text().splitlines())) for path in files_in("csv")
    }


def by_npz(run: Run) -> Any:
    run("export", "logs", "-o", "npz", "--format", "npz", *_NO_SOUND)
    return {
        path.name: {name: plain(array) for name, array in np.load(path).items()}
        for path in files_in("npz")
    }


def by_text_and_sound(run: Run) -> Any:
    run("export", "logs", "-o", "day.txt", "--topics", "/hall/segment")
    run("export", "logs", "-o", "clips", "--format", "wav")
    return Path("day.txt").read_text(), {path.name: path.read_bytes() for path in files_in("clips")}


def by_bags(run: Run) -> Any:
    run("export", "logs", "-o", "bag", "--format", "rosbag2")
    run("export", "logs", "-o", "day.bag", "--format", "bag")
    with rosbag2.Reader("bag") as bag, rosbag1.Reader("day.bag") as old:
        return [
            {topic: about.msgcount for topic, about in reader.topics.items()}
            for reader in (bag, old)
        ]


def by_doctor(run: Run) -> Any:
    found = []
    for folder in ("logs", "left"):
        output = json.loads(run("doctor", folder, "--json").stdout)
        assert not output["more"]
        found += [
            (each["path"], each["level"], each["rule"], each["what"]) for each in output["findings"]
        ]
    return sorted(each for each in found if each[2] != "newer")


def by_replay(run: Run) -> Any:
    made = run("replay", "logs", "--model", "models/smoothed.safetensors", "--json")
    output = json.loads(made.stdout)
    assert output["compared"]["bit_for_bit"]
    del output["took_seconds"]
    run("replay", "logs", "--model", "models/smoothed.safetensors", "-o", "again")
    again = read_columns(find_logs(Path("again")))
    return output, {topic: plain(columns.fields) for topic, columns in again.items()}


def by_relabel(run: Run) -> Any:
    same = run("relabel", "logs", "--model", "models/merged.safetensors", "--workers", "1")
    new = run("relabel", "logs", "--model", "models/smoothed.safetensors", "--workers", "1")
    layers = sorted(path for path in find_logs(Path("logs")) if ".relabel-smoothed" in path.name)
    labels = read_columns(layers)
    for layer in layers:
        layer.unlink()
    fields = {topic: plain(columns.fields) for topic, columns in labels.items()}
    return same.stdout, new.stdout, fields


def by_diff(run: Run) -> Any:
    queue = run("diff", "logs", "live", "merged", "--queue", "--json")
    return json.loads(run("diff", "logs", "live", "merged", "--json").stdout), queue.stdout


def by_report(run: Run) -> Any:
    run("report", "logs", "--day", "2026-03-01", "-o", "day.html")
    return Path("day.html").read_text()


def by_evaluate(run: Run) -> Any:
    return json.loads(run("evaluate", "log", "logs", "--reference", "review", "--json").stdout)


def by_training(run: Run) -> Any:
    base = ["--base", "models/smoothed.safetensors", "--home", "logs"]
    run("train", *base, "--output", "adapted.safetensors")
    return load_model(Path("adapted.safetensors")).sha256


def by_timeline(_: Run) -> Any:
    return plain(read_timeline([Path("logs")])), plain(read_timeline([Path("left")]))


def by_watching(_: Run) -> Any:
    live = LiveTimeline()
    logs = [path for path in find_logs(Path("logs")) if not is_layer(path)]
    return [
        plain(news)
        for path in logs
        for batch in iterate_messages([path])
        for news in live.take(path, batch)
    ]


def by_marks(run: Run) -> Any:
    run("annotate", "export", "logs", "-o", "marks.csv")
    marks = [plain(mark) for path in find_logs(Path("logs")) for mark in read_marks(path)]
    return marks, Path("marks.csv").read_text()


def by_enrolment(run: Run) -> Any:
    span = ["--start", "2026-03-01T06:59:38", "--end", "2026-03-01T06:59:41"]
    made = run("enrol", "coughing", "--home", "home", "--log", "logs", *span)
    by_topic = read_columns(find_logs(Path("home", "enrolled")))
    return made.stdout, {topic: plain(columns.fields) for topic, columns in by_topic.items()}


def by_recovery(run: Run) -> Any:
    (left,) = find_logs(Path("left"))
    made = run("recover", left, "-o", "recovered.mcap")
    by_topic = read_columns([Path("recovered.mcap")])
    Path("recovered.mcap").unlink()
    return made.returncode, {topic: plain(columns.fields) for topic, columns in by_topic.items()}


def by_splicing(run: Run) -> Any:
    start, end = "2026-03-01T06:59:40", "2026-03-01T07:00:05"
    logs = [path for path in find_logs(Path("logs")) if not is_layer(path)]
    run("merge", *logs, "-o", "both.mcap")
    run("cut", "both.mcap", "-o", "part.mcap", "--start", start, "--end", end)
    by_topic = read_columns([Path("part.mcap")])
    return {topic: plain(columns.fields) for topic, columns in by_topic.items()}


def by_catalog(run: Run) -> Any:
    output = json.loads(run("catalog", "logs", "--json", "--export", "rows.parquet").stdout)
    rows = pq.read_table("rows.parquet").to_pylist()
    for written in ("rows.parquet", "logs/catalog.sqlite"):
        Path(written).unlink()
    of_files = {"size", "mtime", "input_sha256"}
    return output["labels"], [
        {key: value for key, value in row.items() if key not in of_files} for row in rows
    ]


READERS = [
    by_info,
    by_cat,
    by_messages,
    by_columns,
    by_follow,
    by_parquet,
    by_csv,
    by_npz,
    by_text_and_sound,
    by_bags,
    by_doctor,
    by_replay,
    by_relabel,
    by_diff,
    by_report,
    by_evaluate,
    by_training,
    by_timeline,
    by_watching,
    by_marks,
    by_enrolment,
    by_recovery,
    by_splicing,
    by_catalog,
]


def files_in(folder: str) -> list[Path]:
    return sorted(Path(folder).iterdir())
