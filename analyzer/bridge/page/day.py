"""A day on the page: its picture, counts, times, and one sentence about it."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import date, tzinfo
from typing import Any, NamedTuple

from hearthlog.analyzer.activity import SoundEvent
from hearthlog.analyzer.activity.checked_minutes import UNMEASURED, Sureness
from hearthlog.analyzer.activity.event_counts import AROUND, MINUTE
from hearthlog.analyzer.bridge.corrections import NO_CORRECTIONS, EventCorrections
from hearthlog.analyzer.bridge.home_state import MOST, ClassSounds, LiveMicrophone
from hearthlog.analyzer.bridge.page import ENGLISH, Translation, clock, room
from hearthlog.analyzer.bridge.page.status import missing_classes
from hearthlog.analyzer.logs.local_time import (
    EVENING,
    MORNING,
    Today,
    at_hour,
    day_span,
    evening_before,
    local_time,
)
from hearthlog.analyzer.logs.spans import cut, joined, union
from hearthlog.models.classes import (
    IMPORTANT,
    OBJECTS_ACTIVITY,
    SPEECH,
    UNKNOWN,
    WORRYING,
    class_name,
    colour_on_paper,
    ordered,
)
from hearthlog.schemas.frames import NANOSECONDS

BIN = 120 * NANOSECONDS  # as in the picture of the report
MAIN = (*IMPORTANT, SPEECH, OBJECTS_ACTIVITY)  # in the week, which has no room for more
_HOUR = 3600 * NANOSECONDS
_MOST_TIMES = 40  # of a count
_MOST_GAPS = 6  # in words
_SILENT = 60 * NANOSECONDS  # shortest gap that is drawn
_DIGITS = 4  # decimals of a position in the day, 0 to 1


class TimeOfDay(NamedTuple):
    """A part of a day, in nanoseconds of UTC; no two of a day have a time in common."""

    name: str  # of the column of its counts
    start: int
    end: int


class DaySpan(NamedTuple):
    """A span of the local time of a home, in nanoseconds of UTC."""

    start: int
    end: int
    zone: tzinfo

    def place(self, time: int) -> float:
        """Return the position of a time in the day, 0 to 1."""
        inside = min(max(time, self.start), self.end)
        return round((inside - self.start) / (self.end - self.start), _DIGITS)


class HomeDay(NamedTuple):
    """The microphones of a home on a day."""

    microphones: Sequence[LiveMicrophone]
    moment: Today  # the current day; for a past day, its last moment
    zone: tzinfo
    words: Translation = ENGLISH
    is_past: bool = False
    corrections: EventCorrections = NO_CORRECTIONS
    sureness: Sureness = UNMEASURED

    def sure(self, event: SoundEvent) -> str:
        """Return a word for the confidence of an event; empty if none can be justified.

        What somebody has answered needs none.
        """
        if self.corrections.correction_of(event) is not None:
            return ""
        return self.words.sureness(event.confidence, self.sureness)

    def when(self, time: int) -> str:
        """Format a time: `14:05`, on the current day also `yesterday 23:10`."""
        return self.words.when(time, self.moment.now, self.zone, is_past=self.is_past)

    def is_unsure(self, event: SoundEvent) -> bool:
        """Whether an event is shown as not sure: nobody has answered what it was, either."""
        return (
            self.sureness.is_unsure(event.confidence)
            and self.corrections.correction_of(event) is None
        )

    def sounds(self, microphone: LiveMicrophone, since: int) -> dict[str, ClassSounds]:
        """Return the events of each shown class since a time, corrected by people."""
        return microphone.sounds(since, self.corrections, microphone.common_names)

    @property
    def date(self) -> date:
        """The local date."""
        return local_time(self.moment.midnight, self.zone).date()

    def span(self) -> DaySpan:
        """Return the day with the night before it: from the evening before to the evening.

        The current day has its own evening, too: only from midnight on it belongs to the next.
        """
        start, evening = evening_before(self.date, self.zone), self._hour(EVENING)
        is_late = not self.is_past and self.moment.now >= evening
        return DaySpan(start, day_span(self.date, self.zone)[1] if is_late else evening, self.zone)

    def times_of_day(self) -> list[TimeOfDay]:
        """Return the parts of the day that have begun: its night, the day and the evening."""
        span, now, words = self.span(), self.moment.now, self.words
        morning, evening = self._hour(MORNING), self._hour(EVENING)
        first, last = f"{EVENING:02}", f"{MORNING:02}"
        parts = (
            TimeOfDay(words.text("hours of night", first=first, last=last), span.start, morning),
            TimeOfDay(words.text("hours of day", first=last, last=first), morning, evening),
            TimeOfDay("", evening, span.end),
        )
        begun = [part for part in parts if part.start <= min(now, span.end - 1)]
        if not self.is_past and now < begun[-1].end:
            since = words.text("since", time=clock(begun[-1].start, self.zone))
            begun[-1] = begun[-1]._replace(name=since)
        return begun

    def _hour(self, hour: int) -> int:
        return at_hour(self.date, hour, self.zone)


def picture_of(home: HomeDay) -> Any:
    """Return the picture of a day for JSON."""
    day = home.span()
    hours = range(day.start, day.end, _HOUR)
    morning, evening = (at_hour(home.date, hour, home.zone) for hour in (MORNING, EVENING))
    nights = [(day.start, morning), *([(evening, day.end)] if evening < day.end else [])]
    now = home.moment.now
    return {
        "date": home.date.isoformat(),
        "title": home.words.long_date(home.date),
        "sentence": day_sentence(home),
        "more": more_sentences(home),
        "television": _capital(_television(home, day.start, min(now, day.end))),
        "now": None if home.is_past else day.place(now - now % BIN),
        "hours": [(day.place(hour), local_time(hour, home.zone).hour) for hour in hours],
        "nights": [(day.place(start), day.place(end)) for start, end in nights],
        "columns": [part.name for part in home.times_of_day()],
        "rooms": [_room(microphone, day, home) for microphone in home.microphones],
        "missing": missing_classes(home.microphones, home.words),
    }


def _room(microphone: LiveMicrophone, day: DaySpan, home: HomeDay) -> Any:
    times_of_day = home.times_of_day()
    covered = [_is_covered(microphone, part, day, home.moment.now) for part in times_of_day]
    gaps = _gaps(microphone, day, home)
    return {
        "room": room(microphone.name),
        "gaps": [(day.place(a), day.place(b)) for a, b in gaps],
        "unheard": _gaps_in_words(gaps, home),
        "lanes": [
            _lane(label, sounds, home, [*zip(times_of_day, covered, strict=True)])
            for label, sounds in home.sounds(microphone, 0).items()
        ],
    }


def _is_covered(microphone: LiveMicrophone, part: TimeOfDay, day: DaySpan, now: int) -> bool:
    """Whether a part of the day was listened to enough for a count of 0."""
    share = microphone.listened_share(part.start, min(part.end, now))
    return share >= MOST if part.start == day.start else share > 0


def _gaps(microphone: LiveMicrophone, day: DaySpan, home: HomeDay) -> list[tuple[int, int]]:
    """Return the gaps of a microphone in a day, up to now, without short ones."""
    gaps = microphone.not_listened(day.start, min(day.end, home.moment.now))
    long = gaps.ends - gaps.starts >= _SILENT
    shown = joined(gaps.starts[long], gaps.ends[long], BIN - 1)  # two minutes and more apart
    return [*shown.pairs()]


def _gaps_in_words(gaps: Sequence[tuple[int, int]], home: HomeDay) -> str:
    """Return the gaps in words, as the text alternative of the picture; empty without gaps."""
    words = home.words
    spans = [
        words.text("range", first=clock(start, home.zone), last=clock(end, home.zone))
        for start, end in gaps[:_MOST_GAPS]
    ]
    if len(gaps) > _MOST_GAPS:
        spans.append(words.text("picture.more", count=len(gaps) - _MOST_GAPS))
    return words.text("picture.unheard", spans=words.listed(spans)) if spans else ""


def _lane(
    label: str, sounds: ClassSounds, home: HomeDay, parts: Sequence[tuple[TimeOfDay, bool]]
) -> Any:
    day, words = home.span(), home.words
    events = [e for e in sounds.events if day.start - 24 * _HOUR <= e.start < day.end]
    counted = [e for e in sounds.counted if e.start < day.end]
    of_parts = [[e for e in counted if part.start <= e.start < part.end] for part, _ in parts]
    counts = [
        len(own) if own or is_covered else None
        for own, (_, is_covered) in zip(of_parts, parts, strict=True)
    ]
    of_day = [event for own in of_parts for event in own]
    count = len(of_day) if of_day or None not in counts else None
    # What is not recognised is called nothing that it might not be.
    unsure = set() if class_name(label) == UNKNOWN else {*filter(home.is_unsure, counted)}
    uncounted = sorted({*events} - {*counted})
    uncounted_today = [event for event in uncounted if event.start >= day.start]
    of_last_days = [event for event in counted if event.start >= day.start - 24 * _HOUR]
    last = (of_last_days if home.is_past and of_last_days else [None, *sounds.counted])[-1]
    at = "" if last is None else home.when(last.end)
    name = words.class_words(label)
    often = words.text("count.not known") if count is None else _perhaps(of_day, unsure, words)
    key = "lane of a day" if home.is_past else "lane and last" if count else "lane"
    description = words.text(key, **{"class": name, "times": often, "last": at})
    if uncounted_today:
        times = words.times(len(uncounted_today))
        description = words.text("lane beside", told=description, times=times)
    return {
        "label": label,
        "perhaps": bool(sounds.doubtful),
        "main": label in MAIN,
        "words": name,
        "colour": colour_on_paper(label),
        "bars": bars(counted, day),
        "sure_bars": bars((e for e in counted if e not in unsure), day),
        "unsure_bars": bars(unsure, day),
        "pale": bars(uncounted, day),
        "told": description,
        "count": count,
        "counts": counts,
        "unsure": [len(unsure.intersection(own)) for own in (of_day, *of_parts)],
        "uncounted": len(uncounted_today),
        "uncounted_times": _few_clocks(uncounted_today, home),
        "last": f"{at}?" if last in unsure else at,
        "times": [_times(each, name, sounds.given, home) for each in (of_day, *of_parts)],
    }


def _perhaps(
    events: Sequence[SoundEvent], doubtful: Collection[SoundEvent], words: Translation
) -> str:
    """Return how often a sound was, in words: `twice, perhaps 3 more times`."""
    unsure = len({*events}.intersection(doubtful))
    sure = len(events) - unsure
    if not unsure:
        return words.times(sure)
    more = words.more_times(unsure, sure) if sure else words.times(unsure)
    return ", ".join([words.times(sure)] * bool(sure) + [words.text("perhaps", what=more)])


def _times(events: Sequence[SoundEvent], name: str, given: Collection[str], home: HomeDay) -> Any:
    """Return start, id, length, sureness and class by people of events, and how many are left out.

    The newest come first.
    """
    words, shown = home.words, events[-_MOST_TIMES:]
    mark = words.text("mark.other", **{"class": name})
    times = [
        (
            clock(event.start, home.zone),
            event.id,
            " · ".join(filter(None, (words.length(event.seconds), home.sure(event)))),
            mark if event.id in given else "",
        )
        for event in reversed(shown)
    ]
    return {"times": times, "before": len(events) - len(shown)}


def _few_clocks(events: Sequence[SoundEvent], home: HomeDay) -> str:
    """Return the times of day of a few events in words; empty if there are more."""
    if len(events) > _MOST_CLOCKS:
        return ""
    return home.words.clocks([clock(event.start, home.zone) for event in events])


def bars(events: Iterable[SoundEvent], day: DaySpan) -> str:
    """Return which two minutes of a day have some of events: a digit for each, 1 or 0.

    Empty without events in the day.
    """
    filled = ["0"] * -(-(day.end - day.start) // BIN)
    for event in (each for each in events if each.end > day.start):
        start, end = max(event.start, day.start), min(max(event.end, event.start + 1), day.end)
        first, last = (start - day.start) // BIN, -(-(end - day.start) // BIN)
        filled[first:last] = ["1"] * (last - first)
    return "".join(filled) if "1" in filled else ""


_QUIET_SHARE = 0.01  # most of a quiet night with any sound
_QUIET_EVENTS = 5  # most events of important classes in a quiet night
_NEARLY_ALL = 0.95  # of a part of a past day: of less, its sentence says so
_NOON = 12
_MOST_CLASSES = 3  # in the sentence
_MOST_CLOCKS = 4  # of a class
_TELEVISION_PAUSE = 20 * MINUTE  # shorter pauses of a television are left out, as in the report
_MOST_TELEVISION = 2  # times of a television
_LONGEST = 84  # characters of a sentence about several classes: four lines of a phone


SoundsOfRooms = dict[str, dict[str, Sequence[SoundEvent]]]  # by class and microphone


def day_sentence(home: HomeDay) -> str:
    """Return a sentence about the night, after noon about the day; its counts are those below it.

    A night or a day that was not listened to is never called quiet.
    """
    is_about_day = home.is_past or not _is_before_noon(home)
    return _sentence_of_day(home) if is_about_day else night_sentence(home)


def more_sentences(home: HomeDay) -> str:
    """Return what is below the sentence of a day: its morning, or a television and the night.

    Of a past day, only the television; empty until 07:00.
    """
    moment, words = home.moment, home.words
    start = at_hour(home.date, MORNING, home.zone)
    if moment.now < start:
        return ""
    begin = home.span().start if home.is_past else start
    found, television = _events_of(home, begin, moment.now), _television(home, begin, moment.now)
    if home.is_past or not _is_before_noon(home):
        named = [f"{_capital(television)}."] if television and _important(found) else []
        return " ".join([*named, *[night_sentence(home)] * (not home.is_past)])
    names = [name for name in found if class_name(name) != UNKNOWN][:_MOST_CLASSES]
    texts = [_class_and_span(name, found[name], home) for name in names]
    texts += [television] * bool(television)
    since = words.text("since", time=clock(start, home.zone))
    return words.text("sentence", when=since, what="; ".join(texts)) + "." if texts else ""


def _class_and_span(name: str, rooms: Mapping[str, Sequence[SoundEvent]], home: HomeDay) -> str:
    """Format the counts of a class; in a single room, also when one that is not important was."""
    text = ", ".join(_class_and_times(name, rooms, home, _MOST_CLOCKS))
    if name in IMPORTANT or len(home.microphones) > 1:
        return text
    (events,) = rooms.values()
    edges = events[0].start, max(event.end for event in events)
    first, last = (clock(edge, home.zone) for edge in edges)
    when = first if first == last else home.words.text("range", first=first, last=last)
    return home.words.text("times and clocks", times=text, clocks=when)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _is_before_noon(home: HomeDay) -> bool:
    return local_time(home.moment.now, home.zone).hour < _NOON


def night_sentence(home: HomeDay) -> str:
    """Return a sentence about the last night, or the one that has begun."""
    moment = home.moment
    start, end = moment.night, min(moment.morning, moment.now)
    words, found = home.words, _events_of(home, start, moment.morning)
    is_over = moment.now >= moment.morning
    television = _television(home, start, end)
    if not all(each.is_night_covered(moment) for each in home.microphones) or not home.microphones:
        when = words.text("night.partly")
    elif all(_is_quiet(each, found, start, end) for each in home.microphones):
        when, television = words.text("night.quiet" if is_over else "night.quiet so far"), ""
        found = _important(found)
    else:
        when = words.text("night.last" if is_over else "night.this")
    return _sentence([DayPart(when, found, television)], home)


def _sentence_of_day(home: HomeDay) -> str:
    moment, words, span = home.moment, home.words, home.span()
    morning = at_hour(home.date, MORNING, home.zone)
    start = span.start if home.is_past else morning
    since = "" if home.is_past else words.text("since", time=clock(start, home.zone))
    day = DayPart(since, _events_of(home, start, span.end), _television(home, start, moment.now))
    parts = [day]
    if home.is_past:
        both = (("day.past night", start, morning), ("day.past day", morning, span.end))
        parts = [
            DayPart(
                words.text(
                    key if _listened_share(home, *times) >= _NEARLY_ALL else f"{key} partly"
                ),
                _important(_events_of(home, *times)),
                _television(home, *times),
            )
            for key, *times in both
        ]
    parts = [part for part in parts if _important(part.found) or part.television]
    is_split = home.is_past and bool(parts)
    if not is_split and _listened_share(home, start, moment.now) < MOST:
        partly = words.text("day.past partly" if home.is_past else "day.partly")
        return _sentence([day._replace(when=partly)], home)
    if any(_important(part.found) for part in parts):
        named = [part._replace(television="") for part in parts if _important(part.found)]
        return _sentence(named, home)
    detectable = {name for each in home.microphones for name in each.classes} & {*IMPORTANT}
    names = [words.inside(words.class_words(name)) for name in ordered(detectable)]
    if not names:
        return _sentence([day], home) if day.found or day.television else ""
    key = "day.past none" if home.is_past else "day.none"
    none = words.text(key, when=since, classes=words.listed(names, "or"))
    return "; ".join(filter(None, (none, day.television))) + "."


def _listened_share(home: HomeDay, start: int, end: int) -> float:
    """Return the share of a time span to which each microphone listened."""
    return min((each.listened_share(start, end) for each in home.microphones), default=0.0)


def _important(found: SoundsOfRooms) -> SoundsOfRooms:
    return {name: own for name, own in found.items() if name in IMPORTANT}


def _events_of(home: HomeDay, start: int, end: int) -> SoundsOfRooms:
    """Return the events that begin in a time span, the most important class first."""
    found: SoundsOfRooms = {}
    for microphone in home.microphones:
        for label, sounds in home.sounds(microphone, start).items():
            own = [event for event in sounds.counted if event.start < end]
            if own:
                found.setdefault(label, {})[microphone.name] = own
    return {name: found[name] for name in ordered(found)}


def _is_quiet(microphone: LiveMicrophone, found: SoundsOfRooms, start: int, end: int) -> bool:
    """Whether a night was quiet in a room, by its events that count; no television is quiet."""
    own = [(name, event) for name in found for event in found[name].get(microphone.name, ())]
    seconds = sum(event.seconds for _, event in own)
    important = sum(name in IMPORTANT for name, _ in own)
    sound = seconds * NANOSECONDS + cut(microphone.television(), start, end).length
    return important <= _QUIET_EVENTS and sound <= _QUIET_SHARE * (end - start)


def _television(home: HomeDay, start: int, end: int) -> str:
    """Return when something like a television sounded, in words; empty if it was short."""
    words = home.words
    minutes = union(*(cut(each.television(), start, end) for each in home.microphones))
    if minutes.length <= _QUIET_SHARE * (end - start):
        return ""
    pairs = [*joined(*minutes, _TELEVISION_PAUSE).pairs()]
    clocks = [(clock(first, home.zone), clock(last, home.zone)) for first, last in pairs]
    times = words.listed([words.text("range", first=a, last=b) for a, b in clocks])
    key = "television.times"
    if len(pairs) > _MOST_TELEVISION:
        key = "television.some"
        times = words.text("range", first=clocks[0][0], last=clocks[-1][1])
    elif len(pairs) == 1 and end == home.moment.now and pairs[0][1] > end - AROUND * MINUTE:
        key, times = "television.since", clocks[0][0]  # it may be on
    elif len(pairs) == 1 and pairs[0][0] == start:
        key, times = "television.until", clocks[0][1]
    return words.text(key, times=times, length=words.length(minutes.length / NANOSECONDS))


class DayPart(NamedTuple):
    """A part of a day, for the sentence about it."""

    when: str
    found: SoundsOfRooms  # events
    television: str = ""  # when there was something like one

    @property
    def names(self) -> list[str]:
        """The classes of the sentence: the important ones, if there are any."""
        important = [name for name in self.found if name in IMPORTANT]
        return (important or [*self.found])[:_MOST_CLASSES]


def _sentence(parts: Sequence[DayPart], home: HomeDay) -> str:
    """Return a sentence for each part, all short if they are about several classes."""
    full = [part._replace(found={name: part.found[name] for name in part.names}) for part in parts]
    if sum(len(part.found) + bool(part.television) for part in full) <= 1:
        return _sentence_of(full, home, None)
    # Times of the first class matter more than a last one that worries nobody.
    for shown in _ever_fewer_classes(full):
        sentence = _sentence_of(shown, home, _MOST_CLOCKS)
        if len(sentence) <= _room_for(shown):
            return sentence
    for most in (1, 0):
        sentence = _sentence_of(shown, home, most)
        if len(sentence) <= _room_for(shown):
            break
    return sentence


def _ever_fewer_classes(parts: list[DayPart]) -> Iterator[list[DayPart]]:
    """Yield the parts, then without the last class that worries nobody, while one class is left."""
    yield parts
    while sum(len(part.found) for part in parts) > 1:
        places = [n for n, part in enumerate(parts) if {*part.found} - {*WORRYING}]
        if not places:
            return
        last = parts[places[-1]]
        name = [name for name in last.found if name not in WORRYING][-1]
        rest = {each: own for each, own in last.found.items() if each != name}
        left = [last._replace(found=rest)] if rest or last.television else []
        parts = [*parts[: places[-1]], *left, *parts[places[-1] + 1 :]]
        yield parts


def _room_for(parts: Sequence[DayPart]) -> int:
    """Return the most characters of the sentences about some parts of a day."""
    limit = _LONGEST + sum(len(part.television) for part in parts)  # is never left out
    return limit + (sum(len(part.when) for part in parts) if len(parts) > 1 else 0)


def _sentence_of(parts: Sequence[DayPart], home: HomeDay, most: int | None) -> str:
    sentences = [_part_in_words(part, home, most) for part in parts]
    return ". ".join(_capital(each) for each in sentences if each) + "."


def _part_in_words(part: DayPart, home: HomeDay, most: int | None) -> str:
    words = home.words
    parts = [_class_and_times(name, part.found[name], home, most) for name in part.found]
    texts = [", ".join(each) for each in parts]
    is_simple = all(len(each) == 1 for each in parts) and not part.television
    if part.television:
        texts.insert(sum(name in IMPORTANT for name in part.found), part.television)
    what = words.listed(texts) if is_simple else "; ".join(texts)
    return (
        words.text("sentence", when=part.when, what=what)
        if what and part.when
        else (part.when or what)
    )


def _class_and_times(
    name: str, rooms: Mapping[str, Sequence[SoundEvent]], home: HomeDay, most: int | None
) -> list[str]:
    """Format the counts of a class, by room: rooms may hear the same sound, so none are added.

    In each room first the events that are counted on, then those that are not sure.

    Parameters
    ----------
    most : int or None
        In a sentence about one of several classes or more, how many times of day are written out:
        more are left out.
    """
    words = home.words
    shown = words.inside(words.class_words(name))
    parts: list[str] = []
    for microphone, events in rooms.items():
        unsure = [event for event in events if home.is_unsure(event)]
        sure = [event for event in events if event not in unsure]
        if sure:
            where = _where(name, microphone, sure, home, most)
            parts.append(_times_of(words.times(len(sure)), where, "" if parts else shown, words))
        if unsure:
            count = len(unsure)
            times = words.more_times(count, len(sure)) if sure else words.times(count)
            # Without those of the sure ones, its times would be taken for all of them.
            own = (
                0
                if sure and most is not None and not _are_times_written(sure, home, most)
                else most
            )
            where = _where(name, "" if sure else microphone, unsure, home, own)
            text = _times_of(times, where, "" if parts else shown, words)
            parts.append(words.text("perhaps", what=text))
    return parts


def _times_of(times: str, where: str, name: str, words: Translation) -> str:
    """Format a count, with its class and where it was if these are given."""
    if not name:
        return words.text("times and clocks", times=times, clocks=where) if where else times
    key = "class and times" if where else "class and count"
    return words.text(key, **{"class": name, "times": times, "clocks": where})


def _where(
    name: str, microphone: str, events: Sequence[SoundEvent], home: HomeDay, most: int | None
) -> str:
    """Format in which of several rooms, and for an important class when, a sound was heard."""
    words = home.words
    place = room(microphone) if microphone and len(home.microphones) > 1 else ""
    if name not in IMPORTANT:
        return place
    each = [clock(event.start, home.zone) for event in events]
    clocks = [*dict.fromkeys(each)]
    when = words.clocks(each)
    if not _are_times_written(events, home, most):
        return place
    if len(clocks) > _MOST_CLOCKS:
        when = words.text("range", first=clocks[0], last=clocks[-1])
    return words.text("room and clocks", room=place, clocks=when) if place else when


def _are_times_written(events: Sequence[SoundEvent], home: HomeDay, most: int | None) -> bool:
    clocks = {clock(event.start, home.zone) for event in events}
    return most is None or len(clocks) <= most
