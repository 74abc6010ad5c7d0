"""Start conditions of the service, checked as the user that will run it.

Runs as a separate process: ``rehearsal FOLDER [CONFIG]``. It prints one line of JSON with the
permissions that the unit must grant, or with an error.
"""

import json
import os
import pwd
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from hearthlog.recorder.addresses import is_address
from hearthlog.recorder.config import Settings, load_settings
from hearthlog.recorder.recording import recording_problems
from hearthlog.schemas.errors import ConfigurationError, HearthlogError, LogError
from hearthlog.tools.service.unit import STATE, Needs


def main() -> None:
    """Report the needs of the recorder, or the reason why it cannot start."""
    folder = Path(sys.argv[1])
    config = Path(sys.argv[2]) if len(sys.argv) > 2 else None
    with suppress(FileNotFoundError):  # systemd creates it
        os.chdir(folder)
    try:
        answer = asdict(_rehearsed(load_settings(config, {}, {}), folder))
    except (HearthlogError, OSError) as error:
        answer = {"error": str(error), "is_wrong_use": isinstance(error, ConfigurationError)}
    print(json.dumps(answer))


def _rehearsed(settings: Settings, folder: Path) -> Needs:
    """Return the needs of a recorder after checking that it would start."""
    output = folder / settings.output
    _check_folder(output, folder)
    is_made = output.is_relative_to(STATE) and not os.access(STATE, os.W_OK)  # by systemd
    there = Path(tempfile.gettempdir()) if is_made else output
    if problems := recording_problems(settings.model_copy(update={"output": there})):
        raise problems[0]
    models = {settings.model, *(each.model for each in settings.microphone)} - {None}
    files = [str(folder / model) for model in models if model is not None and model.exists()]
    devices = [name for each in settings.microphone for name in (each.device, each.fallback)]
    return Needs(str(output), files, any(map(is_address, devices)), settings.readable_by)


def _check_folder(output: Path, folder: Path) -> None:
    """Check a folder of logs, which must exist if it is outside the service's folder."""
    user = pwd.getpwuid(os.getuid()).pw_name
    if not output.is_relative_to(folder) and not output.is_dir():
        raise LogError(f"{output}: no such folder; make it, and give it to {user}")
    if output.is_dir() and not os.access(output, os.W_OK | os.X_OK):
        raise LogError(f"{output}: {user} may not write there; give it to them with chown")


if __name__ == "__main__":
    main()
