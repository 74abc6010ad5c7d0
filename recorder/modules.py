"""Modules of hearthlog as processes of their own."""

import sys


def module_command(module: str) -> list[str]:
    """Return the command that runs a module, with the current folder not on its path."""
    return [sys.executable, "-P", "-m", module]
