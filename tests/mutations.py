"""What becomes of files that were changed in any way: a word wherever values are not the same.

    python tests/mutations.py FOLDER --count 2400 --seed 0

makes files of our own and of other writers in a new folder, changes each of them at random, and
lets the verbs read them in a process of limited memory. It prints each file of which a verb ended
with a traceback, took too long, or gave other values without a line and a status of 1 or 3.
"""

import argparse
import contextlib
import hashlib
import io
import json
import random
import struct
import sys
import warnings
from collections import Counter
from pathlib import Path
from tempfile import TemporaryFile

MAGIC = b"\x89MCAP0\r\n"
MESSAGE, CHUNK, INDEX, METADATA, DATA_END = 5, 6, 7, 12, 15
SECONDS = 120  # for all verbs; the machine may be busy
LABELLED = {"finished", "live", "live-finished"}  # files that are relabelled
RELABELLED = "general"  # a starter model
# The writer of these has no checksums: which values are wrong nobody can know, and of a bit that
# changed not even that some are.
UNCHECKED = "rosbags"


# Mutations: of the bytes of a file, whose records begin at certain bytes.


def records_of(data):
    """Byte at which each record begins and ends, and its opcode."""
    place = len(MAGIC)
    while place + 9 <= len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, place)
        yield place, place + 9 + length, opcode
        place += 9 + length


def _any(rng, data, *opcodes):
    return rng.choice([each for each in records_of(data) if each[2] in opcodes] or [(8, 9, 0)])


def _group(data, chunk):
    """End of the message indexes behind a chunk."""
    end = chunk[1]
    for start, last, opcode in records_of(data):
        if start == end and opcode == INDEX:
            end = last
    return end


def flipped_bit(rng, data):
    place = rng.randrange(len(data))
    return data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]


def flipped_bits(rng, data):
    for _ in range(rng.randrange(2, 20)):
        data = flipped_bit(rng, data)
    return data


def changed_head(rng, data):
    start, end, _ = rng.choice([*records_of(data)])
    place = start + rng.randrange(min(end - start, 60))
    return data[:place] + rng.randbytes(1) + data[place + 1 :]


def wrong_length(rng, data):
    start, _, _ = rng.choice([*records_of(data)])
    length = rng.choice([0, 1, 21, 22, 4096, 1 << 20, 1 << 31, 1 << 63, (1 << 64) - 1])
    return data[: start + 1] + struct.pack("<Q", length) + data[start + 9 :]


def cut_end(rng, data):
    return data[: rng.randrange(len(data))]


def cut_beginning(rng, data):
    return data[rng.randrange(len(data)) :]


def deleted_bytes(rng, data):
    place = rng.randrange(len(data))
    return data[:place] + data[place + rng.randrange(1, 40) :]


def deleted_pages(rng, data):
    place = rng.randrange(len(data))
    return data[:place] + data[place + rng.choice([512, 4096, 65_536]) :]


def inserted_noise(rng, data):
    place = rng.randrange(len(data))
    return data[:place] + rng.randbytes(rng.choice([1, 7, 512, 4096])) + data[place:]


def zeros(rng, data):
    place, length = rng.randrange(len(data)), rng.choice([16, 512, 4096, 65_536])
    return data[:place] + bytes(min(length, len(data) - place)) + data[place + length :]


def noise(rng, data):
    place, length = rng.randrange(len(data)), rng.choice([16, 512, 4096])
    return data[:place] + rng.randbytes(min(length, len(data) - place)) + data[place + length :]


def repeated_pages(rng, data):
    place, length = rng.randrange(len(data)), rng.choice([100, 512, 4096, 65_536])
    return data[: place + length] + data[place:]


def moved_pages(rng, data):
    first, second = sorted(rng.randrange(len(data)) for _ in range(2))
    return data[:first] + data[second:] + data[first:second]


def overwritten(rng, data):
    first, second = (rng.randrange(len(data)) for _ in range(2))
    block = data[first : first + rng.choice([64, 512, 4096])]
    return data[:second] + block + data[second + len(block) :]


def chunk_left_out(rng, data):
    start, end, _ = _any(rng, data, CHUNK, MESSAGE)
    return data[:start] + data[end:]


def chunk_and_indexes_left_out(rng, data):
    chunk = _any(rng, data, CHUNK, MESSAGE)
    return data[: chunk[0]] + data[_group(data, chunk) :]


