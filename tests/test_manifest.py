from math import inf

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.training.manifest import (
    BUILTIN,
    LABELS,
    left_out_lines,
    load_scenario,
    read_manifest,
)

pytestmark = pytest.mark.fast

HEADER = "path,label,source_group,source,licence\n"


def manifest(folder, text, audio=("a.wav", "b.wav")):
    for name in audio:
        (folder / name).touch()
    path = folder / "manifest.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path, labels=LABELS):
    with pytest.raises(DataError) as caught:
        read_manifest(path, labels)
    return str(caught.value)


def test_clips_are_read_with_paths_beside_the_manifest(tmp_path):
    path = manifest(tmp_path, HEADER + "a.wav,speech,anna,home,CC0\nb.wav,shower,bath,,\n")
    first, second = read_manifest(path, LABELS)
    assert first.path == tmp_path / "a.wav"
    assert (first.label, first.source_group) == ("speech", "anna")
    assert (first.source, first.licence) == ("home", "CC0")
    assert (second.source, second.licence) == ("", "")


def test_the_names_that_audioset_has_for_our_labels_are_labels(tmp_path):
    rows = 'a.wav,"Crying, sobbing",anna\nb.wav,water_tap_faucet,bath\n'
    path = manifest(tmp_path, "path,label,source_group\n" + rows)
    clips = read_manifest(path, LABELS)
    assert [clip.label for clip in clips] == ["Crying, sobbing", "water_tap_faucet"], "as they are"
    assert [BUILTIN["bathroom"].find(clip.label) for clip in clips] == ["other", "tap_water"]
    assert [BUILTIN["general"].find(clip.label) for clip in clips] == ["crying", None]
    assert "'water_tap_faucet'" in refusal(path, ["crying", "speech"])


def test_a_label_may_be_about_parts_of_a_file(tmp_path):
    header = "path,label,source_group,start,end\n"
    rows = "a.wav,speech,anna,1.5,3\na.wav,music,anna,4,\na.wav,speech,anna,,1.5\n"
    clips = read_manifest(manifest(tmp_path, header + rows), LABELS)
    assert [(clip.start, clip.end) for clip in clips] == [(1.5, 3.0), (4.0, inf), (0.0, 1.5)]
    again = manifest(tmp_path, header + "a.wav,speech,anna,1,2\na.wav,music,anna,1.0,2.0\n")
    assert refusal(again) == f"{again}:3: 'a.wav' is listed in line 2 too"


@pytest.mark.parametrize("span", ["2,1", "1,1", "-1,1", "nan,1", "0,nan", "inf,", "1 s,2", "1,2e"])
def test_what_is_no_part_of_a_file_is_named_with_its_line(tmp_path, span):
    path = manifest(tmp_path, f"path,label,source_group,start,end\na.wav,speech,anna,{span}\n")
    assert refusal(path).startswith(f"{path}:2: start '")
    assert refusal(path).endswith("are no part of a file; give seconds, the start before the end")


