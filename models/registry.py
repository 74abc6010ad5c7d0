"""A folder of model files: champion, candidate, history, and labelling judgements."""

import hashlib
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from hearthlog.models.classifiers.model import Model
from hearthlog.models.classifiers.network_names import AUDIOSET, is_by_names
from hearthlog.models.modelfile import SUFFIX, load_model
from hearthlog.models.starter import GENERAL, STARTERS, starter_file, with_network
from hearthlog.schemas.errors import LogError, ModelError
from hearthlog.schemas.new_files import (
    locked_folder,
    private_folder,
    replaced_file,
    sync_folder,
)

_FOLDER = "judgements"
_LARGEST = 1 << 16  # bytes
_MOST_REASONS = 32
_LONGEST_REASON = 500  # characters
_SHA256 = "[0-9a-f]{64}"

_Text = Annotated[str, StringConstraints(max_length=_LONGEST_REASON, pattern="^[^\x00-\x1f\x7f]*$")]


class Judgement(BaseModel):
    """The decision whether a model may label a home: one small file per model, next to the models.

    The file name contains the hash of the model, so another of the same name has no judgement.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Annotated[str, StringConstraints(pattern=f"^{_SHA256}$")]
    # SHA-256 of the model used for comparison; empty if there was none
    champion: Annotated[str, StringConstraints(pattern=f"^({_SHA256})?$")]
    # time of the judgement in nanoseconds of UTC
    judged: Annotated[int, Field(ge=0, lt=1 << 63, strict=True)]
    # reasons for a refusal, one sentence each; empty if the model may label
    reasons: Annotated[tuple[_Text, ...], Field(max_length=_MOST_REASONS)] = ()
    insisted: Annotated[bool, Field(strict=True)] = False

    @property
    def may_label(self) -> bool:
        """Whether the model may label."""
        return self.insisted or not self.reasons


def judgement_path(folder: Path, sha256: str) -> Path:
    """Return the path of a model's judgement."""
    return folder / _FOLDER / f"{sha256}.json"


def judgements_of(folder: Path) -> list[Path]:
    """List the judgement files of a folder of models."""
    return list((folder / _FOLDER).glob("*.json"))


def read_judgement(folder: Path, sha256: str) -> Judgement | None:
    """Read the valid judgement of a model; None if there is none."""
    path = judgement_path(folder, sha256)
    with suppress(OSError, ValidationError):
        if path.is_file():
            with path.open("rb") as stream:
                data = stream.read(_LARGEST + 1)
            if len(data) <= _LARGEST:
                judgement = Judgement.model_validate_json(data)
                return judgement if judgement.model == sha256 else None
    return None


def write_judgement(folder: Path, judgement: Judgement) -> None:
    """Write a judgement, replacing an earlier one; raise `ModelError` if that fails."""
    path = judgement_path(folder, judgement.model)
    try:
        private_folder(path.parent)
        with replaced_file(path) as temporary:
            temporary.write_text(judgement.model_dump_json(indent=2))
    except (LogError, OSError) as error:
        raise ModelError(f"{path}: cannot be written ({error})") from error


def override_judgement(folder: Path, sha256: str) -> None:
    """Allow a model to label regardless of its judgement, or without one.

    Raise `ModelError` if the permission cannot be written.
    """
    judgement = read_judgement(folder, sha256)
    if judgement is None or not judgement.may_label:
        judgement = judgement or Judgement(model=sha256, champion="", judged=time.time_ns())
        write_judgement(folder, judgement.model_copy(update={"insisted": True}))


# Both are symbolic links in the folder, so any program can open them. A link is replaced in one
# step, so there is always a champion. The file `history` lists earlier champions, the last one at
# the end. It is written before the link: if a command is killed between the two writes, `history`
# ends with the current champion, which is skipped.
CHAMPION, CANDIDATE = ALIASES = ("champion", "candidate")
DEFAULT_FOLDER = Path("models")
DEFAULT_MODEL = DEFAULT_FOLDER / (CHAMPION + SUFFIX)
_HISTORY = "history"
_KEPT = 100  # earlier champions


@dataclass(frozen=True, eq=False)
class ModelEntry:
    """One model file of the folder, or a starter model."""

    name: str
    aliases: tuple[str, ...]  # aliases of this model
    size: int  # bytes
    model: Model | None
    problem: str = ""  # reason why the file cannot be used
    starter: bool = False  # shipped with this version, whether or not the folder has a copy


