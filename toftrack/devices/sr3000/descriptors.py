"""What an emulated SR3000 says of itself: USB descriptors in the form that pyusb expects.

Ids and endpoints are those of the camera; the rest is ordinary for a high-speed USB device of one
interface with two bulk endpoints.
"""

from __future__ import annotations

import array
from typing import Any

PACKET_BYTES = 512
"""Of a bulk endpoint at high speed."""
_VENDORS_OWN = 0xFF  # a class of devices
_SERIAL_NUMBER = 3  # number of the string


class Descriptor:
    """The fields of a descriptor; those that nobody states are 0."""

    extra_descriptors = ()

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)

    def __getattr__(self, name: str) -> int:
        return 0


def device(vendor: int, product: int, port: int, address: int) -> Descriptor:
    """The device descriptor, with its place on the bus."""
    return Descriptor(
        bLength=18,
        bDescriptorType=1,
        bcdUSB=0x0200,
        bDeviceClass=_VENDORS_OWN,
        bMaxPacketSize0=64,
        idVendor=vendor,
        idProduct=product,
        iSerialNumber=_SERIAL_NUMBER,
        bNumConfigurations=1,
        address=address,
        bus=1,
        port_numbers=(1 + port,),
        speed=3,
    )


def configuration(number: int) -> Descriptor:
    """The only configuration's descriptor; IndexError for another."""
    if number > 0:
        raise IndexError(number)
    return Descriptor(
        bLength=9,
        bDescriptorType=2,
        wTotalLength=32,
        bNumInterfaces=1,
        bConfigurationValue=1,
        bmAttributes=0xC0,
    )


def interface(number: int, index: int, alternate: int, config: int) -> Descriptor:
    """The only interface's descriptor, which has `number`; IndexError for another index."""
    if index > 0 or alternate > 0 or config > 0:
        raise IndexError((index, alternate, config))
    return Descriptor(
        bLength=9,
        bDescriptorType=4,
        bInterfaceNumber=number,
        bNumEndpoints=2,
        bInterfaceClass=_VENDORS_OWN,
    )


def endpoint(address: int) -> Descriptor:
    """A bulk endpoint's descriptor."""
    return Descriptor(
        bLength=7,
        bDescriptorType=5,
        bEndpointAddress=address,
        bmAttributes=2,
        wMaxPacketSize=PACKET_BYTES,
    )


def string(data: array.array, index: int, serial: str) -> int:
    """Answer a request for string `index` into `data`: 0 is the list of languages, else `serial`.

    Returns the number of bytes.
    """
    text = (0x0409).to_bytes(2, "little") if index == 0 else serial.encode("utf-16-le")
    content = bytes((2 + len(text), 3)) + text
    count = min(len(content), len(data))
    data[:count] = array.array("B", content[:count])
    return count
