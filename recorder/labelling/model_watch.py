"""Watched model files: a thread loads and checks replaced models and candidates.

A replacement labels only after a promotion check that permits it; a scenario's model needs none.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread
from typing import NamedTuple

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.features import FeatureSet
from hearthlog.models.modelfile import SUFFIX, load_model, name_and_digest, starter_for
from hearthlog.models.registry import (
    CANDIDATE,
    DEFAULT_MODEL,
    is_starter,
    judgement_path,
    judgements_of,
    read_judgement,
)
from hearthlog.models.starter import GENERAL, STARTERS
from hearthlog.recorder.host import announce, give_back
from hearthlog.schemas.errors import ModelError

LOOK_SECONDS = 1.0

FileIdentity = tuple[int, int, int, int] | None


class Loaded(NamedTuple):
    """A checked model with its classifier."""

    model: Model
    classifier: Classifier


class ReloadRequests:
    """Requests immediate checks from all watches; safe in a signal handler."""

    def __init__(self) -> None:
        self.restart = False
        self._queues: list[SimpleQueue[None]] = []

    def queue(self) -> SimpleQueue[None]:
        """Return a new queue, for the requests to one watch."""
        self._queues.append(SimpleQueue())
        return self._queues[-1]

    def request(self) -> None:
        """Request a check from all watches."""
        for queue in self._queues:
            queue.put(None)


class ModelWatch:
    """Checks in a thread every second whether a model file was replaced.

    `path` is a model file, a symbolic link to one, or the name of a starter model. While the file
    `DEFAULT_MODEL` is missing, the starter model `general` replaces it. An item in `requests`
    triggers an immediate check, which repeats earlier refusals; unlike an event, a queue is safe in
    a signal handler. `starter` is the name of the starter model at the start, empty for a file; the
    user of `ready` sets it to None. Raise `ModelError` if the model at the start cannot be used.
    """

    def __init__(
        self, path: Path, requests: SimpleQueue[None], scenario: str = "", network: str = ""
    ) -> None:
        self._path = path = starter_for(path, network)
        self._requests = requests
        self._scenario = scenario
        self._seen = file_identity(path)  # before loading, so that a later replacement is detected
        is_default = path == DEFAULT_MODEL and not scenario
        self._starts_with_starter = is_default and self._seen is None
        begins = starter_for(Path(GENERAL), network) if self._starts_with_starter else path
        self.starter = str(begins) if str(begins) in STARTERS and self._seen is None else ""
        self.first = self._load_first(begins)
        self.ready: Loaded | None = None
        self.held: Loaded | None = None
        self._awaited: Path | None = None  # file of the missing promotion check
        self._judged: FileIdentity = None
        self._last = self.first.model
        _warn_if_simulated(self._last)
        self._results: SimpleQueue[Loaded | str | None] = SimpleQueue()  # None: the model in use
        self._closed = Flag()
        self._thread = Thread(target=self._watch, name="model watch", daemon=True)
        self._thread.start()

    def _load_first(self, path: Path) -> Loaded:
        """Load the first model; a model with a changed bit still labels, rather than none."""
        damaged: list[str] = []
        try:
            loaded = load_checked(path, damaged.append)
        except ModelError as error:
            raise ModelError(f"{self._where()}{error}") from error
        for line in damaged:
            announce(f"{self._where()}{line}. It keeps labelling")
        if not damaged and not self._scenario:
            _warn_if_changed(path, loaded.model)
        return loaded

    def refusals(self) -> Iterator[str]:
        """Yield the refusals of models since the last call, and update `ready`."""
        with suppress(Empty):
            while True:
                result, self.held = self._results.get_nowait(), None
                if isinstance(result, str):
                    yield result
                elif result is not None:
                    self.ready = result

    def offer_again(self) -> None:
        """Make a held model ready again: another model may have given up the conflicting class."""
        if self.ready is None and self.held is not None:
            self.ready, self._last = self.held, self.held.model

    def refuse_ready(self, reason: str, in_use: Model) -> str:
        """Hold the ready model, and return the refusal; empty if it was reported before."""
        assert self.ready is not None
        is_held, self.held, self.ready = self.ready is self.held, self.ready, None
        self._last = in_use
        if is_held:
            return ""
        text = self._refusal(self.held.model.name, reason)
        announce(text)
        return text

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._requests.put(None)
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.is_set():
            requested = self._wait()
            now = file_identity(self._path)
            nothing_yet = self._starts_with_starter and now is None and self._seen is None
            changed = now != self._seen or self._awaited_judgement() != self._judged
            if (changed or requested) and not (nothing_yet or self._closed.is_set()):
                self._seen = now
                self._look()
                give_back()

    def _awaited_judgement(self) -> FileIdentity:
        return None if self._awaited is None else file_identity(self._awaited)

    def _wait(self) -> bool:
        """Wait for the next check; return whether it was requested."""
        try:
            self._requests.get(timeout=LOOK_SECONDS)
        except Empty:
            return False
        while not self._requests.empty():
            self._requests.get_nowait()
        return True

    def _look(self) -> None:
        self._awaited = self._judged = None
        try:
            if name_and_digest(self._path) == (self._last.name, self._last.sha256):
                self._results.put(None)
                return  # the memory of a second copy would not be returned completely
            loaded = load_checked(self._path)
        except Exception as error:  # noqa: BLE001  whatever is wrong with the file, the recording goes on
            if file_identity(self._path) == self._seen:  # else it is still being written
                self._refuse(str(error) or repr(error))
            return
        if loaded.classifier.feature_set != self.first.classifier.feature_set:
            theirs, ours = (one.classifier.feature_set.name for one in (loaded, self.first))
            self._refuse(f"it is for feature set {theirs}, not {ours}; restart the recorder")
            return
        model = loaded.model
        if model.sha256 != self._last.sha256 and (reason := self._unjudged(model)):
            self._refuse(reason, model.name)
            return
        self._last = model
        _warn_if_simulated(model)
        self._results.put(loaded)

    def _unjudged(self, model: Model) -> str:
        """Return why a model may not label; empty if it may."""
        if self._scenario:
            return ""
        folder = self._path.parent
        awaited = judgement_path(folder, model.sha256)
        judged = file_identity(awaited)  # before reading, so that a later replacement is detected
        judgement = read_judgement(folder, model.sha256)
        if judgement is not None and judgement.may_label:
            return ""
        self._awaited, self._judged = awaited, judged
        promote = f"hearthlog models promote {model.name}"
        if judgement is None:
            return f"it was not checked in this home; `{promote}` checks it"
        return f"{judgement.reasons[0]}; `{promote} --anyway` overrides this"

    def _refuse(self, reason: str, name: str = "") -> None:
        text = self._refusal(name or self._path.stem, reason)
        self._results.put(text)
        announce(text)

    def _refusal(self, name: str, reason: str) -> str:
        return f"{self._where()}model {name} refused: {reason}; going on with {self._last.name}"

    def _where(self) -> str:
        return f"scenario {self._scenario}: " if self._scenario else ""


def _warn_if_simulated(model: Model) -> None:
    if model.description.training_data.simulated:
        announce(
            f"model {model.name} was trained on simulated sounds only and is mostly wrong about "
            "real ones, whatever its confidence; train one from recordings"
        )


def _warn_if_changed(path: Path, champion: Model) -> None:
    """Warn if a champion has no promotion check: its file was replaced or damaged."""
    is_kept = path.is_symlink() and judgements_of(path.parent)
    is_shipped = is_starter(champion.name, champion.sha256)
    if is_kept and not is_shipped and read_judgement(path.parent, champion.sha256) is None:
        announce(
            f"model {champion.name} is not the file that was promoted: it was replaced, or the "
            "disk has changed a bit of it; it keeps labelling. Restore it from a backup, or "
            f"check the present file with `hearthlog models promote {champion.name}`"
        )


def load_checked(path: Path, on_damage: Callable[[str], object] | None = None) -> Loaded:
    """Load a model and check that it can classify; raise `ModelError` if it cannot be used."""
    model = load_model(path, on_damage)
    return Loaded(model, Classifier(model))


def file_identity(path: Path) -> FileIdentity:
    """Return an identity of a file's version; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size


