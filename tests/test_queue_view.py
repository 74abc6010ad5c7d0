"""A queue in the real viewer: what is asked, close up, and the sound of it."""

import subprocess

import numpy as np
import psutil
import pytest
from conftest import HEARTHLOG
from viewers import patiently, pixels

from hearthlog.analyzer.colours import colour
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.lanes import SHARES
from hearthlog.analyzer.review.timeline import SoundClip
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.review.viewer.viewer import open_hidden

SECOND = 1_000_000_000
MARGIN = 20 * SECOND
_LEFT = 190  # pixels at the left of the plot of what is asked
_LANES, _SPECTRUM = 202, slice(110, 230)  # where the spectrogram is, at 1920 x 1080
_NEAR = 14  # of 255: how far a colour may be off


@pytest.fixture(scope="module")
def logs(day, model_file, tmp_path_factory):
    """Three minutes of a home."""
    folder = tmp_path_factory.mktemp("queue") / "logs"
    subprocess.run([*HEARTHLOG, "record", day, "--model", model_file, "-o", folder], check=True)
    return folder


@pytest.fixture
def timeline(logs):
    """Three minutes, of which the sound from 60 to 65 s was kept."""
    timeline = read_timeline([logs])
    hiss = np.random.default_rng(1).integers(-16_000, 16_000, 5 * 16_000).astype(np.int16)
    clip = SoundClip(timeline.grid.start + 60 * SECOND, 16_000, hiss)
    timeline.microphones["mic"].clips.append(clip)
    return timeline


@pytest.fixture
def view(timeline):
    """A viewer that shows them, for spans that are looked at close up."""
    try:
        with open_hidden() as viewer:
            viewer.draw(timeline, close_up=True)
            viewer.wait_until_drawn()
            yield viewer
    except DataError as error:
        if "does not run here" not in str(error):
            raise
        pytest.skip(str(error))


def ask(view, logs, start, end):
    """Go to a span, as a queue does."""
    view.draw_close_up(read_timeline([logs], start - MARGIN, end + MARGIN))
    view.ask(start, end, "music? 3.0 s")
    view.show(start, end, MARGIN)


def is_asked(picture, start, end):
    """Whether a light band lies from the start of a span to its end, and ends there."""
    left = _LEFT
    scale = (picture.shape[1] - left) / (end - start + 2 * MARGIN)
    first, last = (left + round(edge * scale) for edge in (MARGIN, MARGIN + end - start))
    inside = picture[:, first + 5 : last - 5].min(axis=2) > 150
    beside = picture[:, [first - 10, last + 10]].min(axis=2) < 100
    return (inside.all(axis=1) & beside.all(axis=1)).sum() >= 10


def share_of_right_columns(picture, timeline, start, end):
    """In how many columns most of the bands has the colour of the most probable class."""
    shares = timeline.microphones["mic"].plots[SHARES, "live"]
    names, values = shares.names, shares.values
    first, last = start - MARGIN, end + MARGIN
    words = 174  # pixels of the names of lanes
    left = words + int(np.argmax((pixels_of_bands(picture, names) > 40).any(axis=1)[words:][:80]))
    width = picture.shape[1] - left
    right = []
    for share in np.linspace(0.05, 0.8, 60):  # the legend is on the right
        time = first + int(share * (last - first))
        place = int(timeline.grid.find(np.array([time]))[0])
        column = picture[:, left + int(share * width)]
        seen = [(np.abs(column - np.array(colour(n))).max(axis=1) <= _NEAR).sum() for n in names]
        expected = values[place]
        if expected.max() > 0.7:
            right.append(int(np.argmax(seen)) == int(np.argmax(expected)))
    assert len(right) > 20
    return np.mean(right)


def pixels_of_bands(picture, names):
    """For each column how many pixels have the colour of each class."""
    return np.stack(
        [(np.abs(picture - np.array(colour(n))).max(axis=2) <= _NEAR).sum(axis=0) for n in names],
        axis=1,
    )


def test_close_ups_are_right_and_the_span_is_marked_also_when_the_queue_jumps_back(
    view, logs, timeline
):
    for second in (150, 30, 61, 45):
        start = timeline.grid.start + second * SECOND
        end = start + 3 * SECOND
        ask(view, logs, start, end)

        def is_right(png, start=start, end=end):
            picture = pixels(png)
            right = share_of_right_columns(picture, timeline, start, end)
            return right > 0.85 and is_asked(picture, start, end)

        patiently(view.picture, is_right)
    assert view.state().errors == []


def test_the_layout_stays_when_the_cursor_is_within_the_timeline(view, logs, timeline):
    start = timeline.grid.start + 40 * SECOND
    ask(view, logs, start, start + 3 * SECOND)
    patiently(view.picture, lambda png: is_asked(pixels(png), start, start + 3 * SECOND))
    before = columns_of(view)
    assert before
    view._size_due = 0.0
    view.refresh()
    assert columns_of(view) == before


def columns_of(view):
    """The widths of columns, by container."""
    blueprint = view._blueprint()
    shares = {path: one.get("ContainerBlueprint", {}) for path, one in blueprint.items()}
    return {path: one["col_shares"] for path, one in shares.items() if one.get("col_shares")}


def test_the_viewer_hardly_grows_with_the_spans_that_it_showed(view, logs, timeline):
    ours = psutil.Process().children(recursive=True)
    (viewer,) = [each for each in ours if each.name() == "rerun"]
    memory = []
    for number in range(12):
        start = timeline.grid.start + (30 + 37 * number % 120) * SECOND
        ask(view, logs, start, start + 3 * SECOND)
        patiently(view.picture)
        memory.append(viewer.memory_info().rss)
    assert memory[-1] - memory[3] < 8 * 8_000_000


def test_the_spectrogram_of_a_span_shows_its_sound_where_it_was_kept(view, logs, timeline):
    def seconds_of_hiss(start):
        """The first and the last second in which the spectrogram is bright; none if it is dark."""
        picture = pixels(patiently(view.picture))[_SPECTRUM, _LANES:]
        red, _, blue = np.moveaxis(picture, 2, 0)
        bright = ((red > 120) & (blue > 40)).mean(axis=0) > 0.3
        columns = np.flatnonzero(bright) / len(bright) * (MARGIN * 2 + SECOND) / SECOND
        return [round(float(columns[k])) + start // SECOND for k in (0, -1)] if len(columns) else []

    for second, expected in ((0, []), (62, [60, 65]), (100, []), (70, [60, 65])):
        start = timeline.grid.start + second * SECOND
        close = read_timeline([logs], start - MARGIN, start + SECOND + MARGIN)
        close.microphones["mic"].clips.extend(timeline.microphones["mic"].clips)
        view.draw_close_up(close)
        view.show(start, start + SECOND, MARGIN)
        patiently(view.cursor, lambda cursor, start=start: cursor == start)
        begin = (second * SECOND) - MARGIN
        patiently(lambda begin=begin: [seconds_of_hiss(begin)], lambda f, e=expected: f == [e])
        assert view.state().errors == []
