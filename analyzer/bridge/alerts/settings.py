"""How alerts are delivered."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field


class DeliverySettings(BaseModel):
    """Where alerts go, besides the broker of MQTT."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    urls_file: Path | None = Field(
        default=None,
        examples=["/etc/hearthlog/alert-urls"],
        description="Addresses as Apprise reads them, one a line; they are secrets.",
    )
