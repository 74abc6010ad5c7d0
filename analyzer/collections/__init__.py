"""Public collections of labelled sound: their table, and a reader of each."""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from hearthlog.analyzer.errors import DataError
from hearthlog.analyzer.logs.text_files import csv_records, read_text
from hearthlog.recorder.sources.audio_files import files_below
from hearthlog.recorder.sources.open_audio import is_audio
from hearthlog.schemas.errors import listed
from hearthlog.schemas.files import read_limited


class CategorySpan(NamedTuple):
    """Category of a file, or of a part of it."""

    categories: tuple[str, ...]
    start: float = 0.0  # in seconds
    end: float = math.inf  # infinite for the end of the file


class CollectionClip(NamedTuple):
    """An audio file of a collection.

    Groups of two collections are the same only if their recordings are: `source_group` is the
    original recording or speaker, with a prefix for the origin of its number.
    """

    path: Path
    sounds: tuple[CategorySpan, ...]
    source_group: str
    licence: str
    seconds: float = math.inf
    left_out: str = ""  # reason for skipping the clip


_TABLE_LIMIT = 128 << 20  # the largest, of AudioSet, has 50 MB
_JSON_LIMIT = 256 << 20


def read_table(
    path: Path, columns: Sequence[str], delimiter: str = ","
) -> Iterator[tuple[str, list[str]]]:
    """Yield some columns of a table with a header line.

    Raise `DataError` if the file cannot be read, is larger than 128 MB, is no such table, lacks one
    of the columns, or has a line that ends before them.
    """
    lines = csv_records(path, read_text(path, "table", _TABLE_LIMIT), delimiter)
    number, header = next(lines, (1, []))
    names = [name.strip() for name in header]
    missing = [name for name in columns if name not in names]
    if missing:
        raise DataError(
            f"{path}:{number}: no column {', '.join(missing)} in the first line; is this another "
            "version of the collection?"
        )
    places = [names.index(name) for name in columns]
    for number, record in lines:
        where = f"{path}:{number}"
        if len(record) <= max(places):
            raise DataError(f"{where}: has {len(record)} fields, the first line names {len(names)}")
        yield where, [record[place].strip() for place in places]


def read_json(path: Path) -> dict[str, object]:
    """Read a JSON object.

    Raise `DataError` if the file cannot be read, is larger than 256 MB, or is no object of
    JSON.
    """
    try:
        content = json.loads(read_limited(path, "file of the collection", _JSON_LIMIT, DataError))
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is not JSON ({str(error)[:100]})") from error
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds no object of JSON")
    return content


def path_inside(where: str, folder: Path, name: str) -> Path:
    """Return the path of a file that a table names.

    Raise `DataError` if the path is outside the folder, or is no valid name.
    """
    pure = PurePosixPath(name)
    if not name or pure.is_absolute() or ".." in pure.parts or "\0" in name:
        raise DataError(f"{where}: {name[:64]!r} is no name of a file of the collection")
    return folder / pure


def audio_by_name(folder: Path) -> dict[str, Path]:
    """Find audio files by name anywhere in a folder."""
    found: dict[str, Path] = {}
    for path in files_below(folder):
        if is_audio(path.name):
            found.setdefault(path.name, path)
    return found


def clips_by_name(
    paths: Iterable[Path],
    pattern: re.Pattern[str],
    group: str,
    licence: str,
    categories: Mapping[str, str] | None = None,
) -> Iterator[CollectionClip]:
    """Yield clips with their source and category, or a text for it, in the file name."""
    for path in paths:
        found = pattern.fullmatch(path.name)
        source, text = found.group("source", "category") if found else ("", "")
        category = categories[text] if categories and found else text
        reason = "" if found else "not named as a clip of the collection"
        sounds = (CategorySpan((category,)),)
        yield CollectionClip(path, sounds, f"{group}_{source}", licence, left_out=reason)


