"""`hearthlog models fetch`: a network of sounds, downloaded because somebody asks for it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.text import end_with_warnings, print_lines, tell, wrong_use

if TYPE_CHECKING:
    from hearthlog.models.embedding.networks import EmbeddingNetwork


def fetch(
    name: Annotated[
        str | None, typer.Argument(help="A network, as yamnet; without any they are listed.")
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option("--from", help="A file of the network that you have, instead of a download."),
    ] = None,
) -> None:
    """Fetch a network of sounds, with which labels are truer in a home that nobody has heard.

    This is the only command of hearthlog that downloads. It says whose the network is, checks that
    the file is the one that is known, and tries it. Exit status 3: it is there, and cannot be used.
    """
    from hearthlog.models.embedding.networks import NETWORKS, network_folders
    from hearthlog.tools.service.unit import NAME, SYSTEM_UNITS

    if name is None:
        if source is not None:
            wrong_use("say which network it is: hearthlog models fetch NAME --from FILE")
        _list()
        return
    network = NETWORKS.get(name)
    tell(f"{network.attribution}; its licence is {network.licence}")
    path = _put(network) if source is None else _put_from(network, source)
    print(path)
    if path.is_relative_to(network_folders()[0]) and (SYSTEM_UNITS / NAME).exists():
        tell("the service of this machine does not look there: for it, run this with sudo")
    end_with_warnings(_tried(network, path))


def _put(network: "EmbeddingNetwork") -> Path:
    """Download a network, unless it is there; return where it is."""
    from hearthlog.models.embedding.networks import folder_for_new, read_network_file
    from hearthlog.models.errors import ModelError
    from hearthlog.tools.cli.progress import share_done
    from hearthlog.tools.download import DownloadError, download

    path = folder_for_new() / network.filename
    try:
        read_network_file(network, path)
    except ModelError:
        pass
    else:
        tell("it is there already")
        return path
    file = network.files[0]
    if not file.url:
        raise ModelError(f"{network.name}: there is no address of it; bring its file with --from")
    what = f"fetching {file.size / 1e6:.1f} MB from {file.url.split('/')[2]}"
    try:
        with share_done(what, announce=True) as report:
            download(file.url, path, file.size, file.sha256, report)
    except DownloadError as error:
        raise DownloadError(f"{error}; or bring its file: models fetch NAME --from FILE") from error
    return path


def _put_from(network: "EmbeddingNetwork", source: Path) -> Path:
    from hearthlog.models.embedding.networks import folder_for_new, read_network_file
    from hearthlog.tools.download import put

    data, _ = read_network_file(network, source)
    path = folder_for_new() / network.filename
    put(data, path)
    return path


def _tried(network: "EmbeddingNetwork", path: Path) -> list[str]:
    """Try a network as a recorder will; return what is wrong with it."""
    from hearthlog.analyzer.extras import missing
    from hearthlog.models.embedding.networks import missing_modules
    from hearthlog.models.errors import ModelError
    from hearthlog.recorder.labelling.embedder_probe import check_pace, probe_network

    if absent := missing_modules(network.suffix):
        return [missing(*absent)]
    try:
        probe = probe_network(network.name, path)
        check_pace(path, probe)
    except ModelError as error:
        return [str(error)]
    if probe.different_answers:
        first = probe.different_answers[0]
        return [f"{path}: hears otherwise than models were made with ({first}): labels are worse"]
    tell(f"it works: {1000 * probe.seconds:.2g} ms for a window; recorders take it when they start")
    return []


def _list() -> None:
    from hearthlog.models.embedding.networks import NETWORKS, find_network
    from hearthlog.models.errors import ModelError

    problems = []
    for name in NETWORKS.names():
        try:
            network = NETWORKS.get(name)
        except ModelError as error:
            problems.append(str(error))
            continue
        size = f"{network.files[0].size / 1e6:.1f} MB"
        there = find_network(name) or "not there"
        line = f"{name}: {there} ({size}, {network.licence}; {network.attribution})"
        print_lines([line])
    end_with_warnings(problems)
