"""`python -m hearthlog.tools.lab.routine`: how well changes of a home's routines are noticed.

Simulated homes go on for months; each day is judged by the weeks before it. The days on which
nothing was thrown in tell how many alarms are false; changes are thrown in four times each, one at
a time.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC
from typing import Annotated, NamedTuple

import numpy as np
import typer

from hearthlog.analyzer.activity.day_anomaly import (
    DAYS,
    FEWEST,
    SPAN,
    Compared,
    compare,
    judge,
    rarity,
)
from hearthlog.analyzer.activity.day_profile import DayProfile, Profiles
from hearthlog.schemas.arrays import Float64
from hearthlog.tools.home.clips import ClipLibrary
from hearthlog.tools.lab.command import run
from hearthlog.tools.lab.routine_hearing import Hearing
from hearthlog.tools.lab.routine_months import (
    CHANGES,
    Sounds,
    day_number,
    gaps,
    heard,
    lived,
    planned,
)

_LENGTH = 100  # days
_STARTS = (40, 55, 70, 85)  # of what is thrown in
_MONTH = 30.0
_ONCE_IN = (14.0, 30.0, 60.0)
_DRAWS = 2000
_TREES = 50
_LARGEST = 6.0
_WORDS = 42  # characters of a line before its figures

Method = Callable[[Compared], float]


class Home(NamedTuple):
    """Figures of the days of a home, higher for more unusual ones, by method.

    Attributes
    ----------
    normal : np.ndarray [shape=(n, m)], float64
        Of days on which nothing was thrown in.
    changed : dict of str to list of np.ndarray [shape=(k, m)]
        By change, of the first days of each time.
    """

    normal: Float64
    changed: dict[str, list[Float64]]


def once_in(compared: Compared) -> float:
    """Return what an alert goes by."""
    return judge(compared, day_number(0)).once_in


def alone(compared: Compared) -> float:
    """Return the same of the day without those before it."""
    return rarity(compared.own[-1:], compared)


def largest(compared: Compared) -> float:
    """Return the largest deviation of a figure."""
    return float(np.nanmax(np.abs(compared.own[-1])))


def mahalanobis(compared: Compared) -> float:
    """Return how far a day is from the others, by how their figures go together."""
    from sklearn.covariance import LedoitWolf  # noqa: PLC0415  takes a second, for --methods

    return float(
        LedoitWolf().fit(_known(compared.others)).mahalanobis(_known(compared.own[-1:]))[0]
    )


def isolation_forest(compared: Compared) -> float:
    """Return how easily a day is told from the others by random cuts."""
    from sklearn.ensemble import IsolationForest  # noqa: PLC0415

    forest = IsolationForest(n_estimators=_TREES, random_state=0).fit(_known(compared.others))
    return float(-forest.score_samples(_known(compared.own[-1:]))[0])


METHODS: dict[str, Method] = {
    "routines, the day and three days": once_in,
    "routines, the day alone": alone,
    "largest deviation of a figure": largest,
    "Mahalanobis (Ledoit-Wolf)": mahalanobis,
    "isolation forest": isolation_forest,
}


def _known(deviations: Float64) -> Float64:
    return np.clip(np.nan_to_num(deviations), -_LARGEST, _LARGEST)


def simulate(seed: int, weeks: int, methods: Sequence[Method], library: ClipLibrary) -> Home:
    """Judge the days of a simulated home, and those of changes that are thrown in.

    Parameters
    ----------
    seed : int
    weeks : int
        That a day is compared with, at most.
    methods : sequence of callable
    library : ClipLibrary
    """
    rng = np.random.default_rng((seed, 1))
    hearing = Hearing(rng)
    sounds = lived(planned(seed, _LENGTH, library), _LENGTH, rng)
    missing = gaps(_LENGTH, rng)
    whole = Profiles(heard(sounds, (0, _LENGTH), hearing, missing, rng), UTC, night_after=True)
    normal = [whole.of(day_number(number)) for number in range(_LENGTH - 1)]

    def judged(days: Sequence[DayProfile], number: int) -> Float64 | None:
        return _judged(days, number, weeks, whole, methods)

    found = [judged(normal, number) for number in range(DAYS + SPAN, len(normal))]
    changed: dict[str, list[Float64]] = {name: [] for name in CHANGES}
    for place, name in enumerate(CHANGES):
        for start in _STARTS:
            own = np.random.default_rng((seed, start, place))
            days = list(normal)
            days[start : start + SPAN] = _changed(sounds, name, start, hearing, own)
            rows = [judged(days, number) for number in range(start, start + SPAN)]
            kept = [row for row in rows if row is not None]
            changed[name].append(np.array(kept).reshape(-1, len(methods)))
    return Home(np.array([row for row in found if row is not None]), changed)


def _changed(
    sounds: Sounds, name: str, start: int, hearing: Hearing, rng: np.random.Generator
) -> list[DayProfile]:
    """Return the first days of a change, all of which are heard."""
    change, length = CHANGES[name]
    near = start - 1, start + length + 2
    own = change(sounds, start, start + length, rng)
    home = heard(own, near, hearing, gaps(0, rng), rng)
    profiles = Profiles(home, UTC, night_after=True)
    return [profiles.of(day_number(number)) for number in range(start, start + SPAN)]


def _judged(
    days: Sequence[DayProfile],
    number: int,
    weeks: int,
    profiles: Profiles,
    methods: Sequence[Method],
) -> Float64 | None:
    first = number - SPAN + 1
    earlier = [day for day in days[max(first - 7 * weeks, 0) : first] if day.is_comparable]
    span = [day for day in days[first : number + 1] if day.is_comparable]
    if not days[number].is_comparable or len(earlier) < FEWEST:
        return None
    compared = compare(span, earlier, profiles.figures, profiles.classes)
    return np.array([method(compared) for method in methods])


def _detected(homes: Sequence[Home], name: str, limit: float, method: int, days: int) -> Float64:
    """Return for each home on which share of the times a change is noticed within some days."""
    return np.array(
        [
            np.mean([bool((rows[:days, method] >= limit).any()) for rows in home.changed[name]])
            for home in homes
        ]
    )


def _interval(values: Float64) -> tuple[float, float]:
    """Return where the mean over homes lies nine times in ten, by bootstrap."""
    rng = np.random.default_rng(0)
    draws = values[rng.integers(len(values), size=(_DRAWS, len(values)))].mean(axis=1)
    low, high = np.quantile(draws, (0.05, 0.95))
    return float(low), float(high)


def _text(values: Float64, form: str) -> str:
    low, high = _interval(values)
    return f"{values.mean():{form}} ({low:{form}} to {high:{form}})"


def alarm_lines(homes: Sequence[Home]) -> Iterator[str]:
    """Say how many alarms are false, and which changes are noticed.

    Parameters
    ----------
    homes : sequence of Home
        Of which the first method is `once_in`.

    Yields
    ------
    str
        A line of a table.
    """
    yield f"{'once_in':{_WORDS}}" + "".join(f"{limit:>24g}" for limit in _ONCE_IN)
    months = [
        np.array([_MONTH * (home.normal[:, 0] >= limit).mean() for home in homes])
        for limit in _ONCE_IN
    ]
    yield f"{'false alarms a month':{_WORDS}}" + "".join(
        f"{_text(each, '.2f'):>24}" for each in months
    )
    for name in CHANGES:
        for days, words in ((1, "on its first day"), (SPAN, f"within {SPAN} days")):
            shares = [_detected(homes, name, limit, 0, days) for limit in _ONCE_IN]
            cells = (f"{_text(100 * share, '.0f'):>24}" for share in shares)
            yield f"{name if days == 1 else '':24}{words:>18}" + "".join(cells)


def method_lines(homes: Sequence[Home]) -> Iterator[str]:
    """Compare methods, each with the limit that gives a false alarm a month in all homes together.

    Parameters
    ----------
    homes : sequence of Home

    Yields
    ------
    str
        A line of a table.
    """
    yield f"{'% noticed, on its first day / within 3 days':44}" + "".join(
        f"{number + 1:>9}" for number in range(len(CHANGES))
    )
    for method, words in enumerate(METHODS):
        scores = np.concatenate([home.normal[:, method] for home in homes])
        limit = float(np.quantile(scores, 1 - 1 / _MONTH))
        cells = []
        for name in CHANGES:
            shares = (100 * _detected(homes, name, limit, method, n).mean() for n in (1, SPAN))
            cells.append("/".join(f"{share:.0f}" for share in shares))
        yield f"{words:44}" + "".join(f"{cell:>9}" for cell in cells)
    yield "; ".join(f"{number}: {name}" for number, name in enumerate(CHANGES, 1))


def main(
    homes: Annotated[int, typer.Option(min=2)] = 20,
    seed: Annotated[int, typer.Option(help="Of the first home.")] = 200,
    weeks: Annotated[int, typer.Option(min=1, max=4, help="That a day is compared with.")] = 4,
    *,
    methods: Annotated[bool, typer.Option("--methods", help="Compare other methods, too.")] = False,
) -> None:
    """Print how many alarms of simulated months are false, and which changes are noticed."""
    library = ClipLibrary()
    chosen = [*METHODS.values()][: None if methods else 1]
    found = []
    for number in range(homes):
        found.append(simulate(seed + number, weeks, chosen, library))
        if sys.stderr.isatty():
            print(f"\r{number + 1} of {homes} homes", end="", file=sys.stderr, flush=True)
    days = sum(len(home.normal) for home in found)
    print(f"{homes} homes, {days} days without a change, {weeks} weeks to compare with")
    print(*alarm_lines(found), *(method_lines(found) if methods else ()), sep="\n")


if __name__ == "__main__":
    run(main)
