"""What a `.srs` recording says of its camera and of itself, and the text of its TOFT object."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from toftrack.camera import Camera
from toftrack.errors import ToftrackError
from toftrack.json_text import parse_json
from toftrack.recordings.npz import DEFAULT_FPS
from toftrack.recordings.sr_frame import HEIGHT, WIDTH


@dataclass(frozen=True)
class SrsInit:
    """Which camera made the recording."""

    product_id: int = 0x0074
    interface_type: int = 0
    serial_number: int = 0


@dataclass(frozen=True)
class SrsFacts:
    """What toftrack adds to the format."""

    range_m: float | None = None
    """What the largest distance word stands for; None = not stated."""
    camera: Camera | None = None
    """None = not stated."""
    fps: float = DEFAULT_FPS
    metadata: dict[str, Any] = field(default_factory=dict)


def facts_text(facts: SrsFacts) -> bytes:
    """The content of a TOFT object."""
    content = {
        "range_m": facts.range_m,
        "fps": facts.fps,
        "camera": facts.camera and facts.camera.to_dict(),
        "metadata": facts.metadata,
    }
    return json.dumps(content).encode()


def parse_facts(path: Path, text: bytes) -> SrsFacts:
    """What the content of a TOFT object says; `path` is for the message.

    Raises ToftrackError: what the recorder stated must not be replaced by a guess in silence.
    """
    damaged = ToftrackError(f"the TOFT object of the recording '{path}' is damaged")
    try:
        content = parse_json(text)
        range_m, fps = content["range_m"], float(content["fps"])
        range_m = None if range_m is None else float(range_m)
        camera, metadata = content["camera"], content["metadata"]
    except (ValueError, TypeError, KeyError):
        raise damaged from None
    for number in (fps, 1.0 if range_m is None else range_m):
        if not (np.isfinite(number) and number > 0):
            raise damaged
    if not isinstance(metadata, dict):
        raise damaged
    camera = None if camera is None else Camera.from_dict(camera, path)
    if camera is not None and (camera.width, camera.height) != (WIDTH, HEIGHT):
        raise damaged
    return SrsFacts(range_m, camera, fps, metadata)
