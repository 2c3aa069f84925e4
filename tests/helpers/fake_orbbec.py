"""A module like pyorbbecsdk as far as a camera needs it: no SDK, no camera."""

import threading
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

DEPTH, IR, LEFT_IR = "depth", "ir", "left_ir"


class OBError(Exception):
    """What the SDK raises, beside RuntimeError."""


class Getters:
    """An object of the SDK: `get_x()` is the attribute x, `as_y()` and `is_y()` are itself."""

    def __init__(self, **values: Any) -> None:
        self.values = values

    def __getattr__(self, name: str) -> Callable[..., Any]:
        kind, _, rest = name.partition("_")
        if kind in ("as", "is"):
            return lambda: self
        if kind == "get" and rest in self.values:
            return lambda: self.values[rest]
        raise AttributeError(name)


def profile(
    pixels: str,
    size: tuple[int, int] = (8, 6),
    fps: int = 30,
    lens: Sequence[float] = (0.0,) * 8,
    model: str | None = "brown_conrady",
) -> Getters:
    """A video stream profile.  model: of the lens; None: the SDK before 2.1 does not tell it."""
    distortion = dict(zip(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"), lens, strict=True))
    return Getters(
        format=pixels,
        width=size[0],
        height=size[1],
        fps=fps,
        intrinsic=SimpleNamespace(fx=9.0, fy=8.0, cx=4.0, cy=3.0, width=8, height=6),
        distortion=SimpleNamespace(**distortion, **({} if model is None else {"model": model})),
    )


def image(number: int, dtype: Any = np.uint16, few: bool = False) -> Getters:
    """A frame.  few: it has too few bytes."""
    pixels = np.full((6, 8), number % 200, dtype).view(np.uint8).ravel()
    return Getters(
        index=number,
        timestamp_us=5_000_000 + 1000 * number,
        system_timestamp_us=9_000_000 + 1000 * number,
        depth_scale=0.25,
        format="y8" if dtype == np.uint8 else "y16",
        width=8,
        height=6,
        data=pixels[: 5 if few else None],
    )


class Images:
    """A set of frames: depth, and infrared where there is any."""

    def __init__(self, depth: Getters | None, infrared: Getters | None = None) -> None:
        self._depth, self._infrared = depth, infrared

    def get_depth_frame(self) -> Getters | None:
        return self._depth

    def get_frame(self, kind: str) -> Getters | None:
        assert kind in ("ir_frame", "left_ir_frame")
        return self._infrared


class Camera:
    """A plugged-in camera: its profiles by sensor, and the sets of frames that it sends."""

    def __init__(
        self, serial: str, profiles: dict[str, list[Getters]], sets: Sequence[Images] = ()
    ) -> None:
        self.serial, self.profiles, self.sets = serial, profiles, list(sets)
        self.plugged = True
        self.started: list[Getters] = []

    def get_device_info(self) -> Getters:
        return Getters(name="Femto Fake", serial_number=self.serial, firmware_version="1.2.3")


class Sdk(SimpleNamespace):
    """The module. `start_error` is what starting a camera raises."""

    def __init__(self, *cameras: Camera, start_error: str | None = None) -> None:
        models = ("none", "brown_conrady", "brown_conrady_k6", "kannala_brandt4")
        others = ("inverse_brown_conrady", "modified_brown_conrady")
        formats = "y8 y10 y11 y12 y14 y16 z16 rle rvl mjpg"
        super().__init__(
            OBError=OBError,
            OBLogLevel=SimpleNamespace(NONE=5),
            OBFormat=SimpleNamespace(**{name.upper(): name for name in formats.split()}),
            OBSensorType=SimpleNamespace(DEPTH_SENSOR=DEPTH, IR_SENSOR=IR, LEFT_IR_SENSOR=LEFT_IR),
            OBFrameType=SimpleNamespace(IR_FRAME="ir_frame", LEFT_IR_FRAME="left_ir_frame"),
            OBFrameAggregateOutputMode=SimpleNamespace(FULL_FRAME_REQUIRE=0),
            OBCameraDistortionModel=SimpleNamespace(**{n.upper(): n for n in (*models, *others)}),
        )

        def devices(*_: Any) -> SimpleNamespace:
            listed = [camera for camera in cameras if camera.plugged]
            return SimpleNamespace(
                get_count=lambda: len(listed),
                get_device_serial_number_by_index=lambda index: listed[index].serial,
                get_device_by_index=lambda index: listed[index],
            )

        class Context:
            set_logger_level = staticmethod(lambda level: None)
            query_devices = devices

        class Config:
            def __init__(self) -> None:
                self.streams: list[Getters] = []
                self.enable_stream = self.streams.append

            def set_frame_aggregate_output_mode(self, mode: int) -> None: ...

        class Pipeline:
            def __init__(self, camera: Camera) -> None:
                self._camera, self._stopped = camera, threading.Event()
                self._thread: threading.Thread | None = None

            def get_stream_profile_list(self, sensor: str) -> SimpleNamespace:
                if sensor not in self._camera.profiles:
                    raise OBError("no such sensor")
                profiles = self._camera.profiles[sensor]
                return SimpleNamespace(
                    get_count=lambda: len(profiles),
                    get_stream_profile_by_index=lambda index: profiles[index],
                    get_default_video_stream_profile=lambda: profiles[0],
                )

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

            def stop(self) -> None:
                self._stopped.set()
                assert self._thread is not None
                self._thread.join()
                self._camera.started = []

        self.Context, self.Config, self.Pipeline = Context, Config, Pipeline
