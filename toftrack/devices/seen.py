"""Which depth cameras this computer sees, for the sentence of one that was not found."""

from __future__ import annotations

import importlib
from collections.abc import Container
from typing import Any

import usb.core

_REALSENSE = (
    *(0x0A66, 0x0A80, 0x0AA5, *range(0x0AD1, 0x0AD7), 0x0AF6, 0x0AFE, 0x0AFF, 0x0B00, 0x0B01),
    *(0x0B03, 0x0B07, 0x0B3A, 0x0B3D, 0x0B48, 0x0B49, 0x0B4B, 0x0B4D, 0x0B52, 0x0B5B, 0x0B5C),
    *(0x0B64, 0x0B68, 0xABCD),
)
_ALL = range(0x10000)
_KNOWN: tuple[tuple[str, str, int, Container[int]], ...] = (
    ("RealSense", "realsense", 0x8086, _REALSENSE),
    ("Orbbec", "orbbec", 0x2BC5, _ALL),
    ("SwissRanger", "sr3000", 0x0852, (0x0074,)),
    ("SwissRanger", "sr3000", 0x1AD2, (0x0074, 0x0075)),
    ("Azure Kinect", "", 0x045E, (0x097C,)),
    ("Kinect V2", "", 0x045E, (0x02C4, 0x02D8)),
    ("Kinect", "", 0x045E, (0x02AE,)),
    ("PrimeSense or Xtion", "", 0x1D27, _ALL),
    ("Luxonis", "", 0x03E7, (0x2485, 0xF63B)),
    ("Stereolabs", "", 0x2B03, _ALL),
    ("pmd", "", 0x1C28, _ALL),
)
"""The maker, the device of the configuration if there is one, and the USB ids."""
_SDKS = {"realsense": "RealSense", "orbbec": "Orbbec"}
"""Devices whose module tells what its SDK lists."""


def cameras_seen(backend: Any = None) -> str:
    """What is connected, in words, as "seen: Orbbec 2bc5:0670 (device=orbbec)": on USB or, where
    that cannot be listed, what the SDKs list that are installed; raises nothing.

    backend: of pyusb; None = libusb.
    """
    seen, unlisted = [], ""
    try:
        for one in usb.core.find(find_all=True, backend=backend):
            vendor, product = one.idVendor, one.idProduct
            for maker, device, known, products in _KNOWN:
                if vendor == known and product in products:
                    seen.append((f"{maker} {vendor:04x}:{product:04x}", device))
    except usb.core.NoBackendError:
        unlisted = "; USB cannot be listed without libusb-1.0"
    except (usb.core.USBError, NotImplementedError) as error:
        unlisted = f"; USB cannot be listed: {error}"
    # Loading an SDK takes a second, and one of them greets the user.
    for device, maker in _SDKS.items() if unlisted else ():
        seen += [(f"{maker} {number}", device) for number in _listed(device)]
    words = [f"{name} (device={device})" if device else name for name, device in seen]
    return f"seen: {', '.join(words)}{unlisted}" if words else f"no depth camera is seen{unlisted}"


def _listed(device: str) -> list[str]:
    """The serial numbers that a vendor's SDK lists; none where it is not installed or fails."""
    try:
        # By name, because these modules import this one.
        module = importlib.import_module(f"toftrack.devices.{device}.device")
        return list(module.listed_serials())
    except Exception:  # what is said is of another camera
        return []
