"""A queue in the real viewer: what is asked, close up, and the sound of it."""

import subprocess
from contextlib import suppress
from operator import ge
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from conftest import HEARTHLOG
from viewers import patiently, pixels

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.review.lanes import PROBABILITIES
from hearthlog.analyzer.review.timeline import Key, LabelledSpans, Question, SoundClip
from hearthlog.analyzer.review.timeline_reader import read_timeline
from hearthlog.analyzer.review.viewer.drawing import _SPECTRUM_SHAPE, clear_sound, placed_lanes
from hearthlog.analyzer.review.viewer.viewer import open_hidden
from hearthlog.models.classes import colour, ordered

SECOND = 1_000_000_000
MARGIN = 20 * SECOND
_LEFT = 202  # pixels at the left of the plot of what is asked, as of the lanes
_LANES, _SPECTRUM = 202, slice(130, 190)  # where the spectrogram is, at 1920 x 1080
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


def query(view, logs, start, end):
    """Go to a span, as a queue does."""
    view.draw_close_up(read_timeline([logs], start - MARGIN, end + MARGIN))
    view.show_question(start, end, Question("Music?", "1 of 10", [Key("a", "yes")]))
    view.show(start, end, MARGIN)


def is_requested(picture, start, end, beyond=4):
    """Whether a light band lies from the start of a span to its end, and ends there."""
    left = _LEFT
    scale = (picture.shape[1] - left) / (end - start + 2 * MARGIN)
    first, last = (left + round(edge * scale) for edge in (MARGIN, MARGIN + end - start))
    inside = picture[:, first + 3 : last - 3].min(axis=2) > 150
    neighbour = picture[:, [first - beyond, last + beyond]].min(axis=2) < 100
    return (inside.all(axis=1) & neighbour.all(axis=1)).sum() >= 10


