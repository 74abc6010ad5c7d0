"""`hearthlog evaluate paper`: the figures of the paper beside ours."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from hearthlog.schemas.text import shortened
from hearthlog.tools.cli.options import Clips, Json, labelled_clips
from hearthlog.tools.cli.progress import share_done
from hearthlog.tools.cli.scores import between, share
from hearthlog.tools.cli.table import NAME_WIDTH, print_table
from hearthlog.tools.cli.text import end_with_warnings, number, print_json

if TYPE_CHECKING:
    from hearthlog.analyzer.evaluation.evaluate_method import CrossValidation
    from hearthlog.analyzer.evaluation.paper import Reproduction
    from hearthlog.analyzer.training.manifest import LeftOut

_MOSTLY = 0.7  # share of a class that is of one collection
_THIN = 20  # sources
_SCORES = ("precision", "recall", "F1", "95 %")


def paper(
    *,
    data: Clips,
    scenario: Annotated[
        Literal["bathroom", "general"] | None,
        typer.Option(help="Only this one.", show_default="both"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Put the figures of the paper beside those of its method and of ours, on these clips."""
    from hearthlog.analyzer.extras import require

    require("sklearn", "scipy", "joblib")
    from hearthlog.analyzer.evaluation.paper import PAPER_F1, reproduce
    from hearthlog.analyzer.training.manifest import left_out_lines
    from hearthlog.analyzer.training.scenario import LABELS

    left_out: list[LeftOut] = []
    clips = labelled_clips([data], LABELS, left_out)
    scenarios = [scenario] if scenario else list(PAPER_F1)
    with share_done(f"learning from {number(len(clips), 'clip')}", announce=True) as progress:
        found = reproduce(clips, scenarios, progress)
    left_out += dict.fromkeys(clip for one in found for clip in one.left_out)
    if as_json:
        print_json({one.scenario: _as_json(one) for one in found})
    else:
        for one in found:
            print_reproduction(one)
        print(_WHY)
    end_with_warnings(left_out_lines(left_out))


def print_reproduction(found: "Reproduction") -> None:
    """Print what the paper reports of a scenario, and how its method and ours do on each class."""
    segments = sum(one.segments for one in found.sound.values())
    print(
        f"{found.scenario}: {segments} segments of 1 s from {number(found.sources, 'source')} in "
        f"{number(found.collections, 'collection')}\n"
    )
    methods = list(dict.fromkeys(method for method, _ in found.results))
    kinds = list(dict.fromkeys(kind for _, kind in found.results))
    rows = [("the paper reports", f"{found.paper_f1:.2f}", *("" for _ in kinds[1:]))]
    for method in methods:
        results = [found.results[method, kind] for kind in kinds]
        rows += [
            (f"{method}: macro F1", *(share(one.scores.macro_f1) for one in results)),
            ("  95 %", *(between(one.scores.macro_f1_interval) for one in results)),
            ("  share right", *(share(_right(one)) for one in results)),
        ]
    print_table(("folds by", *kinds), rows)
    print()
    rows = [
        (
            shortened(name, NAME_WIDTH),
            *map(str, (one.segments, one.sources, one.collections)),
            share(one.largest),
        )
        for name, one in found.sound.items()
    ]
    print_table(("class", "segments", "sources", "collections", "largest"), rows)
    print()
    heads = [(f"{method}: {_SCORES[0]}", *_SCORES[1:]) for method in methods]
    rows = [
        (
            shortened(name, NAME_WIDTH) if kind == kinds[0] else "",
            kind,
            *(cell for method in methods for cell in _cells(found.results[method, kind], name)),
        )
        for name in found.sound
        for kind in kinds
    ]
    print_table(("class", "folds by", *(cell for head in heads for cell in head)), rows, words=2)
    print(f"\n{_thin_text(found)}\n")


def _cells(result: "CrossValidation", name: str) -> tuple[str, ...]:
    one = result.scores.per_class[name]
    return (*map(share, (one.precision, one.recall, one.f1)), between(one.f1_interval))


def _right(result: "CrossValidation") -> float:
    from hearthlog.analyzer.evaluation.paper import share_right

    return share_right(result.scores.confusion)


def _thin_text(found: "Reproduction") -> str:
    """Say which classes the figures know little of."""
    few = [name for name, one in found.sound.items() if one.sources < _THIN]
    one_sided = [name for name, one in found.sound.items() if one.largest > _MOSTLY]
    return (
        f"fewer than {_THIN} sources: {', '.join(few) or 'none'}\n"
        f"more than {_MOSTLY:.0%} from one collection, which folds by collection leave out: "
        f"{', '.join(one_sided) or 'none'}"
    )


def _as_json(found: "Reproduction") -> dict[str, Any]:
    results: dict[str, dict[str, Any]] = {}
    for (method, kind), one in found.results.items():
        results.setdefault(method, {})[kind] = {
            "folds": one.folds,
            "share_right": _right(one),
            **asdict(one.scores),
        }
    return {
        "paper_f1": found.paper_f1,
        "sources": found.sources,
        "collections": found.collections,
        "sound": {name: one._asdict() for name, one in found.sound.items()},
        "methods": results,
        "skipped": dict(found.skipped),
    }


_WHY = """\
why they differ
- Folds by segment are the paper's: its published code draws the windows to test on at random, of
  windows that begin 50 ms apart. Seconds of one recording are alike, so what is tested is half
  known. The figure says how well recordings are told apart that were learned from.
- Folds by source keep the seconds of a recording, or of a speaker, on one side. The figure is of
  new sounds, by microphones and in rooms that were learned from.
- Folds by collection leave out all that a collection recorded, as a home is of which nothing was
  learned. The classes of a collection share a signature (microphone, room, codec), and a class that
  is mostly of one collection is hardly learned without it.
- Macro F1 is the mean over classes: a class of few sources counts as much as any other. The code of
  the paper prints this mean as F1. The share right (micro F1) counts segments.
- The 95 % are of other draws of sources. They do not know how other collections would be.
- paper learns from the mean and deviation of 21 features over a second, with an RBF support vector
  machine. room, the default, learns from 33 features above the floor of the room, and from copies
  in other rooms; here without the class unknown, which the paper has not.
- The 45 minutes of sound of the paper are not published. These clips are others."""
