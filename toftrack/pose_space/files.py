"""Pose-space model files: arrays and JSON in one .npz, never pickled objects."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from threadpoolctl import threadpool_limits

from toftrack.configuration.plugins import installed, named_object
from toftrack.errors import ToftrackError, check_choice, check_format, reported_errors
from toftrack.files.archives import read_archive, write_archive
from toftrack.files.json_text import parse_json
from toftrack.hand.skeleton import ANGLE_NAMES
from toftrack.pose_space.base import PoseSpace
from toftrack.pose_space.data.pose_data import PoseData, natural_data, synthetic_data
from toftrack.pose_space.kernel import IsomapPoseSpace, KernelPCAPoseSpace, LLEPoseSpace
from toftrack.pose_space.pca import PCAPoseSpace

FORMAT = "toftrack-pose-space"
VERSION = 1
_ADVICE = "make one with toftrack train"
_NATURAL = 120
_DATA: dict[str, Callable[[], PoseData]] = {
    "natural": partial(natural_data, _NATURAL),
    "synthetic": synthetic_data,
}
_SAME_RAD = 1e-6
"""Poses that differ by less than this in every angle are the same."""
_OWN = (IsomapPoseSpace, KernelPCAPoseSpace, LLEPoseSpace, PCAPoseSpace)
KINDS: dict[str, type[PoseSpace]] = {space.kind: space for space in _OWN}
"""Every kind of toftrack's own."""


def kind_of_space(kind: str, of_file: str | None = None) -> type[PoseSpace]:
    """The class of a kind: of a name in KINDS, of an installed package's entry point, or one that
    the configuration names, my_module.MySpace.

    of_file: the data file that names it, if one does: there a class's path is only a name.
    """
    if kind in KINDS:
        return KINDS[kind]
    if kind in (others := installed("pose_space")):
        space = named_object(others[kind].value, f"the installed pose space {kind}")
    elif of_file is None and "." in kind:
        space = named_object(kind, "pose_space.kind")
    else:
        known = ", ".join((*KINDS, *others))
        what = f"{of_file}: the pose space" if of_file else "the pose space"
        raise ToftrackError(
            f"{what} kind {kind!r} is unknown; known are {known}, and your own as"
            " pose_space.kind=MODULE.CLASS (docs/extending.md)"
        )
    if not (isinstance(space, type) and issubclass(space, PoseSpace)):
        raise ToftrackError(f"pose_space.kind={kind} is no subclass of PoseSpace; name one")
    return space


def fit_pose_space(
    kind: str = "pca", dims: int = 4, data: PoseData | None = None, **settings: Any
) -> PoseSpace:
    """Learn a pose space of a kind, from the synthetic training poses unless others are given.

    settings: of that kind, as its `fit` takes them.
    """
    fit = getattr(kind_of_space(kind), "fit", None)
    if fit is None:
        raise ToftrackError(
            f"pose_space.kind={kind} has no class method fit, and cannot be learned; write one, or"
            " give pose_space.file=FILE"
        )
    takes = tuple(inspect.signature(fit).parameters)[3:]
    unknown = [name for name in settings if name not in takes]
    if unknown:
        raise ToftrackError(
            f"pose_space.{unknown[0]} is no setting of {kind}, which takes"
            f" {', '.join(takes) or 'none but dims'}"
        )
    data = data or synthetic_data()
    if float((data.angles_rad - data.angles_rad[:1]).abs().max()) < _SAME_RAD:
        raise ToftrackError(
            f"the {len(data)} training poses are all the same; a pose space needs poses that differ"
        )
    # Matrices of some hundred rows: a second thread only waits for the first, four times as long.
    with threadpool_limits(1, "blas"):
        space: PoseSpace = fit(data.angles_rad, data.labels, dims, **settings)
    if space.dims != dims:
        raise ToftrackError(
            f"pose_space.kind={kind} learned {space.dims} dimensions instead of {dims}; give"
            f" pose_space.dims={space.dims}"
        )
    return space


def save_pose_space(
    space: PoseSpace, path: str | Path, sources: tuple[dict[str, Any], ...] = ()
) -> None:
    """Write a model file; `sources` says what it was learned from (PoseData.sources)."""
    header = {
        "format": FORMAT,
        "version": VERSION,
        "kind": space.kind,
        "angle_names": ANGLE_NAMES,
        "training_labels": space.training_labels,
        "sources": sources,
    }
    arrays = {name: tensor.cpu().numpy() for name, tensor in space.arrays().items()}
    write_archive(path, {"header": json.dumps(header), **arrays})


def load_pose_space(path: str | Path, configured: str = "pca") -> PoseSpace:
    """Read a model file; ToftrackError when it is not one of this version and size, or its kind is
    neither the configured one nor one that kind_of_space knows.
    """
    what = f"{path} is not a pose-space file"
    with reported_errors(what, _ADVICE, OSError, ValueError, KeyError):
        arrays = read_archive(path)
        header = parse_json(str(arrays.pop("header")))
    check_format(path, header, FORMAT, VERSION, "a pose-space file", _ADVICE)
    kind, labels = header.get("kind"), header.get("training_labels")
    made = kind_of_space(configured)
    if kind != made.kind:
        made = kind_of_space(str(kind), of_file=str(path))
    if header.get("angle_names") != list(ANGLE_NAMES):
        raise ToftrackError(
            f"{path} describes other joint angles than the {len(ANGLE_NAMES)} of this"
            f" hand; {_ADVICE}"
        )
    expected = (TypeError, RuntimeError, IndexError, ValueError)
    with reported_errors(f"{path} is a damaged pose-space file", _ADVICE, *expected):
        needed = {field.name for field in fields(made)} - {"training_labels"}
        for name in sorted(set(arrays) ^ needed):
            raise ValueError(f"{'no' if name in needed else 'one too many'} array {name!r}")
        if not isinstance(labels, list):
            raise ValueError("no labels")
        tensors = {name: torch.from_numpy(array).float() for name, array in arrays.items()}
        space = made(**tensors, training_labels=tuple(labels))
        angles = space.decode(space.training_latents)
        if not all(bool(tensor.isfinite().all()) for tensor in (*tensors.values(), angles)):
            raise ValueError("not all finite")
        bounds = space.lower, space.upper
        if angles.shape[-1] != len(ANGLE_NAMES) or any(b.shape != (space.dims,) for b in bounds):
            raise ValueError(f"of another size, {angles.shape[-1]} angles")
        if bool((space.lower > space.upper).any()) or len(labels) != len(space.training_latents):
            raise ValueError("bounds or labels do not fit")
        space.encode(angles[:1])
    return space


def make_pose_space(
    kind: str = "pca",
    dims: int = 4,
    file: str | None = None,
    data: str = "synthetic",
    **settings: Any,
) -> PoseSpace:
    """The pose space of a configuration: read from `file`, or learned on the spot when None.

    data: what it is learned from: "natural" motion, or "synthetic", the paper's 79 poses.
    """
    if file is None:
        remedy = ", or a file of toftrack train for others: pose_space.file=FILE"
        check_choice("pose_space.data", data, _DATA, remedy)
        return fit_pose_space(kind, dims, _DATA[data](), **settings).to("cpu")
    space = load_pose_space(file, kind)
    wanted = kind_of_space(kind).kind
    if space.kind != wanted or space.dims != dims:
        choice = "" if space.kind == wanted else f"pose_space={space.kind} "
        raise ToftrackError(
            f"{file} is a {space.dims}-dimensional {space.kind} space and the configuration"
            f" asks for a {dims}-dimensional {wanted}; give {choice}pose_space.dims={space.dims}"
        )
    return space
