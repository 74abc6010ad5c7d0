"""Folders of public collections become manifests that can be learned from."""

import csv
import json
import os
import shutil
from math import inf
from pathlib import Path

import collectionfolders as made
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from hearthlog.analyzer.collections import COLLECTIONS, CategorySpan, short_licence
from hearthlog.analyzer.collections.manifest_writer import (
    LabelMap,
    labelled_parts,
    make_manifest,
    read_map,
    shipped_map,
)
from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.manifest import LABELS, read_manifest
from hearthlog.models.modelfile import load_model, model_card
from hearthlog.schemas.errors import ignore_progress
from hearthlog.tools.cli.main import make_app

pytestmark = pytest.mark.fast

NAMED = {each.name: each for each in COLLECTIONS}
WRITERS = {
    "esc50": made.write_esc50,
    "fsd50k": made.write_fsd50k,
    "urbansound8k": made.write_urbansound8k,
    "desed": made.write_desed,
    "vocalsound": made.write_vocalsound,
    "audioset-strong": made.write_audioset_strong,
    "ravdess": made.write_ravdess,
    "emodb": made.write_emodb,
    "voxceleb": made.write_voxceleb,
    "folder": made.write_own,
}
# What two classes can be told apart in each of them.
CLASSES = {
    "urbansound8k": ("music", "other_negative"),
    "desed": ("speech", "objects_activity"),
    "audioset-strong": ("coughing", "speech"),
    "folder": ("flushing_water", "laughing"),
    "ravdess": ("anger", "sadness"),
    "emodb": ("anger", "sadness"),
    "voxceleb": ("id10001", "id10270"),
}
MOODS = {"anger", "sadness", "neutral", "id10001", "id10270"}
KEPT = {"ravdess", "emodb", "voxceleb"}  # whose labels are moods or people


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """All of the folders."""
    return {name: write(tmp_path_factory.mktemp(name) / "c") for name, write in WRITERS.items()}


@pytest.fixture
def copied(written, tmp_path):
    """Copy one of the folders, to spoil it."""
    return lambda name: Path(shutil.copytree(written[name], tmp_path / "copied" / name))


def command(*words):
    return CliRunner().invoke(make_app(), [str(word) for word in words])


def rows_of(name, folder, output, **options):
    """The lines of a manifest, with paths from the folder of the collection."""
    make_manifest(NAMED[name], folder, output, ignore_progress, **options)
    with output.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    root = folder.resolve()
    for row in rows:
        path = Path(os.path.normpath(output.parent.resolve() / row["path"]))
        row["path"] = path.relative_to(root).as_posix()
    return rows


def refusal(name, folder, output, **options):
    with pytest.raises(DataError) as caught:
        make_manifest(NAMED[name], folder, output, ignore_progress, **options)
    assert not output.exists()
    assert str(caught.value).isprintable()
    return str(caught.value)


@pytest.mark.parametrize("name", WRITERS)
def test_three_commands_make_a_manifest_a_model_and_an_evaluation(written, tmp_path, name):
    table, model = tmp_path / "manifest.csv", tmp_path / "made.safetensors"
    first, second = CLASSES.get(name, ("coughing", "laughing"))
    scenario = tmp_path / "own.toml"
    more = ', "neutral"' if name in KEPT else ""
    scenario.write_text(f'[classes]\none = ["{first}"]\ntwo = ["{second}"{more}]\n')
    done = command("manifest", name, written[name], "-o", table)
    assert done.exit_code == 0, done.stderr
    clips = read_manifest(table, LABELS | MOODS if name in KEPT else LABELS)
    assert f"{table}: {len(clips)} clips" in done.stdout
    done = command("train", "--data", table, "--scenario", scenario, "-o", model, "--json")
    assert done.exit_code == 0, done.stderr
    used = [clip for clip in clips if clip.label in {first, second}]
    learned = json.loads(done.stdout)["training_data"]["collections"]
    assert {(one["name"], one["licence"]) for one in learned} >= {
        (clip.source, clip.licence) for clip in used
    }
    card = model_card(load_model(model))
    assert all(f"- {clip.source}: " in card for clip in used)
    assert all((clip.licence or "licence unstated") in card for clip in used)
    done = command("evaluate", "model", model, "--data", table)
    assert done.exit_code in {0, 3}, done.stderr
    assert "expected calibration error" in done.stdout


