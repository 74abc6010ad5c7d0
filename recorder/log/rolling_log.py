"""A recorder's log: files of limited length and size, and their description."""

import hashlib
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hearthlog.models.classifiers.model import Model
from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.features.installed import entries_of
from hearthlog.models.modelfile.modelfile import attachment_of, model_attachments
from hearthlog.recorder.config import Settings
from hearthlog.recorder.events import Notice
from hearthlog.recorder.log.recovery import LogFinisher, active_logs
from hearthlog.recorder.stream.messages import EncodedMessage, opening_messages
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.frames import NANOSECONDS
from hearthlog.schemas.logs.files import free_log_path, log_path
from hearthlog.schemas.logs.metadata import (
    RecordedScenario,
    other_features,
    provenance,
    scenario_entries,
)
from hearthlog.schemas.logs.writer import Attachment, LogWriter
from hearthlog.schemas.messages.message_types import header
from hearthlog.schemas.messages.topics import (
    CANDIDATE,
    SCENARIO,
    EmbeddingSource,
    Topic,
    topics_of,
)


@dataclass(frozen=True)
class LogDescription:
    """Description of a recording, written to every file."""

    root: Path  # folder of the logs
    node: str  # name of the recorder
    topics: Sequence[Topic]
    infos: Sequence[Any]  # `AudioStreamInfo` of each microphone; each file sets their stamps
    metadata: Mapping[str, str]  # the `hearthlog` record
    attachments: Sequence[Attachment]
    # By microphone, additional lines of `/rosout` at the start of a file.
    lines: Mapping[str, Sequence[str]] = field(default_factory=dict)


def describe_log(  # noqa: PLR0913, PLR0917
    settings: Settings,
    info: Any,
    features: FeatureSet,
    model: Model | None,
    secondary: Mapping[str, Model] | None = None,
    embedding: EmbeddingSource | None = None,
) -> LogDescription:
    """Return the description of the logs of one microphone.

    Parameters
    ----------
    model : Model or None
        Labelling model; None for no labels.
    embedding : EmbeddingSource, optional
        Source of the embeddings; None without a network.
    """
    secondary = secondary or {}
    microphone = info.header.frame_id
    models = {"model", "scenarios"}
    # Paths of this machine.
    elsewhere: Any = dict.fromkeys(["output", *models], True)
    elsewhere["microphone"] = {"__all__": models}
    configuration = settings.model_dump_json(indent=2, exclude=elsewhere).encode()
    classes = None if model is None else list(model.classes)
    attachments = [Attachment("configuration.json", "application/json", configuration)]
    metadata = provenance(
        settings.node,
        configuration_sha256=hashlib.sha256(configuration).hexdigest(),
        **entries_of(features),
        model=info.model,
        model_sha256=info.model_sha256,
        timezone=settings.timezone,
    )
    if (candidate := secondary.get(CANDIDATE)) is not None:
        metadata |= {"candidate": candidate.name, "candidate_sha256": candidate.sha256}
    if model is not None:
        attachments += model_attachments(model)
    named = {labelling: list(one.classes) for labelling, one in secondary.items()}
    description = LogDescription(
        root=settings.output,
        node=settings.node,
        topics=topics_of(
            microphone,
            features.feature_names,
            classes,
            named,
            directions=bool(settings.settings_of(microphone).array),
            embedding=embedding,
        ),
        infos=[info],
        metadata=metadata,
        attachments=attachments,
    )
    parts = {labelling.partition("/"): one for labelling, one in secondary.items()}
    scenarios = {name: one for (kind, _, name), one in parts.items() if kind == SCENARIO}
    return with_scenarios(description, microphone, scenarios)


def with_scenarios(
    description: LogDescription, microphone: str, scenarios: Mapping[str, Model]
) -> LogDescription:
    """Add metadata, attachments and lines of a microphone's scenarios, without their topics."""
    entries = dict(description.metadata)
    attachments = list(description.attachments)
    for name, model in scenarios.items():
        entries |= scenario_entries(RecordedScenario(microphone, name, model.name, model.sha256))
        attachments += _scenario_attachments(name, model)
    lines = [
        f"scenario {name}: {len(model.classes)} labels by {model.name} ({model.sha256[:12]})"
        for name, model in scenarios.items()
    ]
    return replace(
        description,
        metadata=entries,
        attachments=attachments,
        lines={**description.lines, microphone: lines},
    )


def _scenario_attachments(scenario: str, model: Model) -> list[Attachment]:
    own = f"{SCENARIO}-{scenario}"  # not a valid microphone name
    return [replace(each, name=attachment_of(each.name, own)) for each in model_attachments(model)]


