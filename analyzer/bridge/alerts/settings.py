"""How alerts are delivered."""

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from hearthlog.recorder.config import PlainPath

NO_LISTENER = (
    "bridge.alert: nobody would be told; name urls_file in [bridge.delivery], or a broker in "
    "[bridge.mqtt]"
)


def _check_secret_file(value: Any) -> Any:
    if "://" in str(value):  # a secret, which no message may repeat
        raise ValueError("names a file; write the address into that file, on a line of its own")
    return value


SecretFile = Annotated[PlainPath, BeforeValidator(_check_secret_file)]


class DeliverySettings(BaseModel):
    """Where alerts go, besides the broker of MQTT."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    urls_file: SecretFile | None = Field(
        default=None,
        examples=["/etc/hearthlog/alert-urls"],
        description="Addresses as Apprise reads them, one a line; they are secrets.",
    )