def test_columns_may_be_in_any_order_and_others_are_ignored(tmp_path):
    path = manifest(tmp_path, "\ufeffsource_group,note,label,path\nanna,x,speech,a.wav\n")
    (clip,) = read_manifest(path, LABELS)
    assert (clip.path.name, clip.label, clip.source_group) == ("a.wav", "speech", "anna")


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", None, "empty"),
        ("\n\n", None, "empty"),
        (HEADER, None, "no clips"),
        ("path,label\na.wav,speech\n", 1, "no column source_group"),
        (HEADER + "a.wav,speech,anna,,\n\nnowhere.wav,speech,anna,,\n", 4, "no such file"),
        (HEADER + 'a.wav,speech,"anna\nmaria",,\nb.wav,spech,anna,,\n', 4, "'spech'"),
        (HEADER + "a.wav,speech\n", 2, "2 fields"),
        (HEADER + "a.wav,speech,,,\n", 2, "source_group is empty"),
        (HEADER + "a.wav,speech,anna,,\na.wav,music,anna,,\n", 3, "line 2"),
        (HEADER + 'a.wav,speech,"anna,,\n', 2, "not CSV"),
        (HEADER + "a" * 200_000 + ",speech,anna,,\n", 2, "not CSV"),
        (HEADER + "a.wav,speech,anna,,\n\0.wav,speech,anna,,\n", 3, "no such file"),
        (HEADER + "a" * 5000 + ",speech,anna,,\n", 2, "no such file"),
        (HEADER + "/dev/zero,speech,anna,,\n", 2, "no such file"),
        (HEADER + "a.wav,speech,anna,x," + "y" * 301 + "\n", 2, "licence"),
        (HEADER.encode() + b"a.wav,speech,ann\xe9,,\n", 2, "UTF-8"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, text, line, reason):
    path = manifest(tmp_path, text)
    message = refusal(path)
    assert message.startswith(f"{path}: " if line is None else f"{path}:{line}: ")
    assert reason in message
    assert message.isprintable()


def test_lines_of_no_use_can_be_left_out_and_the_others_are_read(tmp_path):
    header = "path,label,source_group,start,end\n"
    rows = [
        *("a.wav,speech,anna,,", "b.wav,spech,anna,,", "none.wav,speech,anna,,"),
        *("b.wav,speech,anna,3,1", "a.wav,speech,anna,0,", "b.wav,speech", "b.wav,,anna,,"),
        *("c.wav,spech,anna,,", "b.wav,speech,anna,,"),
    ]
    path = manifest(tmp_path, header + "\n".join(rows))
    left_out = []
    clips = read_manifest(path, LABELS, left_out)
    assert [clip.path.name for clip in clips] == ["a.wav", "b.wav"]
    lines = left_out_lines(left_out)
    assert lines[0] == (
        f"left out: 2, a label that the scenario does not know: {path}:3: 'spech'; {path}:9: "
        "'spech'"
    )
    assert [line.split(": ")[1] for line in lines] == [
        "2, a label that the scenario does not know",
        *("1, no such file", "1, no part of a file", "1, listed twice"),
        *("1, a line that is not complete", "1, no label"),
    ]
    path.write_text(header + "none.wav,speech,anna,,\n")
    with pytest.raises(DataError, match=r"lists no clip that can be used.*none\.wav"):
        read_manifest(path, LABELS, [])


def test_a_missing_manifest_is_named(tmp_path):
    assert "no such manifest" in refusal(tmp_path / "manifest.csv")


def test_a_manifest_beyond_reason_is_refused_unread(tmp_path):
    path = tmp_path / "manifest.csv"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    assert "larger than 64 MB" in refusal(path)


@pytest.mark.parametrize("end", ["\n", "\r"])
def test_a_manifest_of_blank_lines_is_refused_by_their_number(tmp_path, end):
    path = manifest(tmp_path, HEADER + end * 3_000_000)
    assert refusal(path).startswith(f"{path}: has 3,000,00")
    assert refusal(path).endswith(" lines; at most 1,000,000 are read")


def test_a_manifest_with_many_blank_lines_is_read(tmp_path):
    path = manifest(tmp_path, HEADER + "\n" * 100_000 + "a.wav,speech,anna,,\n")
    assert len(read_manifest(path, LABELS)) == 1


@pytest.mark.parametrize("field", ["aa,", '"aa\n",'], ids=["in a line", "over lines"])
def test_a_record_of_any_number_of_fields_is_not_held(tmp_path, field):
    path = manifest(tmp_path, HEADER + field * 400_000)
    assert refusal(path) == f"{path}:2: is not CSV (a record is longer than 1 MB)"


@settings(deadline=None)
@given(raw=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path_factory, raw):
    path = manifest(tmp_path_factory.mktemp("any"), HEADER.encode() + raw)
    assert refusal(path).isprintable()


