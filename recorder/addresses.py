"""Network addresses of sound, and their public names for the log."""

import re
from typing import NamedTuple
from urllib.parse import parse_qsl, urlsplit

from hearthlog.schemas.errors import SourceError
from hearthlog.schemas.frames import SAMPLE_RATE

_SCHEMES = ("rtsp", "http", "https")
_TOPIC_SCHEME = "ros2"
_MOST_CHARACTERS = 2000


def is_address(device: str) -> bool:
    """Return whether a device is a network address rather than a local device."""
    return "://" in device


class TopicAddress(NamedTuple):
    """A ROS 2 topic; `rate` (Hz) and `channels` apply to messages without these fields."""

    topic: str
    rate: int = SAMPLE_RATE
    channels: int = 1

    @property
    def name(self) -> str:
        """The address without parameters."""
        return f"{_TOPIC_SCHEME}://{self.topic}"


def is_topic(device: str) -> bool:
    """Return whether a device is a ROS 2 topic."""
    return device.startswith(f"{_TOPIC_SCHEME}://")


def read_topic(address: str) -> TopicAddress:
    """Parse the address of a topic, such as "ros2:///robot/audio?rate=48000&channels=4".

    Raise `SourceError` if it is no such address.
    """
    form = "write it as ros2:///robot/audio, or ros2:///robot/audio?rate=48000&channels=4"
    topic, _, parameters = address.removeprefix(f"{_TOPIC_SCHEME}://").partition("?")
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", topic, re.ASCII) or len(address) > _MOST_CHARACTERS:
        raise SourceError(f"{address[:80]!r} does not name a ROS 2 topic; {form}")
    given = dict(parse_qsl(parameters, keep_blank_values=True))
    if not given.keys() <= {"rate", "channels"} or not all(
        re.fullmatch(r"[1-9]\d{0,5}", text, re.ASCII) for text in given.values()
    ):
        raise SourceError(f"{address[:80]!r} has other parameters than rate and channels; {form}")
    return TopicAddress(topic, **{name: int(text) for name, text in given.items()})


def check_address(address: str) -> None:
    """Check an address as far as possible without the network.

    Raise `SourceError` if its scheme is unsupported, its host is missing, or it cannot be parsed.
    The message does not repeat the address, as it may contain a password.
    """
    if re.search(r"[\0-\x20\x7f]", address) or len(address) > _MOST_CHARACTERS:
        raise SourceError(
            "the address of a microphone has a space or a line break, or more than "
            f"{_MOST_CHARACTERS} characters; write a space as %20"
        )
    if is_topic(address):
        read_topic(address)
        return
    scheme = address.partition("://")[0]
    if scheme not in _SCHEMES:
        raise SourceError(
            f"{scheme[:16]!r} is not a supported address; use rtsp://, http://, https:// or ros2://"
        )
    if not _has_host(address):
        raise SourceError(
            f"the address {scheme}://… of a microphone has no host, or an ambiguous one; write "
            "it as rtsp://camera/stream, and in a password / as %2F, @ as %40, ? as %3F and # "
            "as %23"
        )


def _has_host(address: str) -> bool:
    """Return whether the host is unambiguous."""
    try:
        parts = urlsplit(address)
        host, _ = parts.hostname, parts.port
    except ValueError:
        return False
    return bool(host) and "@" not in address.partition("://")[2].removeprefix(parts.netloc)


def public_name(device: str) -> str:
    """Return a device's name for the log: an address without user, password and parameters."""
    if not is_address(device):
        return device
    if is_topic(device):
        return device.partition("?")[0]
    scheme, _, rest = device.partition("://")
    place = re.split(r"[/?#]", rest, maxsplit=1)[0]
    path = rest.removeprefix(place)
    if "@" in path:  # the end of the password is ambiguous
        return f"{scheme}://…"
    # Some cameras have `user=…&password=…` in their paths.
    return f"{scheme}://{place.rpartition('@')[2]}" + re.sub(r"[^/]*[=&?#].*", "…", path)