def read_timed_sounds(
    paths: Iterable[Path], columns: Sequence[str], names: Mapping[str, str] | None = None
) -> dict[str, tuple[str, list[CategorySpan]]]:
    """Read tables of timed sounds, separated by tabs: by file name, its first line and its sounds.

    The columns are those of file, start, end and category; a line without a category names a file
    alone. `names` has the names of categories that the tables give as ids. Raise `DataError` as
    `read_table` and `read_seconds` do.
    """
    files: dict[str, tuple[str, list[CategorySpan]]] = {}
    for path in paths:
        for where, (file, start, end, category) in read_table(path, columns, "\t"):
            _, sounds = files.setdefault(file, (where, []))
            if category:
                name = (names or {}).get(category, category)
                sounds.append(CategorySpan((name,), *read_seconds(where, start, end)))
    return files


def read_seconds(where: str, *texts: str) -> list[float]:
    """Read times in seconds.

    Raise `DataError` if one is no number from 0 to 1e9.
    """
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = []
    if len(values) < len(texts) or not all(0 <= value <= 1e9 for value in values):
        shown = ", ".join(repr(text[:32]) for text in texts)
        raise DataError(f"{where}: {shown}: a time is not in seconds")
    return values


def read_esc50(folder: Path) -> Iterator[CollectionClip]:
    """ESC-50: 2,000 clips of five seconds, fifty categories.

    Layout and licence from its repository, https://github.com/karolpiczak/ESC-50, version 2:
    `meta/esc50.csv` with `filename,fold,target,category,esc10,src_file,take`, and `audio/`.
    `src_file` is the number of the recording at Freesound. The clips of the subset ESC-10 are CC
    BY, all others CC BY-NC.

    Raise `DataError` if the table of the collection cannot be read.
    """
    columns = "filename", "category", "esc10", "src_file"
    for where, row in read_table(folder / "meta" / "esc50.csv", columns):
        name, category, esc10, recording = row
        licence = "CC BY 3.0" if esc10 == "True" else "CC BY-NC 3.0"
        path = path_inside(where, folder / "audio", name)
        yield CollectionClip(path, (CategorySpan((category,)),), f"fs{recording}", licence)


_FSD50K_PARTS = "dev", "eval"
_CREATIVE_COMMONS = re.compile(r"https?://creativecommons\.org/licenses/([a-z+-]+)/([\d.]+)/?")
_PUBLIC_DOMAIN = re.compile(r"https?://creativecommons\.org/publicdomain/zero/[\d.]+/?")


def read_fsd50k(folder: Path) -> Iterator[CollectionClip]:
    """FSD50K: 51,197 clips of 0.3 to 30 seconds, 200 categories of AudioSet's ontology.

    Layout and licences from its `FSD50K.doc/README.md`, https://zenodo.org/records/4060432:
    `FSD50K.ground_truth/dev.csv` with `fname,labels,mids,split`, `eval.csv` without `split`; audio
    in `FSD50K.dev_audio` and `FSD50K.eval_audio`, called by its number at Freesound; title,
    uploader and licence of each clip in `FSD50K.metadata/dev_clips_info_FSD50K.json` and
    `eval_clips_…`. Labels are separated by commas and have their parents in the ontology with them.

    Clips of one uploader are one source: people upload takes of one afternoon, and the collection
    itself divides development and evaluation by uploader.

    Raise `DataError` if a table of the collection cannot be read.
    """
    truth = folder / "FSD50K.ground_truth"
    parts = [part for part in _FSD50K_PARTS if (truth / f"{part}.csv").exists()]
    if not parts:
        raise DataError(f"{truth}: holds neither dev.csv nor eval.csv")
    for part in parts:
        about = read_json(folder / "FSD50K.metadata" / f"{part}_clips_info_FSD50K.json")
        audio = folder / f"FSD50K.{part}_audio"
        for where, (number, labels) in read_table(truth / f"{part}.csv", ("fname", "labels")):
            clip = about.get(number)
            stated = clip if isinstance(clip, dict) else {}
            uploader = str(stated.get("uploader") or "").strip()
            yield CollectionClip(
                path_inside(where, audio, f"{number}.wav"),
                (CategorySpan(tuple(labels.split(","))),),
                f"freesound_user_{uploader}" if uploader else f"fs{number}",
                short_licence(str(stated.get("license"))),
            )