def test_several_collections_are_learned_from_together(written, tmp_path):
    for name in ("esc50", "fsd50k"):
        done = command("manifest", name, written[name], "-o", tmp_path / f"{name}.csv")
        assert done.exit_code == 0
    (tmp_path / "own.toml").write_text('[classes]\none = ["coughing"]\ntwo = ["laughing"]\n')
    data = "--data", tmp_path / "esc50.csv", "--data", tmp_path / "fsd50k.csv"
    model = tmp_path / "both.safetensors"
    assert command("train", *data, "--scenario", tmp_path / "own.toml", "-o", model).exit_code == 0
    card = model_card(load_model(model))
    for line in ("ESC-50: 7 clips, CC BY-NC 3.0", "FSD50K: 2 clips, CC0", "FSD50K: 1 clips, uns"):
        assert line in card


def test_clips_of_esc_50_have_the_licence_of_their_subset(written, tmp_path):
    rows = rows_of("esc50", written["esc50"], tmp_path / "m.csv")
    assert rows[0] == {
        "path": "audio/1-19111-A-24.wav",
        "label": "coughing",
        "source_group": "fs19111",
        "source": "ESC-50",
        "licence": "CC BY-NC 3.0",
        "start": "",
        "end": "",
        "detail": "coughing",
    }
    assert [row["source_group"] for row in rows[1:3]] == ["fs19118"] * 2
    ours = {row["detail"]: (row["label"], row["licence"]) for row in rows}
    assert ours["crying_baby"] == ("crying", "CC BY 3.0")
    assert ours["dog"] == ("other_negative", "CC BY 3.0")
    assert "footsteps" not in ours


def test_background_sounds_of_urbansound8k_are_left_out(written, tmp_path):
    rows = rows_of("urbansound8k", written["urbansound8k"], tmp_path / "m.csv")
    assert {row["path"]: row["source_group"] for row in rows if row["label"] == "music"} == {
        "audio/fold1/101-9-0-0.wav": "fs101",
        "audio/fold1/101-9-0-1.wav": "fs101",
        "audio/fold2/102-9-0-0.wav": "fs102",
        "audio/fold10/103-9-0-0.wav": "fs103",
    }
    assert [row["source_group"] for row in rows if row["label"] == "other_negative"] == [
        *("fs201", "fs202", "fs203")
    ]


def test_clips_of_fsd50k_have_one_sound_and_its_own_licence(written, tmp_path):
    rows = rows_of("fsd50k", written["fsd50k"], tmp_path / "m.csv")
    keys = "path", "label", "source_group", "licence", "detail"
    assert [tuple(row[key] for key in keys) for row in rows] == [
        ("FSD50K.dev_audio/101.wav", "coughing", "freesound_user_anna", "CC BY 3.0", "Cough"),
        ("FSD50K.dev_audio/102.wav", "coughing", "freesound_user_anna", "CC0", "Cough"),
        ("FSD50K.dev_audio/103.wav", "coughing", "freesound_user_ben", "CC BY-NC 4.0", "Cough"),
        (
            *("FSD50K.dev_audio/201.wav", "laughing", "freesound_user_anna", "CC BY 3.0"),
            "Giggle + Laughter",
        ),
        ("FSD50K.dev_audio/202.wav", "laughing", "freesound_user_cleo", "CC0", "Laughter"),
        (
            *("FSD50K.eval_audio/401.wav", "other_negative", "freesound_user_dora", "CC BY 3.0"),
            "Animal + Bark + Dog + Domestic_animals_and_pets",
        ),
        ("FSD50K.eval_audio/402.wav", "coughing", "freesound_user_emil", "unstated", "Cough"),
    ]


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("http://creativecommons.org/licenses/by/3.0/", "CC BY 3.0"),
        ("https://creativecommons.org/licenses/by-nc/4.0/", "CC BY-NC 4.0"),
        ("http://creativecommons.org/licenses/sampling+/1.0/", "CC Sampling+ 1.0"),
        ("http://creativecommons.org/publicdomain/zero/1.0/", "CC0"),
        ("http://example.org/licenses/by/3.0/", "unstated"),
        ("None", "unstated"),
    ],
)
def test_licences_have_short_names(address, name):
    assert short_licence(address) == name


