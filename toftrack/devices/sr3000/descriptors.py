"""What an emulated SR3000 says of itself: USB descriptors in the form that pyusb expects.

Ids and endpoints are those of the camera; the rest is ordinary for a high-speed USB device of one
interface with two bulk endpoints.
"""

from __future__ import annotations

import array
from types import SimpleNamespace

PACKET_BYTES = 512
"""Of a bulk endpoint at high speed."""
_SERIAL_NUMBER = 3  # number of the string


def device(vendor: int, product: int, port: int, address: int) -> SimpleNamespace:
    """The device descriptor, with its place on the bus."""
    return SimpleNamespace(
        bLength=18,
        bDescriptorType=1,
        bcdUSB=0x0200,
        bDeviceClass=0xFF,
        bDeviceSubClass=0,
        bDeviceProtocol=0,
        bMaxPacketSize0=64,
        idVendor=vendor,
        idProduct=product,
        bcdDevice=0x0100,
        iManufacturer=0,
        iProduct=0,
        iSerialNumber=_SERIAL_NUMBER,
        bNumConfigurations=1,
        address=address,
        bus=1,
        port_number=1 + port,
        port_numbers=(1 + port,),
        speed=3,
    )


def configuration(number: int) -> SimpleNamespace:
    """The only configuration's descriptor; IndexError for another."""
    if number > 0:
        raise IndexError(number)
    return SimpleNamespace(
        bLength=9,
        bDescriptorType=2,
        wTotalLength=32,
        bNumInterfaces=1,
        bConfigurationValue=1,
        iConfiguration=0,
        bmAttributes=0xC0,
        bMaxPower=0,
        extra_descriptors=[],
    )


def interface(number: int, index: int, alternate: int, config: int) -> SimpleNamespace:
    """The only interface's descriptor, which has `number`; IndexError for another index."""
    if index > 0 or alternate > 0 or config > 0:
        raise IndexError((index, alternate, config))
    return SimpleNamespace(
        bLength=9,
        bDescriptorType=4,
        bInterfaceNumber=number,
        bAlternateSetting=0,
        bNumEndpoints=2,
        bInterfaceClass=0xFF,
        bInterfaceSubClass=0,
        bInterfaceProtocol=0,
        iInterface=0,
        extra_descriptors=[],
    )


def endpoint(address: int) -> SimpleNamespace:
    """A bulk endpoint's descriptor."""
    return SimpleNamespace(
        bLength=7,
        bDescriptorType=5,
        bEndpointAddress=address,
        bmAttributes=2,
        wMaxPacketSize=PACKET_BYTES,
        bInterval=0,
        bRefresh=0,
        bSynchAddress=0,
        extra_descriptors=[],
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
