"""How good the pose network is on single frames of recordings with truth, about the true palm:

python -m toftrack.programs.measure_detector FOLDER_OR_FILE ... --weights FILE --weights OTHER

Nothing is tracked and nothing searched for: the crop lies about the true middle of the palm, the
fingers point up in it (unless --as-held is given), the side is told, and the keypoints are compared
with the true joints, in frames in which the hand is visible. The network runs as the tracker runs
it: in ONNX Runtime if its file lies beside the weights, else in torch, which is said.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from toftrack.checks import check_number
from toftrack.compute.rigid import PIVOT_M
from toftrack.detector.network import PoseNet
from toftrack.detector.onnx_networks import OnnxPoseNet, load_networks
from toftrack.detector.proposals_numba import run_pose_network
from toftrack.errors import ToftrackError
from toftrack.frames import Truth
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.programs import command_line
from toftrack.recordings.npz import Recording, read_recording
from toftrack.safe_files import write_whole

RIGHT_M = 0.04
"""A frame is right when every joint is within this."""
_MIDDLE = -PIVOT_M[1] / float(default_hand_shape(DEFAULT_HAND_LENGTH_M).base_m[2].norm())
"""How far from the wrist to the middle finger's knuckle the middle of the palm is."""


@dataclass(frozen=True, eq=False)
class Misses:
    """Of F frames: error_m (F, 21), and the names of recording and pose of each."""

    error_m: np.ndarray
    recording: np.ndarray
    pose: np.ndarray

    def figures(self, rows: np.ndarray | slice = slice(None)) -> dict[str, float]:
        """Mean error, mm, and the shares of frames whose joints all are right."""
        error = self.error_m[rows]
        if len(error) == 0:
            return {"frames": 0}
        return {
            "frames": len(error),
            "mean_mm": round(1e3 * float(error.mean()), 2),
            "median_mm": round(1e3 * float(np.median(error)), 2),
            "within_40_mm": round(100 * float((error.max(1) < RIGHT_M).mean()), 1),
        }

    def tables(self) -> dict[str, dict[str, dict[str, float]]]:
        """Figures of all frames, by pose and by recording."""
        tables = {"all": {"all": self.figures()}}
        for key, names in (("pose", self.pose), ("recording", self.recording)):
            tables[key] = {
                str(name): self.figures(np.flatnonzero(names == name)) for name in np.unique(names)
            }
        return tables


def misses(
    pose: PoseNet | OnnxPoseNet, paths: Sequence[Path], every: int, as_held: bool = False
) -> Misses:
    """Errors of a network's keypoints in every so manieth visible frame of recordings.

    as_held: crops as the camera is held, and not turned so that the fingers point up.
    Raises ToftrackError for a recording without truth or without a side.
    """
    errors, recordings, poses = [], [], []
    for path in paths:
        recording, truth = _with_truth(path)
        for frame in np.flatnonzero(truth.visible)[::every]:
            depth, joints = recording.image(int(frame))[0], truth.joints_m[frame]
            centre = joints[0] + _MIDDLE * (joints[9] - joints[0])
            up = None if as_held else (joints[9] - joints[0])[None]
            seen = run_pose_network(pose, depth, recording.camera.K, centre[None], truth.side, up)
            errors.append(np.linalg.norm(seen.keypoints_m[0].numpy() - joints, axis=1))
            recordings.append(path.stem)
            poses.append("" if truth.pose_name is None else str(truth.pose_name[frame]))
    return Misses(np.array(errors).reshape(-1, 21), np.array(recordings), np.array(poses))


def _with_truth(path: Path) -> tuple[Recording, Truth]:
    recording = read_recording(path)
    truth = recording.truth
    if truth is None or not truth.side:
        raise ToftrackError(f"{path} has no true joints, or does not say whose hand it is")
    if recording.radial:
        raise ToftrackError(f"{path} holds distances along rays; give one with depth_m")
    return recording, truth


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, measure, print the table. Raises ToftrackError."""
    options = _parser().parse_args(arguments)
    check_number("--every", options.every, 1, whole=True)
    paths = [path for given in options.recordings for path in _recordings(given)]
    weights = options.weights or [None]
    tables = {}
    for file in weights:
        pose, _ = load_networks(file)
        name = "the package's" if file is None else str(file)
        tables[name] = misses(pose, paths, options.every, options.as_held).tables()
    _print(tables)
    if options.json is not None:
        write_whole(options.json, json.dumps(tables, indent=1) + "\n")


def _print(tables: dict[str, dict[str, dict[str, dict[str, float]]]]) -> None:
    for number, name in enumerate(tables, 1):
        print(f"weights {number}: {name}")
    print("mean error of the keypoints, mm / frames with all joints within 40 mm")
    first = next(iter(tables.values()))
    for part, rows in first.items():
        for row, figures in rows.items():
            cells = [
                f"{table[part][row]['mean_mm']:6.1f} / {table[part][row]['within_40_mm']:5.1f} %"
                for table in tables.values()
            ]
            print(f"{part:10} {row:24} {figures['frames']:5} frames  " + "   ".join(cells))


def _recordings(given: Path) -> list[Path]:
    """A recording, or those in a folder."""
    paths = sorted(given.glob("*.npz")) if given.is_dir() else [given]
    if not paths:
        raise ToftrackError(f"there are no recordings (.npz) in {given}")
    return paths


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m toftrack.programs.measure_detector",
        description="Errors of the pose network's keypoints on single frames with truth.",
    )
    parser.add_argument("recordings", nargs="+", type=Path, help="files or folders of .npz files")
    parser.add_argument(
        "--weights", action="append", metavar="FILE", help="of train_detector; several are compared"
    )
    parser.add_argument("--every", type=int, default=1, help="every so manieth frame (1)")
    parser.add_argument(
        "--as-held",
        action="store_true",
        help="look as at a new hand: crops as the camera is held, not turned upright",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    return parser


if __name__ == "__main__":
    sys.exit(command_line.run(main))
