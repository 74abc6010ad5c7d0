"""The models of the configured microphones, opened and watched."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from hearthlog.models.errors import ModelError
from hearthlog.models.features.installed import DEFAULT, feature_set
from hearthlog.models.modelfile.modelfile import SUFFIX
from hearthlog.models.modelfile.registry import DEFAULT_FOLDER
from hearthlog.recorder.config import NO_MODEL, Settings
from hearthlog.recorder.labelling.candidate_watch import CandidateWatch
from hearthlog.recorder.labelling.labelling_models import LabellingModels
from hearthlog.recorder.labelling.model_watch import ModelWatch, ReloadRequests


def open_models(  # noqa: PLR0913
    settings: Settings,
    microphones: Sequence[str],
    reload_requests: ReloadRequests | None,
    stack: ExitStack,
    *,
    leaves_out: bool = False,
    network: str = "",
) -> dict[str, LabellingModels]:
    """Load the models of microphones, and watch their files; once for those that have the same.

    Parameters
    ----------
    reload_requests : ReloadRequests or None
        Make the recorder check at once whether a file has been replaced.
    leaves_out : bool
        Whether scenarios that cannot label are left out; else they are an error.

    Raises
    ------
    ModelError
        If a model cannot be used.
    ConfigurationError
        If models cannot label side by side.
    """
    reload_requests = reload_requests or ReloadRequests()
    chosen = {
        each.name: (each.model or settings.model or NO_MODEL, settings.scenarios_of(each))
        for each in settings.microphone
    }
    models: dict[str, LabellingModels] = {}
    for name in microphones:
        same = next((other for other in models if chosen[other] == chosen[name]), None)
        models[name] = (
            _watched_models(
                settings, *chosen[name], reload_requests, stack, network, leaves_out=leaves_out
            )
            if same is None
            else models[same]
        )
    return models


def _watched_models(  # noqa: PLR0913, PLR0917
    settings: Settings,
    path: Path,
    scenarios: Mapping[str, Path],
    reload_requests: ReloadRequests,
    stack: ExitStack,
    network: str,
    *,
    leaves_out: bool,
) -> LabellingModels:
    watches = {}
    left_out: list[str] | None = [] if leaves_out else None
    for name, file in scenarios.items():
        try:
            watch = ModelWatch(file, reload_requests.queue(), name, network)
            watches[name] = stack.enter_context(closing(watch))
        except ModelError as error:
            if left_out is None:
                raise
            left_out.append(str(error))
    if path == NO_MODEL:
        features = feature_set(settings.feature_set or DEFAULT.name)
        return LabellingModels(scenarios=watches, left_out=left_out, features=features)
    watch = ModelWatch(path, reload_requests.queue(), network=network)
    stack.enter_context(closing(watch))
    is_file = path.suffix == SUFFIX  # else the name of a starter
    folder = path.parent if is_file else DEFAULT_FOLDER
    candidates = CandidateWatch(folder, watch.first.classifier.feature_set)
    stack.enter_context(closing(candidates))
    return LabellingModels(watch, candidates, watches, left_out)