def test_speakers_of_vocalsound_are_sources(written, tmp_path):
    rows = rows_of("vocalsound", written["vocalsound"], tmp_path / "m.csv")
    assert {row["source_group"] for row in rows if row["label"] == "coughing"} == {
        *("vocalsound_f0003", "vocalsound_m0004", "vocalsound_f0011")
    }
    assert {row["detail"]: row["label"] for row in rows} == {
        "cough": "coughing",
        "laughter": "laughing",
        "sneeze": "other_negative",
        "sigh": "other_negative",
    }


def test_emotions_are_labels_and_their_actors_sources(written, tmp_path):
    rows = rows_of("ravdess", written["ravdess"], tmp_path / "r.csv")
    assert {(row["detail"], row["label"]) for row in rows} == {
        *(("angry", "anger"), ("sad", "sadness"), ("calm", "neutral"))
    }
    assert {row["source_group"] for row in rows} == {"ravdess_01", "ravdess_02", "ravdess_12"}
    rows = rows_of("emodb", written["emodb"], tmp_path / "e.csv")
    assert {row["label"] for row in rows} == {"anger", "sadness", "neutral"}
    assert {row["source_group"] for row in rows} == {"emodb_03", "emodb_08", "emodb_16"}


def test_actors_may_lie_in_a_folder_of_their_own_or_of_all(written, tmp_path):
    inner = tmp_path / "RAVDESS" / "Audio_Speech_Actors_01-24"
    shutil.copytree(written["ravdess"], inner)
    rows = rows_of("ravdess", inner.parent, tmp_path / "r.csv")
    assert len(rows) == 9


def test_people_are_labels_and_their_videos_sources(written, tmp_path):
    rows = rows_of("voxceleb", written["voxceleb"], tmp_path / "v.csv")
    assert {row["label"] for row in rows} == {"id10001", "id10270"}
    assert len({row["source_group"] for row in rows}) == 10
    assert rows[0]["source_group"] == "youtube_a10001-_678"


def test_a_clip_in_another_place_than_those_of_a_collection_is_left_out(copied, tmp_path):
    folder = copied("voxceleb")
    shutil.copy(next(folder.rglob("*.wav")), folder / "wav" / "stray.wav")
    done = command("manifest", "voxceleb", folder, "-o", tmp_path / "v.csv")
    assert "left out: 1, not placed as a clip of the collection\n" in done.stdout
    done = command("manifest", "emodb", copied("emodb"), "-o", tmp_path / "e.csv")
    assert "left out: 1, not named as a clip of the collection\n" in done.stdout


def test_sounds_of_desed_are_parts_of_files(written, tmp_path):
    rows = rows_of("desed", written["desed"], tmp_path / "m.csv")
    keys = "path", "label", "start", "end", "source_group"
    found = [tuple(row[key] for key in keys) for row in rows]
    below = "audio/validation/validation"
    first, short = (f"{below}/Y{i}-_45678901_30.000_35.000.wav" for i in "ag")
    assert (first, "speech", "", "2.4", "youtube_a-_45678901") in found, "listed in two tables"
    assert (first, "objects_activity", "2.6", "5", "youtube_a-_45678901") in found
    assert (short, "speech", "0.1", "1.1", "youtube_g-_45678901") in found, "made a second long"
    assert (short, "other_negative", "2", "4", "youtube_g-_45678901") in found
    public = "audio/eval/public/kbcdefghijk_120_125.wav"
    assert (public, "speech", "", "2.4", "youtube_kbcdefghijk") in found
    assert len(found) == 15
    assert {row["licence"] for row in rows} == {"unstated (sound of YouTube)"}


def test_audio_of_audioset_is_found_however_it_is_named(written, tmp_path):
    rows = rows_of("audioset-strong", written["audioset-strong"], tmp_path / "m.csv")
    assert len({row["path"] for row in rows}) == len({row["source_group"] for row in rows}) == 10
    first = [row for row in rows if row["source_group"] == "youtube_a_-45678901"]
    assert [(row["label"], row["start"], row["end"]) for row in first] == [
        ("speech", "", "2.4"),
        ("coughing", "2.65", "4.9"),  # a short one, made longer, and its neighbour
        ("other_negative", "9", "10"),
    ]


