"""The poses of a finished run, as they were tracked: the joint angles in its track.npz."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from toftrack.archives import read_archive
from toftrack.errors import ToftrackError, reported_errors
from toftrack.hand.skeleton import ANGLE_NAMES
from toftrack.pose_space.data.pose_data import CLIP, PoseData, spread_out
from toftrack.pose_space.data.pose_files import within_limits

_TRACK = "track.npz"
_ANGLES = slice(6, 6 + len(ANGLE_NAMES))
"""Of the state."""


def run_data(path: str, poses: int | None, confidence: float) -> PoseData:
    """Joint angles of the frames of a run that can be used; of several hands those of all.

    Poses that follow each other are a clip, as neighbours in time resemble each other.

    path: the run's output folder, or the track.npz in it.
    poses: at most so many, picked to cover what was shown; None keeps all.
    confidence: frames of which the tracker was less sure, 0..1, are left out.

    Raises ToftrackError when the file is missing or no track.npz, or too few frames are left.
    """
    place = Path(path).expanduser()
    place = place / _TRACK if place.is_dir() else place
    states, sure, usable = _read(place)
    # The frames of a hand one after another: (T, slots, 27) to (slots * T, 27).
    kept = usable & (sure >= confidence) & np.isfinite(states).all(-1)
    angles = states[kept][:, _ANGLES].astype(np.float64)
    if len(angles) < 2:
        raise ToftrackError(
            f"the run {place} has {len(angles)} frames that are not lost and at least"
            f" {confidence:g} sure, of {len(kept)}; give a longer recording, or a smaller"
            " data.confidence"
        )
    radians, note = within_limits(str(place), angles)
    covering = spread_out(torch.from_numpy(radians), poses or len(radians)).numpy()
    clips = np.arange(len(radians))[covering] // CLIP
    name = place.parent.name if place.name == _TRACK else place.stem
    source = {"data": "run", "file": name, "poses": len(covering)}
    return PoseData(
        torch.from_numpy(radians[covering]),
        (name or "run",) * len(covering),
        torch.from_numpy(clips),
        (source,),
        (f"{place}: {len(covering)} of {len(kept)} poses{note}",),
    )


def _read(place: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (N, 27), confidences (N,) and which can be used (N,), the slots one after another."""
    remedy, no_track = (
        "give data.path=RUN, the output folder of a run",
        "is not the track.npz of a run",
    )
    with (
        reported_errors(f"{place} cannot be read", remedy),
        reported_errors(f"{place} {no_track}", remedy, ValueError),
    ):
        content = read_archive(place, {"state", "lost", "confidence", "dropped"})
    state, lost = content.get("state"), content.get("lost")
    if (
        state is None
        or lost is None
        or state.dtype.kind != "f"
        or lost.dtype != bool
        or state.ndim not in (2, 3)
        or state.shape != (*lost.shape, 6 + len(ANGLE_NAMES))
    ):
        raise ToftrackError(
            f"{place} is not the track.npz of a run: it has no states of"
            f" {6 + len(ANGLE_NAMES)} numbers; give data.path=RUN, the output folder of a run"
        )
    sure = content.get("confidence", np.ones(lost.shape))
    # A dropped frame repeats the one before.
    dropped = content.get("dropped", np.zeros(len(lost), bool))
    if sure.shape != lost.shape or dropped.shape != lost.shape[:1]:
        raise ToftrackError(f"{place} is damaged: its arrays are of different lengths")
    usable = ~lost & ~dropped.astype(bool).reshape(-1, *[1] * (lost.ndim - 1))
    hands = state.reshape(len(state), -1, state.shape[-1]).swapaxes(0, 1)
    flat = [array.reshape(len(state), -1).T.ravel() for array in (sure, usable)]
    return hands.reshape(-1, state.shape[-1]), flat[0], flat[1]