def test_bathroom_is_water_silence_and_other_activities():
    bathroom = BUILTIN["bathroom"]
    assert list(bathroom.classes) == ["silence", "flushing_water", "shower", "tap_water", "other"]
    assert bathroom.class_of["coughing"] == "other"
    assert "other_negative" in bathroom.labels
    assert "other_negative" not in bathroom.class_of


def test_general_is_the_nine_classes_of_the_paper():
    assert list(BUILTIN["general"].classes) == [
        *("silence", "speech", "music", "phone_ring", "coughing"),
        *("crying", "yelling", "laughing", "objects_activity"),
    ]


def test_a_scenario_of_ones_own_may_bring_and_ignore_labels(tmp_path):
    path = tmp_path / "pets.toml"
    path.write_text('ignore = ["rain"]\n[classes]\ndog = ["bark", "howl"]\nquiet = ["silence"]\n')
    scenario = load_scenario(str(path))
    assert scenario.name == "pets"
    assert scenario.class_of == {"bark": "dog", "howl": "dog", "silence": "quiet"}
    assert {"rain", "bark", "speech"} <= scenario.labels
    assert "cat" not in scenario.labels


def scenario_of(folder, text):
    path = folder / "own.toml"
    path.write_text(text)
    return load_scenario(str(path))


def test_a_label_that_a_scenario_names_is_taken_literally_first(tmp_path):
    own = scenario_of(
        tmp_path,
        'ignore = ["laughter"]\n[classes]\nloud = ["shout"]\nangry = ["yell"]\n'
        'cough = ["wet"]\nother = ["coughing", "laughing"]\n',
    )
    labels = ["shout", "yell", "Yell", "yelling", "laughter", "laughing", "cough", "wet"]
    assert {label: own.find(label) for label in labels} == {
        "shout": "loud",
        "yell": "angry",
        "Yell": "angry",
        "yelling": None,  # it may be either
        "laughter": None,
        "laughing": "other",
        "cough": "other",
        "wet": "cough",
    }
    assert own.find("cough", marked=True) == "cough", "a reviewer names classes"
    assert own.find("laughter", marked=True) is None


def test_a_scenario_of_other_names_understands_ours(tmp_path):
    own = scenario_of(
        tmp_path, '[classes]\ncry = ["crying_sobbing"]\nloud = ["shout", "yell", "bark"]\n'
    )
    assert own.find("crying") == own.find("Crying and sobbing") == "cry"
    assert own.find("yelling") == "loud", "all names of it are in one class"
    assert own.find("bark") == "loud"
    assert own.find("Bark") is None, "nobody knows that this is the same"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "[classes]"),
        ("classes = 3", "[classes]"),
        ('[classes]\ndog = ["bark"]', "[classes]"),
        ('[classes]\ndog = ["bark"]\ncat = ["bark"]', "'bark'"),
        ('ignore = ["bark"]\n[classes]\ndog = ["bark"]\ncat = ["mew"]', "'bark'"),
        ('[classes]\n"../dog" = ["bark"]\ncat = ["mew"]', "class name"),
        ('[classes]\ndog = []\ncat = ["mew"]', "dog"),
        ('[classes]\ndog = "bark"\ncat = ["mew"]', "dog"),
        ('[classes]\ndog = [1]\ncat = ["mew"]', "dog"),
        ('labels = 1\n[classes]\ndog = ["bark"]\ncat = ["mew"]', "'labels'"),
        ("[classes", "TOML"),
        (b"\xff\xfe", "TOML"),
        ("a = " + "[" * 100_000, "TOML"),
    ],
)
def test_a_scenario_that_makes_no_sense_is_refused(tmp_path, text, reason):
    path = tmp_path / "home.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError) as caught:
        load_scenario(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert reason in str(caught.value)


@pytest.mark.parametrize("name", ["kitchen", "nowhere.toml"])
def test_a_scenario_that_does_not_exist_is_named(name):
    with pytest.raises(DataError, match=name):
        load_scenario(name)
