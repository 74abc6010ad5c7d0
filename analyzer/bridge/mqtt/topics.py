"""The topics of MQTT: chosen once, and never renamed."""

import re
from typing import NamedTuple
from urllib.parse import quote, unquote

_CLASS_PART = "/class/"
_KEPT = "".join(chr(code) for code in range(33, 127) if chr(code) not in "%+#/$")


CONFIG, TOLD = "config", "told"  # kinds of places


class Place(NamedTuple):
    """The subject of a topic; parts that do not apply are empty."""

    kind: str
    microphone: str = ""
    label: str = ""


class Topics(NamedTuple):
    """Names the topics of one recorder."""

    base: str
    node: str

    @property
    def root(self) -> str:
        """What all topics of the recorder begin with."""
        return f"{self.base}/{self.node}"

    def of_home(self, kind: str) -> str:
        """Name a topic of the recorder: `bridge` or `recorder`."""
        return f"{self.root}/{kind}"

    def of_microphone(self, microphone: str, kind: str) -> str:
        """Name a topic of a microphone, such as `listening`, `heard` or `event`."""
        return f"{self.root}/{microphone}/{kind}"

    def of_class(self, microphone: str, label: str, kind: str) -> str:
        """Name a topic of a class: `on`, `count_today`, `count_night` or `last_heard`.

        Parameters
        ----------
        label : str
            The class; what a topic may not have, or what is no ASCII, is written `%2B`, as in
            addresses.
        """
        return f"{self.root}/{microphone}{_CLASS_PART}{_part(label)}/{kind}"

    def of_told(self, label: str) -> str:
        """Name the topic that says whether a class is told of."""
        return f"{self.root}/told/{_part(label)}"

    @property
    def told_filter(self) -> str:
        """The subscription that matches all names of `of_told`."""
        return f"{self.root}/told/+"

    def name(self, place: Place) -> str:
        """Name the topic of a place of any kind but `config`, which has a topic of discovery."""
        kind, microphone, label = place
        if kind == TOLD:
            return self.of_told(label)
        if label:
            return self.of_class(microphone, label, kind)
        return self.of_microphone(microphone, kind) if microphone else self.of_home(kind)

    def parse(self, topic: str) -> Place | None:
        """Return the place of a topic that `name` gives; None of another one."""
        parts = topic.removeprefix(f"{self.root}/").split("/")
        match parts:
            case [kind]:
                place = Place(kind)
            case ["told", label]:
                place = Place(TOLD, label=unquote(label))
            case [microphone, kind]:
                place = Place(kind, microphone)
            case [microphone, "class", label, kind]:
                place = Place(kind, microphone, unquote(label))
            case _:
                return None
        return place if self.name(place) == topic else None


def _part(label: str) -> str:
    return quote(label, safe=_KEPT)


def identifier(text: str) -> str:
    """Make a text part of an identifier, which no other text gives."""
    escaped = r"[^a-z0-9_]|_(?=[0-9a-f]+[^a-z0-9])"
    return re.sub(escaped, lambda match: f"_{ord(match[0]):x}_", text)
