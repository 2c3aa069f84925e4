"""What is known of a run: its metadata, the sentence it begins with, and the hand's size."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from toftrack.devices.base import Device
from toftrack.errors import ToftrackError
from toftrack.hand.shape import HandShape
from toftrack.output.summary import shape_file
from toftrack.tracking.tracker import HandsTracker

_APART_S = 1.0


def run_metadata(config: DictConfig, device: Device, tracker: HandsTracker) -> dict[str, Any]:
    """The metadata of run.json and track.npz, JSON-able.

    The hand's shape is the first slot's at the start, its side 'auto' where none was given.
    """
    camera, shape = device.camera, tracker.shapes[0]
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
            "side": configured_side(config, shape.side) or "auto",
            "fitted": tracker.model.fits,
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


def configured_side(config: Mapping[str, Any], side: str) -> str | None:
    """The side that was given; None where either hand may come, or both.

    config: of the run.  side: of the hand that is looked for.
    """
    configured = config.get("hands", 1) == 1 and (config.get("hand") or {}).get("side") != "auto"
    return side if configured else None


def opening(metadata: dict[str, Any], device: Device) -> str:
    """What is tracked, how many hands, which side, which size: one line to begin with."""
    about, shape, config = metadata["device"], metadata["hand_shape"], metadata["config"]
    source = about.get("recording") or about.get("device")
    count = "live" if device.frames is None else f"{device.frames} frames"
    side = shape["side"]
    length_mm = 1e3 * float(shape["hand_length_m"])
    fitted = "to be fitted from" if shape["fitted"] else "of"
    if config.get("hands", 1) > 1:
        what = "up to two hands, their lengths"
    elif side == "auto":
        what = "a hand of either side (hand.side=right or left to say which), its length"
    else:
        other = "left" if side == "right" else "right"
        what = f"a {side} hand (hand.side={other} for the other), its length"
    return f"tracking {source} ({count}): {what} {fitted} {length_mm:.0f} mm"


class ShapeFiles:
    """The hands' files of a run, hand_shape.json and of a second slot hand_shape_2.json.

    They are there from the start on and follow what is fitted. Between the first and the last time
    they are a second old at most: they serve runs that are killed.
    """

    def __init__(self, folder: Path, tracker: HandsTracker) -> None:
        self._tracker, count = tracker, len(tracker.states)
        self._paths = [folder / shape_file(slot) for slot in range(count)]
        self._saved: list[HandShape | None] = [None] * count
        self._saved_s = [-math.inf] * count

    def save(self, last: bool = False) -> None:
        """Write the present hands, where they are others than were written.

        Raises ToftrackError when that is not possible; before the last time, it may be later.
        """
        now_s = time.monotonic()
        for slot, (path, shape) in enumerate(zip(self._paths, self._tracker.fitted, strict=True)):
            due = last or now_s > self._saved_s[slot] + _APART_S
            if shape is self._saved[slot] or not due:
                continue
            self._saved_s[slot] = now_s
            try:
                shape.to("cpu").save(path)
            except OSError as error:
                if last:
                    raise ToftrackError(
                        f"'{path}' cannot be written ({error.strerror or error}); make room, or "
                        "choose another folder with hydra.run.dir=DIR"
                    ) from error
            else:
                self._saved[slot] = shape
