"""Label files as other programs, and the people who use them, write them.

All speak of one minute: coughing from 1.5 to 2.5 s, the water tap from 4 to 6 s, and more in some.
"""

import json
from typing import NamedTuple


class ForeignFile(NamedTuple):
    """A label file, and what has to become of it."""

    program: str
    what: str
    name: str
    content: str | bytes
    options: tuple[str, ...] = ()
    map: str = ""  # the content of a --map
    marks: tuple[tuple[float, float, str], ...] = ((1.5, 2.5, "coughing"), (4, 6, "tap_water"))
    left_out: tuple[str, ...] = ()  # pieces of what is said of lines that are left out
    refused: str = ""  # a piece of why no line is taken


COUGH, TAP = (1.5, 2.5, "coughing"), (4, 6, "tap_water")
BELL = (8, 9, "doorbell")
GERMAN = 'Husten = "coughing"\n"Wasserhahn" = "tap_water"\n"Türklingel" = "doorbell"\n'
YES = ("--yes",)


def _eaf(tiers: str, header: str = "") -> str:
    """Write a document of ELAN with time slots `t<milliseconds>`."""
    times = (500, 1500, 2500, 4000, 6000, 8000, 9000)
    slots = "".join(f'<TIME_SLOT TIME_SLOT_ID="t{t}" TIME_VALUE="{t}"/>' for t in times)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<ANNOTATION_DOCUMENT FORMAT="3.0">\n'
        f'<HEADER TIME_UNITS="milliseconds">{header}</HEADER>\n'
        f"<TIME_ORDER>{slots}</TIME_ORDER>\n{tiers}</ANNOTATION_DOCUMENT>\n"
    )


def _tier(name: str, *annotations: tuple[int, int, str], who: str = "") -> str:
    rows = "".join(
        f'<ANNOTATION>\n<ALIGNABLE_ANNOTATION ANNOTATION_ID="{name}{i}" TIME_SLOT_REF1="t{start}" '
        f'TIME_SLOT_REF2="t{end}">\n<ANNOTATION_VALUE>{label}</ANNOTATION_VALUE>\n'
        "</ALIGNABLE_ANNOTATION>\n</ANNOTATION>\n"
        for i, (start, end, label) in enumerate(annotations)
    )
    return f'<TIER TIER_ID="{name}" {who} LINGUISTIC_TYPE_REF="default-lt">\n{rows}</TIER>\n'


def _region(start: float, end: float, *labels: str) -> dict[str, object]:
    value = {"start": start, "end": end, "channel": 0, "labels": list(labels)}
    return {"id": "aB3", "from_name": "label", "to_name": "audio", "type": "labels"} | {
        "original_length": None,
        "value": value,
    }


def _tasks(*annotations: list[dict[str, object]]) -> str:
    made = [
        {"id": i, "completed_by": i, "result": result, "was_cancelled": False}
        for i, result in enumerate(annotations, 1)
    ]
    return json.dumps([{"id": 1, "annotations": made, "data": {"audio": "/data/upload/day.wav"}}])


_RAVEN = "Selection\tView\tChannel\tBegin Time (s)\tEnd Time (s)\tLow Freq (Hz)\tHigh Freq (Hz)"
_SOUNDS = ((1500, 2500, "coughing"), (4000, 6000, "tap_water"))

