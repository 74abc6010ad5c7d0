"""What is to be done with each log: its job, and whether its layer is current."""

from pathlib import Path
from typing import NamedTuple

from hearthlog.analyzer.logs.layers import Chain
from hearthlog.analyzer.relabel.layer import LayerMetadata
from hearthlog.models.classifiers.model import Model
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.logs.files import relabel_path, stem
from hearthlog.schemas.logs.metadata import earlier_digests

_MOST_EARLIER = 1000  # logs: within so many a floor is forgotten, even if each has a minute only


class Job(NamedTuple):
    """A log to label."""

    log: Path
    layer: Path
    earlier: tuple[Path, ...]  # logs before it, the last first
    next_log: Path | None
    model: Path
    model_sha256: str
    replaces: bool  # whether there is a layer that may be replaced
    continues_layer: bool  # whether the open segment at the start is taken from the layer before


def make_job(
    chain: Chain, place: int, model: Model, model_path: Path, *, continues_layer: bool
) -> Job:
    """Make the job of one log of a chain, as if it had no layer.

    Parameters
    ----------
    continues_layer : bool
        Whether the open segment at the start is taken from the layer before.
    """
    log = chain.logs[place]
    first = max(place - _MOST_EARLIER, 0) if continues_layer else 0
    return Job(
        log=log,
        layer=relabel_path(log, model.name),
        earlier=tuple(reversed(chain.logs[first:place])),
        next_log=chain.logs[place + 1] if place + 1 < len(chain.logs) else None,
        model=model_path,
        model_sha256=model.sha256,
        replaces=False,
        continues_layer=continues_layer,
    )


def is_current(job: Job, metadata: LayerMetadata, log_sha256: str) -> bool:
    """Tell whether a layer need not be made again; its open segment at the start is not compared.

    Raise `LogError` if the layer is of another model, or of another log.
    """
    inputs = metadata.inputs
    if inputs.model_sha256 != job.model_sha256:
        raise LogError(
            f"{job.layer}: was made by another model of this name ({inputs.model_sha256[:12]}, not "
            f"{job.model_sha256[:12]}); move it away, or give the model another name"
        )
    digest = inputs.input_sha256
    if digest != log_sha256 and digest not in earlier_digests(job.log):
        raise LogError(
            f"{job.layer}: was made from another log of this name; move it away, and run again"
        )
    # Where a log beside it has been deleted since, the layer knows more than one made now would.
    same_before = not job.earlier or stem(job.earlier[0]) == inputs.before
    same_behind = job.next_log is None or stem(job.next_log) == inputs.behind
    return same_before and same_behind and not metadata.loss
