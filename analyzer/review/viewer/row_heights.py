"""Heights of the rows of a review, for a viewer of some size."""

from typing import Any, NamedTuple

Blueprint = dict[str, Any]

# Points of the viewer's own parts.
TOP_BAR, TAB_BAR, AXIS_HEIGHT = 36.0, 30.0, 17.0
_PANEL_HEIGHTS = 150.0, 250.0  # a quarter of the viewer, within these
_FOLDED_HEIGHT = 30.0  # of the time panel
_LEAST_LANE = 26.0  # else its name is cut
_WINDOW_HEIGHT = 768.0

_CONTAINER, _PANEL = "ContainerBlueprint", "TimePanelBlueprint"


class RowHeights(NamedTuple):
    """Rows of a review from above, with their heights in points of a window of 768.

    The spectrogram is above the lanes: it fills its row only if it grows like its width.
    """

    fixed: tuple[int, ...]  # above the microphones, in every window
    stacks: tuple[tuple[int, ...], ...]  # of each microphone
    lanes: int  # which row of a stack has the lanes; those above grow with the window
    has_plots: bool  # in the last row of a stack
    is_close_up: bool  # where nothing has to be dragged on the time ruler


class _Fit(NamedTuple):
    """Heights of the rows of a review in a viewer, in points."""

    is_folded: bool  # whether the time panel is
    fixed: list[float]
    homes: float  # height of all microphones
    above: list[float]  # heights of the rows above the lanes of a stack
    plots: float  # of a stack, 0 if they are hidden


class FittedRows:
    """Fits the rows of a review into a viewer: names of lanes are legible before all else."""

    def __init__(self, rows: RowHeights) -> None:
        self._rows = rows
        self._is_folded = False

    def reset(self) -> None:
        """Begin with a viewer that opened anew."""
        self._is_folded = False

    def fit(self, blueprint: Blueprint, height: float, count: int) -> float:
        """Set the heights in a blueprint for a viewer's height; return that of the lanes.

        The height of the lanes includes tabs and axis; there are `count` lanes at most.
        """
        fits = self._fits(height)
        fit = next((one for one in fits if self._lane(one, count) >= _LEAST_LANE), fits[-1])
        self._set_rows(blueprint, fit)
        if fit.is_folded != self._is_folded:
            self._is_folded = fit.is_folded
            panel = blueprint.setdefault("/time_panel", {}).setdefault(_PANEL, {})
            panel["state"] = "Collapsed" if fit.is_folded else "Expanded"
        return self._lanes_height(fit)

    def _fits(self, height: float) -> list[_Fit]:
        """Return what can be shown, the more the earlier."""
        rows, (least, most) = self._rows, _PANEL_HEIGHTS
        panel = min(max(height / 4, least), most)
        fixed = [float(one) for one in rows.fixed]
        choices = [(False, fixed, True)]
        if rows.is_close_up:
            choices += [(True, fixed, True), (True, fixed, False)]
        else:
            choices += [(False, fixed, False), (False, [0.0] * len(fixed), False)]
        return [
            self._fit(height, _FOLDED_HEIGHT if folded else panel, folded, own, plots)
            for folded, own, plots in choices
        ]

    def _fit(
        self,
        height: float,
        panel: float,
        is_folded: bool,  # noqa: FBT001
        fixed: list[float],
        has_plots: bool,  # noqa: FBT001
    ) -> _Fit:
        homes = max(height - TOP_BAR - panel - sum(fixed), 0.0)
        stack = max(self._rows.stacks, key=lambda one: one[self._rows.lanes])
        above = [one * height / _WINDOW_HEIGHT for one in stack[: self._rows.lanes]]
        below = stack[self._rows.lanes :]
        plots = 0.0
        if has_plots and self._rows.has_plots:
            plots = max(self._inside(homes) - sum(above), 0.0) * below[-1] / sum(below)
        return _Fit(is_folded, fixed, homes, above, plots)

    def _inside(self, homes: float) -> float:
        return homes - TAB_BAR * (len(self._rows.stacks) > 1)

    def _lanes_height(self, fit: _Fit) -> float:
        stack = max(self._rows.stacks, key=lambda one: one[self._rows.lanes])
        between = stack[self._rows.lanes : len(stack) - self._rows.has_plots]
        left = max(self._inside(fit.homes) - sum(fit.above) - fit.plots, 0.0)
        return left * between[0] / sum(between)

    def _lane(self, fit: _Fit, count: int) -> float:
        return (self._lanes_height(fit) - TAB_BAR - AXIS_HEIGHT) / max(count, 1)

    def _set_rows(self, blueprint: Blueprint, fit: _Fit) -> None:
        viewport = blueprint.get("/viewport", {}).get("ViewportBlueprint", {})
        top = _container(blueprint, f"/container/{viewport.get('root_container')}")
        contents = _contents(top)
        if len(self._rows.stacks) == 1:  # the viewer joins its rows with those above
            _set_stack(blueprint, top, fit, self._rows, [*fit.fixed])
        elif len(contents) == len(fit.fixed) + 1:
            top["row_shares"] = [*fit.fixed, fit.homes]
            for path in _contents(_container(blueprint, contents[-1])):
                _set_stack(blueprint, _container(blueprint, path), fit, self._rows, [])
        for path, height in zip(contents, fit.fixed, strict=False):
            _container(blueprint, path)["visible"] = height > 0


def _set_stack(
    blueprint: Blueprint, own: dict[str, Any], fit: _Fit, rows: RowHeights, above: list[float]
) -> None:
    """Set the heights of the rows of a microphone, below those of the home."""
    contents = _contents(own)
    stack = next((one for one in rows.stacks if len(contents) == len(above) + len(one)), None)
    if stack is None:  # the user has changed it
        return
    heights = [*fit.above, *map(float, stack[rows.lanes :])]
    if rows.has_plots:
        _container(blueprint, contents[-1])["visible"] = fit.plots > 0
        heights[-1] = fit.plots
    inside = fit.homes - TAB_BAR * (len(rows.stacks) > 1)
    others = stack[rows.lanes : len(stack) - rows.has_plots]
    left = max(inside - sum(fit.above) - fit.plots, 0.0)
    for row, height in enumerate(others, rows.lanes):
        heights[row] = left * height / sum(others)
    own["row_shares"] = [*above, *heights]


def _contents(own: dict[str, Any]) -> list[str]:
    """Return the paths in a container; the viewer writes a single one without a list."""
    found = own.get("contents", [])
    paths = found if isinstance(found, list) else [found]
    return [path for path in paths if isinstance(path, str)]


def _container(blueprint: Blueprint, path: str) -> dict[str, Any]:
    """Return a container of a blueprint, with a path as in the contents of another one."""
    found: dict[str, Any] = blueprint.get(f"/{path.removeprefix('/')}", {}).get(_CONTAINER, {})
    return found