def chunk_twice(rng, data):
    chunk = _any(rng, data, CHUNK, MESSAGE)
    end = _group(data, chunk)
    return data[:end] + data[chunk[0] : end] + data[end:]


def chunk_twice_far_away(rng, data):
    chunk = _any(rng, data, CHUNK, MESSAGE)
    to, _, _ = rng.choice([*records_of(data)])
    return data[:to] + data[chunk[0] : _group(data, chunk)] + data[to:]


def swapped_chunks(rng, data):
    first, second = sorted([_any(rng, data, CHUNK, MESSAGE), _any(rng, data, CHUNK, MESSAGE)])
    ends = _group(data, first), _group(data, second)
    if ends[0] > second[0]:
        return data
    middle = data[ends[0] : second[0]]
    one, two = data[first[0] : ends[0]], data[second[0] : ends[1]]
    return data[: first[0]] + two + middle + one + data[ends[1] :]


def bytes_out_of_an_index(rng, data):
    start, end, _ = _any(rng, data, INDEX, METADATA)
    place = rng.randrange(start, end)
    return data[:place] + data[min(place + rng.randrange(1, 40), end) :]


def record_left_out(rng, data):
    start, end, _ = rng.choice([*records_of(data)])
    return data[:start] + data[end:]


MUTATIONS = (
    flipped_bit, flipped_bits, changed_head, wrong_length, cut_end, cut_beginning, deleted_bytes,
    deleted_pages, inserted_noise, zeros, noise, repeated_pages, moved_pages, overwritten,
    chunk_left_out, chunk_and_indexes_left_out, chunk_twice, chunk_twice_far_away, swapped_chunks,
    bytes_out_of_an_index, record_left_out,
)  # fmt: skip
FLIPS = {flipped_bit, flipped_bits}


# The verbs, and what they say of a file.


def run(*arguments):
    """Run the command in this process; return its status, its output, and its lines of errors."""
    from hearthlog.tools.cli.main import main  # noqa: PLC0415

    errors, argv = io.StringIO(), sys.argv
    with TemporaryFile("w+", encoding="utf-8") as out:
        try:
            sys.argv = ["hearthlog", *map(str, arguments)]
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
                main()
            status = 0
        except SystemExit as end:
            status = end.code or 0
        finally:
            sys.argv = argv
        out.seek(0)
        return status, out.read(), errors.getvalue()


def messages_of(path):
    """Count the messages of a file, whatever they are; tell also what was warned of."""
    from hearthlog.schemas.logs.merged_reading import iterate_messages  # noqa: PLC0415

    messages = Counter()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for batch in iterate_messages([path]):
            for raw in batch:
                times = raw.log_times.tolist()
                rows = ((raw.channel.topic, times[i], raw.payload(i)) for i in range(len(raw)))
                messages.update(_digest(row) for row in rows)
    return messages, [str(each.message) for each in warned]


def columns(path, _folder):
    """Rows that are not the same need an error or a warning; a file may end early if unfinished."""
    from hearthlog.schemas.errors import HearthlogError  # noqa: PLC0415
    from hearthlog.schemas.logs.columns import read_columns  # noqa: PLC0415
    from hearthlog.schemas.mcap.logfile import LogFile  # noqa: PLC0415

    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            read = read_columns([path])
            with LogFile(path) as file:
                complete = file.complete
    except HearthlogError as error:
        return 1, "", str(error)
    text = {
        topic: [len(same), *(_sum(values) for values in same.fields.values())]
        for topic, same in sorted(read.items())
    }
    lines = [str(each.message) for each in warned]
    lines += [] if complete else ["not complete"]
    return 3 if lines else 0, json.dumps(text), "\n".join(lines)


def _sum(values):
    return _digest(values.tobytes() if values.dtype != object else values.tolist())


def _digest(values):
    return hashlib.blake2b(repr(values).encode(), digest_size=8).hexdigest()


def cat(path, _folder):
    return run("cat", path, "--format", "ndjson")


def info(path, _folder):
    status, out, errors = run("info", path, "--json")
    about = json.loads(out) if out else {"topics": {}, "unfinished": []}
    counts = {name: topic["messages"] for name, topic in about["topics"].items()}
    lines = [*errors.splitlines(), *about["unfinished"]]
    return status, json.dumps(counts, sort_keys=True), "\n".join(lines)


def doctor(path, _folder):
    status, out, errors = run("doctor", path)
    return status, json.dumps(sorted(messages_in(path).items())), errors + out * (status > 0)


