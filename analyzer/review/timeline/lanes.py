"""The lanes of a review: one for each class of sound, and what people and the box have to say."""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from hearthlog.analyzer.colours import GAP, Colour, colour
from hearthlog.analyzer.review.timeline.disagreements import disagreements
from hearthlog.analyzer.review.timeline.model import (
    LabelledSpans,
    LabellingTimeline,
    MicrophoneTimeline,
    Timeline,
    no_spans,
)
from hearthlog.models.classes import OF_EVERY_SCENARIO, SILENCE, class_name, in_words
from hearthlog.schemas.messages.topics import (
    LIVE,
    RELABEL,
    is_review,
    is_scenario,
    review_labelling,
    scenario_name,
)

REVIEWED = "Reviewed"  # the name of the lane, and of its spans without a mark
NOT_HEARD = "Not heard"
_TROUBLE = "Trouble"
_RECURRING = "Recurs"
_VOICES = "Voices"
_LOOKED_AT: Colour = (58, 70, 92)
_TROUBLED: Colour = (240, 140, 40)
_MOST_LANES = 12  # of classes, where some were not heard at all


class Lane(NamedTuple):
    """A lane.

    Attributes
    ----------
    labelling : str
        The one whose labels it shows; empty if it stands beside all of them.
    """

    microphone: str
    labelling: str
    name: str
    spans: LabelledSpans
    colours: Mapping[str, Colour]


def timeline_lanes(timeline: Timeline) -> Iterator[Lane]:
    """Make the lanes of a timeline, microphone by microphone, from above.

    Yields
    ------
    Lane
        For each labelling a lane for each class but silence: what was heard for the shortest time
        comes first, what was not heard last. Then what stands beside all labellings: a lane for
        each scenario, where others differ from the first one, what is reviewed, also of scenarios,
        what was not heard, and trouble.
    """
    for microphone in timeline.microphones.values():
        labellings = labellings_of(microphone)
        words = _classes(microphone, labellings)
        for one in labellings:
            for name, shade in words.items():
                spans = _of_class(one.spans, name)
                yield Lane(microphone.name, one.name, name, spans, {name: shade})
        yield from _beside(microphone, labellings)


def labellings_of(microphone: MicrophoneTimeline) -> list[LabellingTimeline]:
    """Return the labellings of a microphone by models of the home, the recorder's first."""
    models = [one for one in microphone.labellings if not is_review(one.name)]
    return [one for one in models if not is_scenario(one.name)]


def labelling_in_words(name: str) -> str:
    """Name a labelling: `the recorder`, the scenario, or the model."""
    if is_scenario(name):
        return name.replace("/", " ")
    return "the recorder" if name == LIVE else name.removeprefix(f"{RELABEL}/")


def scenario_sounds(spans: LabelledSpans) -> LabelledSpans:
    """Leave out of the spans of a scenario what it has no name for."""
    named = np.array([class_name(text) not in OF_EVERY_SCENARIO for text in spans.texts], bool)
    return LabelledSpans(spans.starts[named], spans.ends[named], spans.texts[named])


def reviewed_lane(
    microphone: str, scenario: str, marks: LabelledSpans, reviewed: LabelledSpans
) -> Lane:
    """Make the lane of what is reviewed.

    Parameters
    ----------
    scenario : str
        Its name; empty for the sounds of the home.
    """
    names = {text: in_words(text) for text in dict.fromkeys(marks.texts)}
    shades = {name: colour(text) for text, name in names.items()}
    texts = np.array([*[REVIEWED] * len(reviewed), *(names[t] for t in marks.texts)], object)
    starts = np.concatenate([reviewed.starts, marks.starts])
    ends = np.concatenate([reviewed.ends, marks.ends])
    spans = LabelledSpans(starts, ends, texts)
    name = f"{in_words(scenario)} reviewed" if scenario else REVIEWED
    return Lane(microphone, "", name, spans, {REVIEWED: _LOOKED_AT, **shades})


def _classes(
    microphone: MicrophoneTimeline, labellings: list[LabellingTimeline]
) -> dict[str, Colour]:
    """Return the classes in words, what was heard for the shortest time first."""
    models = {name for one in labellings if one.probabilities for name in one.probabilities.names}
    known = {name for one in labellings for name in one.spans.texts} | models
    names = [name for name in microphone.classes if name in known and class_name(name) != SILENCE]
    seconds: Counter[str] = Counter()
    for one in labellings:
        for name in names:
            own = one.spans.texts == name
            seconds[in_words(name)] += int((one.spans.ends - one.spans.starts)[own].sum())
    shades = {in_words(name): colour(name) for name in reversed(names)}
    heard = sorted((name for name in shades if seconds[name]), key=lambda name: seconds[name])
    silent = [in_words(name) for name in names if not seconds[in_words(name)]]
    room = max(_MOST_LANES - len(heard), 0)
    return {name: shades[name] for name in dict.fromkeys([*heard, *silent[:room]])}


def _of_class(spans: LabelledSpans, name: str) -> LabelledSpans:
    labels = {text for text in dict.fromkeys(spans.texts) if in_words(text) == name}
    own = np.isin(spans.texts, list(labels)) if labels else np.zeros(len(spans), bool)
    return LabelledSpans(spans.starts[own], spans.ends[own], np.full(own.sum(), name, object))


def _beside(microphone: MicrophoneTimeline, labellings: list[LabellingTimeline]) -> Iterator[Lane]:
    for one in (each for each in microphone.labellings if is_scenario(each.name)):
        yield _scenario_lane(microphone.name, one)
    for other in labellings[1:]:
        spans = disagreements(labellings[0].spans, other.spans)
        shades = {in_words(text): colour(text) for text in dict.fromkeys(spans.texts)}
        texts = np.array([in_words(text) for text in spans.texts], object)
        name = f"{labelling_in_words(other.name)} differs"
        yield Lane(microphone.name, "", name, LabelledSpans(*spans[:2], texts), shades)
    for name, named in ((_RECURRING, microphone.recurring), (_VOICES, microphone.spoken)):
        if len(named):
            yield _named_lane(microphone.name, name, named)
    marks = {one.name: one.spans for one in microphone.labellings if is_review(one.name)}
    for scenario, looked_at in {"": microphone.reviewed, **microphone.reviewed_scenarios}.items():
        own = marks.get(review_labelling(scenario), no_spans())
        yield reviewed_lane(microphone.name, scenario, own, looked_at)
    kinds = (NOT_HEARD, microphone.gaps, GAP), (_TROUBLE, microphone.troubles, _TROUBLED)
    for name, spans, shade in kinds:
        if len(spans):
            texts = np.full(len(spans), name, object)
            named = LabelledSpans(*spans[:2], texts)
            yield Lane(microphone.name, "", name, named, {name: shade})


def _scenario_lane(microphone: str, labelling: LabellingTimeline) -> Lane:
    """Make one lane of all classes of a scenario, but of what it has no name for."""
    spans = scenario_sounds(labelling.spans)
    shades = {in_words(text): colour(text) for text in dict.fromkeys(spans.texts)}
    words = np.array([in_words(text) for text in spans.texts], object)
    own = LabelledSpans(*spans[:2], words)
    name = in_words(scenario_name(labelling.name))
    return Lane(microphone, "", name, own, shades)


def _named_lane(microphone: str, lane: str, named: LabelledSpans) -> Lane:
    names = {text: in_words(text) for text in dict.fromkeys(named.texts)}
    shades = {name: colour(text) for text, name in names.items()}
    texts = np.array([names[text] for text in named.texts], object)
    return Lane(microphone, "", lane, LabelledSpans(*named[:2], texts), shades)
