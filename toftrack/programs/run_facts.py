"""What is known of a run: its metadata, the sentence it begins with, and the hand's size."""

from __future__ import annotations

import math
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from toftrack.devices.base import Device
from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape
from toftrack.output.files import save_whole
from toftrack.tracking.tracker import Tracker

_APART_S = 1.0


def run_metadata(config: DictConfig, device: Device, tracker: Tracker) -> dict[str, Any]:
    """The metadata of run.json and track.npz, JSON-able."""
    camera, shape = device.camera, tracker.shape
    return {
        "toftrack": version("toftrack"),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "seed": config.seed,
        "compute": str(tracker.device),
        "renderer": tracker.scorer.name,
        "device": device.description,
        "pose_space": {"kind": tracker.space.kind, "dims": tracker.space.dims},
        "hand_shape": {
            "side": shape.side,
            "fitted": tracker.model.fit is not None,
            "thickness": shape.thickness,
            "hand_length_m": shape.hand_length_m,
            "bone_lengths_m": shape.bone_lengths_m.tolist(),
        },
        "camera": {
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
            "distortion": camera.distortion.tolist(),
            "lens": camera.lens,
            "depth_polynomial": list(camera.depth_polynomial),
        },
        "config": OmegaConf.to_container(config, resolve=True),
    }


def opening(metadata: dict[str, Any], device: Device) -> str:
    """What is tracked, which side, which size: one line to begin with."""
    about, side = metadata["device"], metadata["hand_shape"]["side"]
    source = about.get("recording") or about.get("device")
    count = "live" if device.frames is None else f"{device.frames} frames"
    other = "left" if side == "right" else "right"
    length_mm = 1e3 * float(metadata["hand_shape"]["hand_length_m"])
    fitted = "fitted from" if metadata["hand_shape"]["fitted"] else "of"
    return (
        f"tracking {source} ({count}): a {side} hand (hand.side={other} for the other), its length "
        f"{fitted} {length_mm:.0f} mm"
    )


class ShapeFile:
    """hand_shape.json of a run, which is there from the start on and follows what is fitted.

    Between the first and the last time it is a second old at most: it serves runs that are killed.
    """

    def __init__(self, folder: Path, tracker: Tracker) -> None:
        self._path = folder / "hand_shape.json"
        self._tracker = tracker
        self._saved: HandShape | None = None
        self._saved_s = -math.inf

    def save(self, last: bool = False) -> None:
        """Write the present hand, where it is another than was written.

        Raises ToftrackError when that is not possible; before the last time, it may be later.
        """
        shape = self._tracker.fitted
        now_s = time.monotonic()
        if shape is self._saved or not (last or now_s > self._saved_s + _APART_S):
            return
        self._saved_s = now_s
        try:
            save_whole(self._path, shape.to("cpu").save)
        except OSError as error:
            if last:
                raise ToftrackError(
                    f"'{self._path}' cannot be written ({error.strerror or error}); make room, or "
                    "choose another folder with hydra.run.dir=DIR"
                ) from error
            return
        self._saved = shape
