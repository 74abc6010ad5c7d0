"""The index of a catalogue saves looking at logs, and never changes what is found in them."""

import os
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from stores import put
from test_catalog import SECOND, fleet, recording, relabelled

import hearthlog.analyzer.logs.locations
import hearthlog.analyzer.logs.selection
from hearthlog.analyzer.logs.catalog import FINISHED, read_catalog
from hearthlog.analyzer.logs.catalog_writer import write_catalog
from hearthlog.analyzer.logs.selection import select
from hearthlog.schemas.errors import LogError, ignore_progress
from hearthlog.schemas.logs.files import CATALOG, find_logs, time_span
from hearthlog.schemas.logs.writer import LogWriter

__all__ = ["fleet", "recording"]
_TICK = 0.05  # s; clocks of disks are finer


@pytest.fixture
def old(monkeypatch):
    """Make the catalogue of a folder in which all has been as it is for a while."""
    monkeypatch.setattr(hearthlog.analyzer.logs.locations, "_YOUNG", int(_TICK * SECOND))

    def catalogue(folder, before=None, progress=ignore_progress):
        time.sleep(2 * _TICK)
        return write_catalog(folder, before, progress)

    return catalogue


@pytest.fixture
def catalogued(fleet, old):
    """A fleet with a catalogue, and nothing has changed since."""
    old(fleet)
    return fleet


