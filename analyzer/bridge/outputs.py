"""The outputs that are configured, opened."""

import time
from collections.abc import Callable
from pathlib import Path

from hearthlog.analyzer.bridge.day import today
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.output import Output
from hearthlog.analyzer.bridge.saying import Saying
from hearthlog.analyzer.bridge.settings import BridgeSettings
from hearthlog.schemas.times import NANOSECONDS

_OLDEST = 7 * 24 * 3600 * NANOSECONDS  # how far back the log is read at most, at a start


def open_outputs(
    settings: BridgeSettings, home: Home, state_folder: Path, say: Saying
) -> tuple[dict[str, Output], int]:
    """Open the outputs that are configured.

    Parameters
    ----------
    settings : BridgeSettings
    home : Home
    state_folder : Path
        Of what they have to remember.
    say : Saying

    Returns
    -------
    outputs : dict of str to Output
        By their names.
    since : int
        From when on they have to know the events, in nanoseconds of UTC.

    Raises
    ------
    HearthlogError
        If one cannot be opened.
    ModuleNotFoundError
        If a package that one needs is not installed.
    """
    # Imported here: who wants no broker needs no client of one.
    moment = today(time.time_ns(), home.zone)
    since = min(moment.midnight, moment.night)
    outputs: dict[str, Output] = {}
    on_ring: Callable[[str, str, int], None] | None = None
    if settings.mqtt is not None:
        from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher  # noqa: PLC0415

        outputs["mqtt"] = publisher = MqttPublisher(settings.mqtt, home, say)
        on_ring = publisher.alert
    if settings.prometheus is not None:
        from hearthlog.analyzer.bridge.prometheus import PrometheusOutput  # noqa: PLC0415

        prometheus = PrometheusOutput(settings.prometheus, home, state_folder, since, say)
        since = min(since, max(prometheus.totals.time, moment.now - _OLDEST))
        outputs["prometheus"] = prometheus
    if settings.page is not None:
        from hearthlog.analyzer.bridge.page.home_page import HomePage  # noqa: PLC0415

        outputs["page"] = HomePage(settings.page, home, state_folder, say)
    if settings.ping is not None:
        from hearthlog.analyzer.bridge.pinging import Pinging  # noqa: PLC0415

        outputs["ping"] = Pinging(settings.ping, say)
    if settings.alert:
        from hearthlog.analyzer.bridge.alerts.output import AlertsOutput  # noqa: PLC0415

        outputs["alerts"] = AlertsOutput(
            settings.alert, settings.delivery, home, state_folder, say, on_ring
        )
    return outputs, since
