"""Where files of secrets are: where their name says, or among the credentials of systemd."""

import os
from pathlib import Path

_CREDENTIALS = "CREDENTIALS_DIRECTORY"  # of systemd


def secret_path(path: Path) -> Path:
    """Return where a file of a secret is."""
    return Path(os.environ.get(_CREDENTIALS, "")) / path
