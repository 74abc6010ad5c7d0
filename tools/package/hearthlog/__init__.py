"""Long-term sound monitoring of a home: features and labels every 50 ms, in MCAP logs.

The public API is `__all__`; all other modules may change between versions. Names are imported on
first use, so `import hearthlog` costs a recorder nothing.
"""

import sys
import warnings
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hearthlog._version import __version__

if TYPE_CHECKING:
    from hearthlog._logs import Bearings, Columns, Labelling, Logs, Mark, follow, open_logs
    from hearthlog._sound import (
        Model,
        SoundFeatures,
        SoundLabels,
        classify,
        extract_features,
        load_model,
        save_model,
    )
    from hearthlog._training import Comparison, compare, train
    from hearthlog.schemas.errors import HearthlogError, HearthlogWarning

if not Path(__file__).with_name("schemas").is_dir():  # an editable install of a clone
    __path__.append(str(Path(__file__).parents[3]))

__all__ = [
    "Bearings",
    "Columns",
    "Comparison",
    "HearthlogError",
    "HearthlogWarning",
    "Labelling",
    "Logs",
    "Mark",
    "Model",
    "SoundFeatures",
    "SoundLabels",
    "__version__",
    "classify",
    "compare",
    "extract_features",
    "follow",
    "load_model",
    "open_logs",
    "save_model",
    "train",
]
_MODULES = (
    "hearthlog.schemas.errors",
    "hearthlog._logs",
    "hearthlog._sound",
    "hearthlog._training",
)


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in map(_imported, _MODULES):
            if hasattr(module, name):
                return getattr(module, name)
    raise AttributeError(f"module 'hearthlog' has no attribute {name!r}")


def _imported(module: str) -> ModuleType:
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        from hearthlog.analyzer.errors import MissingModuleError, missing  # noqa: PLC0415

        raise MissingModuleError(missing(error.name or module)) from error


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


_MOVED = {  # modules that documents of earlier versions name, mostly for extensions
    "hearthlog.analyzer.evaluation.event_scores": "hearthlog.analyzer.evaluation",
    "hearthlog.analyzer.training.landmark_method": "hearthlog.analyzer.training.window_methods",
    "hearthlog.analyzer.training.learned_inputs": "hearthlog.analyzer.training.window_methods",
    "hearthlog.analyzer.training.svm_method": "hearthlog.analyzer.training.window_methods",
    "hearthlog.analyzer.training.window_method": "hearthlog.analyzer.training.window_methods",
    "hearthlog.models.classifiers.classifier_kind": "hearthlog.models.classifiers",
    "hearthlog.models.classifiers.learned_windows": "hearthlog.models.classifiers",
    "hearthlog.models.classifiers.rbf_distances": "hearthlog.models.classifiers.rbf_machines",
    "hearthlog.models.classifiers.svm_rbf": "hearthlog.models.classifiers.rbf_machines",
    "hearthlog.models.embedding.projection": "hearthlog.models.embedding",
    "hearthlog.models.features.feature_set": "hearthlog.models.features",
    "hearthlog.models.features.window_inputs": "hearthlog.models.features",
}


class _MovedModules:
    """Finds moved modules under their former names, with a warning that has the new one."""

    @classmethod
    def find_spec(cls, name: str, *_: object) -> ModuleSpec | None:
        if name not in _MOVED:
            return None
        warnings.warn(f"{name} is now {_MOVED[name]}", DeprecationWarning, stacklevel=2)
        return ModuleSpec(name, cls)  # type: ignore[arg-type]

    @staticmethod
    def create_module(_spec: ModuleSpec) -> None:
        return None

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        sys.modules[module.__name__] = import_module(_MOVED[module.__name__])


sys.meta_path.append(_MovedModules)  # after those that find what exists
