"""A microphone is found by its name, or where two have one name, by where it is plugged in."""

import os
import tempfile
import threading
from pathlib import Path

import pytest

from hearthlog.recorder.sources import process
from hearthlog.recorder.sources.capture import (
    Device,
    UsbPlace,
    closed_card,
    find_device,
    list_devices,
    usb_place,
)
from hearthlog.schemas.errors import DeviceError

pytestmark = pytest.mark.fast


class PortAudio:
    """What sounddevice says of four inputs and an output."""

    class default:  # noqa: N801  as sounddevice calls it
        device = (2, 0)

    @staticmethod
    def query_devices():
        names = (
            "USB PnP: Audio (hw:1,0)",
            "USB PnP: Audio (hw:2,0)",
            "Yeti: USB (hw:3,0)",
            "pulse",
        )
        inputs = [(name, 1) for name in names] + [("HDMI (hw:0,3)", 0)]
        return [
            {"index": n, "name": name, "max_input_channels": count, "default_samplerate": 48000.0}
            for n, (name, count) in enumerate(inputs)
        ]


@pytest.fixture
def cards(tmp_path):
    """A tree like /sys: card 1 and 2 at USB, the first with a serial number, card 3 at PCI."""
    for card, port, serial in ((1, "1-1.2", "A1B2"), (2, "1-1.3", "")):
        interface = tmp_path / "devices" / port / f"{port}:1.0"
        (interface / "sound").mkdir(parents=True)
        (interface.parent / "idVendor").write_text("0d8c\n")
        if serial:
            (interface.parent / "serial").write_text(f"{serial}\n")
        (tmp_path / f"card{card}").mkdir()
        (tmp_path / f"card{card}" / "device").symlink_to(interface)
    (tmp_path / "devices" / "0000:00:1f.3").mkdir()
    (tmp_path / "card3").mkdir()
    (tmp_path / "card3" / "device").symlink_to(tmp_path / "devices" / "0000:00:1f.3")
    return tmp_path


def test_a_card_at_usb_has_a_port_and_perhaps_a_serial_number(cards):
    places = [usb_place(card, cards) for card in (1, 2, 3, 9)]
    assert places[:2] == [UsbPlace("usb:1-1.2", "serial:A1B2"), UsbPlace("usb:1-1.3", "")]
    assert places[2:] == [UsbPlace(), UsbPlace()]


@pytest.fixture
def devices(cards, monkeypatch):
    monkeypatch.setattr(
        "hearthlog.recorder.sources.capture.usb_place", lambda card: usb_place(card, cards)
    )
    return list_devices(PortAudio)


def test_two_devices_of_one_name_are_numbered_and_known_by_their_ports(devices):
    assert [device.name for device in devices] == [
        "USB PnP: Audio #1",
        "USB PnP: Audio #2",
        "Yeti: USB",
        "pulse",
    ]
    assert [device.identity for device in devices] == [
        "usb:1-1.2",
        "usb:1-1.3",
        "Yeti: USB",
        "pulse",
    ]


@pytest.mark.parametrize(
    ("requested", "index"),
    [
        ("", 2),
        ("yeti", 2),
        ("usb:1-1.3", 1),
        ("serial:A1B2", 0),
        ("USB PnP: Audio #2", 1),
        ("pulse", 3),
    ],
)
def test_a_device_is_found_by_what_it_is_asked_for(devices, requested, index):
    assert find_device(devices, requested).index == index


def test_a_port_in_which_nothing_is_plugged_is_no_other_device(devices):
    left = [device for device in devices if device.port != "usb:1-1.3"]
    with pytest.raises(DeviceError, match=r"no microphone is called 'usb:1-1\.3'"):
        find_device(left, "usb:1-1.3", exact=True)


def test_only_the_whole_name_will_do_where_it_must_be_the_same_device():
    devices = [Device(0, "labmic2", 1, 16_000.0, is_default=True)]
    assert find_device(devices, "labmic").name == "labmic2"
    with pytest.raises(DeviceError, match="no microphone is called 'labmic'"):
        find_device(devices, "labmic", exact=True)


def test_a_card_that_is_plugged_in_ends_the_wait_for_one(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "_CARDS", tmp_path)
    plug = threading.Timer(0.5, (tmp_path / "pcmC1D0c").touch)
    plug.start()
    assert process.cards_change(threading.Event(), 60.0)
    assert not process.cards_change(threading.Event(), 0.1)


def test_a_card_of_a_group_that_is_not_the_accounts_is_named_with_the_group():
    account, nobody = os.geteuid(), 65_534
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        node = Path(folder, "pcmC0D0c")
        node.touch()
        assert closed_card(Path(folder)) == ""
        node.chmod(0)
        if account == 0:  # who may open anything
            os.seteuid(nobody)
        try:
            found = closed_card(Path(folder))
        finally:
            os.seteuid(account)
        group = node.stat().st_gid
    assert found.startswith(f"this account may not open {node}: add it to the group {group};")