def list_models(folder: Path) -> list[ModelEntry]:
    """Load all models of a folder and the starter models, by name; also targets of broken aliases.

    An unusable entry has a `problem`; only starter models if the folder does not exist. Raise
    `ModelError` if the path is not a folder, or an alias is not a link to a model file in it.
    """
    if os.path.lexists(folder):
        _check_folder(folder)
    named = {alias: target(folder, alias) for alias in ALIASES}
    names = {path.stem for path in folder.glob("[!.]*" + SUFFIX)} - set(ALIASES)
    names |= {name for name in named.values() if name is not None}
    entries = [
        _entry(_path(folder, name), tuple(alias for alias in ALIASES if named[alias] == name))
        for name in sorted(names)
    ]
    return entries + [_entry(starter_file(name), ()) for name in STARTERS if name not in names]


def target(folder: Path, alias: str) -> str | None:
    """Return the name of an alias's target, which need not exist; None without the alias.

    Raise `ModelError` if the alias exists but is not a link to a model file in the folder.
    """
    link = _path(folder, alias)
    if not os.path.lexists(link):
        return None
    text = str(link.readlink()) if link.is_symlink() else ""
    if Path(text).name != text or Path(text).suffix != SUFFIX or Path(text).stem in ALIASES:
        raise ModelError(
            f"{link}: is no link to a model file of this folder; give it another name, and promote "
            "a model"
        )
    return Path(text).stem


def resolve(folder: Path, name: str) -> str:
    """Resolve an alias, or a name of a model or its file, which need not exist, to a model's name.

    Raise `ModelError` if the alias does not exist or is not a link to a model file, or the name
    points outside the folder.
    """
    name = name.removesuffix(SUFFIX)
    if name in ALIASES:
        model = target(folder, name)
        if model is None:
            raise ModelError(f"{folder}: there is no {name}; name a model, or promote one")
        return model
    if Path(name).name != name:
        raise ModelError(f"{name!a}: name a model of {folder}, without its folder")
    return name


def load(folder: Path, name: str) -> Model:
    """Load a model of a folder, by `name` as in `resolve`, or a starter model or `audioset`.

    Raise `ModelError` if the folder does not exist, or `resolve` or `load_model` refuses the model.
    """
    stem = name.removesuffix(SUFFIX)
    if stem in {*STARTERS, AUDIOSET} and not os.path.lexists(_path(folder, stem)):
        return load_model(Path(AUDIOSET) if stem == AUDIOSET else starter_file(stem))
    _check_folder(folder)
    return load_model(_path(folder, resolve(folder, name)))


def find_model_by_sha256(folder: Path, sha256: str) -> Path | None:
    """Find a model by its SHA-256, in a folder or among the starter models."""
    for path in [*sorted(folder.glob("[!.]*" + SUFFIX)), *map(starter_file, STARTERS)]:
        if path.is_file() and not path.is_symlink() and _digest(path) == sha256:
            return path
    return None


def is_starter(name: str, sha256: str) -> bool:
    """Return whether a model is a starter model of this version."""
    file = starter_file(name)
    return name in STARTERS and file.is_file() and _digest(file) == sha256


def first_starter(folder: Path) -> str | None:
    """Return the name of the starter model that preceded the champion.

    It is the one from which the champion was adapted, traced through models still in the folder;
    else `general`, the default of a recorder, in the variant with embeddings if the champion uses
    embeddings. None if the champion is that model, or has another feature set.
    """
    try:
        champion = model = load(folder, CHAMPION)
    except ModelError:
        return GENERAL
    seen: set[str] = set()
    while (sha256 := model.description.training_data.base_sha256) not in {"", *seen}:
        seen.add(sha256)
        for name in STARTERS:
            if is_starter(name, sha256):
                return name
        path = find_model_by_sha256(folder, sha256)
        if path is None:
            break
        with suppress(ModelError):
            model = load_model(path)
    name = GENERAL if champion.description.embedding is None else with_network(GENERAL)
    general = load_model(starter_file(name))
    alike = champion.description.feature_set == general.description.feature_set
    return name if alike and champion.sha256 != general.sha256 else None


