"""`hearthlog setup`: from an installation to a running recorder."""

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from hearthlog.tools.cli.setup_questions import NETWORK, NONE, Installation, Questions, SetupError
from hearthlog.tools.cli.terminal import print_lines, print_notice, share_done, wrong_use

if TYPE_CHECKING:
    from hearthlog.tools.service.configuration_file import Answers

_ACCOUNT = "hearthlog"
_LEAST_FREE = 100_000_000  # bytes more than the configuration keeps free: ten hours of logs
_LABEL_SECONDS = 120.0


def setup(
    *,
    microphone: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DEVICE=ROOM",
            help="Device (see `hearthlog devices`; empty: the default) and its room; repeatable.",
        ),
    ] = None,
    node: Annotated[str | None, typer.Option(help="Name of the home.")] = None,
    timezone: Annotated[str | None, typer.Option(help="Time zone of the home.")] = None,
    keep_sound: Annotated[
        bool | None,
        typer.Option(
            "--keep-sound/--no-keep-sound", help="Keep clips of sounds that the model is unsure of."
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            metavar="yamnet|none", help="Network for better labels, downloaded if absent."
        ),
    ] = None,
    page: Annotated[
        bool | None, typer.Option("--page/--no-page", help="Serve a page of the home.")
    ] = None,
    page_port: Annotated[
        int | None, typer.Option(min=1, max=65_535, help="Port of the page.", show_default="8380")
    ] = None,
    mqtt: Annotated[
        str | None,
        typer.Option(metavar="HOST|none", help="MQTT broker, such as that of Home Assistant."),
    ] = None,
    mqtt_user: Annotated[str | None, typer.Option(help="User at the broker.")] = None,
    mqtt_password_file: Annotated[
        Path | None, typer.Option(help="File with the password of that user, which is copied.")
    ] = None,
    alerts: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|none", help="File with Apprise addresses for alerts, which is copied."
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Configuration to write or to change.",
            show_default="/etc/hearthlog.toml for root, else ./hearthlog.toml",
        ),
    ] = None,
    no_service: Annotated[
        bool, typer.Option("--no-service", help="Only write the configuration.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Take the default for whatever no option answers.")
    ] = False,
) -> None:
    """Set up a recorder: choose microphones, write the configuration, start the service.

    Asks what no option answers, shows the result, and then changes this machine: root installs
    a service of the machine, anybody else a user service that records in the current folder.
    Run again, it changes the answers in an existing configuration and keeps everything else.
    """
    if mqtt in {None, NONE} and (mqtt_user is not None or mqtt_password_file is not None):
        wrong_use("--mqtt-user and --mqtt-password-file need --mqtt HOST")
    if page is not True and page_port is not None:
        wrong_use("--page-port needs --page")
    for name in [name for name in os.environ if name.startswith("HEARTHLOG_")]:
        del os.environ[name]  # a service does not have these variables
    try:
        installation = _installation(config, service=not no_service)
        questions = Questions(installation, yes=yes)
        from hearthlog.tools.service.configuration_file import Answers

        _check_disk(questions)
        answers = Answers(
            microphones=questions.microphones(microphone),
            node=questions.node(node),
            timezone=questions.timezone(timezone),
            keep_sound=questions.keep_sound(keep_sound),
            network=questions.network(network),
            page=questions.page(page, page_port),
            broker=questions.broker(mqtt, mqtt_user, mqtt_password_file),
            alerts=questions.alerts(alerts),
            secrets=questions.secrets,
        )
        text = _text(questions, answers)
        _confirm(questions, answers, text)
    except (KeyboardInterrupt, EOFError, typer.Abort):
        _end_interrupted("nothing was changed")
    try:
        is_recording = _carry_out(installation, answers, text)
    except KeyboardInterrupt:
        _end_interrupted("interrupted: the configuration and the service are as before")
    try:
        if is_recording:
            _wait_for_labels(installation, answers)
    except KeyboardInterrupt:
        doctor = _command(installation, "doctor --live", _logs(installation))
        _end_interrupted(f"the recorder runs, without a label yet: {doctor} says what it waits for")
    _print_next(installation, answers)


def _end_interrupted(line: str) -> NoReturn:
    print(file=sys.stderr)
    print_notice(line)
    raise typer.Exit(130) from None


