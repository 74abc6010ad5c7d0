"""The file of the model that speaks, watched: what takes its place is loaded and checked aside."""

import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread
from typing import NamedTuple

from hearthlog.models.classifiers.classifier import Classifier
from hearthlog.models.classifiers.model import Model
from hearthlog.models.modelfile.modelfile import load_model

_LOOK_SECONDS = 1.0

_Identity = tuple[int, int, int, int] | None


class Loaded(NamedTuple):
    """A model that was checked, ready to speak."""

    model: Model
    classifier: Classifier


class ModelWatch:
    """Looks every second, in a thread of its own, whether a model's file is another one.

    Parameters
    ----------
    path : Path
        A model file, or a symbolic link to one.
    asked : SimpleQueue
        What is put into it makes the watch look at once, and say again what it has refused. Unlike
        an event it can be put to from a signal handler at any moment.

    Attributes
    ----------
    first : Loaded
        The model that is there at the start.
    ready : Loaded or None
        The last one that has taken its place; to be set to None by who uses it.

    Raises
    ------
    ModelError
        If the model that is there at the start cannot be used.
    """

    def __init__(self, path: Path, asked: SimpleQueue[None]) -> None:
        self._path = path
        self._asked = asked
        self._seen = _identity(path)  # before it is loaded: a later file is another one
        self.first = _load(path)
        self.ready: Loaded | None = None
        self._last = self.first.model
        _warn_if_simulated(self._last)
        self._found: SimpleQueue[Loaded | str] = SimpleQueue()
        self._closed = Flag()
        self._thread = Thread(target=self._watch, name="model watch", daemon=True)
        self._thread.start()

    def refusals(self) -> Iterator[str]:
        """Take what was found since the last time: say what was refused, and set `ready`."""
        with suppress(Empty):
            while True:
                found = self._found.get_nowait()
                if isinstance(found, str):
                    yield found
                else:
                    self.ready = found

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._asked.put(None)
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.is_set():
            asked = self._wait()
            now = _identity(self._path)
            if (now != self._seen or asked) and not self._closed.is_set():
                self._seen = now
                self._look()

    def _wait(self) -> bool:
        """Wait for the next look; return whether somebody has asked for it."""
        try:
            self._asked.get(timeout=_LOOK_SECONDS)
        except Empty:
            return False
        while not self._asked.empty():
            self._asked.get_nowait()
        return True

    def _look(self) -> None:
        try:
            loaded = _load(self._path)
        except Exception as error:  # noqa: BLE001  whatever is wrong with a file: the sound goes on
            if _identity(self._path) == self._seen:  # else it is still being written
                self._refuse(str(error) or repr(error))
            return
        if loaded.classifier.feature_set != self.first.classifier.feature_set:
            theirs, ours = (one.classifier.feature_set.name for one in (loaded, self.first))
            self._refuse(f"it is for feature set {theirs}, not {ours}; start the recorder anew")
            return
        model = loaded.model
        if (model.name, model.sha256) != (self._last.name, self._last.sha256):
            self._last = model
            _warn_if_simulated(model)
            self._found.put(loaded)

    def _refuse(self, reason: str) -> None:
        text = f"model {self._path.stem} refused: {reason}; going on with {self._last.name}"
        self._found.put(text)
        _say(text)


def _warn_if_simulated(model: Model) -> None:
    if model.description.training_data.simulated:
        _say(
            f"model {model.name} has learned from simulated sounds alone and is mostly wrong about "
            "real ones, however sure it is; train one from recordings"
        )


def _say(text: str) -> None:
    with suppress(OSError):  # the log says it too
        sys.stderr.write(f"hearthlog: {text}\n")
        sys.stderr.flush()


def _load(path: Path) -> Loaded:
    model = load_model(path)
    return Loaded(model, Classifier(model))


def _identity(path: Path) -> _Identity:
    """Return what changes when another file takes a name; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size