def messages_in(path):
    from hearthlog.schemas.errors import HearthlogError  # noqa: PLC0415

    try:
        return messages_of(path)[0]
    except HearthlogError:
        return Counter()


def recover(path, folder):
    copy = folder / "recovered.mcap"
    copy.unlink(missing_ok=True)
    status, out, errors = run("recover", path, "-o", copy)
    if not out:
        return status, "", errors
    saved = messages_of(copy)[0] - _gaps(copy)
    if "the log had no end" in errors:
        status = status or 3
    return status, json.dumps(sorted(saved.items())), errors


def _gaps(path):
    """Count the gaps that a recovery has written."""
    from hearthlog.schemas.logs.merged_reading import iterate_messages  # noqa: PLC0415

    gaps = Counter()
    for batch in iterate_messages([path]):
        for raw in batch:
            for i, time in enumerate(raw.log_times.tolist()):
                if b"the log was damaged" in (payload := raw.payload(i)):
                    gaps[_digest((raw.channel.topic, time, payload))] += 1
    return gaps


def relabel(path, folder):
    for layer in folder.glob("*.relabel-*"):
        layer.unlink()
    status, _, errors = run("relabel", path, "--model", RELABELLED, "--workers", "1")
    layers = [*folder.glob("*.relabel-*.mcap")]
    text = json.dumps(sorted(messages_of(layers[0])[0].items())) if layers else ""
    return status, text, errors


VERBS = (columns, cat, info, doctor, recover, relabel)


def compared(path, folder):
    """Let all verbs read a file; raise AssertionError where one says nothing of other values."""
    expected = json.loads((folder / "expected.json").read_text())
    wrong = []
    for verb in VERBS:
        if verb.__name__ not in expected:
            continue
        status, text, errors = verb(path, folder)
        own = expected[verb.__name__]
        name = verb.__name__
        if "Traceback" in errors or status not in {0, 1, 3}:
            wrong.append(f"{name}: status {status}: {errors[-500:]}")
        elif status and not errors:
            wrong.append(f"{name}: status {status} without a line")
        elif text != own[1] and not status:
            wrong.append(f"{name}: other values without a word")
        elif name == "recover" and text and folder.name != UNCHECKED and json_more(text, own[1]):
            wrong.append(f"{name}: saved what was not there")
    assert not wrong, "; ".join(wrong)


def json_more(text, own):
    return {row for row, _ in json.loads(text)} - {row for row, _ in json.loads(own)}


def expect(path, folder, verbs=VERBS):
    """Note what the verbs say of a whole file."""
    texts = {verb.__name__: verb(path, folder) for verb in verbs}
    (folder / "expected.json").write_text(json.dumps(texts))
    return texts


# The files.


def write_files(folder):
    """Write whole files of all kinds; return them by name."""
    from threading import Event  # noqa: PLC0415

    import soundfile  # noqa: PLC0415

    from hearthlog.recorder.config import load_settings  # noqa: PLC0415
    from hearthlog.recorder.recording import record_files  # noqa: PLC0415
    from hearthlog.recorder.sources.audio_files import FileSource  # noqa: PLC0415

    clips = sorted((Path(__file__).parent / "data" / "household").glob("*/*.flac"))
    samples = [soundfile.read(clip, dtype="int16")[0] for clip in clips[::6]][:8]
    sounds = []
    for number, clip in enumerate(samples):
        sounds.append(folder / f"{number}.wav")
        soundfile.write(sounds[-1], clip[: 5 * 16_000], 16_000)
    settings = load_settings(None, {"output": folder / "logs", "model": RELABELLED}, {})
    source = FileSource(sounds, 1_772_348_400 * 10**9)
    (log,) = record_files(settings, source, Event()).logs
    files = {"finished": log}
    for name, finished in (("live", False), ("live-finished", True)):
        files[name] = folder / name / (log.name + ".active" * (not finished))
        files[name].parent.mkdir()
        files[name].write_bytes(live_shaped(log, finished=finished))
    run("relabel", log, "--model", RELABELLED, "--workers", "1")
    (files["layer"],) = log.parent.glob("*.relabel-*.mcap")
    for name, options in FOREIGN.items():
        files[name] = folder / f"{name}.mcap"
        files[name].write_bytes(foreign(**options))
    files[UNCHECKED] = rosbag(folder / "bag")
    return files


