"""Layouts of Foxglove, Lichtblick and PlotJuggler for the microphones and classes of a home."""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from mcap import records

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.home_logs import HomeLogs
from hearthlog.analyzer.logs.selection import array_names
from hearthlog.models.classes import Colour, class_name, colour, in_words, ordered
from hearthlog.schemas.errors import LogError
from hearthlog.schemas.mcap.chunks import read_definitions
from hearthlog.schemas.mcap.logfile import LogFile
from hearthlog.schemas.messages.topics import DIAGNOSTICS, LIVE, ROSOUT, parse_topic

FOXGLOVE_SUFFIX, PLOTJUGGLER_SUFFIX = ".json", ".xml"
ChannelType = tuple[records.Channel, records.Schema | None]
_ENERGY = "energy"
_NOVELTY, _CONFIDENCE, _LEVEL = "#f5774d", "#4e98e2", "#5cd6a9"
_SECONDS = 60  # in view
_PALE: Colour = (23, 190, 207)  # for white, which a white page does not show


class LaidOutMicrophone(NamedTuple):
    """A microphone in a layout."""

    name: str
    # in the order of all displays, each with its place in `probabilities`
    classes: list[tuple[str, int]]
    energy: int | None  # its place in the features

    @property
    def title(self) -> str:
        """Name for people."""
        return self.name.replace("_", " ").capitalize()


def channels_of(log: Path) -> list[ChannelType]:
    """List the channels of a log with their schemas.

    Raise `LogError` if it cannot be read, is not an MCAP file, or is damaged.
    """
    with LogFile(log) as file:
        read_definitions(file)
        return [(each, file.schemas.get(each.schema_id)) for each in file.channels.values()]


def microphones_to_lay_out(logs: HomeLogs) -> list[LaidOutMicrophone]:
    """Return the microphones of the last readable log of each recorder.

    Raise `DataError` if there are none.
    """
    hidden = logs.hidden_classes()
    latest: dict[str, list[records.Channel]] = {}
    for entry in reversed(logs.between()):
        if entry.node not in latest:
            with suppress(LogError):  # an earlier log may be readable
                latest[entry.node] = [channel for channel, _ in channels_of(entry.path)]
    names: dict[str, dict[str, records.Channel]] = {}
    for channel in (each for channels in latest.values() for each in channels):
        topic = parse_topic(channel.topic)
        if topic is not None and topic.labelling == LIVE:
            names.setdefault(topic.microphone, {})[topic.kind] = channel
    found = []
    for name, kinds in sorted(names.items()):
        classes, features = (
            array_names(kinds[kind].metadata, field) if kind in kinds else []
            for kind, field in (("label", "probabilities"), ("features", "values"))
        )
        shown = [(each, classes.index(each)) for each in ordered(classes)]
        shown = [each for each in shown if class_name(each[0]) not in hidden]
        energy = features.index(_ENERGY) if _ENERGY in features else None
        if shown or energy is not None:
            found.append(LaidOutMicrophone(name, shown, energy))
    if not found:
        raise DataError("no log has a microphone with features or labels; record first")
    return found


def foxglove_layout(microphones: Sequence[LaidOutMicrophone]) -> str:
    """Return the layout of Foxglove and Lichtblick, as JSON; a tab for each microphone."""
    panels: dict[str, dict[str, Any]] = {}
    columns = [(one.title, _stacked(list(_panels(one, panels)))) for one in microphones]
    left = columns[0][1]
    if len(columns) > 1:
        left = "Tab!microphones"
        tabs = [{"title": title, "layout": layout} for title, layout in columns]
        panels[left] = {"activeTabIdx": 0, "tabs": tabs}
    panels["RosOut!events"] = _titled(
        "Events", {"searchTerms": [], "minLogLevel": 1, "topicToRender": ROSOUT}
    )
    panels["DiagnosticSummary!health"] = _titled(
        "The recorder",
        {
            "minLevel": 0,
            "pinnedIds": [],
            "topicToRender": DIAGNOSTICS,
            "hardwareIdFilter": "",
            "sortByLevel": True,
        },
    )
    right = _split("column", 60, "RosOut!events", "DiagnosticSummary!health")
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", 72, left, right),
    }
    return json.dumps(layout, indent=2) + "\n"


def _panels(one: LaidOutMicrophone, panels: dict[str, dict[str, Any]]) -> Iterator[str]:
    """Add the panels of a microphone; yield their names, from the top."""
    if one.classes:
        name = f"StateTransitions!heard_{one.name}"
        paths = [
            _series(f"/{one.name}/label.label", "each 50 ms"),
            _series(f"/{one.name}/segment.label", "segments, when they close"),
        ]
        panels[name] = _titled(
            f"{one.title}: what is heard",
            {"paths": paths, "isSynced": False, "xAxisRange": _SECONDS, "showPoints": False},
        )
        yield name
        name = f"Plot!probabilities_{one.name}"
        shares = [
            _series(f"/{one.name}/label.probabilities[{place}]", in_words(each), _shade(each))
            for each, place in one.classes
        ]
        panels[name] = _plot(f"{one.title}: how probable each class is", shares, (0, 1))
        yield name
        name = f"Plot!novelty_{one.name}"
        doubt = [
            _series(f"/{one.name}/label.novelty", "novelty", _NOVELTY),
            _series(f"/{one.name}/label.confidence", "confidence", _CONFIDENCE),
        ]
        panels[name] = _plot(f"{one.title}: novelty and confidence", doubt, (0, 1))
        yield name
    if one.energy is not None:
        name = f"Plot!level_{one.name}"
        level = [_series(f"/{one.name}/features.values[{one.energy}].@log10", "level", _LEVEL)]
        title = f"{one.title}: level (-6 is -60 dBFS)"
        panels[name] = _plot(title, level, None)
        yield name


