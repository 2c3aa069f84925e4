"""A module like pyrealsense2 as far as a camera's errors need it: no SDK, no camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

K = SimpleNamespace(
    width=8, height=6, fx=9.0, fy=9.0, ppx=4.0, ppy=3.0, model="none", coeffs=[0.0] * 5
)


class Profile:
    """A stream profile."""

    def __init__(self, kind: str, pixels: str, size: tuple[int, int] = (8, 6), fps: int = 30):
        self._kind, self._pixels, self._size, self._fps = kind, pixels, size, fps

    def stream_type(self) -> str:
        return self._kind

    def format(self) -> str:
        return self._pixels

    def fps(self) -> int:
        return self._fps

    def stream_index(self) -> int:
        return 0

    def is_video_stream_profile(self) -> bool:
        return True

    def as_video_stream_profile(self) -> Profile:
        return self

    def width(self) -> int:
        return self._size[0]

    def height(self) -> int:
        return self._size[1]

    def get_intrinsics(self) -> SimpleNamespace:
        return K


class Sensor:
    """A sensor with two presets."""

    preset: float | None = None

    def __init__(self, profiles: list[Profile]) -> None:
        self._profiles = profiles

    def get_stream_profiles(self) -> list[Profile]:
        return self._profiles

    def supports(self, option: str) -> bool:
        return option == "visual_preset"

    def get_option_range(self, option: str) -> SimpleNamespace:
        return SimpleNamespace(min=0.0, max=1.0)

    def get_option_value_description(self, option: str, value: float) -> str:
        return ("Default", "High Accuracy")[round(value)]

    def set_option(self, option: str, value: float) -> None:
        self.preset = value


class Camera:
    """A plugged-in camera; `frames` are the numbers of those that it sends, None is silence."""

    def __init__(self, serial: str, profiles: list[Profile], frames: list[int | None]) -> None:
        self.serial, self.frames, self.plugged = serial, list(frames), True
        self.sensor = Sensor(profiles)

    def supports(self, info: str) -> bool:
        return info == "serial_number"

    def get_info(self, info: str) -> str:
        return self.serial

    def query_sensors(self) -> list[Sensor]:
        return [self.sensor]

    def is_connected(self) -> bool:
        return self.plugged


class Images:
    """A set of frames with depth only; also its depth frame."""

    def __init__(self, number: int) -> None:
        self._number = number

    def as_frameset(self) -> Images:
        return self

    def get_depth_frame(self) -> Images:
        return self

    def as_depth_frame(self) -> Images:
        return self

    def get_infrared_frame(self) -> None:
        return None

    def get_frame_number(self) -> int:
        return self._number

    def get_timestamp(self) -> float:
        return 1000.0 + self._number

    def get_units(self) -> float:
        return 0.001

    def get_data(self) -> np.ndarray:
        return np.full((6, 8), self._number % 1000, np.uint16)


class Sdk(SimpleNamespace):
    """The module. `start_error` is what starting a camera raises, `misses` what a wait finds."""

    def __init__(self, *cameras: Camera, start_error: str | None = None) -> None:
        names = ("name", "serial_number", "firmware_version")
        super().__init__(
            camera_info=SimpleNamespace(**{name: name for name in names}),
            stream=SimpleNamespace(depth="depth", infrared="infrared"),
            format=SimpleNamespace(z16="z16", y8="y8", y16="y16"),
            option=SimpleNamespace(visual_preset="visual_preset"),
            distortion=SimpleNamespace(none="none"),
            context=lambda: SimpleNamespace(devices=list(cameras)),
            config=lambda: SimpleNamespace(enable_stream=lambda *_: None),
            started=None,
        )
        sdk = self

        class Pipeline:
            def set_device(self, device: Camera) -> None:
                self._device = device

            def start(self, config: Any, queue: Any) -> None:
                if start_error is not None:
                    raise RuntimeError(start_error)
                sdk.started = self._device

            def stop(self) -> None:
                sdk.started = None

        class Queue:
            def __init__(self, capacity: int, keep: bool) -> None: ...

            def try_wait_for_frame(self, timeout_ms: int) -> tuple[bool, Images | None]:
                frames = sdk.started.frames
                number = frames.pop(0) if frames else None
                return number is not None, None if number is None else Images(number)

        self.pipeline, self.frame_queue = Pipeline, Queue
