"""Alert rules, their durations, and their notifications."""

import hashlib
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeGuard

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from hearthlog.analyzer.activity import ANY_SOUND, LONGEST_PAUSE
from hearthlog.analyzer.activity.day_anomaly import LONGEST
from hearthlog.analyzer.activity.event_counts import AROUND
from hearthlog.analyzer.logs.spans import EVENT_PAUSE, NEVER
from hearthlog.models.classes import IMPORTANT, ON_TELEVISION, SILENCE, class_name, in_words
from hearthlog.recorder.pause_schedule import QuietHours, check_quiet_hours, quiet_hours
from hearthlog.schemas.errors import HearthlogError
from hearthlog.schemas.frames import NANOSECONDS

SECOND = NANOSECONDS
MINUTE, HOUR, DAY = 60 * SECOND, 3600 * SECOND, 86_400 * SECOND
_UNITS = {"d": DAY, "h": HOUR, "m": MINUTE, "s": SECOND}
_WORDS = {"d": "d", "h": "h", "m": "min", "s": "s"}
_FORM = re.compile(r"(?:(\d{1,3})d)?(?:(\d{1,4})h)?(?:(\d{1,5})m)?(?:(\d{1,6})s)?")


def read_duration(text: object) -> int:
    """Parse a duration such as `1h30m` into nanoseconds.

    Raise `ValueError` if the text has another form.
    """
    found = _FORM.fullmatch(text) if isinstance(text, str) else None
    if found is None or not any(found.groups()):
        raise ValueError(
            f"{str(text)[:64]!r} is not a duration; write one such as 90s, 20m, 1h30m or 7d"
        )
    counts = zip(_UNITS.values(), found.groups(), strict=True)
    return sum(unit * int(count) for unit, count in counts if count)


def duration_words(nanoseconds: int) -> str:
    """Format a duration, a multiple of a second in nanoseconds: `1 h 30 min`."""
    parts = []
    rest = nanoseconds
    for key, unit in _UNITS.items():
        count, rest = divmod(rest, unit)
        if count:
            parts.append(f"{count} {_WORDS[key]}")
    return " ".join(parts) or "0 s"


_LONGEST_WINDOW = 7 * DAY
_MARGIN = 5 * MINUTE
_NIGHT_ENDS = 7 * 60
_LONGEST_NAME = 60  # characters
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_TWO_DAYS = 50 * 3600 * SECOND  # with a margin for clock changes


def _within(least: int, most: int, words: str) -> BeforeValidator:
    def read(text: object) -> int:
        nanoseconds = read_duration(text)
        if not least <= nanoseconds <= most:
            raise ValueError(f"{text} is too short or too long; {words}")
        return nanoseconds

    return BeforeValidator(read)


def _read_minute(text: object) -> int:
    try:
        return quiet_hours(f"{text}-00:00").start
    except HearthlogError:
        raise ValueError(
            f"{str(text)[:64]!r} is not a time of day; write one such as 07:30"
        ) from None


def _check_hours(text: str) -> str:
    try:
        return check_quiet_hours(text)
    except HearthlogError as error:
        raise ValueError(str(error)) from error


def _check_name(name: str) -> str:
    if not 0 < len(name) <= _LONGEST_NAME or _CONTROL.search(name):
        raise ValueError(
            f"{name[:_LONGEST_NAME]!r} is not a rule name; write 1 to {_LONGEST_NAME} characters "
            "in one line, such as Coughing at night"
        )
    return name


Window = Annotated[
    int, _within(MINUTE, _LONGEST_WINDOW, "a minute to seven days"), Field(examples=["1h"])
]
Pause = Annotated[int, _within(0, LONGEST_PAUSE, "ten minutes at most"), Field(examples=["10s"])]
TimeOfDay = Annotated[int, BeforeValidator(_read_minute), Field(examples=["07:30"])]
_Hours = Annotated[str, AfterValidator(_check_hours)]


