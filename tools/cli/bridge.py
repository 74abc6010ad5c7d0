"""`hearthlog bridge` and `hearthlog alerts`: events for other systems, and alert rules on logs."""

import signal
from collections.abc import Callable, Sequence
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hearthlog.schemas.errors import listed
from hearthlog.schemas.frames import millisecond_text
from hearthlog.tools.cli.options import End, Json, Start, Timezone, log_location, parse_span
from hearthlog.tools.cli.terminal import (
    end_with_warnings,
    number,
    print_json,
    print_lines,
    print_notice,
    print_table,
    share_done,
    stopped_by,
    wrong_use,
)

if TYPE_CHECKING:
    from hearthlog.analyzer.bridge.alerts.rules import AlertRule, Notification
    from hearthlog.analyzer.bridge.state import BridgeState
    from hearthlog.analyzer.logs.home_logs import HomeLogs


def bridge(
    logs: Annotated[
        Path | None,
        typer.Argument(
            help="Folder that the recorder writes to.",
            readable=False,
            show_default="the folder of the configuration",
        ),
    ] = None,
    *,
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of the recorder, a TOML file with a table `bridge`."),
    ] = None,
    unmute: Annotated[
        list[str] | None,
        typer.Option(
            help="Class to publish to the broker again that an MQTT command muted; repeatable."
        ),
    ] = None,
) -> None:
    """Follow the log of a recorder, and publish it to MQTT, Home Assistant and other outputs.

    The recorder is not affected: the bridge only reads its logs. Failed deliveries are
    retried.
    """
    from hearthlog.analyzer.bridge.alerts.rule_checks import rule_doubts
    from hearthlog.analyzer.bridge.bridge import (
        Bridge,
        ProblemReporter,
        exposed_files,
        needed_modules,
        open_outputs,
    )
    from hearthlog.analyzer.bridge.settings import (
        RecorderAddress,
        configured_microphones,
        load_bridge_settings,
    )
    from hearthlog.analyzer.bridge.state import BridgeState, state_folder
    from hearthlog.analyzer.errors import require
    from hearthlog.models.classes import class_name
    from hearthlog.recorder.config import exposed_passwords
    from hearthlog.recorder.pause_schedule import time_zone

    settings, own = load_bridge_settings(config)
    if not own.has_outputs():
        where = "no --config is given" if config is None else f"{config} has no bridge table"
        wrong_use(
            f"{where}: `[bridge.page]` in one shows a page of the home; docs/bridge.md describes "
            "the other outputs"
        )
    modules = needed_modules(own)
    if not (own.page or own.ping or any(modules.values())):
        lacking = [name for name, is_there in modules.items() if not is_there]
        require(*lacking)  # the other outputs run without them
    stop = stopped_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    never_tell = frozenset(map(class_name, settings.never_tell))
    home = RecorderAddress(
        logs or settings.output, settings.node, time_zone(settings.timezone), never_tell
    )
    report = ProblemReporter(print_notice)
    state = BridgeState(state_folder(own.state, home.folder), home.node, report)
    for line in [*exposed_files(own, config, state.folder), *exposed_passwords(settings, config)]:
        report(line)
    microphones = [] if logs else configured_microphones(settings)
    for line in rule_doubts(own.alert, settings, microphones):
        report(f"alerts: {line}")
    try:
        if own.mqtt or own.prometheus or own.alert:
            state.claim(home.folder)
        if unmute:
            _unmute(state, [class_name(name) for name in unmute], report)
        outputs, since = open_outputs(own, home, state, report)
        Bridge(home, since, outputs, report).run(stop)
    finally:
        state.close()


def _unmute(state: "BridgeState", classes: list[str], report: "Callable[[str], None]") -> None:
    from hearthlog.analyzer.bridge.mqtt import RetainedTopics

    topics = RetainedTopics(state, report)
    muted = topics.muted()
    if others := [name for name in classes if name not in muted]:
        there = f"muted: {listed(muted, 'and')}" if muted else "no class is muted"
        wrong_use(f"--unmute {others[0]}: this class is published; {there}")
    for name in classes:
        topics.switch(name, is_published=True)
    topics.save()


_WEEK = 7 * 86_400 * 1_000_000_000

alerts = typer.Typer(no_args_is_help=True, help="Try the rules of alerts on logs.")


@alerts.callback()
def _group() -> None:
    """Try the rules of alerts on logs."""