def test_another_part_of_the_same_video_is_other_audio(copied, tmp_path):
    folder = copied("audioset-strong")
    for path in (folder / "audio").rglob("*_30*"):
        path.rename(path.with_name(path.name.replace("_30", "_70")))
    found = {row["path"] for row in rows_of("audioset-strong", folder, tmp_path / "m.csv")}
    ids = ("a_-45678901", "b_-45678901", "i_-45678901")
    assert {Path(path).stem.lstrip("Y") for path in found} == set(ids)


def test_a_folder_of_ones_own_has_sources_by_folder_or_name(written, tmp_path):
    folder = written["folder"]
    rows = rows_of("folder", folder, tmp_path / "m.csv", source="me", licence="CC BY 4.0")
    assert {row["path"]: row["source_group"] for row in rows} == {
        "coughing/anna/a.wav": "me_anna",
        "coughing/ben/a.wav": "me_ben",
        "coughing/ben/b.flac": "me_ben",
        "laughing/anna/c.wav": "me_anna",
        "laughing/party-1.wav": "me_party",
        "laughing/party-2.wav": "me_party",
        "other negative/2021.wav": "me_2021",
        "Toilet flush/new (3).ogg": "me_new",
        "Toilet flush/old_001.wav": "me_old",
        "Toilet flush/old_002.wav": "me_old",
    }
    assert {row["label"] for row in rows if "flush" in row["path"]} == {"flushing_water"}
    assert {(row["source"], row["licence"]) for row in rows} == {("me", "CC BY 4.0")}


def test_a_manifest_has_no_text_that_a_spreadsheet_would_run_and_is_read_as_it_was(tmp_path):
    names = ["=1+1/a.wav", "b/@SUM(A1).wav", "'=c/d.wav", "-2+3.wav"]
    for name in names:
        (tmp_path / "coughing" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "coughing" / name).touch()
    own = {"source": "=cmd|'/c calc'!A1", "licence": "@x"}
    table = tmp_path / "coughing" / "m.csv"
    make_manifest(NAMED["folder"], tmp_path, table, ignore_progress, **own)
    with table.open(newline="") as file:
        fields = [field for row in csv.reader(file) for field in row]
    assert not any(field.startswith(("=", "@", "+", "-")) for field in fields)
    clips = read_manifest(table, LABELS)
    assert {(clip.source, clip.licence) for clip in clips} == {(own["source"], "@x")}
    assert {clip.path for clip in clips} == {tmp_path / "coughing" / name for name in names}


def test_files_of_one_name_are_said_to_count_as_one_recording(tmp_path):
    for label in ("coughing", "speech"):
        (tmp_path / "own" / label).mkdir(parents=True)
    for name in ("coughing/coughing_001", "coughing/coughing_002", "speech/anna", "speech/bert"):
        (tmp_path / "own" / f"{name}.wav").touch()
    done = command("manifest", "folder", tmp_path / "own", "-o", tmp_path / "m.csv")
    assert done.exit_code == 0
    assert "coughing: all files count as one recording" in done.stderr
    assert "speech" not in done.stderr


def test_a_folder_gives_its_sounds_its_name(written, tmp_path, monkeypatch):
    monkeypatch.chdir(written["folder"])
    make_manifest(NAMED["folder"], Path(), tmp_path / "m.csv", ignore_progress)
    clips = read_manifest(tmp_path / "m.csv", LABELS)
    assert {clip.source for clip in clips} == {written["folder"].name}
    assert {clip.licence for clip in clips} == {""}


def test_folders_that_are_called_otherwise_need_a_map(copied, tmp_path):
    folder = copied("folder")
    (folder / "coughing").rename(folder / "dry cough")
    (folder / "laughing").rename(folder / "other")
    assert refusal("folder", folder, tmp_path / "m.csv") == (
        f"{folder}: 'dry cough' or 'other': no label is called so; rename the folder, or give a "
        "--map"
    )
    own = tmp_path / "own.toml"
    own.write_text('skip = ["other"]\n[labels]\ncoughing = ["dry cough"]\n')
    rows = rows_of("folder", folder, tmp_path / "m.csv", map_file=own)
    assert [row["label"] for row in rows].count("coughing") == 3
    assert not [row for row in rows if row["path"].startswith("other/")]
    assert [row["label"] for row in rows].count("flushing_water") == 3, "as without the map"


