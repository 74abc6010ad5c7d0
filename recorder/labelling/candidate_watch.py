"""The candidate, watched: a model on trial, which labels beside the one in use."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread

from hearthlog.models.features.feature_set import FeatureSet
from hearthlog.models.modelfile.modelfile import SUFFIX
from hearthlog.models.modelfile.registry import CANDIDATE
from hearthlog.recorder.journal import say
from hearthlog.recorder.labelling.model_watch import (
    LOOK_SECONDS,
    Loaded,
    file_identity,
    load_checked,
)


class CandidateWatch:
    """Checks every second, in a thread of its own, whether there is another candidate.

    The candidate is the link `candidate.safetensors` beside the model in use. It need not be there.
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
        """Return why candidates were refused since the last call."""
        refusals, self._refusals = self._refusals, []
        return refusals

    def news(self) -> list[Loaded | None]:
        """Return the candidates since the last call; None where there was none any more."""
        return list(self._news())

    def close(self) -> None:
        """End the thread."""
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
        say(text)
