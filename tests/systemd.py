"""A machine with a real systemd: a container of this one's files, whose changes are forgotten."""

import os
import shutil
import subprocess
import sys
import sysconfig
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from microphones import DIES_WITH_PARENT

ROOT = Path(__file__).parents[1]
_PACKAGES = sysconfig.get_path("purelib")
PREFIX = "/opt/hearthlog"
PROGRAM = f"{PREFIX}/bin/hearthlog"
_SECONDS_TO_BOOT = 60
_LAYS_OUT = 'mount --bind / "$1" && shift && exec systemd-nspawn "$@"'


class Machine:
    """A booted container; `run` runs commands in it, as root.

    Attributes
    ----------
    folder : Path
        On this machine, seen there under the same name.
    """

    def __init__(self, leader: int, folder: Path):
        self._enter = ["nsenter", "-t", str(leader), "-m", "-u", "-i", "-n", "-p", "-w"]
        self.folder = folder

    def run(self, *command, check=True, user=None, env=None, seconds=120):
        """Run a command, by default as root; `check` whether its status is 0."""
        words = [f"{name}={value}" for name, value in (env or {}).items()]
        words = ["env", *words, *map(str, command)]
        if user is not None:
            words = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups", *words]
        result = subprocess.run(
            [*self._enter, *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
        assert not check or result.returncode == 0, result.stdout + result.stderr
        return result

    def write(self, path, text):
        self.run("mkdir", "-p", Path(path).parent)
        self.run("sh", "-c", 'printf %s "$1" > "$2"', "sh", text, path)

    def shows(self, name, *options, unit="hearthlog"):
        """Return a property of a unit."""
        return self.run("systemctl", *options, "show", "-P", name, unit).stdout.strip()

    def wait(self, done, seconds=60):
        """Wait until something is true, and return it."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if found := done():
                return found
            time.sleep(0.3)
        journal = self.run("journalctl", "-n", "30", "-o", "cat", check=False).stdout
        pytest.fail(f"did not come in {seconds} s; the journal:\n{journal}")


@contextmanager
def booted(folder: Path):
    """Boot a machine that has hearthlog in /opt/hearthlog; skip where none can be."""
    if os.geteuid() or not all(map(shutil.which, ("systemd-nspawn", "nsenter", "unshare"))):
        pytest.skip("a machine with systemd needs root and the Debian package systemd-container")
    root = folder / "root"
    root.mkdir()
    seen = {ROOT: "/opt/source", sys.base_prefix: "/opt/python", _PACKAGES: "/opt/packages"}
    binds = [f"--bind-ro={there}:{here}" for there, here in seen.items()]
    command = ["unshare", "-m", "--propagation", "slave", "sh", "-c", _LAYS_OUT, "sh", str(root)]
    command += ["-q", "-D", str(root), "--volatile=overlay", "--register=no", "--keep-unit"]
    command += [
        "--private-network",
        "--console=pipe",
        f"--machine=hearthlog-{os.getpid()}",
        *binds,
        f"--bind={folder}",
        "-b",
    ]
    command += ["--", "--unit=basic.target"]
    with (folder / "boot").open("w") as log:
        process = subprocess.Popen(
            [*DIES_WITH_PARENT, *command], stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )
    try:
        machine = Machine(_leader(process, folder), folder)
        active = ("systemctl", "is-active", "basic.target")
        machine.wait(lambda: machine.run(*active, check=False).returncode == 0)
        _install(machine)
        yield machine
    finally:
        process.terminate()  # it is shut down
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _leader(process, folder):
    """Return the process that is number 1 of the container."""
    deadline = time.monotonic() + _SECONDS_TO_BOOT
    while time.monotonic() < deadline:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        for child in children.read_text().split() if children.exists() else ():
            if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                return int(child)
        if process.poll() is not None:
            break
        time.sleep(0.1)
    pytest.skip(f"systemd does not start here: {(folder / 'boot').read_text()[-2000:]}")


def _install(machine):
    """Make an environment of what runs these tests, as if it were installed for everyone."""
    machine.run("/opt/python/bin/python3", "-m", "venv", "--without-pip", PREFIX)
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = machine.run(f"{PREFIX}/bin/python", "-c", code).stdout.strip()
    machine.write(f"{site}/others.pth", "import site; site.addsitedir('/opt/packages')\n")
    machine.run("mkdir", f"{site}/hearthlog")
    parts = (
        f"/opt/source/{name}" for name in ("analyzer", "models", "recorder", "schemas", "tools")
    )
    inner = (
        f"/opt/source/tools/package/hearthlog/{path.name}"
        for path in (ROOT / "tools/package/hearthlog").glob("*.py")
    )
    machine.run("ln", "-s", *parts, *inner, f"{site}/hearthlog")
    script = f"#!{PREFIX}/bin/python\nfrom hearthlog.tools.cli.main import main\nmain()\n"
    machine.write(PROGRAM, script)
    machine.run("chmod", "755", PROGRAM)
