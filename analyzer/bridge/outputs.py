"""The outputs that are configured, opened, and opened again where that failed."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from hearthlog.analyzer.bridge.day import today
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.output import News, Output
from hearthlog.analyzer.bridge.saying import Saying
from hearthlog.analyzer.bridge.settings import BridgeSettings
from hearthlog.analyzer.bridge.totals import TOTALS, kept_until
from hearthlog.analyzer.extras import remedy
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.times import NANOSECONDS

if TYPE_CHECKING:
    from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher

_OLDEST = 7 * 24 * 3600 * NANOSECONDS  # how far back the log is read at most, at a start
_EARLIER = 6 * 3600 * NANOSECONDS  # so much longer no event takes, so that those are known whole
_AGAIN_SECONDS = 60.0

_Output = TypeVar("_Output", bound=Output)


class Reopened(Generic[_Output]):
    """An output that is tried again every minute while it cannot be opened.

    Parameters
    ----------
    make : callable
        Opens it.
    say : callable
        Told why it cannot be opened, in a line.

    Attributes
    ----------
    output : Output or None
        None while it cannot be opened.
    """

    def __init__(self, make: Callable[[], _Output], say: Callable[[str], None]) -> None:
        self.output: _Output | None = None
        self._make = make
        self._say = say
        self._due = 0.0  # by CLOCK_MONOTONIC
        self._open()

    def update(self, news: News) -> None:
        """Tell what is new, if it is open."""
        if self.output is None and time.monotonic() >= self._due:
            self._open()
        if self.output is not None:
            self.output.update(news)

    def close(self) -> None:
        """End, if it is open."""
        if self.output is not None:
            self.output.close()

    def _open(self) -> None:
        self._due = time.monotonic() + _AGAIN_SECONDS
        try:
            self.output = self._make()
        except ModuleNotFoundError as error:
            self._say(f"{error.name} is not installed; {remedy(error.name or '')}; trying again")
        except (HearthlogError, OSError) as error:
            self._say(f"{error}; trying again")
        except Exception as error:  # noqa: BLE001  one that fails must not stop the others
            self._say(f"{type(error).__name__}: {error}; trying again")


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
        Told why one cannot be opened; it is tried again.

    Returns
    -------
    outputs : dict of str to Output
        By their names.
    since : int
        From when on they have to know the events, in nanoseconds of UTC.
    """
    moment = today(time.time_ns(), home.zone)
    since = min(moment.midnight, moment.night) - _EARLIER
    outputs: dict[str, Output] = {}
    # Imported here: who wants no broker needs no client of one.
    if (mqtt := settings.mqtt) is not None:

        def publish() -> "MqttPublisher":
            from hearthlog.analyzer.bridge.mqtt.publisher import MqttPublisher  # noqa: PLC0415

            return MqttPublisher(mqtt, home, state_folder, say)

        publisher = Reopened(publish, say)
        outputs["mqtt"] = publisher
    if (figures := settings.prometheus) is not None:
        first = since

        def count() -> Output:
            from hearthlog.analyzer.bridge.prometheus import PrometheusOutput  # noqa: PLC0415

            return PrometheusOutput(figures, home, state_folder, first, say)

        outputs["prometheus"] = Reopened(count, say)
        kept = kept_until(state_folder / TOTALS, since) - _EARLIER
        since = min(since, max(kept, moment.now - _OLDEST))
    if (page := settings.page) is not None:
        from hearthlog.analyzer.bridge.page.home_page import HomePage  # noqa: PLC0415

        outputs["page"] = Reopened(lambda: HomePage(page, home, state_folder, say), say)
    if (watchdog := settings.ping) is not None:
        from hearthlog.analyzer.bridge.pinging import Pinging  # noqa: PLC0415

        outputs["ping"] = Reopened(lambda: Pinging(watchdog, say), say)
    if settings.alert:
        from hearthlog.analyzer.bridge.alerts.output import AlertsOutput  # noqa: PLC0415

        def ring(rule: str, text: str, rung: int) -> bool:
            return publisher.output is not None and publisher.output.alert(rule, text, rung)

        rules, delivery = settings.alert, settings.delivery
        on_ring = None if mqtt is None else ring
        outputs["alerts"] = Reopened(
            lambda: AlertsOutput(rules, delivery, home, state_folder, say, on_ring), say
        )
    return outputs, since
