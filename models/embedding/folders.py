"""The folders in which networks lie: that of the user, then those of the machine."""

import os
from pathlib import Path


def network_folders() -> list[Path]:
    """Return the folders of networks: `hearthlog/networks` of the folders of data.

    Those are `$XDG_DATA_HOME` (`~/.local/share`) and `$XDG_DATA_DIRS` (`/usr/local/share` and
    `/usr/share`), as in the XDG Base Directory Specification.
    """
    of_user = os.environ.get("XDG_DATA_HOME") or os.path.expanduser("~/.local/share")  # noqa: PTH111  that of Path raises where there is no home
    of_all = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    folders = [Path(text) for text in [of_user, *of_all.split(":")]]
    return [folder / "hearthlog" / "networks" for folder in folders if folder.is_absolute()]


def folder_for_new() -> Path:
    """Return the folder that a network is put into: that of the user, for root that of all users.

    A service sees no home, and what root fetches is for it.
    """
    own, *of_all = network_folders()
    return of_all[0] if of_all and os.geteuid() == 0 else own
