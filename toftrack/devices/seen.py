"""Which depth cameras this computer sees, for the sentence of one that was not found."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import usb.core

_OLD_ORBBEC = "(040[1-4]|060f|063[2-8]|0668)"
_KNOWN = {
    "RealSense (device=realsense)": "8086:(0a(d[1-6]|f6|f[ef])|0b(0[0137]|3a|4[9bd]|5[26bc])"
    "|1155|abcd)",
    "RealSense L515 or SR300 (no longer in its SDK)": "8086:(0a(66|80|a5)|0b(3d|48|6[48]))",
    "Orbbec (device=orbbec)": f"2bc5:(?!{_OLD_ORBBEC})",
    "Orbbec Astra, Astra+ or first Femto (not in its SDK 2)": f"2bc5:{_OLD_ORBBEC}",
    "SwissRanger (device=sr3000)": "0852:0074|1ad2:007[45]",
    **{"Azure Kinect": "045e:097c", "Kinect V2": "045e:02(c4|d8)", "Kinect": "045e:02ae"},
    **{"Luxonis": "03e7:(2485|f63b)", "Stereolabs": "2b03:", "pmd": "1c28:", "PrimeSense": "1d27:"},
}
"""Patterns of USB ids."""


def cameras_seen(backend: Any = None) -> str:
    """What is connected, in words: on USB or, where that cannot be listed, what the SDKs list that
    are installed; raises nothing.  backend: of pyusb; None = libusb.
    """
    unlisted = ""
    try:
        found = usb.core.find(find_all=True, backend=backend)
        ids = [f"{one.idVendor:04x}:{one.idProduct:04x}" for one in found]
        seen = [name for id in ids for name, known in _KNOWN.items() if re.match(known, id)]
    except (usb.core.NoBackendError, usb.core.USBError) as error:
        unlisted = f"; USB cannot be listed, which needs libusb-1.0 and permission: {error}"
        seen = list(_by_sdks())
    return (f"seen: {', '.join(seen)}" if seen else "no depth camera is seen") + unlisted


def _by_sdks() -> Iterator[str]:
    for name, count in (
        ("realsense", lambda rs: len(rs.context().devices)),
        ("orbbec", lambda ob: ob.Context().query_devices().get_count()),
    ):
        with suppress(Exception):  # whatever it is, the sentence is of another camera
            # By name, because these modules import this one.
            sdk = importlib.import_module(f"toftrack.devices.{name}.device").load_sdk()
            yield from count(sdk) * [next(words for words in _KNOWN if f"={name})" in words)]