@alerts.command()
def replay(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Logs, or folders of logs, or URLs such as s3://bucket/home.",
            parser=log_location,
            show_default="the logs of the configuration",
        ),
    ] = None,
    *,
    config: Annotated[
        Path, typer.Option(help="Configuration, a TOML file with `bridge.alert` tables.")
    ],
    start: Start = None,
    end: End = None,
    timezone: Timezone = None,
    as_json: Json = False,
) -> None:
    """Show when, and how often, the alert rules of a configuration would have notified.

    Exit status 3: a log is damaged or unfinished; its readable part was used.
    """
    from hearthlog.analyzer.activity.segments import read_activity, source_microphone
    from hearthlog.analyzer.bridge.alerts.evaluation import notifications
    from hearthlog.analyzer.bridge.alerts.rule_checks import (
        hidden_class,
        unknown_class,
        unknown_microphone,
    )
    from hearthlog.analyzer.bridge.alerts.rules import history, is_hidden
    from hearthlog.analyzer.bridge.settings import load_bridge_settings
    from hearthlog.analyzer.logs.home_logs import find_home_logs
    from hearthlog.analyzer.logs.local_time import home_zone
    from hearthlog.models.classes import class_name

    first, last = parse_span(start, end)
    settings, own = load_bridge_settings(config)
    if not own.alert:
        wrong_use(f"{config}: has no rule; docs/alerts.md shows how to write a [[bridge.alert]]")
    home = find_home_logs(logs or [settings.output])
    _check_node(home, settings.node)
    if timezone is None and "timezone" in settings.model_fields_set:
        timezone = settings.timezone  # the bridge's own time zone
    zone = home_zone(timezone, home.records())
    first, last = _span(home, settings.node, first, last)
    losses = list(home.losses)
    longest = max(history(rule) for rule in own.alert)
    with share_done("reading the labels") as progress:
        activity = read_activity(
            home, settings.node, first - longest, last, losses.append, progress
        )
    hidden = home.hidden_classes().union(map(class_name, settings.never_tell))
    found = {rule.name: notifications(rule, activity, first, last, zone)[0] for rule in own.alert}
    found |= {rule.name: [] for rule in own.alert if is_hidden(rule, hidden)}
    microphones = {source_microphone(name) for name in activity.coverage}
    for rule in own.alert:
        unrecorded = unknown_microphone(rule, microphones, recorded=True)
        problem = hidden_class(rule, hidden) or unrecorded
        if text := problem or unknown_class(rule, activity.classes):
            print_notice(text)
    if as_json:
        print_json(_as_json(found, (first, last), zone))
    else:
        _print(own.alert, found, (first, last), zone)
    end_with_warnings(losses)


def _check_node(home: "HomeLogs", node: str) -> None:
    from hearthlog.analyzer.activity.segments import nodes_of
    from hearthlog.analyzer.errors import DataError

    nodes = nodes_of(home)
    if node not in nodes:
        there = f"there are those of {listed(nodes, 'and')}" if nodes else "there are no logs"
        raise DataError(f"no logs of the recorder {node!r} (node in the configuration); {there}")


def _span(home: "HomeLogs", node: str, first: int | None, last: int | None) -> tuple[int, int]:
    """Return the requested span, clipped to the logs."""
    from hearthlog.analyzer.activity.segments import span_of

    begin, until = span_of(home, node)
    first = begin if first is None else first
    last = until if last is None else last
    if first >= last or first >= until or last <= begin:
        there = f"{_utc(begin)} to {_utc(until)}"
        wrong_use(f"the logs cover {there}; --start and --end select nothing")
    return first, last


def _utc(time: int) -> str:
    return f"{millisecond_text(time)[:16]}Z"


def _print(
    rules: "Sequence[AlertRule]",
    found: "dict[str, list[Notification]]",
    span: tuple[int, int],
    zone: tzinfo,
) -> None:
    every = sorted((ring for own in found.values() for ring in own), key=lambda ring: ring.time)
    print_lines(_line(ring, zone) for ring in every)
    if every:
        print()
    weeks = (span[1] - span[0]) / _WEEK
    rows = [
        (
            rule.name,
            rule.rule,
            str(len(own)),
            f"{len(own) / weeks:.1f}" if weeks >= 1 / 7 else "",  # meaningless for minutes
            str(sum(not ring.is_known for ring in own)),
        )
        for rule in rules
        for own in [found[rule.name]]
    ]
    print_table(("name", "rule", "alerts", "a week", "not known"), rows, words=2)
    print(f"{_days(weeks)}, {_local(span[0], zone)} to {_local(span[1], zone)}, {zone}")


def _days(weeks: float) -> str:
    hours = 7 * 24 * weeks
    return number(round(hours / 24), "day") if hours >= 24 else f"{hours:.1f} hours"


def _line(ring: "Notification", zone: tzinfo) -> str:
    late = f" (delivered at {_local(ring.due, zone)})" if ring.due > ring.time else ""
    return f"{_local(ring.time, zone)}  {ring.rule}: {ring.text}{late}"


def _local(time: int, zone: tzinfo) -> str:
    from hearthlog.analyzer.logs.local_time import local_time

    return f"{local_time(time, zone):%Y-%m-%d %H:%M}"


def _as_json(
    found: "dict[str, list[Notification]]", span: tuple[int, int], zone: tzinfo
) -> dict[str, Any]:
    from hearthlog.analyzer.logs.local_time import iso_time

    return {
        "start": iso_time(span[0], zone),
        "end": iso_time(span[1], zone),
        "timezone": str(zone),
        "rules": {
            name: [
                {
                    "time": iso_time(ring.time, zone),
                    "due": iso_time(ring.due, zone),
                    "text": ring.text,
                    "known": ring.is_known,
                }
                for ring in own
            ]
            for name, own in found.items()
        },
    }
