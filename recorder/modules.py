"""Modules of hearthlog as processes of their own."""

import sys


def module_command(module: str) -> list[str]:
    """Return the command that runs a module, with the current folder not on its path.

    Parameters
    ----------
    module : str
        Full name of a module, or of a package with a `__main__`.

    Returns
    -------
    list of str
        The program and its arguments.
    """
    return [sys.executable, "-P", "-m", module]