def short_licence(address: str) -> str:
    """Return the short name of a Creative Commons licence; `unstated` for others.

    An address is as `http://creativecommons.org/licenses/by/3.0/`.
    """
    if _PUBLIC_DOMAIN.fullmatch(address):
        return "CC0"
    found = _CREATIVE_COMMONS.fullmatch(address)
    if found is None:
        return "unstated"
    kind, version = found.groups()
    return f"CC {'Sampling+' if kind == 'sampling+' else kind.upper()} {version}"


_FOREGROUND = "1"


def read_urbansound8k(folder: Path) -> Iterator[CollectionClip]:
    """UrbanSound8K: 8,732 clips of at most four seconds, ten categories of city sound.

    Layout and licence from its `UrbanSound8K_README.txt`,
    https://urbansounddataset.weebly.com/urbansound8k.html: `metadata/UrbanSound8K.csv` with
    `slice_file_name,fsID,start,end,salience,fold,classID,class`, and `audio/fold1` to
    `audio/fold10`. `fsID` is the number of the recording at Freesound. Salience 2 is a sound in the
    background.

    Raise `DataError` if the table of the collection cannot be read.
    """
    columns = "slice_file_name", "fsID", "salience", "fold", "class"
    for where, row in read_table(folder / "metadata" / "UrbanSound8K.csv", columns):
        name, recording, salience, fold, category = row
        yield CollectionClip(
            path_inside(where, folder / "audio", f"fold{fold}/{name}"),
            (CategorySpan((category,)),),
            f"fs{recording}",
            "CC BY-NC 3.0",
            left_out="" if salience == _FOREGROUND else "in the background of other sounds",
        )


_DESED_COLUMNS = "filename", "onset", "offset", "event_label"
_DESED_NAME = re.compile(r"Y?([\w-]{11})_([\d.]+)_([\d.]+)\.wav", re.ASCII)


def read_desed(folder: Path) -> Iterator[CollectionClip]:
    """DESED: sounds of homes, with times; ten categories.

    Layout from its repository, https://github.com/turpaultn/DESED, and its user
    https://github.com/DCASE-REPO/DESED_task: below `metadata/train`, `metadata/validation` and
    `metadata/eval` lie tables with `filename`, `onset`, `offset`, `event_label`, separated by tabs,
    in which a file without any of the ten has empty fields; tables of other columns are weak labels
    or none. Audio lies below `audio`, called `Y<YouTube id>_<from>_<to>.wav`, in `eval/public`
    without the Y. Several tables have the same files.

    Synthetic soundscapes, without a YouTube id, are mixed from shared sounds, so they
    are not separate sources and are skipped. The other audio is from YouTube,
    without a stated licence.

    Raise `DataError` if a table of the collection cannot be read, or there is none with times.
    """
    files = read_timed_sounds(_desed_tables(folder), _DESED_COLUMNS)
    audio = audio_by_name(folder / "audio")
    for name, (where, sounds) in files.items():
        found = _DESED_NAME.fullmatch(name)
        group, start, end = found.groups() if found else ("", "0", "0")
        path = path_inside(where, folder / "audio", name)
        first, last = read_seconds(where, start, end)
        yield CollectionClip(
            audio.get(path.name, path),
            tuple(dict.fromkeys(sounds)),
            f"youtube_{group}",
            "unstated (sound of YouTube)",
            last - first,
            "" if found else "no YouTube id in its name",
        )


def _desed_tables(folder: Path) -> list[Path]:
    """Return the tables with times."""
    found = []
    for path in files_below(folder / "metadata"):
        if path.suffix == ".tsv":
            head = read_text(path, "table", _TABLE_LIMIT).partition("\n")[0]
            if set(_DESED_COLUMNS) <= {name.strip() for name in head.split("\t")}:
                found.append(path)
    if not found:
        columns = ", ".join(_DESED_COLUMNS)
        raise DataError(f"{folder / 'metadata'}: no *.tsv in it has the columns {columns}")
    return found


