"""Which cameras a user is told of who has not plugged in the one that is meant."""

import re
import sys
from types import SimpleNamespace

import pytest
import usb.core
from helpers.fake_orbbec import Camera, Sdk
from helpers.settings import orbbec

from toftrack.devices.seen import cameras_seen
from toftrack.errors import ToftrackError


def plug(monkeypatch: pytest.MonkeyPatch, *ids: tuple[int, int]) -> None:
    listed = [SimpleNamespace(idVendor=vendor, idProduct=product) for vendor, product in ids]
    monkeypatch.setattr(usb.core, "find", lambda **_: listed)


@pytest.mark.parametrize(
    ("ids", "words"),
    [
        (((0x8086, 0x0026), (0x046D, 0x0825)), "no depth camera is seen"),  # Bluetooth, a webcam
        (((0x8086, 0x0B07),), "seen: RealSense (device=realsense)"),
        (((0x8086, 0x0B64),), "seen: RealSense L515 or SR300 (no longer in its SDK)"),
        (((0x2BC5, 0x66B), (0x45E, 0x97C)), "seen: Orbbec (device=orbbec), Azure Kinect"),
        (((0x2BC5, 0x403),), "seen: Orbbec Astra, Astra+ or first Femto (not in its SDK 2)"),
    ],
)
def test_a_missing_camera_is_answered_with_those_on_usb(monkeypatch, ids, words: str) -> None:
    plug(monkeypatch, *ids)
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", Sdk())
    with pytest.raises(ToftrackError, match=re.escape(f"no Orbbec camera was found ({words}): ")):
        orbbec()


@pytest.mark.parametrize("fails", [usb.core.NoBackendError("none"), usb.core.USBError("denied")])
def test_where_usb_cannot_be_listed_the_sdks_are_asked(monkeypatch, fails: Exception) -> None:
    def find(**_: object) -> None:
        raise fails

    monkeypatch.setattr(usb.core, "find", find)
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    for cameras, words in (([Camera("1", {})], "seen: Orbbec "), ([], "no depth camera is seen")):
        monkeypatch.setitem(sys.modules, "pyorbbecsdk", Sdk(*cameras))
        assert re.match(f"{words}.*; USB cannot be listed.*(libusb|denied)", cameras_seen())