def _installation(config: Path | None, *, service: bool) -> Installation:
    """Return where to set up, after checking that a service can be installed there."""
    from hearthlog.tools.service import unit

    is_system = os.geteuid() == 0
    config = config or Path("/etc/hearthlog.toml" if is_system else "hearthlog.toml")
    folder = unit.STATE if is_system and service else Path.cwd()
    account = _ACCOUNT if is_system and service else None
    installation = Installation(config.absolute(), folder, account, service)
    if service and not is_system:
        unit.check_no_other_recorder()
    if service:
        for name, verb in ((unit.NAME, "record"), (unit.BRIDGE_NAME, "bridge")):
            there = installation.unit(name)
            if not (is_system and unit.is_packaged(name)):
                unit.unit_path(there.parent, name)
            own = None if is_system or verb == "bridge" else folder
            unit.check_unit(there, verb, installation.config, own)
        if is_system:
            unit.check_program_seen()
            unit.check_seen("the configuration", installation.config)
    return installation


def _check_disk(questions: Questions) -> None:
    from hearthlog.recorder.host import disk_of
    from hearthlog.recorder.retention import size_text

    logs = questions.installation.folder / questions.settings.output
    kept = int(questions.settings.min_free_space)
    least = kept + _LEAST_FREE
    free = disk_of(logs).free
    if free < least:
        raise SetupError(
            f"{logs}: {size_text(free)} of the disk are free, and the recorder keeps "
            f"{size_text(kept)} free: make room, {size_text(least)}"
        )


def _text(questions: Questions, answers: "Answers") -> str:
    from hearthlog.recorder.addresses import public_name
    from hearthlog.schemas.errors import ConfigurationError
    from hearthlog.tools.service.configuration_file import configuration_text

    devices, rooms = zip(*answers.microphones, strict=True)
    for key, values in (("device", devices), ("name", rooms)):
        twice = [value for value in values if values.count(value) > 1]
        if twice:
            shown = repr(public_name(twice[0])) if twice[0] else "of the default"
            raise SetupError(f"two microphones have the {key} {shown}: give each its own")
    try:
        return configuration_text(questions.present, answers)
    except ConfigurationError as error:
        raise ConfigurationError(f"{questions.installation.config}: {error}") from error


def _confirm(questions: Questions, answers: "Answers", text: str) -> None:
    """Show what will be changed, and ask for it."""
    import difflib

    from hearthlog.recorder.addresses import public_name

    installation, present, broker = questions.installation, questions.present, answers.broker
    what = "is unchanged" if present == text else "is changed" if present else "is new"
    account = installation.account
    who = "a user service" if account is None else f"of the machine, by {account}"
    parts = [] if answers.page is None else [f"a page at port {answers.page}"]
    parts += [] if broker is None else [f"MQTT at {broker.host}"]
    parts += [] if answers.alerts is None else ["alerts"]
    devices = [
        f"{room}: {public_name(name) or 'the default'}" for name, room in answers.microphones
    ]
    rows = {
        "Microphone": "; ".join(devices),
        "Home": f"{answers.node}, {answers.timezone}",
        "Sound": "clips are kept" if answers.keep_sound else "none is kept",
        "Network": answers.network or "yamnet where it is installed",
        "Bridge": ", ".join(parts) or "none",
        "Configuration": f"{installation.config} {what}",
        "Secrets": ", ".join(map(str, answers.secrets)),
        "Logs": str(installation.folder / questions.settings.output),
        "Service": who if installation.has_service else "none",
    }
    print(file=sys.stderr)
    for name, value in rows.items():
        if value:
            print(f"{name:<15}{value}", file=sys.stderr)
    if present is not None and present != text:
        old, new = (each.splitlines() for each in (present, text))
        changes = difflib.unified_diff(old, new, "before", "after", n=0, lineterm="")
        print(*list(changes)[2:], sep="\n", file=sys.stderr)
    if not questions.confirm("Do this", "--yes", default=True):
        raise typer.Abort


def _carry_out(installation: Installation, answers: "Answers", text: str) -> bool:
    """Change this machine; after a failure before the start of the service it is as before.

    Return whether the service runs.
    """
    from hearthlog.models.embedding.networks import find_network
    from hearthlog.tools.cli.models import fetch
    from hearthlog.tools.service import unit
    from hearthlog.tools.service.configuration_file import written_files

    if answers.network == NETWORK and find_network(NETWORK) is None:
        fetch(NETWORK, None)
    is_new = installation.account is not None and unit.make_account(installation.account)
    failure: unit.StartError | None = None
    is_recording = False
    try:
        with written_files(installation.config, text, answers.secrets, installation.account):
            _check_configuration(installation, answers)
            try:
                is_recording = installation.has_service and _install(installation, answers)
            except unit.StartError as error:  # its needs are met: the journal says more
                failure = error
    except BaseException:
        if is_new:
            unit.remove_account(_ACCOUNT)
        raise
    if failure is not None:
        raise failure
    return is_recording


