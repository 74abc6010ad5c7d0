"""The folder of what the bridge has to remember."""

import os
from pathlib import Path

from hearthlog.analyzer.bridge.errors import BridgeError
from hearthlog.schemas.new_files import private_folder

_OF_SYSTEMD = "STATE_DIRECTORY"  # one folder, or several with colons between them


def state_folder(configured: Path | None, logs: Path) -> Path:
    """Return the folder of the state, which is made where it is missing.

    Returns
    -------
    Path
        The configured one; else that of systemd; else `bridge` beside the logs.

    Raises
    ------
    BridgeError
        If it cannot be made.
    """
    given = os.environ.get(_OF_SYSTEMD, "").partition(":")[0]
    folder = configured or (Path(given) if given else logs.absolute().parent / "bridge")
    try:
        private_folder(folder)
    except OSError as error:
        raise BridgeError(
            f"{folder}: cannot be made ({error.strerror}); name another one: bridge.state"
        ) from error
    return folder
