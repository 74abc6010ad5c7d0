"""Build of the wheel: what hatchling cannot be told in pyproject.toml."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PackageHook(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the package itself at the top of the wheel: it lies below `tools`, which has a place."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add them, unless the install is editable.

        Parameters
        ----------
        version : str
            `standard` or `editable`.
        build_data : dict
            What is built, changed in place.
        """
        if version == "standard":
            build_data["force_include"]["tools/package/hearthlog"] = "/"  # which is hearthlog