def _stacked(panels: Sequence[str]) -> Any:
    """Stack panels; of four the first, of states, is lower, and the second higher."""
    if len(panels) == 1:
        return panels[0]
    share = 22 if len(panels) > 3 else 100 // len(panels) + 10 * (len(panels) == 3)
    return _split("column", share, panels[0], _stacked(panels[1:]))


def _split(direction: str, percentage: int, first: Any, second: Any) -> dict[str, Any]:
    return {
        "direction": direction,
        "splitPercentage": percentage,
        "first": first,
        "second": second,
    }


def _series(path: str, label: str, shade: str = "") -> dict[str, Any]:
    series = {"value": path, "label": label, "enabled": True, "timestampMethod": "headerStamp"}
    return series | ({"color": shade} if shade else {})


def _plot(
    title: str, series: list[dict[str, Any]], scale: tuple[float, float] | None
) -> dict[str, Any]:
    plot = {
        "paths": series,
        "showLegend": True,
        "legendDisplay": "left",
        "sidebarDimension": 180,
        "showPlotValuesInLegend": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": False,
        "xAxisVal": "timestamp",
        "followingViewWidth": _SECONDS,
    }
    if scale is not None:
        plot |= {"minYValue": scale[0], "maxYValue": scale[1]}
    return _titled(title, plot)


def _titled(title: str, config: dict[str, Any]) -> dict[str, Any]:
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title} | config


def _shade(label: str) -> str:
    red, green, blue = colour(label) if min(colour(label)) < 255 else _PALE
    return f"#{red:02x}{green:02x}{blue:02x}"


def plotjuggler_layout(microphones: Sequence[LaidOutMicrophone]) -> str:
    """Return the layout of PlotJuggler 3, as XML; a tab for each microphone.

    A series has the name of its topic there, so series by class are equations.
    """
    tabs, snippets = [], []
    for one in microphones:
        areas, equations = _areas(one)
        sizes = ";".join([f"{1 / len(areas):.3f}"] * len(areas))
        tabs.append(
            f'  <Tab tab_name={quoteattr(one.title)} containers="1">\n   <Container>\n'
            f'    <DockSplitter orientation="-" count="{len(areas)}" sizes="{sizes}">\n'
            f"{''.join(areas)}    </DockSplitter>\n   </Container>\n  </Tab>\n"
        )
        snippets += equations
    return (
        "<?xml version='1.0' encoding='UTF-8'?>\n<root>\n"
        ' <tabbed_widget name="Main Window" parent="main_window">\n'
        f'{"".join(tabs)}  <currentTabIndex index="0"/>\n </tabbed_widget>\n'
        ' <use_relative_time_offset enabled="1"/>\n <customMathEquations>\n'
        f"{''.join(snippets)} </customMathEquations>\n <snippets/>\n</root>\n"
    )


_DECIBELS = "10 * math.log(value) / math.log(10)"


def _areas(one: LaidOutMicrophone) -> tuple[list[str], list[str]]:
    """Return the plots of a microphone, and the equations that name their series."""
    areas, equations = [], []
    if one.classes:
        curves = []
        for each, place in one.classes:
            name = f"{one.title}: {in_words(each)}"
            equations.append(_equation(name, f"/{one.name}/label/probabilities[{place}]"))
            curves.append((name, _shade(each)))
        areas.append(_area("how probable each class is", curves, (0, 1)))
        doubt = [
            (f"/{one.name}/label/novelty", _NOVELTY),
            (f"/{one.name}/label/confidence", _CONFIDENCE),
        ]
        areas.append(_area("novelty and confidence", doubt, (0, 1)))
    if one.energy is not None:
        name = f"{one.title}: level in dBFS"
        equations.append(_equation(name, f"/{one.name}/features/values[{one.energy}]", _DECIBELS))
        areas.append(_area("level in dBFS", [(name, _LEVEL)], (-90, 0)))
    return areas, equations


def _area(title: str, curves: Sequence[tuple[str, str]], scale: tuple[float, float]) -> str:
    rows = "".join(
        f'       <curve name={quoteattr(name)} color="{shade}"/>\n' for name, shade in curves
    )
    return (
        f"     <DockArea name={quoteattr(title)}>\n"
        '      <plot mode="TimeSeries" style="Lines" flip_x="false" flip_y="false">\n'
        f'       <range left="0.0" right="{_SECONDS}" bottom="{scale[0]}" top="{scale[1]}"/>\n'
        f"       <limitY/>\n{rows}      </plot>\n     </DockArea>\n"
    )


def _equation(name: str, source: str, formula: str = "value") -> str:
    return (
        f"  <snippet name={quoteattr(name)}>\n   <global></global>\n"
        f"   <function>return {formula}</function>\n"
        f"   <linked_source>{source}</linked_source>\n  </snippet>\n"
    )