def join_descriptions(descriptions: Sequence[LogDescription]) -> LogDescription:
    """Join the descriptions of several microphones."""
    first = descriptions[0]
    attachments = {each.name: each for each in first.attachments}
    for other in descriptions[1:]:
        (info,) = other.infos
        for each in other.attachments:
            if each not in attachments.values():
                name = attachment_of(each.name, info.header.frame_id)
                attachments[name] = replace(each, name=name)
    topics = {topic.name: topic for each in descriptions for topic in each.topics}
    features: dict[str, str] = {}
    for other in descriptions[1:]:
        (info,) = other.infos
        features |= other_features(first.metadata, other.metadata, info.header.frame_id)
    scenarios = {
        key: text
        for each in descriptions
        for key, text in each.metadata.items()
        if key.startswith(SCENARIO)
    }
    return replace(
        first,
        metadata={**first.metadata, **features, **scenarios},
        lines={name: lines for each in descriptions for name, lines in each.lines.items()},
        topics=list(topics.values()),
        infos=[info for each in descriptions for info in each.infos],
        attachments=list(attachments.values()),
    )


# Maximum delay from a sound to its writing: a block of frames, and the capture delay.
_DELAY_SECONDS = 0.9
_QUIET_SECONDS = 2.0  # without a flush; sound has one every half a second
_FILES = 256  # remembered: longer than clips are buffered, even with one file per second
_LATE = 10 * NANOSECONDS  # lag between microphones; more means that the clock was set back
_NEVER = (1 << 63) - 1


