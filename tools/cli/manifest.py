"""`hearthlog manifest`: a collection of labelled sound to what `train` learns from."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hearthlog.tools.cli.options import check_output
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.table import print_table
from hearthlog.tools.cli.text import end_with_warnings, number, print_lines, tell, wrong_use

if TYPE_CHECKING:
    from collections import Counter

    from hearthlog.analyzer.collections.manifest_writer import ManifestSummary

_SHOWN = 12


def manifest(
    collection: Annotated[
        str,
        typer.Argument(
            help="esc50, fsd50k, urbansound8k, desed, vocalsound, audioset-strong, ravdess, "
            "emodb, voxceleb, or folder."
        ),
    ],
    folder: Annotated[Path | None, typer.Argument(help="Folder of the collection.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Manifest to make, *.csv.")
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option("--map", help="Labels of its categories (TOML), as --print-map prints them."),
    ] = None,
    source: Annotated[
        str | None, typer.Option(help="Name of the sounds in a `folder`; by default its own.")
    ] = None,
    licence: Annotated[
        str | None, typer.Option(help="Licence of the sounds in a `folder`, such as CC0.")
    ] = None,
    print_map: Annotated[
        bool, typer.Option("--print-map", help="Only print the map of the collection, to edit it.")
    ] = False,
) -> None:
    """List the clips of a collection, with labels, sources and licences, to learn from.

    Exit status 3: some audio files of the collection are not there.
    """
    from hearthlog.analyzer.collections.manifest_writer import make_manifest, shipped_map
    from hearthlog.analyzer.collections.readers import FOLDER, NAMES, find_collection

    chosen = find_collection(collection)
    if chosen is None:
        wrong_use(f"{collection}: no such collection; choose one of {', '.join(NAMES)}")
    if (source or licence) and chosen != FOLDER:
        wrong_use(f"--source and --licence are for a folder; {chosen.title} says its own")
    if print_map:
        print(shipped_map(chosen.name), end="")
        return
    if folder is None or output is None:
        wrong_use("give the folder of the collection, and --output; or --print-map")
    check_output("--output", output, ".csv", "a manifest")
    with share_done(f"looking at {folder}") as report:
        made = make_manifest(chosen, folder, output, report, map_file, source or "", licence or "")
    _print(made)
    print(f"\n{output}: {number(made.clips.total(), 'clip')}")
    alone = [label for label, count in made.clips.items() if len(made.groups[label]) == 1 < count]
    if chosen == FOLDER and alone:
        tell(
            f"{', '.join(alone)}: all files count as one recording, for their names differ in a "
            "number only, and training wants several; give each recording or person a sub-folder"
        )
    if made.missing:
        files = number(made.files, "audio file")
        lost = f"{made.missing:,} of {files} are not there, such as {made.first_missing}"
        end_with_warnings([f"{folder}: {lost}; left out"])


def _print(made: "ManifestSummary") -> None:
    rows = [
        (label, f"{count:,}", f"{len(made.groups[label]):,}")
        for label, count in sorted(made.clips.items())
    ]
    print_table(("label", "clips", "sources"), rows)
    print()
    print_lines(_counts("licences", made.licences, "unstated"))
    print_lines(_counts("other_negative is", made.negatives))
    print_lines(f"left out: {count:,}, {why}" for why, count in made.left_out.most_common())
    print_lines(_counts("those that may be one of ours are", made.skipped))


def _counts(what: str, counts: "Counter[str]", unnamed: str = "") -> list[str]:
    """List what is most frequent in a line, if there is anything."""
    named = [f"{name or unnamed} {count:,}" for name, count in counts.most_common(_SHOWN)]
    more = [f"and {len(counts) - _SHOWN:,} more"] if len(counts) > _SHOWN else []
    return [f"{what}: {', '.join(named + more)}"] if named else []