def test_what_is_no_audio_in_a_folder_is_counted_by_its_name(copied, tmp_path):
    folder = copied("folder")
    (folder / "coughing" / "notes.txt").touch()
    (folder / "coughing" / "._phone.m4a").touch()
    (folder / "coughing" / ".Trash").mkdir()
    (folder / "coughing" / ".Trash" / "old.wav").touch()
    (folder / "manifest.csv").touch()
    before = rows_of("folder", folder, tmp_path / "before.csv")
    (folder / "coughing" / "phone.m4a").touch()
    done = command("manifest", "folder", folder, "-o", tmp_path / "m.csv")
    assert done.exit_code == 0
    assert "left out: 1, not named as audio that can be read: *.txt\n" in done.stdout
    assert "left out: 1, hidden: its name begins with a dot\n" in done.stdout
    after = rows_of("folder", folder, tmp_path / "after.csv")
    assert [row["path"] for row in after if row not in before] == ["coughing/phone.m4a"]


def test_links_that_lead_back_are_followed_once(copied, tmp_path):
    folder = copied("folder")
    (folder / "coughing" / "again").symlink_to(folder)
    assert len(rows_of("folder", folder, tmp_path / "m.csv")) == 10


@pytest.mark.parametrize("name", WRITERS)
def test_the_map_that_is_printed_can_be_used(written, tmp_path, name):
    printed = command("manifest", name, "--print-map")
    (tmp_path / "map.toml").write_text(printed.stdout)
    usual = rows_of(name, written[name], tmp_path / "a.csv")
    assert rows_of(name, written[name], tmp_path / "b.csv", map_file=tmp_path / "map.toml") == usual
    assert name in KEPT or set(read_map(name).label_of.values()) <= LABELS


def test_what_is_left_out_is_counted_by_its_reason(written, tmp_path):
    done = command("manifest", "urbansound8k", written["urbansound8k"], "-o", tmp_path / "m.csv")
    assert "\nlicences: CC BY-NC 3.0 7\nother_negative is: dog_bark 3\n" in done.stdout
    assert "\nleft out: 2, may be one of ours\n" in done.stdout
    assert "\nleft out: 1, in the background of other sounds\n" in done.stdout
    of_ours = (
        "clips that may belong to a class of ours are: children_playing 1, air_conditioner 1\n"
    )
    assert of_ours in done.stdout
    done = command("manifest", "desed", written["desed"], "-o", tmp_path / "d.csv")
    assert "\nleft out: 2, several sounds at once\n" in done.stdout
    assert "\nleft out: 1, nothing in it that the collection has a category for\n" in done.stdout


def test_an_edited_map_changes_labels(written, tmp_path):
    own = tmp_path / "map.toml"
    text = shipped_map("esc50").replace('"footsteps", ', "").replace('crying = ["crying_baby"]', "")
    own.write_text(text + 'baby = ["crying_baby"]\n')
    rows = rows_of("esc50", written["esc50"], tmp_path / "m.csv", map_file=own)
    labels = {row["detail"]: row["label"] for row in rows}
    assert labels["footsteps"] == "other_negative"
    assert labels["crying_baby"] == "baby"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "needs a table [labels]"),
        ("labels = 3", "needs a table [labels]"),
        (
            'negative = ["a"]\n[labels]',
            "unknown key 'negative'; known are broad, keep, labels, skip",
        ),
        ('skip = "a"\n[labels]', "'skip' must be"),
        ('keep = "a"\n[labels]', "'keep' must be true or false"),
        ("[labels]\nspeech = [1]", "'speech' must be"),
        ('[labels]\nspeech = "a"', "'speech' must be"),
        ('[labels]\n"" = ["a"]', "'' must be"),
        ('skip = ["a"]\n[labels]\nspeech = ["a"]', "'a' is in two places"),
        ('[labels]\nspeech = ["a", "a"]', "'a' is in two places"),
        ("[labels", "TOML"),
    ],
)
def test_a_map_that_makes_no_sense_is_refused(written, tmp_path, text, reason):
    own = tmp_path / "own.toml"
    own.write_text(text)
    message = refusal("esc50", written["esc50"], tmp_path / "m.csv", map_file=own)
    assert message.startswith(f"{own}: ")
    assert reason in message