class CandidateWatch:
    """Checks every second for another candidate, the optional link `candidate.safetensors`.

    The link is next to the model in use.
    """

    def __init__(self, folder: Path, features: FeatureSet) -> None:
        self._path = folder / (CANDIDATE + SUFFIX)
        self._features = features
        self._results: SimpleQueue[Loaded | str | None] = SimpleQueue()
        self._closed = Flag()
        self._seen = file_identity(self._path)
        self._look()
        self._refusals: list[str] = []
        self.first = next(self._news(), None)
        self._thread = Thread(target=self._watch, name="candidate watch", daemon=True)
        self._thread.start()

    def refusals(self) -> list[str]:
        """Return the refusals of candidates since the last call."""
        refusals, self._refusals = self._refusals, []
        return refusals

    def news(self) -> list[Loaded | None]:
        """Return the candidates since the last call; None where a candidate was removed."""
        return list(self._news())

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._thread.join()

    def _news(self) -> Iterator[Loaded | None]:
        with suppress(Empty):
            while True:
                result = self._results.get_nowait()
                if isinstance(result, str):
                    self._refusals.append(result)
                else:
                    yield result

    def _watch(self) -> None:
        while not self._closed.wait(LOOK_SECONDS):
            now = file_identity(self._path)
            if now != self._seen:
                self._seen = now
                self._look()

    def _look(self) -> None:
        if self._seen is None:
            self._results.put(None)
            return
        try:
            loaded = load_checked(self._path)
        except Exception as error:  # noqa: BLE001  whatever is wrong with the file, the recording goes on
            if file_identity(self._path) == self._seen:  # else it is still being written
                self._refuse(str(error) or repr(error))
            return
        theirs = loaded.classifier.feature_set
        if theirs == self._features:
            self._results.put(loaded)
        else:
            self._refuse(f"it is for feature set {theirs.name}, not {self._features.name}")

    def _refuse(self, reason: str) -> None:
        text = f"candidate refused: {reason}"
        self._results.put(text)
        self._results.put(None)
        announce(text)