_VOCALSOUND_NAME = re.compile(r"(?P<source>[fm]\d+)_\d+_(?P<category>[a-z]+)\.wav")


def read_vocalsound(folder: Path) -> Iterator[CollectionClip]:
    """VocalSound: 21,024 clips of laughter, sighs, coughs, throat clearing, sneezes and sniffs.

    Layout and licence from its repository, https://github.com/YuanGongND/vocalsound:
    `audio_16k`, or `audio_44k` with the same clips, called `f0003_0_cough.wav` for speaker, session
    and category; `datafiles/all.json` lists them as `{"data": [{"wav": "…/f0003_0_cough.wav", …},
    …]}`.

    Raise `DataError` if the list of clips is there and cannot be read.
    """
    audio = folder / "audio_16k"
    if not audio.is_dir():
        audio = folder / "audio_44k"
    listing = folder / "datafiles" / "all.json"
    names = {path.name for path in audio.iterdir() if is_audio(path.name)}
    names.update(_vocalsound_names(listing) if listing.exists() else ())
    paths = (audio / name for name in sorted(names))
    return clips_by_name(paths, _VOCALSOUND_NAME, "vocalsound", "CC BY-SA 4.0")


def _vocalsound_names(path: Path) -> Iterator[str]:
    clips = read_json(path).get("data")
    if not isinstance(clips, list):
        raise DataError(f"{path}: has no list `data`; is this another version of the collection?")
    for clip in clips:
        if isinstance(clip, dict) and isinstance(clip.get("wav"), str):
            yield PurePosixPath(clip["wav"]).name


_AUDIOSET_COLUMNS = "segment_id", "start_time_seconds", "end_time_seconds", "label"
_AUDIOSET_SEGMENT = re.compile(r"([\w-]{11})_(\d{1,12})", re.ASCII)
_AUDIOSET_FILE = re.compile(
    r"Y?([\w-]{11})(?:_(\d{1,12}(?:\.\d+)?)(?:_\d{1,12}(?:\.\d+)?)?)?", re.ASCII
)
_AUDIOSET_SECONDS = 10.0
_AUDIOSET_NAMES_LIMIT = 1 << 20


def read_audioset_strong(folder: Path) -> Iterator[CollectionClip]:
    """AudioSet with times: 456 categories, in ten-second pieces of YouTube's videos.

    Layout from https://research.google.com/audioset/download_strong.html: tables
    `audioset_train_strong.tsv` and `audioset_eval_strong.tsv` with `segment_id`,
    `start_time_seconds`, `end_time_seconds`, `label`, separated by tabs; a segment is `<YouTube
    id>_<from, in milliseconds>`, a label is an id that `mid_to_display_name.tsv` names. The
    collection has no audio. Common file names are `<YouTube id>.wav`, or with times after it, in
    seconds or milliseconds, with or without a leading Y, in any format: all of these are found,
    anywhere in the folder. The audio is from YouTube, without a stated licence.

    Raise `DataError` if a table of the collection cannot be read, or there is none with times.
    """
    listing = folder / "mid_to_display_name.tsv"
    rows = csv_records(listing, read_text(listing, "table", _AUDIOSET_NAMES_LIMIT), "\t")
    names = {row[0].strip(): row[1].strip() for _, row in rows if len(row) > 1}
    tables = sorted(folder.glob("*_strong.tsv"))
    if not tables:
        raise DataError(f"{folder}: no audioset_train_strong.tsv or audioset_eval_strong.tsv in it")
    files = read_timed_sounds(tables, _AUDIOSET_COLUMNS, names)
    audio = _audioset_audio(folder)
    for segment, (where, sounds) in files.items():
        found = _AUDIOSET_SEGMENT.fullmatch(segment)
        if found is None:
            raise DataError(f"{where}: {segment[:64]!r} is no segment of AudioSet")
        video, start = found.groups()
        first = float(start)
        paths = (audio.get((video, time)) for time in (first, first / 1000, None))
        yield CollectionClip(
            next(filter(None, paths), path_inside(where, folder, segment)),
            tuple(sounds),
            f"youtube_{video}",
            "unstated (sound of YouTube)",
            _AUDIOSET_SECONDS,
        )


