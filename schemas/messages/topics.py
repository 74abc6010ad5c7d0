"""Topics of a log: types, quality of service, array names; labels of no sound."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages import message_types

DIAGNOSTICS = "/diagnostics"
ROSOUT = "/rosout"
# Labellings: of the recorder, of a model on trial next to it, of a reviewer, of a scenario
# (`scenario/<name>`), of its reviewer, and of a model that relabelled (`relabel/<model>`).
LIVE, CANDIDATE, REVIEW, RELABEL = "live", "candidate", "review", "relabel"
SCENARIO = "scenario"
_MICROPHONE = "[a-z](?:_?[a-z0-9])*"  # also the name of a scenario
_SCENARIO = f"{SCENARIO}/{_MICROPHONE}"
_NOT_LIVE = rf"{CANDIDATE}|{REVIEW}(?:/{_SCENARIO})?|{_SCENARIO}|{RELABEL}/\w{{1,200}}"
LABELLING = re.compile(f"{LIVE}|{_NOT_LIVE}", re.ASCII)
_LONGEST_SCENARIO = 64
_TOPIC = re.compile(rf"/({_MICROPHONE})/(?:({_NOT_LIVE})/)?(\w+)", re.ASCII)


@dataclass(frozen=True)
class Quality:
    """Quality of service of a topic; the defaults are those of ROS 2."""

    depth: int = 10  # number of kept messages
    transient_local: bool = False  # whether late subscribers get the kept messages
    lifespan_seconds: int | None = None  # lifetime of kept messages; None: unlimited


_LATCHED = Quality(depth=1, transient_local=True)
_OF_ROSOUT = Quality(depth=1000, transient_local=True, lifespan_seconds=10)  # ROS 2 default


@dataclass(frozen=True)
class Topic:
    """Channel of a log."""

    name: str
    type: str
    quality: Quality = Quality()
    # names of the array elements, by the name of the array field
    array_names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)


class EmbeddingSpace(NamedTuple):
    """Network and projection of embeddings; embeddings are comparable within one space only."""

    network: str
    projection_sha256: str
    width: int


class EmbeddingSource(NamedTuple):
    """Network and projection of the embeddings of a microphone."""

    network: str
    network_sha256: str
    projection_sha256: str
    names: tuple[str, ...]
    steps: tuple[float, ...]

    @property
    def space(self) -> EmbeddingSpace:
        """Space in which these embeddings are comparable."""
        return EmbeddingSpace(self.network, self.projection_sha256, len(self.names))

    def metadata(self) -> dict[str, str]:
        """Return the channel metadata other than the element names."""
        return {
            "network": self.network,
            "network_sha256": self.network_sha256,
            "projection_sha256": self.projection_sha256,
            "values_steps": json.dumps(list(self.steps)),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "EmbeddingSource | None":
        """Parse the embedding source in channel metadata; None if there is none."""
        try:
            names = json.loads(metadata["values_names"])
            steps = tuple(float(step) for step in json.loads(metadata["values_steps"]))
            digests = metadata["network_sha256"], metadata["projection_sha256"]
            "".join(names).encode()
        except (KeyError, ValueError, TypeError, RecursionError, OverflowError):
            return None
        fits = isinstance(names, list) and len(names) == len(steps)
        return cls(metadata.get("network", ""), *digests, tuple(names), steps) if fits else None


def check_microphone_name(name: str) -> str:
    """Return a microphone's name; raise `LogError` if it is invalid in a ROS topic."""
    if not re.fullmatch(_MICROPHONE, name):
        raise LogError(
            f"microphone name {name!r} cannot be a topic: use lower-case letters, digits and "
            "single underscores, starting with a letter"
        )
    return name


def check_scenario_name(name: str) -> str:
    """Return the name of a scenario if it has the form of a microphone name.

    Raise `LogError` otherwise, or if it is longer than 64 characters.
    """
    if len(name) > _LONGEST_SCENARIO or not re.fullmatch(_MICROPHONE, name):
        raise LogError(
            f"scenario name {name[:80]!r} cannot be part of a topic: use up to "
            f"{_LONGEST_SCENARIO} lower-case letters, digits and single underscores, starting with "
            "a letter"
        )
    return name


def scenario_labelling(name: str) -> str:
    """Return the labelling of a scenario: `scenario/<name>`."""
    return f"{SCENARIO}/{name}"


def is_scenario(labelling: str) -> bool:
    """Return whether a labelling belongs to a scenario."""
    return labelling.startswith(f"{SCENARIO}/")


