"""The way to learn that the user chose."""

from typing import TYPE_CHECKING

from hearthlog.tools.cli.text import wrong_use

if TYPE_CHECKING:
    from hearthlog.analyzer.training.method import Method


def chosen_method(name: str, **parameters: float | None) -> "Method":
    """Return a way to learn, with other parameters where they are given."""
    from hearthlog.analyzer.errors import DataError
    from hearthlog.analyzer.training.methods import method_named

    chosen = {key: value for key, value in parameters.items() if value is not None}
    for key, value in chosen.items():
        if not 0 < value < float("inf"):
            wrong_use(f"--{key} {value:g}: it must be more than 0")
    try:
        return method_named(name).with_parameters(chosen)
    except DataError as error:
        wrong_use(str(error))