def _audioset_audio(folder: Path) -> dict[tuple[str, float | None], Path]:
    """Find audio by video id and time in the file name."""
    audio: dict[tuple[str, float | None], Path] = {}
    for path in files_below(folder):
        found = _AUDIOSET_FILE.fullmatch(path.stem) if is_audio(path.name) else None
        if found is not None:
            video, start = found.groups()
            audio.setdefault((video, None if start is None else float(start)), path)
    return audio


_RAVDESS_NAME = re.compile(r"03-0[12]-(?P<category>0[1-8])-0[12]-0[12]-0[12]-(?P<source>\d\d)\.wav")
_EMOTIONS = "neutral", "calm", "happy", "sad", "angry", "fearful", "disgust", "surprised"
_RAVDESS_EMOTIONS = {f"{number:02}": name for number, name in enumerate(_EMOTIONS, 1)}


def read_ravdess(folder: Path) -> Iterator[CollectionClip]:
    """RAVDESS: 1,440 spoken and 1,012 sung sentences of 24 actors, each in up to eight emotions.

    Layout and licence from its record, https://zenodo.org/records/1188976: folders `Actor_01` to
    `Actor_24`, wherever they are, with files called `03-01-05-01-02-01-12.wav` for modality,
    channel, emotion, intensity, statement, repetition and actor.

    The category is the emotion.
    """
    paths = (path for path in files_below(folder) if is_audio(path.name))
    return clips_by_name(paths, _RAVDESS_NAME, "ravdess", "CC BY-NC-SA 4.0", _RAVDESS_EMOTIONS)


_EMODB_NAME = re.compile(r"(?P<source>\d\d)[ab]\d\d(?P<category>[WLEAFTN])[a-z]?\.wav")
_EMODB_EMOTIONS = {
    "W": "anger",
    "L": "boredom",
    "E": "disgust",
    "A": "anxiety",
    "F": "happiness",
    "T": "sadness",
    "N": "neutral",
}


def read_emodb(folder: Path) -> Iterator[CollectionClip]:
    """EmoDB, the Berlin database of emotional speech: 535 sentences of ten actors, seven emotions.

    Layout from its page, http://emodb.bilderbar.info/docu: `wav` with files named `03a01Fa.wav`
    for the actor, the text, the letter of the emotion in German, and the version. Its page states
    no licence.

    The category is the emotion.
    """
    paths = sorted(path for path in (folder / "wav").iterdir() if is_audio(path.name))
    return clips_by_name(paths, _EMODB_NAME, "emodb", "unstated", _EMODB_EMOTIONS)


_VOXCELEB_PERSON = re.compile(r"id\d{5}")
_VOXCELEB_VIDEO = re.compile(r"[\w-]{11}", re.ASCII)
_VOXCELEB_PLACE = 3  # index of the person in a path, from the end


def read_voxceleb(folder: Path) -> Iterator[CollectionClip]:
    """VoxCeleb 1 and 2: speech of 1,251 and of 6,112 people in videos.

    Layout from its page, https://www.robots.ox.ac.uk/~vgg/data/voxceleb: `wav` (of VoxCeleb 2
    `aac`) with files called `id10001/1zcIwhmdeo4/00001.wav` for the person, the video at YouTube,
    and the piece. The page states no licence for the sound; the lists are CC BY 4.0.

    The category is the person, the source the video.
    """
    for name in ("wav", "aac"):
        for path in files_below(folder / name):
            person, video = path.parts[-_VOXCELEB_PLACE:-1]
            is_clip = _VOXCELEB_PERSON.fullmatch(person) and _VOXCELEB_VIDEO.fullmatch(video)
            reason = "" if is_clip else "not placed as a clip of the collection"
            if not is_audio(path.name):
                reason = _no_audio(path)
            yield CollectionClip(
                path,
                (CategorySpan((person,)),),
                f"youtube_{video}",
                "unstated (sound of YouTube)",
                left_out=reason,
            )


