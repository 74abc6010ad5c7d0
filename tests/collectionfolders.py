"""Small folders in the layouts of public collections, with synthetic sound in them."""

import csv
import json

import numpy as np
import soundfile

from hearthlog.tools.home.sounds import synthesize

RATE = 16_000


def write_sound(path, *labels, seconds=2.5):
    """Write sounds of labels, one behind the other; no two files are the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = sum(path.name.encode())
    sound = np.concatenate([synthesize(label, seconds, seed + i) for i, label in enumerate(labels)])
    soundfile.write(path, sound, RATE)


def write_table(path, columns, rows, delimiter=","):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, delimiter=delimiter, lineterminator="\n")
        writer.writerows([columns.split(","), *rows])


def write_esc50(folder):
    """Five coughs and laughs of three recordings each, a baby, a dog, and steps."""
    rows = [
        ("1-19111-A-24.wav", 1, 24, "coughing", "False", 19111, "A"),
        ("1-19118-A-24.wav", 1, 24, "coughing", "False", 19118, "A"),
        ("1-19118-B-24.wav", 1, 24, "coughing", "False", 19118, "B"),
        ("2-30830-A-24.wav", 2, 24, "coughing", "False", 30830, "A"),
        ("1-30039-A-26.wav", 1, 26, "laughing", "False", 30039, "A"),
        ("1-30043-A-26.wav", 1, 26, "laughing", "False", 30043, "A"),
        ("3-33658-A-26.wav", 3, 26, "laughing", "False", 33658, "A"),
        ("1-187207-A-20.wav", 1, 20, "crying_baby", "True", 187207, "A"),
        ("1-100032-A-0.wav", 1, 0, "dog", "True", 100032, "A"),
        ("1-155858-A-25.wav", 1, 25, "footsteps", "False", 155858, "A"),
    ]
    sounds = {"crying_baby": "crying", "dog": "objects_activity", "footsteps": "objects_activity"}
    columns = "filename,fold,target,category,esc10,src_file,take"
    write_table(folder / "meta" / "esc50.csv", columns, rows)
    for name, _, _, category, *_ in rows:
        write_sound(folder / "audio" / name, sounds.get(category, category))
    return folder


def write_urbansound8k(folder):
    """Six pieces of street music and dogs, three recordings each, and what is left out."""
    rows = [
        ("101-9-0-0.wav", 101, 0.0, 2.5, 1, 1, 9, "street_music"),
        ("101-9-0-1.wav", 101, 0.5, 3.0, 1, 1, 9, "street_music"),
        ("102-9-0-0.wav", 102, 0.0, 2.5, 1, 2, 9, "street_music"),
        ("103-9-0-0.wav", 103, 0.0, 2.5, 1, 10, 9, "street_music"),
        ("201-3-0-0.wav", 201, 7.0, 9.5, 1, 1, 3, "dog_bark"),
        ("202-3-0-0.wav", 202, 0.0, 2.5, 1, 3, 3, "dog_bark"),
        ("203-3-0-0.wav", 203, 0.0, 2.5, 1, 10, 3, "dog_bark"),
        ("204-3-0-0.wav", 204, 0.0, 2.5, 2, 10, 3, "dog_bark"),
        ("301-2-0-0.wav", 301, 0.0, 2.5, 1, 4, 2, "children_playing"),
        ("302-0-0-0.wav", 302, 0.0, 2.5, 1, 5, 0, "air_conditioner"),
    ]
    columns = "slice_file_name,fsID,start,end,salience,fold,classID,class"
    write_table(folder / "metadata" / "UrbanSound8K.csv", columns, rows)
    for name, *_, fold, _, category in rows:
        sound = "music" if category == "street_music" else "objects_activity"
        write_sound(folder / "audio" / f"fold{fold}" / name, sound)
    return folder


BY, ZERO, NC = (
    f"http://creativecommons.org/{kind}/"
    for kind in ("licenses/by/3.0", "publicdomain/zero/1.0", "licenses/by-nc/4.0")
)
VOICE = "Human_voice"


def write_fsd50k(folder):
    """Ten clips with parents of their labels, of five uploaders and three licences."""
    dev = [
        (101, "Cough,Respiratory_sounds", "/m/01b_21,/m/09hlz4", "train", "anna", BY, "coughing"),
        (102, "Cough,Respiratory_sounds", "/m/01b_21,/m/09hlz4", "train", "anna", ZERO, "coughing"),
        (103, "Cough,Respiratory_sounds", "/m/01b_21,/m/09hlz4", "val", "ben", NC, "coughing"),
        (201, f"Giggle,Laughter,{VOICE}", "/m/07r660_", "train", "anna", BY, "laughing"),
        (202, f"Laughter,{VOICE}", "/m/01j3sz,/m/09l8g", "val", "cleo", ZERO, "laughing"),
        (301, f"Laughter,Speech,{VOICE}", "/m/01j3sz", "train", "cleo", ZERO, "laughing"),
        (302, "Domestic_sounds_and_home_sounds", "/t/dd00071", "train", "ben", ZERO, "speech"),
        (303, f"Whispering,{VOICE}", "/m/02rtxlg,/m/09l8g", "train", "ben", ZERO, "speech"),
    ]
    evaluated = [
        (401, "Bark,Dog,Domestic_animals_and_pets,Animal", "/m/05tny_", "dora", BY, "music"),
        (402, "Cough,Respiratory_sounds", "/m/01b_21,/m/09hlz4", "emil", "by hand", "coughing"),
    ]
    truth, about = folder / "FSD50K.ground_truth", folder / "FSD50K.metadata"
    write_table(truth / "dev.csv", "fname,labels,mids,split", [row[:4] for row in dev])
    write_table(truth / "eval.csv", "fname,labels,mids", [row[:3] for row in evaluated])
    about.mkdir(parents=True)
    for part, rows in (("dev", dev), ("eval", evaluated)):
        clips = {}
        for number, *_, uploader, licence, sound in rows:
            clips[str(number)] = {
                "title": f"{sound}.wav",
                "description": "",
                "tags": [sound],
                "license": licence,
                "uploader": uploader,
            }
            write_sound(folder / f"FSD50K.{part}_audio" / f"{number}.wav", sound)
        (about / f"{part}_clips_info_FSD50K.json").write_text(json.dumps(clips, indent=4))
    return folder


def write_vocalsound(folder):
    """Ten clips of five speakers."""
    sounds = {"cough": "coughing", "laughter": "laughing", "sneeze": "yelling", "sigh": "speech"}
    names = [f"{who}_0_{what}" for who in ("f0003", "m0004", "f0011") for what in list(sounds)[:3]]
    names.append("m0098_1_sigh")
    clips = []
    for name in names:
        write_sound(folder / "audio_16k" / f"{name}.wav", sounds[name.rpartition("_")[2]])
        clips.append({"wav": f"/data/vs_processed/data_16k/{name}.wav", "labels": "/m/01b_21"})
    (folder / "datafiles").mkdir()
    (folder / "datafiles" / "all.json").write_text(json.dumps({"data": clips}, indent=1))
    return folder


DESED = "filename,onset,offset,event_label"


def write_desed(folder):
    """Ten files of real homes: speech and dishes behind each other, and what is left out."""
    ids = [f"Y{'abcdefghij'[i]}-_45678901_30.000_35.000.wav" for i in range(9)]
    rows = []
    for i, name in enumerate(ids[:6]):
        write_sound(folder / "audio" / "validation" / "validation" / name, "speech", "music")
        rows.append((name, "0.000", "2.400", "Speech"))
        rows.append((name, "2.600", "5.000", "Dishes" if i % 2 else "Frying"))
    for name in ids[6:]:
        write_sound(folder / "audio" / "validation" / "validation" / name, "speech", "music")
    rows += [
        (ids[6], "0.500", "0.700", "Speech"),  # shorter than a second
        (ids[6], "2.000", "4.000", "Dog"),
        (ids[7], "0.000", "3.000", "Speech"),  # both at once
        (ids[7], "2.000", "4.000", "Dishes"),
        (ids[7], "4.200", "5.000", "Running_water"),
        (ids[8], "", "", ""),
    ]
    meta = folder / "metadata"
    write_table(meta / "validation" / "validation.tsv", DESED, rows, "\t")
    write_table(meta / "validation" / "test_dcase2018.tsv", DESED, rows[:5], "\t")
    public = "kbcdefghijk_120_125.wav"
    write_table(meta / "eval" / "public.tsv", DESED, [(public, "0.000", "2.400", "Speech")], "\t")
    write_sound(folder / "audio" / "eval" / "public" / public, "speech", "music")
    weak = [(ids[0], "Speech,Dishes")]
    write_table(meta / "train" / "weak.tsv", "filename,event_labels", weak, "\t")
    mixed = [("0.wav", "0.000", "2.000", "Speech")]
    write_table(meta / "train" / "synthetic21_train" / "soundscapes.tsv", DESED, mixed, "\t")
    write_sound(folder / "audio" / "train" / "synthetic21_train" / "0.wav", "speech")
    return folder


def write_audioset_strong(folder):
    """Ten pieces of videos, whose audio is named in the ways that people have."""
    names = {
        "/m/09x0r": "Speech",
        "/m/01b_21": "Cough",
        "/m/093_4n": "Background noise",
        "/m/0bt9lr": "Dog",
        "/m/07qcpgn": "Tap",
    }
    mids = {name: mid for mid, name in names.items()}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mid_to_display_name.tsv").write_text(
        "".join(f"{mid}\t{name}\n" for mid, name in names.items())
    )
    ids = [f"{'abcdefghij'[i]}_-45678901" for i in range(10)]
    audio = [
        *(f"{ids[0]}.wav", f"Y{ids[1]}.wav", f"{ids[2]}_30000.flac", f"{ids[3]}_30.wav"),
        *(f"Y{ids[4]}_30.000_40.000.wav", f"{ids[5]}_30_40.flac"),
        *(f"train/{ids[6]}_30000.wav", f"train/{ids[7]}_30000.wav", f"eval/{ids[8]}.wav"),
        f"eval/{ids[9]}_30000.wav",
    ]
    for name in audio:
        write_sound(folder / "audio" / name, "speech", "coughing", "coughing", "speech")
    rows = []
    for video in ids:
        rows += [
            (f"{video}_30000", "0.000", "10.000", mids["Background noise"]),
            (f"{video}_30000", "0.000", "2.400", mids["Speech"]),
            (f"{video}_30000", "3.000", "3.300", mids["Cough"]),
            (f"{video}_30000", "3.500", "4.900", mids["Cough"]),
            (f"{video}_30000", "5.500", "6.500", mids["Cough"]),
            (f"{video}_30000", "6.400", "6.600", mids["Tap"]),
            (f"{video}_30000", "9.700", "10.000", mids["Dog"]),
        ]
    columns = "segment_id,start_time_seconds,end_time_seconds,label"
    for part, lines in (("train", rows[:42]), ("eval", rows[42:])):
        write_table(folder / f"audioset_{part}_strong.tsv", columns, lines, "\t")
    framed = [(f"{ids[0]}_30000", "0.960", "1.920", mids["Speech"], "NOT_PRESENT")]
    path = folder / "audioset_eval_strong_framed_posneg.tsv"
    write_table(path, f"{columns},present", framed, "\t")
    return folder


def write_own(folder):
    """Ten files that somebody recorded."""
    for name in (
        *("coughing/anna/a.wav", "coughing/ben/a.wav", "coughing/ben/b.flac"),
        *("Toilet flush/old_001.wav", "Toilet flush/old_002.wav", "Toilet flush/new (3).ogg"),
        *("laughing/party-1.wav", "laughing/party-2.wav", "laughing/anna/c.wav"),
        "other negative/2021.wav",
    ):
        label = name.partition("/")[0]
        sound = {"Toilet flush": "flushing_water", "other negative": "yelling"}.get(label, label)
        write_sound(folder / name, sound)
    return folder


def write_ravdess(folder):
    """Nine clips of three actors, and one that is called otherwise."""
    for actor in (1, 2, 12):
        for emotion, sound in ((5, "yelling"), (4, "crying"), (2, "speech")):
            name = f"03-01-{emotion:02d}-01-02-01-{actor:02d}.wav"
            write_sound(folder / f"Actor_{actor:02d}" / name, sound)
    write_sound(folder / "Actor_01" / "copy of 03-01-05.wav", "speech")
    return folder


def write_emodb(folder):
    """Nine clips of three actors, and one of an emotion that there is not."""
    for actor in ("03", "08", "16"):
        for letter, sound in (("W", "yelling"), ("T", "crying"), ("N", "speech")):
            write_sound(folder / "wav" / f"{actor}a01{letter}a.wav", sound)
    write_sound(folder / "wav" / "03a01Xa.wav", "speech")
    return folder


def write_voxceleb(folder):
    """Ten clips of two people, each in five videos."""
    for person, sound in (("id10001", "speech"), ("id10270", "yelling")):
        for number in range(5):
            video = f"{'abcde'[number]}{person[2:]}-_678"
            write_sound(folder / "wav" / person / video / "00001.wav", sound)
    return folder
