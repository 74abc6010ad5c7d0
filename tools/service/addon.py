"""Start of the Home Assistant add-on: recorder and bridge as its services.

The image runs it as root, because only root reads the options; recorder and bridge run as another
account. A service that ends, or hangs, is started again, and the other one goes on.
"""

import argparse
import os
import pwd
import select
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from hearthlog.recorder.errors import ConfigurationError
from hearthlog.recorder.host import module_command
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.new_files import make_folders
from hearthlog.tools.service.addon_options import (
    AddonBroker,
    AddonFolders,
    AddonOptions,
    BrokerError,
    find_broker,
    read_options,
    write_configuration,
)

_AGAIN_SECONDS = 5.0
_BROKER_SECONDS = 60.0
_HANG_SECONDS = 120.0  # as WatchdogSec of the unit of systemd
_END_SECONDS = 80.0  # less than `timeout` of the add-on
_GAPS = 3  # status of a recorder that ended well, with gaps in its log


class Service:
    """A process that is started again when it ends, or when it has stopped reporting.

    Without `account`, this account runs it.
    """

    def __init__(
        self, name: str, command: Sequence[str], folders: AddonFolders, account: str | None
    ) -> None:
        self._name, self._command, self._account = name, command, account
        self._folder = folders.data
        address = folders.data / f".{name}.notify"
        address.unlink(missing_ok=True)
        self.reports = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self.reports.bind(str(address))
        address.chmod(0o600)
        if account is not None:
            shutil.chown(address, account, account)
        self._environment = os.environ | {
            "HOME": str(folders.data / "home"),
            "NOTIFY_SOCKET": str(address),
            "WATCHDOG_USEC": str(int(_HANG_SECONDS * 1e6)),
        }
        self._environment.pop("SUPERVISOR_TOKEN", None)  # it opens the Supervisor's API
        self._environment.pop("HASSIO_TOKEN", None)
        self._process: subprocess.Popen[bytes] | None = None
        self._due = 0.0  # of the next start, by CLOCK_MONOTONIC
        self._reported: float | None = None

    def watch(self) -> None:
        """Start the process if it is due, and end it if it hangs."""
        now = time.monotonic()
        if self._process is None:
            if now >= self._due:
                self._start()
            return
        status = self._process.poll()
        if status is not None:
            self._process = None
            self._due = now + _AGAIN_SECONDS
            if status not in {0, _GAPS}:
                how = f"signal {-status}" if status < 0 else f"status {status}"
                _announce(f"the {self._name} ended with {how}; starting it again")
        elif self._reported is not None and now - self._reported > _HANG_SECONDS:
            _announce(f"the {self._name} hangs; ending it")
            self._process.kill()

    def take_report(self) -> None:
        """Note that the process is alive, if it says so."""
        if b"WATCHDOG=1" in self.reports.recv(1 << 14).split(b"\n"):
            self._reported = time.monotonic()

    def restart(self) -> None:
        """End the process, which is then started again without a pause."""
        self.end()
        self.wait(_END_SECONDS)
        self._process, self._due = None, 0.0

    def end(self) -> None:
        """Ask the process to end."""
        if self._process is not None:
            self._process.terminate()

    def wait(self, seconds: float) -> None:
        """Wait for the end of the process, and force it if that takes too long."""
        if self._process is None:
            return
        try:
            self._process.wait(max(seconds, 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def close(self) -> None:
        """Stop listening to the process."""
        self.reports.close()

    def _start(self) -> None:
        self._reported = None
        person = None if self._account is None else pwd.getpwnam(self._account)
        groups = None if person is None else os.getgrouplist(person.pw_name, person.pw_gid)
        self._process = subprocess.Popen(  # noqa: S603
            self._command,
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            user=None if person is None else person.pw_uid,
            group=None if person is None else person.pw_gid,
            extra_groups=groups,
            umask=0o077,
        )


class Addon:
    """The add-on while it runs: its services, and the broker, which may come later."""

    def __init__(
        self, options: AddonOptions, folders: AddonFolders, account: str | None, supervisor: str
    ) -> None:
        self._options, self._folders, self._account = options, folders, account
        self._supervisor = supervisor
        self._token = os.environ.get("SUPERVISOR_TOKEN", "")
        self._broker_problem = ""
        self._broker_due = 0.0
        self._is_ended = False
        self._broker, problem = self._found_broker()
        write_configuration(options, self._broker, folders, account)
        self._report(problem)
        _make_folders(options, folders, account)
        config = ["--config", str(folders.configuration)]
        program = module_command("hearthlog.tools.cli.main")
        self._recorder = Service("recorder", [*program, "record", *config], folders, account)
        self._bridge = Service("bridge", [*program, "bridge", *config], folders, account)

    def run(self) -> None:
        """Run the services until SIGTERM or SIGINT."""
        services = self._recorder, self._bridge
        by_socket = {each.reports: each for each in services}
        for each in (signal.SIGTERM, signal.SIGINT):
            signal.signal(each, self._end)
        while not self._is_ended:
            for service in services:
                service.watch()
            if self._broker is None and time.monotonic() >= self._broker_due:
                self._take_broker()
            for ready in select.select([*by_socket], [], [], 0.5)[0]:
                by_socket[ready].take_report()
        until = time.monotonic() + _END_SECONDS
        for service in services:
            service.end()
        for service in services:
            service.wait(until - time.monotonic())
            service.close()

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        self._is_ended = True

    def _found_broker(self) -> tuple[AddonBroker | None, str]:
        """Return the broker, or None and the reason."""
        self._broker_due = time.monotonic() + _BROKER_SECONDS
        try:
            return find_broker(self._options, self._supervisor, self._token), ""
        except BrokerError as error:
            return None, str(error)

    def _report(self, problem: str) -> None:
        """Print a problem of the broker when it is new."""
        if problem and problem != self._broker_problem:
            _announce(f"{problem}; the recorder and the page run without it")
        self._broker_problem = problem

    def _take_broker(self) -> None:
        """Restart the bridge with a broker that has been installed meanwhile."""
        broker, problem = self._found_broker()
        self._report(problem)
        if broker is None:
            return
        try:
            write_configuration(self._options, broker, self._folders, self._account)
        except HearthlogError as error:
            self._report(str(error))
            return
        self._broker = broker
        _announce(f"the MQTT broker is {broker.host}")
        self._bridge.restart()


def _make_folders(options: AddonOptions, folders: AddonFolders, account: str | None) -> None:
    """Make the folders that the services write to, also where a backup changed their owner."""
    for folder in (folders.logs(options), folders.state, folders.data / "home"):
        make_folders(folder, 0o755 if folder.is_relative_to(folders.share) else 0o700)
        if account is None:
            continue
        owner = pwd.getpwnam(account)
        if folder.stat().st_uid != owner.pw_uid:
            for path in (folder, *folder.rglob("*")):
                os.chown(path, owner.pw_uid, owner.pw_gid, follow_symlinks=False)


def _announce(text: str) -> None:
    print(f"hearthlog: {text}", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the add-on; end with status 2 and a line for each wrong option."""
    parser = argparse.ArgumentParser("hearthlog.tools.service.addon", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("/data"))
    parser.add_argument("--config", type=Path, default=Path("/config"))
    parser.add_argument("--share", type=Path, default=Path("/share"))
    parser.add_argument("--supervisor", default="http://supervisor")
    parser.add_argument("--account", help="account of the recorder and the bridge")
    given = parser.parse_args(arguments)
    try:
        options = read_options(given.data / "options.json")
        folders = AddonFolders(given.data, given.config, given.share)
        Addon(options, folders, given.account, given.supervisor).run()
    except ConfigurationError as error:
        for line in error.lines:
            _announce(line)
        sys.exit(error.status)
    except (HearthlogError, OSError) as error:
        _announce(str(error))
        sys.exit(1)


if __name__ == "__main__":
    main()
