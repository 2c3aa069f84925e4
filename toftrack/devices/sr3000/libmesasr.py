"""The SR3000 through the vendor's library `libmesasr`, which also loads the camera's firmware.

The C interface is that of the vendor's public header; see `toftrack.devices.sr3000.device` for use.
"""

from __future__ import annotations

import ctypes
from typing import Any

from toftrack.devices.sr3000.transport import Exposure, MesaSettings, NoAnswerError, UnpluggedError
from toftrack.errors import ToftrackError
from toftrack.recordings.sr_frame import HEIGHT, IMAGE_BYTES, WIDTH

_CAMERA = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "SR_OpenUSB": (ctypes.c_int, [ctypes.POINTER(_CAMERA), ctypes.c_uint]),
    "SR_Close": (ctypes.c_int, [_CAMERA]),
    "SR_Acquire": (ctypes.c_int, [_CAMERA]),
    "SR_GetImage": (ctypes.c_void_p, [_CAMERA, ctypes.c_ubyte]),
    "SR_GetRows": (ctypes.c_int, [_CAMERA]),
    "SR_GetCols": (ctypes.c_int, [_CAMERA]),
    "SR_SetTimeout": (None, [_CAMERA, ctypes.c_int]),
    "SR_SetIntegrationTime": (ctypes.c_int, [_CAMERA, ctypes.c_ubyte]),
    "SR_SetModulationFrequency": (ctypes.c_int, [_CAMERA, ctypes.c_int]),
    "SR_SetAmplitudeThreshold": (ctypes.c_int, [_CAMERA, ctypes.c_ushort]),
    "SR_SetMode": (ctypes.c_int, [_CAMERA, ctypes.c_int]),
}


class MesaTransport:
    """One camera, opened and read by the vendor's library; exposure: set when it is opened.

    serial: the last 8 digits of the printed number, which are hexadecimal, as 0x...; None = the
    first camera. ToftrackError where it is no number.
    """

    def __init__(
        self, settings: MesaSettings, exposure: Exposure, serial: str | None = None
    ) -> None:
        self._settings, self._exposure = settings, exposure
        self._serial = _number(serial)
        self._library: ctypes.CDLL | None = None
        self._camera: ctypes.c_void_p | None = None
        self.patience_s = settings.timeout_ms / 1000

    def check(self) -> None:
        self._library = self._library or _load(self._settings.library)

    def open(self) -> None:
        self.close()
        self.check()
        library = self._library
        assert library is not None
        camera = _CAMERA()
        opened = library.SR_OpenUSB(ctypes.byref(camera), self._serial)
        if opened <= 0 or not camera.value:
            wanted = f" with the serial number {self._serial:#010x}" if self._serial else ""
            raise ToftrackError(
                f"the vendor's library found no camera{wanted} that it can open (SR_OpenUSB gave "
                f"{opened}): plug the camera in and switch it on, close other programs that use "
                "it, and check the udev rule in docs/cameras.md"
            )
        self._camera = camera
        try:
            self._configure(library, camera)
        except BaseException:
            self.close()
            raise

    def acquire(self) -> bytes:
        library, camera = self._library, self._camera
        if library is None or camera is None:
            raise UnpluggedError("it is not open")
        result = library.SR_Acquire(camera)
        if result <= 0:
            raise NoAnswerError(f"SR_Acquire gave {result}")
        images = [library.SR_GetImage(camera, number) for number in (0, 1)]
        if not all(images):
            raise NoAnswerError("SR_GetImage gave no image")
        return b"".join(ctypes.string_at(image, IMAGE_BYTES) for image in images)

    def close(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None and self._library is not None:
            self._library.SR_Close(camera)

    def facts(self) -> dict[str, Any]:
        return {"library": self._settings.library, "serial": self._serial or None}

    def _configure(self, library: ctypes.CDLL, camera: ctypes.c_void_p) -> None:
        size = (library.SR_GetCols(camera), library.SR_GetRows(camera))
        if size != (WIDTH, HEIGHT):
            raise ToftrackError(
                f"the camera has {size[0]}x{size[1]} pixels, but an SR3000 has {WIDTH}x{HEIGHT}; "
                "only that is supported"
            )
        exposure = self._exposure
        library.SR_SetTimeout(camera, self._settings.timeout_ms)
        calls = [
            ("SR_SetMode", self._settings.mode),
            ("SR_SetModulationFrequency", exposure.modulation_code),
            ("SR_SetAmplitudeThreshold", exposure.amplitude_threshold),
        ]
        if exposure.integration_time is not None:
            calls.append(("SR_SetIntegrationTime", exposure.integration_time))
        for name, value in calls:
            result = getattr(library, name)(camera, value)
            if result < 0:
                raise ToftrackError(
                    f"the camera does not take its settings ({name}({value}) gave {result}); "
                    "change them in conf/device/sr3000.yaml"
                )


def _load(name: str) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(name)
    except OSError as error:
        raise ToftrackError(
            f"the vendor's library '{name}' cannot be loaded ({error}): install the vendor's "
            "package, or give the file's path with device.libmesasr.library=FILE, or use plain USB "
            "with device.transport=usb"
        ) from None
    for function, (result, arguments) in _SIGNATURES.items():
        try:
            symbol = getattr(library, function)
        except AttributeError:
            raise ToftrackError(
                f"the library '{name}' has no function {function}; it is not the vendor's, or of "
                "another version (1.0.14 is known to have it)"
            ) from None
        symbol.restype, symbol.argtypes = result, arguments
    return library


def _number(serial: str | None) -> int:
    if serial is None:
        return 0
    try:
        number = int(str(serial), 0)
    except ValueError:
        number = -1
    if not 0 <= number <= 0xFFFFFFFF:
        raise ToftrackError(
            f"device.serial={serial} is not a number, which the vendor's library needs; give the "
            "last 8 digits of the printed one as 0x4000002f"
        )
    return number