FILES = (
    ForeignFile(
        "Audacity",
        "names with capitals and blanks",
        "labels.txt",
        "1.500000\t2.500000\tCoughing\n4.000000\t6.000000\tTap Water\n",
        YES,
    ),
    ForeignFile(
        "Audacity",
        "German names",
        "Textmarken.txt",
        "1.500000\t2.500000\tHusten\n4.000000\t6.000000\tWasserhahn\n8.000000\t9.000000\tTürklingel\n",
        map=GERMAN,
        marks=(COUGH, TAP, BELL),
    ),
    ForeignFile(
        "Audacity",
        "an umlaut",
        "labels.txt",
        "1.500000\t2.500000\tcoughing\n8.000000\t9.000000\tTürklingel\n",
        YES,
        marks=(COUGH, (8, 9, "tuerklingel")),
    ),
    ForeignFile(
        "Audacity",
        "decimal commas",
        "Textmarken.txt",
        "1,500000\t2,500000\tcoughing\n4,000000\t6,000000\ttap_water\n",
    ),
    ForeignFile(
        "Audacity",
        "points among spans",
        "labels.txt",
        "0.500000\t0.500000\tsilent until here\n1.500000\t2.500000\tcoughing\n"
        "3.000000\t3.000000\tdoor?\n4.000000\t6.000000\ttap_water\n",
        left_out=("2 points left out", ":1: silent until here is a point"),
    ),
    ForeignFile(
        "Audacity",
        "labels without a text",
        "labels.txt",
        "1.500000\t2.500000\tcoughing\n3.000000\t3.500000\t\n4.000000\t6.000000\ttap_water\n7.0\t8.0\n",
        left_out=("2 empty labels left out", ":2: has no text"),
    ),
    ForeignFile(
        "Audacity",
        "two tracks, one after the other",
        "tracks.txt",
        "1.500000\t2.500000\tcoughing\n4.000000\t6.000000\ttap_water\n"
        "1.000000\t2.000000\tspeech\n5.000000\t7.000000\ttap_water\n",
        marks=((1, 2, "speech"), (2, 2.5, "coughing"), TAP, (6, 7, "tap_water")),
        left_out=("1 overlap left out", ":1: coughing overlaps speech in line 3"),
    ),
    ForeignFile(
        "Audacity",
        "a spectral selection, from Windows",
        "labels.txt",
        b"\xef\xbb\xbf1.500000\t2.500000\tcoughing\r\n\\\t100.0\t4000.0\r\n4.0\t6.0\ttap_water\r\n",
    ),
    ForeignFile(
        "ELAN",
        "a second tier, of notes",
        "day.eaf",
        _eaf(_tier("sounds", *_SOUNDS) + _tier("notes", (500, 6000, "she was in bed, I think"))),
        ("--tier", "sounds"),
    ),
    ForeignFile(
        "ELAN",
        "an annotation without a text",
        "day.eaf",
        _eaf(_tier("sounds", *_SOUNDS, (8000, 9000, ""))),
        left_out=("1 empty label left out", "has no text"),
    ),
    ForeignFile(
        "ELAN",
        "a person as the participant",
        "day.eaf",
        _eaf(_tier("sounds", *_SOUNDS, who='PARTICIPANT="Mrs Day" ANNOTATOR="Ann"')),
        ("--microphone", "mic"),
    ),
    ForeignFile(
        "ELAN",
        "a tier of each of two annotators",
        "day.eaf",
        _eaf(
            _tier("Ann", *_SOUNDS) + _tier("Bob", (500, 2500, "coughing"), (4000, 6000, "shower"))
        ),
        marks=((0.5, 2.5, "coughing"), TAP),
        left_out=("1 overlap left out", "shower overlaps tap_water in line"),
    ),
    ForeignFile(
        "ELAN",
        "an offset of the recording",
        "day.eaf",
        _eaf(
            _tier("sounds", *_SOUNDS),
            '<MEDIA_DESCRIPTOR MEDIA_URL="file:///day.wav" TIME_ORIGIN="40"/>',
        ),
        marks=(),
        refused="has an offset of the recording; set it to 0 in ELAN",
    ),
    ForeignFile(
        "Raven",
        "a column of species",
        "day.Table.1.selections.txt",
        f"{_RAVEN}\tSpecies\n1\tSpectrogram 1\t1\t1.5\t2.5\t200.0\t4000.0\tCOUGH\n"
        "2\tSpectrogram 1\t1\t4.0\t6.0\t200.0\t4000.0\tTAP\n",
        map='COUGH = "coughing"\nTAP = "tap_water"\n',
    ),
    ForeignFile(
        "Raven",
        "decimal commas",
        "day.Table.1.selections.txt",
        f"{_RAVEN}\tAnnotation\n1\tSpectrogram 1\t1\t1,5\t2,5\t200,0\t4000,0\tcoughing\n"
        "2\tSpectrogram 1\t1\t4,0\t6,0\t200,0\t4000,0\ttap_water\n",
    ),
    ForeignFile(
        "Raven",
        "selections that overlap",
        "day.Table.1.selections.txt",
        f"{_RAVEN}\tAnnotation\n1\tSpectrogram 1\t1\t1.5\t2.5\t200.0\t900.0\tcoughing\n"
        "2\tSpectrogram 1\t1\t2.0\t3.0\t900.0\t4000.0\tspeech\n"
        "3\tSpectrogram 1\t1\t4.0\t6.0\t900.0\t4000.0\ttap_water\n",
        marks=(COUGH, (2.5, 3, "speech"), TAP),
        left_out=("1 overlap left out", ":3: speech overlaps coughing in line 2"),
    ),
    ForeignFile(
        "Raven",
        "species beside annotations",
        "day.Table.1.selections.txt",
        f"{_RAVEN}\tAnnotation\tSpecies\n"
        "1\tSpectrogram 1\t1\t1.5\t2.5\t200.0\t900.0\tloud\tcoughing\n"
        "2\tSpectrogram 1\t1\t4.0\t6.0\t900.0\t4000.0\t\ttap_water\n",
        ("--column", "label=Species"),
    ),
    ForeignFile(
        "BirdNET-Analyzer",
        "a selection table",
        "day.BirdNET.selection.table.txt",
        f"{_RAVEN}\tCommon Name\tSpecies Code\tConfidence\tBegin Path\tFile Offset (s)\n"
        "1\tSpectrogram 1\t1\t1.5\t2.5\t0\t15000\tHuman cough\thumcou\t0.91\t/day.wav\t1.5\n"
        "2\tSpectrogram 1\t1\t4.0\t6.0\t0\t15000\tFaucet\tfaucet\t0.62\t/day.wav\t4.0\n",
        map='"human cough" = "coughing"\nFaucet = "tap_water"\n',
    ),
    ForeignFile(
        "BirdNET-Analyzer",
        "results as CSV",
        "day.BirdNET.results.csv",
        "Start (s),End (s),Scientific name,Common name,Confidence,File\n"
        "1.5,2.5,Homo sapiens,Human cough,0.9134,day.wav\n"
        "4.0,6.0,Aqua fluens,Faucet,0.6201,day.wav\n"
        "9.0,12.0,Turdus merula,Eurasian Blackbird,0.4021,day.wav\n"
        "12.0,15.0,Turdus merula,Eurasian Blackbird,0.3021,day.wav\n",
        map='"Human cough" = "coughing"\nFaucet = "tap_water"\n',
        left_out=("2 labels left out", ":4: 'Eurasian Blackbird' is not a class name"),
    ),
    ForeignFile(
        "BirdNET-Analyzer",
        "labels for Audacity",
        "day.BirdNET.results.txt",
        "1.5\t2.5\tHomo sapiens, Human cough\t0.9134\n4.0\t6.0\tAqua fluens, Faucet\t0.6201\n",
        map='"Homo sapiens, Human cough" = "coughing"\n"Aqua fluens, Faucet" = "tap_water"\n',
    ),
    ForeignFile(
        "BirdNET-Analyzer",
        "a table for R",
        "day.BirdNET.results.r.csv",
        "filepath,start,end,scientific_name,common_name,confidence,lat,lon,week,overlap\n"
        "/day.wav,1.5,2.5,Homo sapiens,Cough,0.9,-1,-1,-1,0.0\n"
        "/day.wav,4,6,Aqua fluens,Tap water,0.6,-1,-1,-1,0.0\n",
        YES,
    ),
    ForeignFile(
        "Label Studio",
        "names with capitals, and German ones",
        "project-1.json",
        _tasks(
            [_region(1.5, 2.5, "Husten"), _region(4, 6, "Tap-water"), _region(8, 9, "Türklingel")]
        ),
        YES,
        map=GERMAN,
        marks=(COUGH, TAP, BELL),
    ),
    ForeignFile(
        "Label Studio",
        "two annotators of a task",
        "project-1.json",
        _tasks(
            [_region(1.5, 2.5, "coughing"), _region(4, 6, "tap_water")],
            [_region(1.6, 2.4, "coughing"), _region(5, 7, "shower")],
        ),
        marks=(COUGH, TAP, (6, 7, "shower")),
        left_out=("1 overlap left out", "shower overlaps tap_water in task 1, annotation 1"),
    ),
    ForeignFile(
        "Label Studio",
        "regions without a label, or with two",
        "project-1.json",
        _tasks(
            [
                _region(1.5, 2.5, "coughing"),
                _region(3, 3.5),
                _region(4, 6, "tap_water"),
                _region(8, 9, "speech", "music"),
            ]
        ),
        left_out=("result 2: has no text", "result 4: has 2 labels"),
    ),
    ForeignFile(
        "Label Studio",
        "JSON-MIN",
        "project-1-min.json",
        json.dumps(
            [
                {
                    "audio": "/data/upload/day.wav",
                    "id": 1,
                    "label": [_region(1.5, 2.5, "coughing")["value"]],
                    "annotator": 1,
                    "annotation_id": 1,
                    "created_at": "2026-03-02T10:00:00.000000Z",
                }
            ]
        ),
        marks=(),
        refused="task 1: is no task of Label Studio; export them as JSON",
    ),
    ForeignFile(
        "pyannote",
        "RTTM of a diarization, in which speakers overlap",
        "day.rttm",
        "SPEAKER day 1 1.500 1.000 <NA> <NA> SPEAKER_00 <NA> <NA>\n"
        "SPEAKER day 1 2.000 1.500 <NA> <NA> SPEAKER_01 <NA> <NA>\n",
        ("--microphone", "mic"),
        map='SPEAKER_00 = "speech"\nSPEAKER_01 = "speech"\n',
        marks=((1.5, 2.5, "speech"), (2.5, 3.5, "speech")),
    ),
    ForeignFile(
        "RTTM",
        "numbers without a zero, and other lines",
        "day.rttm",
        ";; a comment\nSPKR-INFO day 1 <NA> <NA> <NA> unknown coughing <NA>\n"
        "SPEAKER day 1  1.50 1.00 <NA> <NA> coughing <NA>\n"
        "SPEAKER day 1   .50  .25 <NA> <NA> speech <NA>\n",
        ("--microphone", "mic"),
        marks=((0.5, 0.75, "speech"), COUGH),
    ),
    ForeignFile(
        "Sonic Visualiser",
        "regions as CSV, without names of columns",
        "regions.csv",
        "1.500000000,1,1.000000000,coughing\n4.000000000,2,2.000000000,tap_water\n",
        ("--column", "start=1", "--column", "duration=3", "--column", "label=4"),
    ),
    ForeignFile(
        "Sonic Visualiser",
        "regions with tabs, and names of columns",
        "regions.txt",
        "TIME\tVALUE\tDURATION\tLABEL\n1.500000000\t1\t1.000000000\tcoughing\n4\t2\t2\ttap_water\n",
    ),
    ForeignFile(
        "Excel",
        "a German table, with rows left empty",
        "Geräusche.csv",
        "Von;Bis;Geräusch;Bemerkung\r\n1,5;2,5;Husten;laut\r\n4;6;Wasserhahn;\r\n;;;\r\n;;;\r\n",
        ("--column", "start=Von", "--column", "end=Bis", "--column", "label=Geräusch"),
        map=GERMAN,
    ),
    ForeignFile(
        "Excel",
        "Unicode text",
        "sounds.txt",
        "Start\tEnd\tLabel\r\n1.5\t2.5\tCoughing\r\n4\t6\tTap water\r\n".encode("utf-16"),
        YES,
    ),
    ForeignFile(
        "Excel",
        "capitals, and a column of comments",
        "sounds.csv",
        '\ufeffStart,End,Label,Comment\r\n1.5,2.5,coughing,"loud,\r\nagain"\r\n4,6,tap_water,\r\n',
    ),
    ForeignFile(
        "Excel",
        "dates as they are written in America",
        "sounds.csv",
        "start,end,label\n3/1/2026 7:00:01 AM,3/1/2026 7:00:02 AM,coughing\n",
        marks=(),
        refused=":2: '3/1/2026 7:00:01 AM' is neither seconds nor a time such as",
    ),
)