def rows_of_classes(picture, names):
    """The row of pixels in the middle of each class, by the lowest row, as it may be rounded."""
    bright = np.abs(picture[:, _LANES:] - np.array(colour(names[-1]))).max(axis=2) <= _NEAR
    lowest = np.flatnonzero(bright[len(picture) // 2 :].mean(axis=1) > 0.02) + len(picture) // 2
    run = max(np.split(lowest, np.flatnonzero(np.diff(lowest) > 3) + 1), key=len)
    assert len(run) > 5
    above = len(names) - np.arange(len(names)) - 0.5
    for off in np.linspace(-1.0, 1.0, 9):
        height = (len(run) + off - 3) / 0.9  # it reaches three pixels into the row above
        yield np.rint(run[-1] + 1 - above * height).astype(int).tolist()


def right_columns(picture, timeline, first, last):
    """The share of columns whose brightest row is that of the most probable class."""
    names = ordered(timeline.microphones["mic"].plots[PROBABILITIES, "live"].names)
    every = rows_of_classes(picture, names)
    return max(right_in_rows(picture, timeline, first, last, rows) for rows in every)


def right_in_rows(picture, timeline, first, last, rows):
    shares = timeline.microphones["mic"].plots[PROBABILITIES, "live"]
    names = ordered(shares.names)
    colours = np.array([colour(name) for name in names])
    right = []
    for share in np.linspace(0.05, 0.95, 90):
        place = int(timeline.grid.find(np.array([first + int(share * (last - first))]))[0])
        values = [shares.values[place, shares.names.index(name)] for name in names]
        if max(values) < 0.8:
            continue
        x = _LANES + int(share * (picture.shape[1] - _LANES))
        seen = np.stack([picture[y - 1 : y + 2, x].mean(axis=0) for y in rows])
        light = ((seen - 13) * (colours - 13)).sum(axis=1) / ((colours - 13) ** 2).sum(axis=1)
        # The round ends of a piece reach three pixels into the next one.
        near = shares.values[max(place - 1, 0) : place + 2].argmax(axis=1)
        expected = {shares.names[number] for number in near}
        right.append(names[int(light.argmax())] in expected and light.max() > 0.6)
    assert len(right) > 20
    return np.mean(right)


def test_close_ups_are_right_and_the_span_is_marked_also_when_the_queue_jumps_back(
    view, logs, timeline
):
    for second in (150, 30, 61, 45):
        start = timeline.grid.start + second * SECOND
        end = start + 3 * SECOND
        query(view, logs, start, end)

        def is_right(png, start=start, end=end):
            picture = pixels(png)
            right = right_columns(picture, timeline, start - MARGIN, end + MARGIN)
            return right > 0.85 and is_requested(picture, start, end)

        patiently(view.picture, is_right)
    assert view.state().errors == []


def test_a_drag_in_a_queue_is_seen_on_the_requested_span_until_both_are_the_same(
    view, logs, timeline
):
    start = timeline.grid.start + 60 * SECOND
    first, dragged = (start, start + 6 * SECOND), (start + 2 * SECOND, start + 12 * SECOND)
    query(view, logs, *first)
    for span in (dragged, first, dragged):
        view.show(*span, MARGIN)

        def is_right(png, span=span):
            view.refresh()  # as a session does several times a second
            picture = pixels(png)
            scale = (picture.shape[1] - _LEFT) / (span[1] - span[0] + 2 * MARGIN)
            only_first = _LEFT + round((first[0] - span[0] + MARGIN + SECOND) * scale)
            grey = np.ptp(picture[:, only_first], axis=1) < 20
            grey &= np.abs(picture[:, only_first].mean(axis=1) - 90) < 12
            is_behind = grey.sum() >= 20
            return is_requested(picture, *span, beyond=6) and is_behind == (span == dragged)

        patiently(view.picture, is_right)


def runs(lit, gap):
    """The first and the last of the places that are lit, for each run of them."""
    places = np.flatnonzero(lit)
    parts = np.split(places, np.flatnonzero(np.diff(places) > gap) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts if len(part)]


_TOP, _QUESTION = 38, 400  # pixels above the question, and as many columns as it has
_NAMES = ["talking", "music", "telephone ringing", "coughing", "household sounds", "shouting"]


def test_the_question_is_large_and_all_is_shown_on_a_small_screen(timeline):
    """Lanes with their names, the probabilities, the question, and two lines of keys."""
    keys = [Key(str(number), name) for number, name in enumerate(_NAMES * 2)]
    question = Question("Is all of this minute labelled right?", "1 of 10", keys)
    start = timeline.grid.start + 60 * SECOND
    recorder = timeline.microphones["mic"].labellings[0]
    kept = recorder.spans.texts != "laughing"  # eight lanes, as of the general model
    recorder.spans = LabelledSpans(*(part[kept] for part in recorder.spans))
    recorder.classes = [name for name in recorder.classes if name != "laughing"]
    assert len(placed_lanes(timeline)) == 8
    with open_hidden(size=(1366, 768)) as viewer:
        viewer.draw(timeline, close_up=True)
        viewer.wait_until_drawn()
        viewer.show_question(start, start + 5 * SECOND, question)
        viewer.show(start, start + 5 * SECOND, MARGIN)

        def is_right(png):
            viewer.refresh()
            picture = pixels(png)
            light = picture.min(axis=2) > 110
            scale = (1366 - _LEFT) / (45 * SECOND)
            band = _LEFT + round(22 * SECOND * scale)
            bands = runs(light[_TOP:, band - 30 : band + 30].all(axis=1), 1)
            top = bands[0][0] if bands else 0  # not drawn yet
            large = runs(light[_TOP : _TOP + top, :_QUESTION].any(axis=1), 2)
            small = runs(light[_TOP : _TOP + top, _QUESTION + 20 :].any(axis=1), 1)
            heights = [last - first for first, last in large]
            cursor = _LEFT + round(MARGIN * scale)
            lines = runs(light[:, cursor - 4 : cursor + 5].any(axis=1), 4)
            views = [last - first for first, last in lines if last - first > 60][:2]
            return (
                len(large) == 1
                and len(small) == 3
                and heights[0] > 1.4 * max(last - first for first, last in small)
                and max(large[-1][1], small[-1][1]) < top - 2
                and [*map(ge, views, (8 * 27, 70))] == [True, True]
            )

        patiently(viewer.picture, is_right)


@pytest.mark.parametrize(
    ("size", "halves"),
    [((1920, 1080), (60 * SECOND, 10 * SECOND, SECOND)), ((2560, 1440), (60 * SECOND,))],
    ids=["every zoom", "a tall window"],
)
def test_probabilities_are_rows_of_one_colour(timeline, size, halves):
    with open_hidden(size=size) as viewer:
        viewer.draw(timeline, close_up=False)
        viewer.wait_until_drawn()
        middle = timeline.grid.start + 70 * SECOND
        for half in halves:
            viewer.show(middle - half, middle + half, 0, select=False)

            def is_right(png, half=half):
                with suppress(AssertionError, ValueError):
                    return right_columns(pixels(png), timeline, middle - half, middle + half) > 0.85
                return False

            patiently(viewer.picture, is_right)


def test_a_window_keeps_its_layout_when_its_cursor_goes_elsewhere(view, timeline):
    def layout():
        view._size_due = 0.0  # the next refresh looks at the size
        view.refresh()
        shares = (one.get("ContainerBlueprint", {}) for one in view._blueprint().values())
        return [one.get("col_shares") for one in shares]

    before = layout()
    start = timeline.grid.start + 90 * SECOND
    view.show(start, start + SECOND, MARGIN)
    patiently(view.cursor, lambda cursor: cursor == start)
    patiently(view.picture)
    assert layout() == before


def test_the_viewer_hardly_grows_with_the_spans_that_it_showed(view, logs, timeline):
    ours = psutil.Process().children(recursive=True)
    (viewer,) = [each for each in ours if each.name() == "rerun"]
    memory = []
    for number in range(20):  # the memory of a viewer goes up and down by tens of megabytes
        start = timeline.grid.start + (30 + 37 * number % 120) * SECOND
        query(view, logs, start, start + 3 * SECOND)
        patiently(view.picture)
        memory.append(viewer.memory_info().rss)
    assert memory[-1] - memory[3] < 16 * 8_000_000


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


def test_where_no_sound_was_kept_is_a_picture_of_the_same_size_else_the_viewer_warns():
    shapes = []
    canvas = SimpleNamespace(show_image=lambda *image: shapes.append(image[2].shape))
    clear_sound("mic", 0, "No sound was kept here", canvas)
    assert shapes == [_SPECTRUM_SHAPE]