TIMES = made.DESED.replace(",", "\t") + "\n"
MAP = LabelMap({"a": "a", "b": "b", "also a": "a"}, frozenset({"all"}), frozenset({"vague"}))
SOUNDS = st.builds(
    lambda name, start, length: CategorySpan((name,), start / 4, (start + length) / 4),
    st.sampled_from(["a", "b", "also a", "all", "vague", "unnamed"]),
    st.integers(0, 40),
    st.integers(1, 20),
)


@given(sounds=st.lists(SOUNDS, max_size=12))
def test_parts_are_a_second_or_more_of_one_label(sounds):
    parts, left_out = labelled_parts(sounds, 15.0, MAP)
    for part in parts:
        assert 0 <= part.start <= part.end - 1 <= 14
        inside = [one for one in sounds if one.start < part.end and one.end > part.start]
        assert {MAP.decide(one.categories).label for one in inside if one[0] != ("all",)} == {
            part.label
        }
        apart = [one for one in parts if one.label == part.label and one is not part]
        assert all(one.start > part.end or one.end < part.start for one in apart)
    alone = [one for one in sounds if not MAP.decide(one.categories).reason]
    assert len(sounds) - len(alone) <= left_out.total() <= len(sounds) - len(parts)


def test_a_sound_in_the_last_moment_is_extended_towards_the_start():
    (part,), _ = labelled_parts([CategorySpan(("a",), 9.9, 10.0)], 10.0, MAP)
    assert part[2:] == (9.0, 10.0)
    (part,), _ = labelled_parts([CategorySpan(("a",), 0.0, 0.5)], 10.0, MAP)
    assert part[2:] == (0.0, 1.0)
    (part,), _ = labelled_parts([CategorySpan(("a",))], inf, MAP)
    assert part[2:] == (0.0, inf)


def test_paths_are_relative_to_the_manifest_wherever_it_is(written, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    for table in (written["esc50"] / "manifest.csv", tmp_path / "link" / "m.csv"):
        make_manifest(NAMED["esc50"], written["esc50"], table, ignore_progress)
        clips = read_manifest(table, LABELS)
        assert len(clips) == 9
        assert not any(line.startswith("/") for line in table.read_text().splitlines())
    (written["esc50"] / "manifest.csv").unlink()


def test_a_manifest_is_never_overwritten(written, tmp_path):
    table = tmp_path / "m.csv"
    table.write_text("mine")
    done = command("manifest", "esc50", written["esc50"], "-o", table)
    assert done.exit_code != 0
    assert "exists already" in str(done.exception)
    assert table.read_text() == "mine"


def test_files_that_are_not_there_are_left_out_and_told(copied, tmp_path):
    folder = copied("esc50")
    gone = folder / "audio" / "1-19118-A-24.wav"
    gone.unlink()
    (folder / "audio" / "1-100032-A-0.wav").unlink()
    done = command("manifest", "esc50", folder, "-o", tmp_path / "m.csv")
    assert done.exit_code == 3
    assert done.stderr == (
        f"hearthlog: {folder}: 2 of 10 audio files are not there, such as {gone}; left out\n"
    )
    assert len(read_manifest(tmp_path / "m.csv", LABELS)) == 7


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in {"folder", *KEPT}])
def test_a_collection_without_its_audio_is_refused(copied, tmp_path, name):
    folder = copied(name)
    for path in folder.rglob("*"):
        if path.suffix in {".wav", ".flac"}:
            path.unlink()
    message = refusal(name, folder, tmp_path / "m.csv")
    assert message.startswith(f"{folder}: none of its ")
    assert message.endswith("; download them too")


def test_an_empty_folder_is_refused(tmp_path):
    assert refusal("folder", tmp_path, tmp_path / "m.csv") == f"{tmp_path}: lists no audio"
    assert "no such folder" in refusal("esc50", tmp_path / "none", tmp_path / "m.csv")


def test_the_folder_of_another_collection_is_recognised(written, tmp_path):
    message = refusal("esc50", written["urbansound8k"], tmp_path / "m.csv")
    assert message == (
        f"{written['urbansound8k']}: has no meta/esc50.csv, and looks as UrbanSound8K; use "
        "`hearthlog manifest urbansound8k`"
    )