def scenario_name(labelling: str) -> str:
    """Return the scenario name of a labelling; empty if there is none."""
    parts = labelling.removeprefix(f"{REVIEW}/").partition("/")
    return parts[2] if parts[0] == SCENARIO else ""


def review_labelling(scenario: str = "") -> str:
    """Return the labelling of reviews: `review`, or `review/scenario/<name>` for a scenario."""
    return f"{REVIEW}/{scenario_labelling(scenario)}" if scenario else REVIEW


def is_review(labelling: str) -> bool:
    """Return whether a labelling belongs to a reviewer."""
    return labelling.partition("/")[0] == REVIEW


def topic(microphone: str, kind: str) -> str:
    """Return the topic of a microphone and kind: `/<microphone>/<kind>`."""
    return f"/{microphone}/{kind}"


class TopicName(NamedTuple):
    """Parts of the name of a topic."""

    microphone: str
    labelling: str  # `live`, `candidate`, `review`, `scenario/<name>`, `relabel/<model>` …
    kind: str  # `features`, `label`, `segment` …


def labelling_topic(microphone: str, labelling: str, kind: str) -> str:
    """Return the topic of a microphone, labelling and kind."""
    return topic(microphone, kind if labelling == LIVE else f"{labelling}/{kind}")


def relabelling(model: str) -> str:
    """Return the labelling of a model that relabelled logs: `relabel/<model>`."""
    return f"{RELABEL}/{re.sub('[^A-Za-z0-9_]', '_', model)}"


def parse_topic(name: str) -> TopicName | None:
    """Split a microphone's topic into its parts; None for another topic."""
    match = _TOPIC.fullmatch(name)
    return None if match is None else TopicName(match[1], match[2] or LIVE, match[3])


def microphone_of(topic: str) -> str:
    """Return the microphone of a topic, such as "/mic/features"; empty if there is none."""
    parts = topic.split("/")
    return parts[1] if len(parts) > 2 else ""


def label_topics(microphone: str, labelling: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of a labelling; `classes` are in the order of the probabilities."""
    label, segment = (labelling_topic(microphone, labelling, kind) for kind in ("label", "segment"))
    return (
        Topic(label, message_types.LABEL, array_names={"probabilities": classes}),
        Topic(segment, message_types.SEGMENT),
    )


def topics_of(  # noqa: PLR0913
    microphone: str,
    feature_names: Sequence[str],
    classes: Sequence[str] | None,
    secondary: Mapping[str, Sequence[str]] | None = None,
    *,
    directions: bool = False,
    embedding: EmbeddingSource | None = None,
) -> list[Topic]:
    """List the topics that a recorder writes for a microphone.

    `classes` are in the order of the probabilities; None for a recorder without a model, which
    writes no labels and no segments.
    """
    statistics = {"mean": feature_names, "std": feature_names}
    topics = [
        Topic(topic(microphone, "info"), message_types.STREAM_INFO, _LATCHED),
        Topic(
            topic(microphone, "features"),
            message_types.FEATURES,
            array_names={"values": feature_names},
        ),
        Topic(topic(microphone, "statistics"), message_types.STATISTICS, array_names=statistics),
        Topic(topic(microphone, "gap"), message_types.GAP),
        Topic(DIAGNOSTICS, message_types.DIAGNOSTICS),
        Topic(ROSOUT, message_types.LOG, _OF_ROSOUT),
    ]
    if directions:
        topics.append(Topic(topic(microphone, "direction"), message_types.DIRECTION))
    if embedding is not None:
        topics.append(
            Topic(
                topic(microphone, "embedding"),
                message_types.EMBEDDING,
                array_names={"values": embedding.names},
                metadata=embedding.metadata(),
            )
        )
    if classes is not None:
        topics += label_topics(microphone, LIVE, classes)
    for labelling, names in (secondary or {}).items():
        topics += label_topics(microphone, labelling, names)
    return topics


def audio_topic(microphone: str) -> Topic:
    """Return the only topic of an audio layer."""
    return Topic(topic(microphone, "audio"), message_types.RAW_AUDIO)


SILENCE, UNKNOWN = "silence", "unknown"


def spelt(label: str) -> str:
    """Convert a label to the form of class names: `Crying, sobbing` to `crying_sobbing`."""
    return re.sub("[ ,-]+", "_", label.lower())


def is_sound(label: str) -> bool:
    """Return whether a label names a sound, rather than silence or an unknown sound."""
    return spelt(label) not in {SILENCE, UNKNOWN}
