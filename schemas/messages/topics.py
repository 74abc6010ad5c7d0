"""The topics of a log: types, quality of service, array names; labels for no sound."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from hearthlog.schemas.errors import LogError
from hearthlog.schemas.messages import message_types

DIAGNOSTICS = "/diagnostics"
ROSOUT = "/rosout"
# Labellings: the recorder's, that of a model on trial beside it, a reviewer's, by its name
# `scenario/<name>`, what a reviewer says of that, and by its model `relabel/<model>`.
LIVE, CANDIDATE, REVIEW, RELABEL = "live", "candidate", "review", "relabel"
SCENARIO = "scenario"
_MICROPHONE = "[a-z](?:_?[a-z0-9])*"  # and the name of a scenario
_SCENARIO = f"{SCENARIO}/{_MICROPHONE}"
_NOT_LIVE = rf"{CANDIDATE}|{REVIEW}(?:/{_SCENARIO})?|{_SCENARIO}|{RELABEL}/\w{{1,200}}"
LABELLING = re.compile(f"{LIVE}|{_NOT_LIVE}", re.ASCII)
_LONGEST_SCENARIO = 64
_TOPIC = re.compile(rf"/({_MICROPHONE})/(?:({_NOT_LIVE})/)?(\w+)", re.ASCII)


@dataclass(frozen=True)
class Quality:
    """The quality of service of a topic, where topics differ: the defaults are those of ROS 2."""

    depth: int = 10  # how many messages are kept
    transient_local: bool = False  # they are kept for those who come late
    lifespan_seconds: int | None = None  # for how long; None: for ever


_LATCHED = Quality(depth=1, transient_local=True)
_OF_ROSOUT = Quality(depth=1000, transient_local=True, lifespan_seconds=10)  # of any ROS 2 node


@dataclass(frozen=True)
class Topic:
    """One channel of a log.

    Attributes
    ----------
    array_names : mapping of str to sequence of str
        Names of the elements of an array, by the name of the field that holds the array.
    """

    name: str
    type: str
    quality: Quality = Quality()
    array_names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)


class EmbeddingSpace(NamedTuple):
    """Network and projection of embeddings; only those of the same space can be compared."""

    network: str
    projection_sha256: str
    width: int


class EmbeddingSource(NamedTuple):
    """The network and the projection behind the embeddings of a microphone."""

    network: str
    network_sha256: str
    projection_sha256: str
    names: tuple[str, ...]
    steps: tuple[float, ...]

    @property
    def space(self) -> EmbeddingSpace:
        """With which embeddings these can be compared."""
        return EmbeddingSpace(self.network, self.projection_sha256, len(self.names))

    def metadata(self) -> dict[str, str]:
        """Return what the channel says besides the names."""
        return {
            "network": self.network,
            "network_sha256": self.network_sha256,
            "projection_sha256": self.projection_sha256,
            "values_steps": json.dumps(list(self.steps)),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "EmbeddingSource | None":
        """Read what a channel says of its embeddings; None where it does not."""
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
    """Return the name of a microphone if it can be part of a ROS topic.

    Raise `LogError` if the name has another form.
    """
    if not re.fullmatch(_MICROPHONE, name):
        raise LogError(
            f"microphone name {name!r} cannot be a topic: use lower-case letters, digits and "
            "single underscores, starting with a letter"
        )
    return name


def check_scenario_name(name: str) -> str:
    """Return the name of a scenario if it can be part of a ROS topic.

    Parameters
    ----------
    name : str
        As that of a microphone, of up to 64 characters.

    Raises
    ------
    LogError
        If the name has another form.
    """
    if len(name) > _LONGEST_SCENARIO or not re.fullmatch(_MICROPHONE, name):
        raise LogError(
            f"scenario name {name[:80]!r} cannot be part of a topic: use up to "
            f"{_LONGEST_SCENARIO} lower-case letters, digits and single underscores, starting with "
            "a letter"
        )
    return name


def scenario_labelling(name: str) -> str:
    """Name the labelling of a scenario: `scenario/<name>`."""
    return f"{SCENARIO}/{name}"


def is_scenario(labelling: str) -> bool:
    """Tell whether a labelling is that of a scenario."""
    return labelling.startswith(f"{SCENARIO}/")


def scenario_name(labelling: str) -> str:
    """Return the name of the scenario that a labelling is of; empty if it is of none."""
    parts = labelling.removeprefix(f"{REVIEW}/").partition("/")
    return parts[2] if parts[0] == SCENARIO else ""


def review_labelling(scenario: str = "") -> str:
    """Name what reviewers say: `review`, or of a scenario `review/scenario/<name>`.

    Parameters
    ----------
    scenario : str
        Its name; empty for the sounds of the home.
    """
    return f"{REVIEW}/{scenario_labelling(scenario)}" if scenario else REVIEW


def is_review(labelling: str) -> bool:
    """Tell whether a labelling is that of a reviewer."""
    return labelling.partition("/")[0] == REVIEW


def topic(microphone: str, kind: str) -> str:
    """Name the topic of one kind of a microphone: `/<microphone>/<kind>`."""
    return f"/{microphone}/{kind}"


class TopicName(NamedTuple):
    """The parts of the name of a topic."""

    microphone: str
    labelling: str  # `live`, `candidate`, `review`, `scenario/<name>`, `relabel/<model>` …
    kind: str  # `features`, `label`, `segment` …


def labelling_topic(microphone: str, labelling: str, kind: str) -> str:
    """Name the topic of one kind of a labelling."""
    return topic(microphone, kind if labelling == LIVE else f"{labelling}/{kind}")


def relabelling(model: str) -> str:
    """Name the labelling of a model that relabelled logs: `relabel/<model>`."""
    return f"{RELABEL}/{re.sub('[^A-Za-z0-9_]', '_', model)}"


def parse_topic(name: str) -> TopicName | None:
    """Split the name of a topic into its parts.

    Returns
    -------
    TopicName or None
        None if it is no topic of a microphone.
    """
    match = _TOPIC.fullmatch(name)
    return None if match is None else TopicName(match[1], match[2] or LIVE, match[3])


def microphone_of(topic: str) -> str:
    """Return the name of a topic's microphone; empty if it has none.

    Parameters
    ----------
    topic : str
        Name of the topic, such as "/mic/features".
    """
    parts = topic.split("/")
    return parts[1] if len(parts) > 2 else ""


def label_topics(microphone: str, labelling: str, classes: Sequence[str]) -> tuple[Topic, Topic]:
    """Return the topics of a labelling.

    Parameters
    ----------
    classes : sequence of str
        Names of the classes, in the order of the probabilities.
    """
    label, segment = (labelling_topic(microphone, labelling, kind) for kind in ("label", "segment"))
    return (
        Topic(label, message_types.LABEL, array_names={"probabilities": classes}),
        Topic(segment, message_types.SEGMENT),
    )


def topics_of(  # noqa: PLR0913
    microphone: str,
    feature_names: Sequence[str],
    classes: Sequence[str] | None,
    beside: Mapping[str, Sequence[str]] | None = None,
    *,
    directions: bool = False,
    embedding: EmbeddingSource | None = None,
) -> list[Topic]:
    """List the topics that a recorder writes for a microphone.

    Parameters
    ----------
    classes : sequence of str or None
        Names of the classes, in the order of the probabilities; None for a recorder without a
        model, which writes no labels and no segments.
    directions : bool
        Whether it is an array, and has directions.
    embedding : EmbeddingSource, optional
        Of its embeddings; None without a network.
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
    for labelling, names in (beside or {}).items():
        topics += label_topics(microphone, labelling, names)
    return topics


def audio_topic(microphone: str) -> Topic:
    """Return the only topic of a layer of sound."""
    return Topic(topic(microphone, "audio"), message_types.RAW_AUDIO)


SILENCE, UNKNOWN = "silence", "unknown"


def spelt(label: str) -> str:
    """Spell a label as the names of classes are: `Crying, sobbing` as `crying_sobbing`."""
    return re.sub("[ ,-]+", "_", label.lower())


def is_sound(label: str) -> bool:
    """Tell whether a label names a sound, and neither silence nor what the model does not know."""
    return spelt(label) not in {SILENCE, UNKNOWN}