def test_the_folder_around_a_collection_is_recognised(copied, tmp_path):
    folder = copied("esc50")
    message = refusal("esc50", folder.parent, tmp_path / "m.csv")
    assert message == f"{folder.parent}: has no meta/esc50.csv, but {folder} has; give that folder"


def test_another_version_of_a_collection_is_refused(tmp_path):
    (tmp_path / "101 - Dog").mkdir()
    (tmp_path / "101 - Dog" / "1-100032-A.ogg").touch()
    assert refusal("esc50", tmp_path, tmp_path / "m.csv") == (
        f"{tmp_path}: has no meta/esc50.csv, so this is not the folder of ESC-50, or of another "
        "version of it"
    )


@pytest.mark.parametrize(
    ("table", "text", "reason"),
    [
        ("esc50/meta/esc50.csv", "file,class\n", "1: no column filename, category, esc10, src_"),
        ("esc50/meta/esc50.csv", "\udce9", "1: is not UTF-8"),
        ("esc50/meta/esc50.csv", "filename,category,esc10,src_file\na.wav,dog\n", "2: has 2 f"),
        ("esc50/meta/esc50.csv", "", "1: no column"),
        ("urbansound8k/metadata/UrbanSound8K.csv", "a;b\n", "1: no column slice_file_name"),
        ("desed/metadata/eval/public.tsv", f"{TIMES}kbcdefghijk_120_125.wav\tone\t2\tDog\n",
         "2: 'one', '2': a time is not in seconds"),
        ("desed/metadata/eval/public.tsv", f"{TIMES}kbcdefghijk_120_125.wav\t0\tinf\tDog\n",
         "2: '0', 'inf': a time is not in seconds"),
        ("audioset-strong/audioset_eval_strong.tsv",
         "segment_id\tstart_time_seconds\tend_time_seconds\tlabel\nx\t0\t1\t/m/01b_21\n",
         "2: 'x' is no segment of AudioSet"),
    ],
)  # fmt: skip
def test_a_table_of_other_content_is_named_with_its_line(copied, tmp_path, table, text, reason):
    name, _, inner = table.partition("/")
    path = copied(name) / inner
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    message = refusal(name, tmp_path / "copied" / name, tmp_path / "m.csv")
    assert message.startswith(f"{path}:{reason}")


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("fsd50k/FSD50K.metadata/dev_clips_info_FSD50K.json", "{", "is not JSON"),
        ("fsd50k/FSD50K.metadata/dev_clips_info_FSD50K.json", "[" * 100_000, "is not JSON"),
        ("fsd50k/FSD50K.metadata/dev_clips_info_FSD50K.json", "[]", "no object of JSON"),
        ("fsd50k/FSD50K.metadata/eval_clips_info_FSD50K.json", None, "no such file"),
        ("vocalsound/datafiles/all.json", '{"data": 3}', "has no list `data`"),
    ],
)
def test_other_files_of_a_collection_are_checked(copied, tmp_path, file, text, reason):
    name, _, inner = file.partition("/")
    path = copied(name) / inner
    path.unlink() if text is None else path.write_text(text)
    message = refusal(name, tmp_path / "copied" / name, tmp_path / "m.csv")
    assert message.startswith(f"{path}: ")
    assert reason in message


def test_tables_without_times_alone_are_no_desed(copied, tmp_path):
    folder = copied("desed")
    for path in (folder / "metadata").rglob("*.tsv"):
        if path.name != "weak.tsv":
            path.unlink()
    assert "no *.tsv in it has the columns" in refusal("desed", folder, tmp_path / "m.csv")


@pytest.mark.parametrize("name", ["../../secret.wav", "/etc/passwd", "a/../../b.wav", "\0.wav", ""])
def test_names_that_lead_out_of_a_collection_are_refused(copied, tmp_path, name):
    folder = copied("esc50")
    path = folder / "meta" / "esc50.csv"
    path.write_text(f"filename,category,esc10,src_file\n{name},dog,False,1\n")
    message = refusal("esc50", folder, tmp_path / "m.csv")
    assert message == f"{path}:2: {name!r} is no name of a file of the collection"


def test_a_name_too_long_for_any_file_is_one_that_is_not_there(copied, tmp_path):
    folder = copied("esc50")
    with (folder / "meta" / "esc50.csv").open("a") as stream:
        stream.write("a" * 5000 + ".wav,1,0,dog,False,7,A\n")
    done = command("manifest", "esc50", folder, "-o", tmp_path / "m.csv")
    assert done.exit_code == 3
    assert "1 of 11 audio files are not there" in done.stderr


