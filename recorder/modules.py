"""Modules of ours as processes of their own."""

import sys


def module_command(module: str) -> list[str]:
    """Return the command that runs a module, and no file of the folder in which it is started.

    Parameters
    ----------
    module : str
        Its full name; of a package, that of the package with a `__main__`.
    """
    return [sys.executable, "-P", "-m", module]