class _Rule(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, AfterValidator(_check_name)] = Field(
        examples=["Coughing at night"], description="Shown; unique."
    )
    cooldown: Window = Field(
        default="1h", validate_default=True, description="Minimum time between two notifications."
    )
    quiet_hours: list[_Hours] = Field(
        default=[], description='Quiet hours, in which notifications wait, such as ["22:00-06:30"].'
    )
    urgent: bool = Field(default=False, description="Notify in quiet hours too.")

    def hours(self) -> list[QuietHours]:
        """Return the quiet hours that delay notifications; none for an urgent rule."""
        return [] if self.urgent else [quiet_hours(text) for text in self.quiet_hours]

    @property
    def fingerprint(self) -> str:
        """Hash of the rule, to detect changes since the last evaluation."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


class _SoundRule(_Rule):
    label: str = Field(
        default=ANY_SOUND, alias="class", max_length=64, description="Class; by default any sound."
    )
    microphone: str = Field(default="", description="Microphone; by default all together.")
    confidence: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Least confidence of a counted segment."
    )
    least_seconds: float = Field(
        default=0.0, ge=0.0, le=3600.0, description="Least length of a counted event."
    )

    @model_validator(mode="before")
    @classmethod
    def _name_class(cls, values: Any) -> Any:
        if isinstance(values, dict) and isinstance(values.get("class"), str):
            name = class_name(values["class"])
            if name == SILENCE:
                raise ValueError(
                    f"{SILENCE} is not a sound; for no sound at all use none_by without a class"
                )
            return values | {"class": name}
        return values

    @property
    def words(self) -> str:
        """Human-readable name of the class."""
        return "Any sound" if self.label == ANY_SOUND else in_words(self.label)


class MoreThan(_SoundRule):
    """More than so many events, or so many minutes, of a class in a window."""

    rule: Literal["more_than"]
    count: int | None = Field(default=None, ge=0, le=100_000, description="Events in the window.")
    minutes: float | None = Field(default=None, ge=0.0, le=10_080.0, description="In the window.")
    window: Window

    @model_validator(mode="after")
    def _check_amount(self) -> "MoreThan":
        if (self.count is None) == (self.minutes is None):
            raise ValueError("set either count or minutes")
        return self


class NoneBy(_SoundRule):
    """None of a class from one time of day to another, if enough of that time was recorded."""

    rule: Literal["none_by"]
    since: TimeOfDay
    by: TimeOfDay
    least_share: float = Field(
        default=0.75,
        gt=0.0,
        le=1.0,
        description="Share of the time that must be recorded; with less the result is unknown.",
    )

    @model_validator(mode="after")
    def _check_times(self) -> "NoneBy":
        if self.since == self.by:
            raise ValueError("since and by are the same time of day")
        return self


class LongerThan(_SoundRule):
    """A class for longer than a time, with no more than short pauses."""

    rule: Literal["longer_than"]
    longer_than: Window
    pause: Pause = Field(
        default="10s", validate_default=True, description="Pause that ends a sound."
    )


class RecorderSilent(_Rule):
    """Nothing from the recorder for a time, not even diagnostics."""

    rule: Literal["recorder_silent"]
    silent_for: Window = Field(default="10m", validate_default=True)


class UnlikeUsual(_SoundRule):
    """A day, or its night, outside the range of the previous four weeks."""

    rule: Literal["unlike_usual"]
    part: Literal["day", "night"] = Field(
        default="day", description="Compare the day before, or the night from 22:00 to 07:00."
    )
    of: Literal["count", "minutes"] = Field(default="count", description="What is compared.")
    which: Literal["more", "less", "both"] = Field(
        default="both", description="Deviation that notifies."
    )
    margin: float = Field(
        default=0.25, ge=0.0, le=10.0, description="Share above the highest or below the lowest."
    )
    at: TimeOfDay = Field(default="08:00", validate_default=True)
    least_share: float = Field(
        default=0.75,
        gt=0.0,
        le=1.0,
        description="Share of the time that must be recorded for a comparison.",
    )

    @model_validator(mode="after")
    def _check_time(self) -> "UnlikeUsual":
        if self.part == "night" and self.at < _NIGHT_ENDS:
            raise ValueError("at: a night ends at 07:00")
        return self


class UnusualDay(_Rule):
    """A day, with its night, more unusual than most of the previous four weeks."""

    rule: Literal["unusual_day"]
    once_in: float = Field(default=30.0, ge=7.0, le=LONGEST, description="Return period in days.")
    at: TimeOfDay = Field(default="08:00", validate_default=True)

    @model_validator(mode="after")
    def _check_time(self) -> "UnusualDay":
        if self.at < _NIGHT_ENDS:
            raise ValueError("at: a night ends at 07:00")
        return self


SoundRule = MoreThan | NoneBy | LongerThan | UnlikeUsual
DailyRule = UnlikeUsual | UnusualDay  # evaluated once a day on weeks of logs
AlertRule = Annotated[
    MoreThan | NoneBy | LongerThan | RecorderSilent | UnlikeUsual | UnusualDay,
    Field(discriminator="rule"),
]


def _check_names(rules: list[AlertRule]) -> list[AlertRule]:
    names = [rule.name for rule in rules]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two rules have the name {twice!r}; give each its own")
    return rules


AlertRules = Annotated[list[AlertRule], AfterValidator(_check_names), Field(max_length=100)]


def is_hidden(rule: AlertRule, hidden: Collection[str]) -> TypeGuard[SoundRule]:
    """Whether a rule is of a class that nobody is told of, so that the rule never notifies."""
    return isinstance(rule, SoundRule) and rule.label in hidden


def pause_of(rule: SoundRule) -> int:
    """Return the longest pause within an event, in nanoseconds."""
    return rule.pause if isinstance(rule, LongerThan) else EVENT_PAUSE


_DECIDED = (AROUND + 1) * MINUTE  # after the start of a minute, whether it has a television


def delay_of(rule: SoundRule) -> int:
    """Return how much later sounds count for a rule than they begin, in nanoseconds.

    A television is known only minutes later, and its talk must not notify. Nobody waits for what a
    person may need help for.
    """
    is_apart = rule.label in ON_TELEVISION and rule.label not in IMPORTANT
    return _DECIDED if is_apart and isinstance(rule, MoreThan | LongerThan) else 0


def history(rule: AlertRule) -> int:
    """Return the length of activity before a time that a rule needs, in nanoseconds.

    Events that begin earlier and reach into this history must be complete.
    """
    if isinstance(rule, MoreThan):
        return rule.window + 2 * delay_of(rule) + _MARGIN
    if isinstance(rule, RecorderSilent):
        return rule.silent_for + _MARGIN
    if isinstance(rule, DailyRule):
        return 34 * DAY
    if isinstance(rule, NoneBy):
        return _TWO_DAYS
    return LONGEST_PAUSE + 2 * delay_of(rule) + _MARGIN


def live_history(rule: AlertRule) -> int:
    """Return the length of live activity before a time that a rule needs, in nanoseconds.

    Daily rules read weeks from the logs, but the evaluated day live: a silence since the start of
    that day may have no segment in the logs yet.
    """
    return _TWO_DAYS if isinstance(rule, DailyRule) else history(rule)


class Notification(NamedTuple):
    """Notification by a rule."""

    rule: str
    time: int  # log time, in nanoseconds of UTC
    text: str
    is_known: bool  # False if the recorder heard too little to tell
    due: int  # earliest delivery, in nanoseconds of UTC: the time, or the end of quiet hours

    @property
    def id(self) -> str:
        """Identifier of the notification: the same in every evaluation."""
        return f"{self.time}-{hashlib.sha256(self.rule.encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class RuleState:
    """State of a rule between two evaluations; times in nanoseconds of UTC."""

    last: int = -NEVER  # time of the last notification
    has_rung: bool = False  # whether the condition at the end has given its notification
    since: int = -NEVER  # when the rule came into force; whether a recorder ran before is unknown
    until: int = 0  # end of the evaluation; 0 for a new rule


class Condition(NamedTuple):
    """Time span in which the condition of a rule holds."""

    start: int  # in nanoseconds of UTC
    end: int  # likewise, exclusive
    text: Callable[[int], str]  # returns the text of a notification at a time
    is_known: bool = True  # False if the recorder heard too little to tell
