"""Build hook of the wheel: settings that hatchling does not support in pyproject.toml."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PackageHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the files below `tools/package` at the top of the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files, unless the install is editable.

        Parameters
        ----------
        version : str
            `standard` or `editable`.
        build_data : dict
            Build settings, changed in place.
        """
        if version == "standard":
            build_data["force_include"]["tools/package/hearthlog"] = "/"  # the package hearthlog