def _check_configuration(installation: Installation, answers: "Answers") -> None:
    from hearthlog.schemas.errors import ConfigurationError
    from hearthlog.tools.cli.recorder import findings
    from hearthlog.tools.service import unit

    if installation.folder.is_dir():
        os.chdir(installation.folder)
    errors, problems, warnings = findings(installation.config)
    if errors or problems:
        raise ConfigurationError(*map(str, errors), *problems)
    if installation.account is not None and answers.has_bridge():  # before the recorder starts
        unit.checked_bridge(installation.config, installation.account)
    print_notice(*warnings)


def _install(installation: Installation, answers: "Answers") -> bool:
    """Install the services, and start or restart them; return whether they run."""
    from hearthlog.tools.cli.recorder import install_service
    from hearthlog.tools.service import unit

    is_user = installation.account is None
    is_running = unit.is_user_manager_running() if is_user else unit.is_systemd_running()
    for name in (unit.NAME, unit.BRIDGE_NAME):
        is_bridge = name == unit.BRIDGE_NAME
        if is_bridge and (is_user or not answers.has_bridge()):
            if installation.is_running(name):
                unit.stop_unit(name)
        elif installation.account is not None and not is_bridge and unit.is_packaged(name):
            unit.start_unit(name, is_running=is_running)
        else:
            account = installation.account if is_bridge else None  # it reads logs and secrets
            install_service(
                user=is_user, config=installation.config, account=account, bridge=is_bridge
            )
    return is_running


def _wait_for_labels(installation: Installation, answers: "Answers") -> None:
    """Wait until each microphone has a label in the log that is being written."""
    from threading import Event

    from hearthlog.schemas.logs.follow import follow_messages

    logs = _logs(installation)
    end = time.monotonic() + _LABEL_SECONDS
    missing = {f"/{room}/label" for _, room in answers.microphones}
    start = time.time_ns()
    stop = Event()
    with share_done("waiting for the first label", announce=True) as report:
        while not logs.is_dir() and time.monotonic() < end:
            time.sleep(0.2)
        if logs.is_dir():
            ignored = lambda _error: None  # noqa: E731  the doctor reports damaged logs
            for _, batch in follow_messages(logs, None, start, stop, ignored, ticks=True):
                missing -= {messages.channel.topic for messages in batch if len(messages)}
                left = end - time.monotonic()
                report(1 - max(left, 0.0) / _LABEL_SECONDS)
                if not missing or left < 0:
                    break
    if missing:
        raise SetupError(
            f"no label in {logs} of {', '.join(sorted(missing))} in {_LABEL_SECONDS:.0f} s; the "
            f"recorder runs: {_command(installation, 'doctor --live', logs)} says what it waits for"
        )
    print_lines([f"{logs}: the labels of {', '.join(r for _, r in answers.microphones)} arrive"])


def _logs(installation: Installation) -> Path:
    from hearthlog.recorder.config import load_settings

    return installation.folder / load_settings(installation.config, {}, {}).output


def _command(installation: Installation, verb: str, *arguments: object) -> str:
    """Return a command in backticks, of the user who may read the logs."""
    who = "" if installation.account is None else f"sudo -u {installation.account} "
    return f"`{' '.join([f'{who}hearthlog {verb}', *map(str, arguments)])}`"


def _print_next(installation: Installation, answers: "Answers") -> None:
    """Print what to do next."""
    logs = _logs(installation)
    lines = []
    if not installation.has_service:
        lines.append(f"to record: {_command(installation, 'record --config', installation.config)}")
    if answers.has_bridge() and installation.account is None:
        bridge = _command(installation, "bridge --config", installation.config)
        lines.append(f"to publish: {bridge}, which prints the address of the page")
    elif answers.page is not None:
        lines.append(f"the page: {_page_address(answers.page)}")
    lines.append(f"after an hour, what was heard: {_command(installation, 'info', logs)}")
    print_lines(lines)


_PAGE_ADDRESS = Path("/var/lib/hearthlog-bridge/page-address")
_ADDRESS_SECONDS = 10.0


def _page_address(port: int) -> str:
    """Return the address of the page, which the bridge writes at its start."""
    end = time.monotonic() + _ADDRESS_SECONDS
    while time.monotonic() < end:
        try:
            if f":{port}/" in (address := _PAGE_ADDRESS.read_text("utf-8").strip()):
                return address
        except OSError:
            pass
        time.sleep(0.2)
    return f"`sudo cat {_PAGE_ADDRESS}` shows its address"
