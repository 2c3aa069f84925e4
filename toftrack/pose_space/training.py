"""What `python train_pose_space.py` does: fit, report, write the model and two figures."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from toftrack.errors import ToftrackError
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.files import fit_pose_space, save_pose_space
from toftrack.pose_space.training_poses import synthetic_training_poses
from toftrack.views.pose_figures import corners_figure, poses_figure

_PAPER_VARIANCE = {3: 97.4, 4: 97.5}


def train(config: DictConfig) -> float:
    """Learn the configured space; returns the root mean square reconstruction error in degrees."""
    settings = config.pose_space
    if settings.file is not None:
        raise ToftrackError(
            "pose_space.file names a model to use, not to train; leave it out, the new model is"
            " written into the output folder"
        )
    folder = Path(HydraConfig.get().runtime.output_dir)
    poses = synthetic_training_poses()
    space = fit_pose_space(settings.kind, settings.dims)
    error = reconstruction_error_degrees(space)
    print(f"{len(poses.labels)} training poses, {space.kind}, {space.dims} dimensions")
    print(_variance_table(space))
    print(f"reconstruction error on the training poses: {error:.2f} degrees rms")

    model = folder / "pose_space.npz"
    save_pose_space(space, model)
    figures = {"poses.png": poses_figure(space), "corners.png": corners_figure(space)}
    for name, picture in figures.items():
        if not cv2.imwrite(str(folder / name), picture):
            raise ToftrackError(
                f"{folder / name} cannot be written; give another hydra.run.dir=DIR"
            )
    print("\n".join(f"  {folder / name}" for name in (model.name, *figures)))
    print(f"use it: python track.py pose_space={space.kind} pose_space.file={model}")
    return error


def reconstruction_error_degrees(space: PoseSpace) -> float:
    """Root mean square over poses and angles of decode(encode(x)) - x on the training poses."""
    angles = synthetic_training_poses().angles_rad.to(space.lower.dtype)
    residual = space.decode(space.encode(angles)) - angles
    return math.degrees(float(residual.square().mean().sqrt()))


def _variance_table(space: PoseSpace) -> str:
    ratios = getattr(space, "explained_variance_ratio", None)
    if ratios is None:
        return "this space has no explained variance per component"
    rows = ["components   variance   together   paper"]
    for number in range(1, 9):
        paper = f"{_PAPER_VARIANCE[number]:6.1f} %" if number in _PAPER_VARIANCE else "       -"
        alone, together = 100 * float(ratios[number - 1]), 100 * float(ratios[:number].sum())
        rows.append(f"{number:10d} {alone:8.2f} % {together:8.2f} % {paper}")
    return "\n".join(rows)