def promote(folder: Path, name: str, alias: str = CHAMPION) -> tuple[Model, str | None]:
    """Point an alias to a usable model; a starter model is first copied to the folder.

    The folder is created if needed for a starter model. Permission to label is a separate
    judgement, which the recorder reads.

    Raise `ModelError` if the model cannot be used, if the folder does not exist or is not writable,
    or if the file at the alias is not a link to a model file.
    """
    with _locked(folder, make=name.removesuffix(SUFFIX) in STARTERS):
        before = target(folder, alias)
        model = load(folder, name)
        if is_by_names(model):
            raise ModelError(
                f"{name} has learned nothing and labels beside the champion: write "
                f'scenarios = {{{AUDIOSET} = "{AUDIOSET}"}} into the configuration of the recorder'
            )
        _copy_starter(folder, model)
        if model.name != before:
            if alias == CHAMPION and before is not None:
                _write_history(folder, [*_earlier(folder), before])
            _point(folder, alias, model.name)
        return model, before


def rollback(folder: Path) -> tuple[Model, str]:
    """Restore the last earlier champion that is still usable, and permit it to label.

    The default starter model counts as the predecessor of the first champion.

    Raise `ModelError` if there is no champion, no usable earlier champion, or the folder does not
    exist or is not writable.
    """
    with _locked(folder):
        before = resolve(folder, CHAMPION)
        earlier = _earlier(folder)
        while earlier:
            with suppress(ModelError):
                model = load(folder, earlier.pop())
                override_judgement(folder, model.sha256)
                _point(folder, CHAMPION, model.name)
                _write_history(folder, earlier)
                return model, before
        starter = first_starter(folder)
        if starter is None:
            raise ModelError(f"{folder}: no champion before {before} can be used; promote a model")
        model = load(folder, starter)
        if not is_starter(model.name, model.sha256):
            raise ModelError(
                f"{_path(folder, starter)}: is not the starter of this name; give it another name "
                "to return to that, or promote a model"
            )
        _copy_starter(folder, model)
        override_judgement(folder, model.sha256)
        _point(folder, CHAMPION, model.name)
        _write_history(folder, [])
        return model, before


def _copy_starter(folder: Path, model: Model) -> None:
    """Copy a starter model to a folder, unless the folder has a file of this name."""
    path = _path(folder, model.name)
    if not os.path.lexists(path):
        with replaced_file(path) as temporary:
            shutil.copyfile(starter_file(model.name), temporary)


def _entry(path: Path, aliases: tuple[str, ...]) -> ModelEntry:
    try:
        model = load_model(path)
        size, starter = path.stat().st_size, is_starter(model.name, model.sha256)
        return ModelEntry(path.stem, aliases, size, model, starter=starter)
    except (ModelError, OSError) as error:
        size = path.stat().st_size if path.is_file() else 0
        return ModelEntry(path.stem, aliases, size, None, str(error))


def _path(folder: Path, name: str) -> Path:
    return folder / (name + SUFFIX)


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise ModelError(
            f"{folder}: no such folder of models; `hearthlog train -o {folder}/NAME.safetensors` "
            "makes it"
        )


@contextmanager
def _locked(folder: Path, *, make: bool = False) -> Iterator[None]:
    """Lock the aliases of a folder against other processes."""
    try:
        if make:
            private_folder(folder)
        _check_folder(folder)
        with locked_folder(folder):
            yield
    except LogError as error:
        raise ModelError(str(error)) from error
    except OSError as error:
        raise ModelError(f"{folder}: cannot be written ({error.strerror or error})") from error


def _point(folder: Path, alias: str, name: str) -> None:
    """Replace a link atomically."""
    link = _path(folder, alias)
    temporary = folder / f".{link.name}.tmp"
    temporary.unlink(missing_ok=True)  # left by a killed command
    temporary.symlink_to(name + SUFFIX)
    temporary.replace(link)
    sync_folder(folder)


def _earlier(folder: Path) -> list[str]:
    """Read the earlier champions, without the current champion."""
    path = folder / _HISTORY
    names = path.read_text(errors="replace").splitlines() if path.is_file() else []
    champion = target(folder, CHAMPION)
    while names and names[-1] == champion:
        names.pop()
    return names


def _write_history(folder: Path, names: list[str]) -> None:
    with replaced_file(folder / _HISTORY) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in names[-_KEPT:]))