def test_a_table_beyond_reason_is_refused_unread(copied, tmp_path):
    folder = copied("esc50")
    with (folder / "meta" / "esc50.csv").open("wb") as stream:
        stream.truncate(1 << 40)
    assert "larger than 128 MB" in refusal("esc50", folder, tmp_path / "m.csv")


def test_a_manifest_that_could_not_be_read_again_is_not_made(written, tmp_path, monkeypatch):
    monkeypatch.setattr("hearthlog.analyzer.collections.manifest_writer.SIZE_LIMIT", 500)
    message = refusal("esc50", written["esc50"], tmp_path / "m.csv")
    assert message.endswith("which `train` does not read; leave out some of the audio")


def test_a_file_that_is_listed_twice_is_taken_once(copied, tmp_path):
    folder = copied("esc50")
    table = folder / "meta" / "esc50.csv"
    table.write_text(table.read_text() + table.read_text().splitlines()[1] + "\n")
    done = command("manifest", "esc50", folder, "-o", tmp_path / "m.csv")
    assert "left out: 1, listed twice\n" in done.stdout
    assert len(read_manifest(tmp_path / "m.csv", LABELS)) == 9


def test_odd_uploaders_and_names_come_through(copied, tmp_path):
    folder = copied("fsd50k")
    path = folder / "FSD50K.metadata" / "dev_clips_info_FSD50K.json"
    about = json.loads(path.read_text())
    about["101"]["uploader"], about["102"]["uploader"] = 'a,"b"\nc', "\ud800"
    about["103"], about["201"]["license"] = [], ["x"]
    path.write_text(json.dumps(about))
    rows = rows_of("fsd50k", folder, tmp_path / "m.csv")
    groups = [row["source_group"] for row in rows[:3]]
    assert groups == ['freesound_user_a,"b"\nc', "freesound_user_?", "fs103"]
    assert [row["licence"] for row in rows[2:4]] == ["unstated", "unstated"]
    assert len(read_manifest(tmp_path / "m.csv", LABELS)) == 7


def test_names_that_are_not_utf_8_are_left_out(copied, tmp_path):
    folder = copied("folder")
    odd = os.fsdecode(os.fsencode(folder / "laughing") + b"/\xe9.wav")
    shutil.copy(folder / "laughing" / "party-1.wav", odd)
    done = command("manifest", "folder", folder, "-o", tmp_path / "m.csv")
    assert "left out: 1, its name is not UTF-8\n" in done.stdout
    assert len(read_manifest(tmp_path / "m.csv", LABELS)) == 10


def test_broken_audio_is_found_when_it_is_learned_from(copied, tmp_path):
    folder = copied("esc50")
    (folder / "audio" / "1-19111-A-24.wav").write_text("no sound")
    (tmp_path / "own.toml").write_text('[classes]\none = ["coughing"]\ntwo = ["laughing"]\n')
    assert command("manifest", "esc50", folder, "-o", tmp_path / "m.csv").exit_code == 0
    options = "--scenario", tmp_path / "own.toml", "-o", tmp_path / "m.safetensors"
    done = command("train", "--data", tmp_path / "m.csv", *options)
    assert done.exit_code == 3
    assert "left out: 1, cannot be read" in done.stderr
    assert "1-19111-A-24.wav: cannot be read as audio" in done.stderr


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("esc51", "x", "-o", "m.csv"), "choose one of esc50, fsd50k, "),
        (("esc50",), "give the folder of the collection, and --output"),
        (("esc50", "x"), "give the folder of the collection, and --output"),
        (("esc50", "x", "-o", "m.txt"), "a manifest is named *.csv"),
        (("esc50", "x", "-o", "m.csv", "--licence", "CC0"), "are for a folder; ESC-50 has its"),
    ],
)
def test_wrong_use_is_told(words, reason):
    done = command("manifest", *words)
    assert done.exit_code == 2
    assert reason in done.stderr


def test_a_licence_of_several_lines_is_refused(written, tmp_path):
    message = refusal("folder", written["folder"], tmp_path / "m.csv", licence="CC\n0")
    assert message == "'CC\\n0': a licence is one line of at most 300 characters"
