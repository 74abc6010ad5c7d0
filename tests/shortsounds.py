"""What one looks for in a long day: short sounds."""

from datetime import date

import pytest
from homelife import GENERAL, at, write_day

DAY = date(2026, 3, 1)
SOUGHT = {
    "coughing": [(at("02:06") + 137 * number, 0.5) for number in range(14)],
    "flushing_water": [(at("03:48"), 6)],
    "crying": [(at("16:54"), 20)],
    "yelling": [(at("17:21"), 2), (at("17:41"), 2)],
}


@pytest.fixture(scope="module")
def short_sounds(tmp_path_factory):
    """Logs of a day in which little is heard but an evening of talk and music."""
    folder = tmp_path_factory.mktemp("short") / "logs"
    evening = [(at("19:30") + 60 * i, 60, ("speech", "music")[i % 2], 0.9) for i in range(150)]
    sought = [(*span, name, 0.9) for name, spans in SOUGHT.items() for span in spans]
    classes = [*GENERAL, "flushing_water"]
    hours = [hour for hour in range(24) if hour != 13]
    write_day(folder, DAY, sought + evening, classes=classes, hours=hours)
    return folder
