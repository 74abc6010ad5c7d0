"""Outputs of the bridge are opened one by one, and again where that failed."""

from datetime import UTC

import pytest

from hearthlog.analyzer.bridge import outputs
from hearthlog.analyzer.bridge.day import today
from hearthlog.analyzer.bridge.home import Home
from hearthlog.analyzer.bridge.home_state import HomeState
from hearthlog.analyzer.bridge.output import News
from hearthlog.analyzer.bridge.outputs import open_outputs
from hearthlog.analyzer.bridge.saying import Saying
from hearthlog.analyzer.bridge.settings import BridgeSettings
from hearthlog.analyzer.ports import listen

pytestmark = pytest.mark.fast

NEWS = News(HomeState(), [], [], today(0, UTC), UTC)


@pytest.fixture
def home(tmp_path):
    return Home(tmp_path, "home", UTC)


def test_an_output_that_cannot_be_opened_is_tried_again_and_stops_no_other(
    home, tmp_path, monkeypatch
):
    monkeypatch.setattr(outputs, "_AGAIN_SECONDS", 0.0)
    said = []
    with listen() as other:
        port = other.getsockname()[1]
        tables = {"prometheus": {"port": port}, "ping": {"url": "http://127.0.0.1:9"}}
        opened, _ = open_outputs(
            BridgeSettings.model_validate(tables), home, tmp_path, Saying(said.append)
        )
        opened["prometheus"].update(NEWS)
        assert list(opened) == ["prometheus", "ping"]
        (line,) = said
        assert line.startswith(f"bridge.prometheus: cannot listen on port {port} (")
        assert line.endswith("; take another; trying again")
    opened["prometheus"].update(NEWS)
    assert opened["prometheus"].output is not None
    for output in opened.values():
        output.close()


def test_without_a_table_nothing_is_opened(home, tmp_path):
    opened, since = open_outputs(BridgeSettings(), home, tmp_path, Saying(pytest.fail))
    assert opened == {}
    assert since > 0
