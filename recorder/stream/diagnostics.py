"""Messages of `/diagnostics`."""

from hearthlog.recorder.events import SourceHealth
from hearthlog.recorder.stream.messages import EncodedMessage
from hearthlog.schemas.messages import message_types
from hearthlog.schemas.messages.message_types import encode, header, message
from hearthlog.schemas.messages.topics import DIAGNOSTICS


def diagnostics(subject: str, health: SourceHealth, microphone: str = "") -> EncodedMessage:
    """Encode the health of one thing.

    Parameters
    ----------
    subject : str
        A microphone or recorder by its name, and behind a space what of it, if not all of it.
    """
    status = message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=health.level,
        name=f"hearthlog: {subject}",
        message=health.summary,
        hardware_id=subject.partition(" ")[0],
        values=[
            message("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in health.values.items()
        ],
    )
    head = header(health.stamp, microphone)
    array = message(message_types.DIAGNOSTICS, header=head, status=[status])
    return EncodedMessage(health.stamp, DIAGNOSTICS, encode(array))
