"""A module like pyorbbecsdk as far as a camera needs it: no SDK, no camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

DEPTH, IR, LEFT_IR = "depth", "ir", "left_ir"


class OBError(Exception):
    """What the SDK raises, beside RuntimeError."""


class Profile:
    """A video stream profile."""

    def __init__(
        self,
        pixels: str,
        size: tuple[int, int] = (8, 6),
        fps: int = 30,
        lens: Sequence[float] = (0.0,) * 8,
        model: str | None = "brown_conrady",
    ) -> None:
        self._pixels, self._size, self._fps, self._lens, self._model = (
            pixels,
            size,
            fps,
            lens,
            model,
        )

    def is_video_stream_profile(self) -> bool:
        return True

    def as_video_stream_profile(self) -> Profile:
        return self

    def get_format(self) -> str:
        return self._pixels

    def get_width(self) -> int:
        return self._size[0]

    def get_height(self) -> int:
        return self._size[1]

    def get_fps(self) -> int:
        return self._fps

    def get_intrinsic(self) -> SimpleNamespace:
        return SimpleNamespace(fx=9.0, fy=8.0, cx=4.0, cy=3.0, width=8, height=6)

    def get_distortion(self) -> SimpleNamespace:
        names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
        reported = SimpleNamespace(**dict(zip(names, self._lens, strict=True)))
        if self._model is not None:  # the SDK before 2.1 does not tell it
            reported.model = self._model
        return reported


class Profiles:
    """The profiles of a sensor, the first of which is proposed."""

    def __init__(self, profiles: list[Profile]) -> None:
        self._profiles = profiles

    def get_count(self) -> int:
        return len(self._profiles)

    def get_stream_profile_by_index(self, index: int) -> Profile:
        return self._profiles[index]

    def get_default_video_stream_profile(self) -> Profile:
        return self._profiles[0]


class Image:
    """A frame."""

    def __init__(self, number: int, kind: str, dtype: Any = np.uint16, few: bool = False) -> None:
        self._number, self._kind, self._dtype, self._few = number, kind, dtype, few

    def as_video_frame(self) -> Image:
        return self

    def as_depth_frame(self) -> Image:
        return self

    def get_index(self) -> int:
        return self._number

    def get_timestamp_us(self) -> int:
        return 5_000_000 + 1000 * self._number

    def get_depth_scale(self) -> float:
        return 0.25

    def get_format(self) -> str:
        return "y8" if self._dtype == np.uint8 else "y16"

    def get_width(self) -> int:
        return 8

    def get_height(self) -> int:
        return 6

    def get_data(self) -> np.ndarray:
        image = np.full((6, 8), self._number % 200, self._dtype)
        return image.view(np.uint8).ravel()[: 5 if self._few else None]


class Images:
    """A set of frames: depth, and infrared where there is any."""

    def __init__(self, depth: Image | None, infrared: Image | None = None) -> None:
        self._depth, self._infrared = depth, infrared

    def get_depth_frame(self) -> Image | None:
        return self._depth

    def get_frame(self, kind: str) -> Image | None:
        assert kind in ("ir_frame", "left_ir_frame")
        return self._infrared


class Camera:
    """A plugged-in camera: its profiles by sensor, and the sets of frames that it sends."""

    def __init__(
        self, serial: str, profiles: dict[str, list[Profile]], sets: Sequence[Images] = ()
    ) -> None:
        self.serial, self.profiles, self.sets = serial, profiles, list(sets)
        self.plugged, self.pause_s = True, 0.0
        self.started: list[Profile] = []
        self.begun = threading.Event()

    def get_device_info(self) -> SimpleNamespace:
        return SimpleNamespace(
            get_name=lambda: "Femto Fake",
            get_serial_number=lambda: self.serial,
            get_firmware_version=lambda: "1.2.3",
        )


class Sdk(SimpleNamespace):
    """The module. `start_error` is what starting a camera raises."""

    def __init__(self, *cameras: Camera, start_error: str | None = None) -> None:
        sensors = {"DEPTH_SENSOR": DEPTH, "IR_SENSOR": IR, "LEFT_IR_SENSOR": LEFT_IR}
        models = ("none", "brown_conrady", "brown_conrady_k6", "kannala_brandt4")
        others = ("inverse_brown_conrady", "modified_brown_conrady")
        super().__init__(
            OBError=OBError,
            OBLogLevel=SimpleNamespace(NONE=5),
            OBFormat=SimpleNamespace(Y16="y16", Z16="z16", Y8="y8"),
            OBSensorType=SimpleNamespace(**sensors),
            OBFrameType=SimpleNamespace(IR_FRAME="ir_frame", LEFT_IR_FRAME="left_ir_frame"),
            OBFrameAggregateOutputMode=SimpleNamespace(FULL_FRAME_REQUIRE=0),
            OBCameraDistortionModel=SimpleNamespace(**{n.upper(): n for n in (*models, *others)}),
        )

        class Devices:
            def __init__(self) -> None:
                self._listed = [camera for camera in cameras if camera.plugged]

            def get_count(self) -> int:
                return len(self._listed)

            def get_device_serial_number_by_index(self, index: int) -> str:
                return self._listed[index].serial

            def get_device_by_index(self, index: int) -> Camera:
                return self._listed[index]

        class Context:
            @staticmethod
            def set_logger_level(level: int) -> None: ...

            def query_devices(self) -> Devices:
                return Devices()

        class Config:
            def __init__(self) -> None:
                self.streams: list[Profile] = []

            def enable_stream(self, profile: Profile) -> None:
                self.streams.append(profile)

            def set_frame_aggregate_output_mode(self, mode: int) -> None: ...

        class Pipeline:
            def __init__(self, camera: Camera) -> None:
                self._camera = camera
                self._thread: threading.Thread | None = None
                self._stopped = threading.Event()

            def get_stream_profile_list(self, sensor: str) -> Profiles:
                if sensor not in self._camera.profiles:
                    raise OBError("no such sensor")
                return Profiles(self._camera.profiles[sensor])

            def start(self, config: Config, callback: Callable[[Images], None]) -> None:
                if start_error is not None:
                    raise OBError(start_error)
                self._camera.started = config.streams
                self._stopped.clear()
                self._thread = threading.Thread(target=self._run, args=(callback,), daemon=True)
                self._thread.start()

            def _run(self, callback: Callable[[Images], None]) -> None:
                for images in self._camera.sets:
                    if self._stopped.is_set():
                        return
                    callback(images)
                    time.sleep(self._camera.pause_s)
                self._camera.begun.set()

            def stop(self) -> None:
                self._stopped.set()
                assert self._thread is not None
                self._thread.join()
                self._camera.started = []

        self.Context, self.Config, self.Pipeline = Context, Config, Pipeline