class RollingLog:
    """Writes messages into successive files.

    Parameters
    ----------
    file_seconds : int
        Files begin at multiples of this, in UTC.
    flush_seconds : float
        A killed process loses at most this much sound.
    sync_seconds : float
        A power cut loses at most this much sound.
    file_bytes : int
        Size at which the next file begins; 0 for no limit.
    """

    def __init__(  # noqa: PLR0913
        self,
        description: LogDescription,
        file_seconds: int,
        flush_seconds: float,
        sync_seconds: float,
        *,
        live: bool = False,
        file_bytes: int = 0,
        finisher: LogFinisher | None = None,
    ) -> None:
        self.finished: list[Path] = []
        self.safe = 0
        self._given = 0  # appended messages, without the opening messages of files
        self._description = description
        self._file_nanoseconds = file_seconds * NANOSECONDS
        self._file_bytes = file_bytes
        self._flush_nanoseconds = int((flush_seconds - _DELAY_SECONDS) * NANOSECONDS)
        self._sync_seconds = sync_seconds - _DELAY_SECONDS
        self._live = live
        self._name = free_log_path if live else log_path
        self._finisher = finisher
        self._writer: LogWriter | None = None
        self._abandoned: LogWriter | None = None  # of the file with the disk error
        self._late = _LATE if len(description.infos) > 1 else 0
        self._last = self._until = 0  # empty range: the first message opens a file
        self._flush_at: int | None = None
        self._flushed = time.monotonic()
        self._synced = time.monotonic()
        self._begun: deque[tuple[int, Path]] = deque(maxlen=_FILES)

    def write(self, messages: Sequence[EncodedMessage]) -> None:
        """Append messages.

        If time runs backwards, because the clock was set, a new file begins. Raise `LogError` on a
        disk error: the written part remains and is completed at the next start. Also, unless live,
        if the name of a new file is taken.
        """
        with self._preserving_written():
            for part in self._parts(messages):
                if not self._last - self._late <= part[0].log_time < self._until:
                    self._roll(part[0].log_time)
                self._append(part)
                self._given += len(part)
            if self._is_flush_due():
                self.flush()
            if time.monotonic() - self._synced >= self._sync_seconds:
                self.sync()

    def _is_flush_due(self) -> bool:
        if self._flush_at is None:
            return False
        # Without sound there is one message in ten seconds; it must not wait for the next.
        waits = self._live and time.monotonic() - self._flushed >= _QUIET_SECONDS
        return waits or self._last >= self._flush_at

    def flush(self) -> None:
        """Pass written data to the operating system.

        Raise `OSError` on a disk error.
        """
        if self._writer is not None and self._flush_at is not None:
            self._writer.flush()
            self._flush_at = None
            self._flushed = time.monotonic()
            if self._file_bytes and self._writer.size >= self._file_bytes:
                self._until = 0

    def sync(self) -> None:
        """Wait until written data is on the disk.

        Raise `OSError` on a disk error.
        """
        self.flush()
        if self._writer is not None:
            self._writer.sync()
        self.safe = self._given
        self._synced = time.monotonic()

    def finish(self, messages: Sequence[EncodedMessage] = ()) -> None:
        """Append the last messages to the open file, and complete it.

        Parameters
        ----------
        messages : sequence of EncodedMessage
            In the order of their log times; dropped if no file is open.

        Raises
        ------
        LogError
            On a disk error; the written part remains and is completed at the next start.
        """
        with self._preserving_written():
            if self._writer is not None:
                self._append(messages)
                self._given += len(messages)
            self._finish_file()

    def may_begin(self, stamp: int) -> bool:
        """Return whether a file may begin at a time: each second has one name."""
        description = self._description
        path = log_path(description.root, description.node, stamp)
        return free_log_path(description.root, description.node, stamp) == path

    @property
    def is_full(self) -> bool:
        """Whether sound must be dropped; always false, as disk errors raise."""
        return False

    def notices(self) -> list[Notice]:
        """Return notices about the disk; none, as disk errors raise."""
        return []

    def file_at(self, stamp: int) -> tuple[Path, int]:
        """Return the file that contains a time; the later one if the clock was set back.

        Parameters
        ----------
        stamp : int
            A time that was written, in nanoseconds of UTC.

        Returns
        -------
        end : int
            Start of the next file, in nanoseconds of UTC.
        """
        until = _NEVER
        if not self._begun:
            return log_path(self._description.root, self._description.node, stamp), until
        for start, path in reversed(self._begun):
            if start <= stamp:
                return path, until
            until = start
        return self._begun[0][1], until

    def begin_anew(self, description: LogDescription, messages: Sequence[EncodedMessage]) -> None:
        """Complete the open file; the next message begins a file with another description.

        Raise `LogError` as `finish` does.
        """
        self.finish(messages)
        self._description = description
        self._until = 0

    def complete_truncated(self) -> None:
        """Start the completion of files with disk errors, including clips; return immediately."""
        if self._finisher is None:
            return
        # The open file is excluded: the disk may refuse it before that process has started.
        is_open = None if self._writer is None else self._writer.active_path
        logs = active_logs(self._description.root, self._description.node)
        self._finisher.add([path for path in logs if path != is_open])

    def begin_after_failure(self) -> None:
        """Continue after an error: messages that are not `safe` must be written again.

        Raise `OSError` if the disk error persists.
        """
        if self._abandoned is not None:
            self._abandoned.discard_unsynced()
            self._abandoned = None
        self._given = self.safe
        self._until = 0
        self._flush_at = None

    @contextmanager
    def _preserving_written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            kept = ""
            if self._writer is not None:
                self._writer.abandon()
                self._abandoned, self._writer = self._writer, None
                kept = "; what was recorded is kept and completed at the next start"
            what = error.strerror or str(error)
            root = self._description.root
            raise LogError(f"{root}: cannot be written ({what}){kept}") from error

    def _finish_file(self) -> None:
        if self._writer is not None:
            if self._finisher is None:
                self._writer.finish()
            else:
                self._writer.complete()
                self._finisher.add([self._writer.active_path])
            self.finished.append(self._writer.path)
            self._writer = None
        self.safe = self._given

    def _parts(self, messages: Sequence[EncodedMessage]) -> Iterator[Sequence[EncodedMessage]]:
        """Split messages where a file may begin; ordered messages within the file stay together."""
        times = [message.log_time for message in messages]
        if times and times[-1] < self._until and times == sorted(times):
            yield messages
        else:
            for place in range(len(messages)):
                yield messages[place : place + 1]

    def _append(self, messages: Sequence[EncodedMessage]) -> None:
        if not messages:
            return
        assert self._writer is not None
        self._writer.write_messages(messages)
        self._last = max(self._last, messages[-1].log_time)
        if self._flush_at is None:
            self._flush_at = messages[0].log_time + self._flush_nanoseconds

    def _roll(self, stamp: int) -> None:
        self._finish_file()
        description = self._description
        path = self._name(description.root, description.node, stamp)
        self._writer = LogWriter(
            path, description.topics, description.metadata, description.attachments, stamp
        )
        self._begun.append((stamp, path))
        self._last = stamp
        self._until = (stamp // self._file_nanoseconds + 1) * self._file_nanoseconds
        for info in description.infos:
            info.header = header(stamp, info.header.frame_id)
            lines = description.lines.get(info.header.frame_id, ())
            self._append(opening_messages(info, lines))
        self._writer.flush()  # the file is identifiable whatever happens next
        self._flush_at = None
