"""Pose-space model files: arrays and JSON in one .npz, never pickled objects."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from toftrack.errors import ToftrackError
from toftrack.hand.skeleton import ANGLE_NAMES
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.pca import PCAPoseSpace, fit_pca
from toftrack.pose_space.training_poses import synthetic_training_poses

FORMAT = "toftrack-pose-space"
VERSION = 1

_KINDS: dict[str, type] = {PCAPoseSpace.kind: PCAPoseSpace}
_FITS: dict[str, Callable[..., PoseSpace]] = {PCAPoseSpace.kind: fit_pca}


def fit_pose_space(kind: str = "pca", dims: int = 4) -> PoseSpace:
    """Learn a pose space of a kind from the synthetic training poses."""
    if kind not in _FITS:
        raise ToftrackError(f"pose_space kind {kind!r} is unknown; known: {', '.join(_FITS)}")
    poses = synthetic_training_poses()
    return _FITS[kind](poses.angles_rad, poses.labels, dims)


def save_pose_space(space: PoseSpace, path: str | Path) -> None:
    """Write a model file."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "kind": space.kind,
        "angle_names": ANGLE_NAMES,
        "training_labels": space.training_labels,
    }
    arrays = {name: tensor.cpu().numpy() for name, tensor in space.arrays().items()}
    with open(path, "wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def load_pose_space(path: str | Path) -> PoseSpace:
    """Read a model file; ToftrackError when it is not one of this version and size."""
    advice = "make one with train_pose_space.py"
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            arrays = {name: archive[name] for name in archive.files if name != "header"}
    except FileNotFoundError:
        raise ToftrackError(f"no pose-space file at {path}; {advice}") from None
    except (OSError, ValueError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise ToftrackError(f"{path} is not a pose-space file ({error}); {advice}") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ToftrackError(f"{path} is not a pose-space file; {advice}")
    if header.get("version") != VERSION:
        raise ToftrackError(
            f"{path} is a pose space of version {header.get('version')} and this toftrack reads"
            f" version {VERSION}; {advice}"
        )
    if header.get("kind") not in _KINDS:
        raise ToftrackError(f"{path} holds a pose space of unknown kind {header.get('kind')!r}")
    if tuple(header.get("angle_names", ())) != ANGLE_NAMES:
        raise ToftrackError(
            f"{path} describes other joint angles than the {len(ANGLE_NAMES)} of this"
            f" hand; {advice}"
        )
    try:
        tensors = {name: torch.from_numpy(array).float() for name, array in arrays.items()}
        space = _KINDS[header["kind"]](
            **tensors, training_labels=tuple(header.get("training_labels", ()))
        )
        angles = space.decode(space.training_latents)
    except (TypeError, RuntimeError, IndexError, ValueError) as error:
        raise ToftrackError(f"{path} is a damaged pose-space file ({error}); {advice}") from None
    if angles.shape[-1] != len(ANGLE_NAMES) or space.lower.shape != (space.dims,):
        raise ToftrackError(
            f"{path} is a pose space of another size ({angles.shape[-1]} angles); {advice}"
        )
    return space


def make_pose_space(kind: str = "pca", dims: int = 4, file: str | None = None) -> PoseSpace:
    """The pose space of a configuration: read from `file`, or learned on the spot when None."""
    if file is None:
        return fit_pose_space(kind, dims)
    space = load_pose_space(file)
    if space.kind != kind or space.dims != dims:
        raise ToftrackError(
            f"{file} is a {space.dims}-dimensional {space.kind} space and the configuration"
            f" asks for a {dims}-dimensional {kind}; give pose_space={space.kind}"
            f" pose_space.dims={space.dims}"
        )
    return space
