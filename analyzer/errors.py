"""Errors of the analyzer, and the commands that install what is missing."""

import json
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

from hearthlog.schemas.errors import HearthlogError, listed


class DataError(HearthlogError):
    """Logs or labelled sounds cannot be used, or a result cannot be written."""


class WorkerError(HearthlogError):
    """A worker failed before finishing its task, or no worker is available."""


class LostClusterError(WorkerError):
    """The connection to the Dask cluster is lost, with all unfinished tasks."""


@contextmanager
def collect_errors(messages: list[str], *kinds: type[Exception]) -> Iterator[None]:
    """Suppress errors of some kinds, and add their messages to a list."""
    try:
        yield
    except kinds as error:
        messages.append(str(error))


_CLUSTER = ("dask", "distributed", "fsspec", "s3fs", "upath")
_EXTRAS = {
    "rerun": "viewer",
    "rerun_cli": "viewer",
    "foxglove": "foxglove",
    "ai_edge_litert": "embedding",
    "onnx": "onnx",
    "onnxruntime": "onnx",
    "paho": "bridge",
    "apprise": "bridge",
    "prometheus_client": "bridge",
} | dict.fromkeys(_CLUSTER, "cluster")
_NAMES = {"sklearn": "scikit-learn", "paho": "paho-mqtt", "rerun": "Rerun", "rerun_cli": "Rerun"}
_NAMES["ai_edge_litert"] = "LiteRT"


class MissingModuleError(HearthlogError, ModuleNotFoundError):
    """A module of an extra is not installed."""


def require(*modules: str) -> None:
    """Check that modules of an extra can be imported, before starting work that needs them.

    Raise `MissingModuleError` if a module is not installed.

    Parameters
    ----------
    *modules : str
        Import names.
    """
    absent = [module for module in modules if find_spec(module) is None]
    if absent:
        raise MissingModuleError(missing(*absent))


def missing(*modules: str) -> str:
    """Format an error message for missing modules, with the command that installs them."""
    tops = [module.partition(".")[0] for module in modules]
    names = list(dict.fromkeys(_NAMES.get(top, top) for top in tops))
    are = "is" if len(names) == 1 else "are"
    return f"{listed(names, 'and')} {are} not installed; {remedy(*tops)}"


def remedy(*modules: str) -> str:
    """Return the command that installs the extras of modules the way hearthlog was installed."""
    extra = ",".join(
        dict.fromkeys(_EXTRAS.get(module.partition(".")[0], "headless") for module in modules)
    )
    given, options = _origin()
    name, _, address = given.partition(" @ ")
    what = f"{name}[{extra}]" + (f" @ {address}" if address else "")
    where = " in a clone of hearthlog" if given == "." else ""
    return f"try: {_installer()} {options}{shlex.quote(what)}{where}"


def _installer() -> str:
    prefix, program = Path(sys.prefix), Path(sys.executable)
    if (prefix / "pipx_metadata.json").exists():
        return "pipx install --force"
    if (prefix / "uv-receipt.toml").exists():
        return "uv tool install"
    if find_spec("pip") is None:
        command = f"uv pip install --python {shlex.quote(sys.executable)}"
    elif (pip := program.with_name("pip")).exists():
        command = f"{shlex.quote(str(pip))} install"
    else:
        command = f"{shlex.quote(str(program))} -m pip install"
    return command if os.access(prefix, os.W_OK) else f"sudo {command}"


def _origin() -> tuple[str, str]:
    """Return the requirement given to pip (PEP 610), `.` if unknown, and the options of pip."""
    try:
        record = json.loads(distribution("hearthlog").read_text("direct_url.json") or "{}")
        url = urlsplit(record["url"])
        vcs = record.get("vcs_info", {}).get("vcs")
        editable = record.get("dir_info", {}).get("editable")
    except (PackageNotFoundError, ValueError, KeyError, AttributeError, OSError):
        return ".", ""
    path = unquote(url.path)
    if url.scheme != "file":
        return f"hearthlog @ {f'{vcs}+' if vcs else ''}{url.geturl()}", ""
    return (path, "--editable " if editable else "") if Path(path).exists() else (".", "")