def live_shaped(log, *, finished):
    """A log in chunks of half a second, as the recorder leaves them."""
    from logreader import LogReader  # noqa: PLC0415

    from hearthlog.schemas.mcap.chunk_writer import ChunkWriter  # noqa: PLC0415

    reader = LogReader(log)
    stream = io.BytesIO()
    writer = ChunkWriter(stream)
    writer.start("ros2", "hearthlog")
    with log.open("rb") as source:
        from mcap.reader import make_reader  # noqa: PLC0415

        read = make_reader(source)
        summary = read.get_summary()
        for record in read.iter_metadata():
            if record.name != "rosbag2":
                writer.add_metadata(record.name, record.metadata)
        for record in read.iter_attachments():
            times = record.create_time, record.log_time
            writer.add_attachment(*times, record.name, record.media_type, record.data)
    for schema in summary.schemas.values():
        writer.register_schema(schema.name, schema.encoding, schema.data)
    channels = {}
    for number, channel in sorted(summary.channels.items()):
        channels[channel.topic] = writer.register_channel(
            channel.topic, channel.message_encoding, channel.schema_id, channel.metadata
        )
        assert channels[channel.topic] == number
    last = 0
    for number, message in enumerate(reader.messages()):
        if message.log_time > last + 500_000_000:
            writer.flush()
            last = message.log_time
        time = message.log_time
        writer.add_message(channels[message.topic], time, message.data, time, number)
    writer.flush()
    size = stream.tell()
    writer.finish()
    return stream.getvalue() if finished else stream.getvalue()[:size]


def foreign(**options):
    """A file of other messages by the writer of `mcap`."""
    from mcap.writer import Writer  # noqa: PLC0415

    stream, rng = io.BytesIO(), random.Random(0)
    writer = Writer(stream, chunk_size=2000, **options)
    writer.start("ros2", "test")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channels = [writer.register_channel(f"/t{n}", "cdr", schema) for n in range(3)]
    for number in range(400):
        text = rng.randbytes(rng.randrange(40)).hex().encode() + b"\0"
        data = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
        time = 10**18 + number * 10**7
        writer.add_message(channels[number % 3], time, data, time, number)
    writer.add_metadata("made", {"a": "b" * 300})
    writer.add_attachment(1, 1, "notes", "text/plain", b"one" * 99)
    writer.finish()
    return stream.getvalue()


def _foreign_options():
    from mcap.writer import CompressionType  # noqa: PLC0415

    return {
        "zstd": {"compression": CompressionType.ZSTD},
        "lz4": {"compression": CompressionType.LZ4},
        "stored": {"compression": CompressionType.NONE},
    }


FOREIGN = _foreign_options()


def rosbag(folder):
    """A bag by the writer of `rosbags`."""
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/Int32"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/number", kind, typestore=store)
        for number in range(500):
            data = store.serialize_cdr(store.types[kind](number), kind)
            writer.write(connection, 10**18 + number * 10**7, bytes(data))
    (path,) = folder.glob("*.mcap")
    return path


def begin(name, path, folder):
    """Note what the verbs say of a whole file; return the process that will read changed ones."""
    from fuzzing import Victim  # noqa: PLC0415

    folder.mkdir(parents=True)
    (folder / path.name).write_bytes(path.read_bytes())
    expect(folder / path.name, folder, VERBS if name in LABELLED else VERBS[:-1])
    return Victim(folder, (compared,), SECONDS)


def main():
    """Change files at random, and print what is said of none of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=2400)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.folder.mkdir()
    files = write_files(options.folder)
    rng = random.Random(options.seed)
    counts, wrong = Counter(), Counter()
    for name, path in files.items():
        data, victim = path.read_bytes(), begin(name, path, options.folder / "victims" / name)
        kinds = [one for one in MUTATIONS if name != UNCHECKED or one not in FLIPS]
        for number in range(options.count // len(files)):
            mutation = kinds[number % len(kinds)]
            changed = mutation(rng, data)
            counts[mutation.__name__] += 1
            if output := victim.read(changed, path.name):
                wrong[mutation.__name__] += 1
                kept = options.folder / f"{name}-{number}-{mutation.__name__}"
                kept.write_bytes(changed)
                print_line(f"{kept.name}: {output.strip().splitlines()[-1]}")
        victim.close()
        print_line(f"{name}: {number + 1} files")
    print_line(f"{counts.total()} files, {wrong.total()} wrong: {dict(wrong)}")


def print_line(line):
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