def found(folder: Path, start: int | None = None, end: int | None = None) -> tuple:
    """Tell what a selection is, what comes before it, and which warnings came with it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            selection = select([folder], (), start, end)
        except LogError as error:
            return (str(error),)
        return selection, list(selection.earlier), {str(one.message) for one in caught}


def found_without(fleet: Path, *span: int | None) -> tuple:
    """Tell what it is without a catalogue."""
    away = fleet.parent / "away"
    (fleet / CATALOG).rename(away)
    try:
        return found(fleet, *span)
    finally:
        away.rename(fleet / CATALOG)


@pytest.fixture
def looked_into(monkeypatch) -> list[str]:
    """Folders that were listed."""
    folders = []
    before = hearthlog.analyzer.logs.locations.look_into

    def look_into(folder):
        folders.append(folder)
        return before(folder)

    monkeypatch.setattr(hearthlog.analyzer.logs.locations, "look_into", look_into)
    return folders


@pytest.fixture
def opened(monkeypatch) -> list[Path]:
    """Logs that were asked for their spans."""
    paths = []

    def span_of(path, **options):
        paths.append(path)
        return time_span(path, **options)

    monkeypatch.setattr(hearthlog.analyzer.logs.selection, "time_span", span_of)
    return paths


def north(fleet: Path) -> list[Path]:
    return [path for path in find_logs(fleet / "north") if path.suffix == ".mcap"]


def inner_folders(fleet: Path) -> set[str]:
    homes = {path.parent for path in find_logs(fleet)}
    return {str(folder) for home in homes for folder in (home, *home.parents)} - {
        str(folder) for folder in (fleet, *fleet.parents)
    }


def is_added(fleet: Path) -> Path:
    return shutil.copy2(north(fleet)[0], north(fleet)[0].with_name("attic_20200101T000000Z.mcap"))


def is_added_in_a_new_home(fleet: Path) -> Path:
    new = fleet / "carl" / "2026" / "03" / "01" / north(fleet)[1].name
    new.parent.mkdir(parents=True)
    return shutil.copy2(north(fleet)[1], new)


def is_removed(fleet: Path) -> None:
    north(fleet)[1].unlink()


def is_finished(fleet: Path) -> None:
    (active,) = find_logs(fleet / "bert")
    shutil.copyfile(north(fleet)[0], active)
    active.rename(active.with_suffix(""))


def is_replaced(fleet: Path) -> None:
    first, second, *_ = north(fleet)
    shutil.copy2(second, first.with_name("copy"))
    first.with_name("copy").rename(first)


def is_appended_to(fleet: Path) -> None:
    (active,) = find_logs(fleet / "bert")
    full = north(fleet)[0].read_bytes()
    with active.open("ab") as stream:
        stream.write(full[active.stat().st_size :])


def is_reviewed(fleet: Path) -> None:
    relabelled(north(fleet)[0], [(12, "speech")])


def is_moved_with_its_home(fleet: Path) -> None:
    (fleet / "bert").rename(fleet / "north" / "carl")


def is_removed_with_its_home(fleet: Path) -> None:
    shutil.rmtree(fleet / "bert")


def is_put_in_the_place_of_another(fleet: Path) -> None:
    first, second, *_ = north(fleet)
    first.with_name("aside").write_bytes(first.read_bytes())
    second.rename(first)
    first.with_name("aside").rename(second)


def is_replaced_by_nonsense(fleet: Path) -> None:
    path = north(fleet)[1]
    path.with_name("nonsense").write_bytes(b"nonsense")
    path.with_name("nonsense").rename(path)


def has_a_link_instead(fleet: Path) -> None:
    first, second, *_ = north(fleet)
    first.unlink()
    first.symlink_to(second)


CHANGES = (
    is_added, is_added_in_a_new_home, is_removed, is_finished, is_replaced, is_appended_to,
    is_reviewed, is_moved_with_its_home, is_removed_with_its_home, is_put_in_the_place_of_another,
    is_replaced_by_nonsense, has_a_link_instead,
)  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_found_after_a_log_is_as_without_a_catalogue(catalogued, change):
    first, second, third = map(time_span, north(catalogued)[:3])
    spans = [(first[1] - SECOND, first[1]), second, (second[0] + SECOND, third[1] - SECOND)]
    before = [found(catalogued, *span) for span in spans]
    change(catalogued)
    after = [found(catalogued, *span) for span in spans]
    assert after == [found_without(catalogued, *span) for span in spans]
    assert after != before


def test_a_link_is_followed_whenever_it_leads_elsewhere(fleet, old):
    outside = fleet.parent / "outside.mcap"
    outside.mkdir()
    link = fleet / "linked" / "a.mcap"
    link.parent.mkdir()
    link.symlink_to(outside)
    old(fleet)
    outside.rmdir()
    shutil.copy2(north(fleet)[1], outside)
    assert link in found(fleet)[0].logs
    old(fleet, read_catalog(fleet))
    shutil.copy2(north(fleet)[2], outside)
    span = time_span(outside)
    assert found(fleet, *span) == found_without(fleet, *span)
    assert link in found(fleet, *span)[0].logs


def test_folders_that_did_not_change_are_not_listed_again(catalogued, looked_into):
    found(catalogued)
    assert not inner_folders(catalogued) & set(looked_into)
    is_added(catalogued)
    found(catalogued)
    day = str(north(catalogued)[0].parent)
    assert inner_folders(catalogued) & set(looked_into) == {day}


def test_a_folder_that_changed_just_before_it_was_listed_is_listed_again(fleet, looked_into):
    write_catalog(fleet)
    looked_into.clear()
    found(fleet)
    assert inner_folders(fleet) <= set(looked_into)


def test_where_folders_do_not_change_with_their_files_all_are_listed(catalogued, looked_into):
    later = time.time_ns() + 60 * SECOND
    os.utime(catalogued / CATALOG, ns=(later, later))  # as if no folder had noticed it
    found(catalogued)
    assert inner_folders(catalogued) <= set(looked_into)


def test_the_index_does_not_say_what_is_in_a_folder_that_one_may_not_read(
    catalogued, looked_into, monkeypatch
):
    day = str(north(catalogued)[0].parent)
    monkeypatch.setattr(os, "access", lambda path, _: path != day)  # as for another user
    found(catalogued)
    assert inner_folders(catalogued) & set(looked_into) == {day}


def test_only_what_is_not_finished_or_in_the_span_is_looked_at(catalogued, opened):
    first, second, *others = north(catalogued)
    for path in others:
        path.write_bytes(b"nonsense")  # which no program does: a finished log is never changed
    span = None, time_span(second)[1]
    selection, _, output = found(catalogued, *span)
    assert {first, second} < set(selection.logs)
    assert not opened
    assert not output
    second.write_bytes(b"nonsense")
    _, _, output = found(catalogued, *span)
    assert opened == [second]
    assert len(output) == 1


def test_logs_without_a_span_are_asked_and_enrolled_sounds_are_left_out(fleet, opened, old):
    enrolled = fleet / "north" / "anna" / "enrolled" / "a.mcap"
    enrolled.parent.mkdir()
    shutil.copy2(north(fleet)[0], enrolled)
    silent, damaged = (north(fleet)[0].with_name(name) for name in ("silent.mcap", "bad.mcap"))
    LogWriter(silent, [], {}).finish()
    damaged.write_bytes(b"nonsense")
    old(fleet)
    for changes in ([], [is_added]):
        new = {change(fleet) for change in changes}
        assert found(fleet, 0, SECOND) == found_without(fleet, 0, SECOND)
        assert found(fleet) == found_without(fleet)
        assert enrolled not in found(fleet)[0].logs
        opened.clear()
        found(fleet)
        assert {damaged, silent} <= set(opened) <= {damaged, silent} | new


def test_a_log_that_has_not_got_its_name_yet_is_looked_at(fleet, old):
    first, second, *_ = north(fleet)
    active = first.with_name("attic_20200101T000000Z.mcap.active")
    shutil.copy2(first, active)  # whole, but for its name
    old(fleet)
    assert read_catalog(fleet).current(active).state == FINISHED
    shutil.copy2(second, active)
    span = time_span(second)
    assert active in found(fleet, *span)[0].logs
    assert found(fleet, *span) == found_without(fleet, *span)


def test_a_log_that_another_program_writes_under_its_last_name_is_looked_at(fleet, old):
    first, *_ = north(fleet)
    (cut,) = find_logs(fleet / "bert")
    growing = cut.rename(cut.with_suffix(""))
    old(fleet)
    growing.write_bytes(first.read_bytes())
    span = time_span(first)[1] - SECOND, time_span(first)[1]
    assert growing in found(fleet, *span)[0].logs
    assert found(fleet, *span) == found_without(fleet, *span)


def test_what_was_before_a_span_comes_last_first(catalogued, old):
    first, second, *_ = north(catalogued)
    (cut,) = find_logs(catalogued / "bert")
    other = is_added_in_a_new_home(catalogued)
    expected = [second, other, first, cut]
    assert found(catalogued, time_span(second)[0] + SECOND)[1] == expected
    old(catalogued, read_catalog(catalogued))
    assert found(catalogued, time_span(second)[0] + SECOND)[1] == expected


def test_logs_that_were_not_read_for_the_catalogue_are_asked(fleet, old, monkeypatch):
    monkeypatch.setattr(hearthlog.analyzer.logs.catalog_writer, "_TASK", 1)

    def interrupt(share):
        if share > 1 / 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        old(fleet, None, interrupt)
    assert found(fleet) == found_without(fleet)


def test_a_log_whose_name_is_no_text_is_known(fleet, old, opened):
    path = north(fleet)[0]
    odd = path.with_name(os.fsdecode(b"hall\xff_20200101T000000Z.mcap"))
    shutil.copy2(path, odd)
    old(fleet)
    assert odd in found(fleet)[0].logs
    assert not opened
    assert found(fleet) == found_without(fleet)


def test_a_query_needs_no_pyarrow(catalogued):
    code = (
        "import sys; from pathlib import Path; sys.modules['pyarrow'] = None; "
        "from hearthlog.analyzer.logs import selection; "
        "selection.time_span = None; "
        "print(len(selection.select([Path(sys.argv[1])], (), 0, 1 << 62).logs))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, catalogued], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) == len(find_logs(catalogued))


def test_logs_in_a_store_are_not_opened_where_the_index_knows_them(fleet, in_memory, opened):
    store = put(fleet, in_memory)
    _, second, *_ = find_logs(store)
    write_catalog(store)
    assert found(store)[0].logs
    assert not opened
    second.write_bytes(b"nonsense")
    found(store)
    assert opened == [second]
