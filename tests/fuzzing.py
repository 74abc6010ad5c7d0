"""What becomes of a hostile file: everything that reads logs, in a process of limited memory."""

import multiprocessing
import resource
import traceback
from pathlib import Path

MEMORY = 1 << 30  # bytes, more than the process has when it starts
SECONDS = 30  # a file; the machine may be busy


class Victim:
    """A process that reads whatever it is given, and is started again when that has killed it."""

    def __init__(self, folder: Path, readers=None, seconds=SECONDS) -> None:
        self._folder = folder
        self._seconds = seconds
        self._readers = READERS if readers is None else readers
        self._context = multiprocessing.get_context("spawn")
        self._start()

    def _start(self) -> None:
        self._pipe, other = self._context.Pipe()
        self._process = self._context.Process(
            target=_serve, args=(other, self._folder, self._readers)
        )
        self._process.start()
        other.close()
        self._pipe.recv()  # it is there: what follows is timed

    def close(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def read(self, data: bytes, name: str) -> str:
        """Return what went wrong, empty if nothing did."""
        path = self._folder / name
        path.write_bytes(data)
        try:
            self._pipe.send(path)
            if self._pipe.poll(self._seconds):
                return self._pipe.recv()
            what = f"took more than {self._seconds} s"
        except (EOFError, OSError):
            what = "killed the process"
        self.close()
        self._start()
        return what


def _serve(pipe, folder: Path, readers) -> None:
    import logreader  # noqa: F401, PLC0415  before the memory is limited

    import hearthlog.analyzer.doctor  # noqa: PLC0415
    import hearthlog.recorder.recording  # noqa: F401, PLC0415

    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    pipe.send("ready")
    while True:
        path = pipe.recv()
        pipe.send("".join(_try(reader, path, folder) for reader in readers))


def _try(reader, path: Path, folder: Path) -> str:
    from hearthlog.schemas.errors import HearthlogError  # noqa: PLC0415

    try:
        reader(path, folder)
    except HearthlogError:
        return ""
    except BaseException:  # noqa: BLE001 - whatever it is, it should not have come out
        return f"{reader.__name__}: {traceback.format_exc()}"
    return ""


def message_by_message(path: Path, _folder: Path) -> None:
    from logreader import LogReader  # noqa: PLC0415

    for item in LogReader(path).messages():
        item.decode()


def as_columns(path: Path, _folder: Path) -> None:
    from hearthlog.schemas.logs.columns import read_columns  # noqa: PLC0415

    read_columns([path])


def as_columns_between(path: Path, _folder: Path) -> None:
    from hearthlog.schemas.logs.columns import read_columns  # noqa: PLC0415

    middle = 1_772_348_410_000_000_000
    read_columns([path], ["/mic/features", "/mic/gap"], middle, middle + 5_000_000_000)


def summarised(path: Path, _folder: Path) -> None:
    from hearthlog.analyzer.logs.summary import summarise  # noqa: PLC0415

    summarise([path])


def examined(path: Path, _folder: Path) -> None:
    from hearthlog.analyzer.doctor.examination import examine  # noqa: PLC0415

    for findings in examine(path):
        assert all(str(finding).isprintable() for finding in findings.shown)


def recovered(path: Path, folder: Path) -> None:
    """What is recovered can be read, and breaks no rule of MCAP."""
    from logreader import LogReader  # noqa: PLC0415

    from hearthlog.analyzer.doctor.examination import examine  # noqa: PLC0415
    from hearthlog.schemas.errors import HearthlogError  # noqa: PLC0415
    from hearthlog.schemas.salvage.recover import recover_log  # noqa: PLC0415

    copy = folder / "recovered.mcap"
    recover_log(path, copy, copy.name)
    try:
        list(LogReader(copy).messages())
        broken = {rule for f in examine(copy) for level, rule in f.counts if level == "error"}
    except HearthlogError as error:
        raise AssertionError(f"what was recovered cannot be read: {error}") from error
    assert not broken & MCAP, f"what was recovered breaks {broken & MCAP}"


MCAP = {
    "magic", "after-end", "header", "framing", "fields", "schema-id", "redefined",
    "chunk-data", "chunk-crc", "chunk-records", "chunk-opcode", "chunk-times", "message-short",
    "channel-missing", "message-index", "message-index-place", "data-opcode", "data-end",
    "data-crc", "attachment-crc", "summary-opcode", "summary-groups", "summary-copy",
    "summary-copies", "summary-offset", "summary-crc", "index-place", "index-twice",
    "index-differs", "index-missing", "statistics", "statistics-channels", "footer", "cut",
}  # fmt: skip
READERS = (message_by_message, as_columns, as_columns_between, summarised, examined, recovered)