_TAKE = re.compile(r"(?:[ _.-]\d{1,3}| ?\(\d{1,3}\))$")


def read_folder(folder: Path) -> Iterator[CollectionClip]:
    """Your own folder: a sub-folder for each label, with audio files in any format.

    Within a sub-folder, a further folder is one source: `coughing/anna/a.wav` and
    `speech/anna/b.wav` have source `anna`. The source of a file outside such a folder is its name
    without a trailing take number: `kettle_001.wav`, `kettle-2.wav` and `kettle (3).wav` have
    source `kettle`.

    The name of each sub-folder is the category.
    """
    for path in files_below(folder):
        inner = path.relative_to(folder).parts
        if len(inner) > 1:
            source = inner[1] if len(inner) > 2 else _TAKE.sub("", path.stem) or path.stem
            reason = ""
            if not is_audio(path.name):
                is_hidden = path.name.startswith(".")
                reason = "hidden: its name begins with a dot" if is_hidden else _no_audio(path)
            yield CollectionClip(path, (CategorySpan((inner[0],)),), source, "", left_out=reason)


def _no_audio(path: Path) -> str:
    return f"not named as audio that can be read: *{path.suffix}"


class CollectionFormat(NamedTuple):
    """A collection; every folder of it has at least one of the markers, if there are any."""

    name: str
    title: str
    markers: tuple[str, ...]  # files, folders or patterns; empty for any folder
    read: Callable[[Path], Iterator[CollectionClip]]


FOLDER = CollectionFormat("folder", "", (), read_folder)
COLLECTIONS = (
    CollectionFormat("esc50", "ESC-50", ("meta/esc50.csv",), read_esc50),
    CollectionFormat("fsd50k", "FSD50K", ("FSD50K.ground_truth",), read_fsd50k),
    CollectionFormat(
        "urbansound8k", "UrbanSound8K", ("metadata/UrbanSound8K.csv",), read_urbansound8k
    ),
    CollectionFormat(
        "desed", "DESED", ("metadata/validation", "metadata/eval", "metadata/train"), read_desed
    ),
    CollectionFormat("vocalsound", "VocalSound", ("audio_16k", "audio_44k"), read_vocalsound),
    CollectionFormat(
        "audioset-strong", "AudioSet", ("mid_to_display_name.tsv",), read_audioset_strong
    ),
    CollectionFormat("ravdess", "RAVDESS", ("Actor_??", "*/Actor_??"), read_ravdess),
    CollectionFormat("emodb", "EmoDB", ("wav/??[ab]??[WLEAFTN]*.wav",), read_emodb),
    CollectionFormat("voxceleb", "VoxCeleb", ("wav/id?????", "aac/id?????"), read_voxceleb),
    FOLDER,
)
NAMES = tuple(collection.name for collection in COLLECTIONS)


def find_collection(name: str) -> CollectionFormat | None:
    """Return a collection by name; None if there is none."""
    return next((each for each in COLLECTIONS if each.name == name), None)


def check_folder(folder: Path, collection: CollectionFormat) -> None:
    """Check that a folder has the layout of a collection.

    Raise `DataError` if the folder is missing, or has the layout of another collection or version.
    """
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    if not collection.markers or _is_of(folder, collection):
        return
    wanted = listed(collection.markers)
    for inner in sorted(folder.iterdir()):
        if inner.is_dir() and _is_of(inner, collection):
            raise DataError(f"{folder}: has no {wanted}, but {inner} has; give that folder")
    others = [each for each in COLLECTIONS if each.markers and _is_of(folder, each)]
    if others:
        raise DataError(
            f"{folder}: has no {wanted}, and looks as {others[0].title}; use `hearthlog manifest "
            f"{others[0].name}`"
        )
    raise DataError(
        f"{folder}: has no {wanted}, so this is not the folder of {collection.title}, or of "
        "another version of it"
    )


def _is_of(folder: Path, collection: CollectionFormat) -> bool:
    return any(True for marker in collection.markers for _ in folder.glob(marker))
