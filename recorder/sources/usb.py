"""Where a sound card is plugged in, as Linux tells it."""

from pathlib import Path
from typing import NamedTuple

_CARDS = Path("/sys/class/sound")


class UsbPlace(NamedTuple):
    """Of a sound card at USB.

    Attributes
    ----------
    port : str
        `usb:` and the bus and ports that lead to it, such as "usb:1-1.2"; the same after a reboot,
        as long as it stays in its socket. Empty for a card that is not at USB.
    serial : str
        `serial:` and its number; empty if it has none.
    """

    port: str = ""
    serial: str = ""


def usb_place(card: int, cards: Path = _CARDS) -> UsbPlace:
    """Find where a sound card is plugged in."""
    interface = (cards / f"card{card}" / "device").resolve()
    device = interface.parent  # of the interface that is the sound card
    try:
        (device / "idVendor").read_text()
    except OSError:
        return UsbPlace()
    try:
        serial = (device / "serial").read_text(errors="replace").strip()
    except OSError:
        serial = ""
    return UsbPlace(f"usb:{device.name}", f"serial:{serial}" if serial else "")
