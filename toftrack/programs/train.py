"""What `toftrack train` does: fit, report, write the model and its figures."""

from __future__ import annotations

import math
import sys
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from toftrack.errors import ToftrackError, check_number
from toftrack.files.json_text import write_json
from toftrack.pose_space.data.pose_data import PoseData
from toftrack.pose_space.files import fit_pose_space, save_pose_space
from toftrack.pose_space.held_out import Errors, Row, errors_table, evaluate_space, spaces_to_learn
from toftrack.programs import shutdown
from toftrack.programs.command_line import in_sweep, job_words, typed
from toftrack.views.figures.chart import write_figures
from toftrack.views.figures.poses import (
    corners_figure,
    manifold_figure,
    poses_figure,
    traversals_figure,
)


def train(config: DictConfig) -> float:
    """Learn the configured space; returns what a sweep minimises: the root mean square error in
    degrees of the nearest points in the box to held-out clips, or of decode(encode(x)) on the
    training poses of a single clip; infinity where too few poses are left beside the held-out ones
    for so many dimensions.
    """
    settings: Any = OmegaConf.to_container(config.pose_space, resolve=True)
    if settings.pop("file", None) is not None:
        raise ToftrackError(
            "pose_space.file names a model to use, not to train; leave it out, the new model is"
            " written into the output folder"
        )
    target = settings.pop("_target_", None)
    if "kind" not in settings:
        raise ToftrackError(
            f"pose_space._target_={target} cannot be learned here; name the class of your space as"
            " kind in its file, as docs/extending.md shows"
        )
    settings.pop("data", None)  # of the tracker's; here the group of this name says it
    kind, dims = settings.pop("kind"), settings.pop("dims")
    folder = Path(HydraConfig.get().runtime.output_dir)
    for number in config.compare:
        check_number("a number of compare", number, 1, whole=True)
    data: PoseData = hydra.utils.instantiate(config.data)
    say = print if not in_sweep() else lambda text: None  # a sweep's jobs say one line each
    for note in data.notes:
        say(note)
    space = fit_pose_space(kind, dims, data, **settings)
    clips = len(data.clips.unique())
    say(f"{len(data)} training poses in {clips} clips, {kind}, {dims} dimensions")
    most = min(len(data) - 2, 21)
    wanted = [number for number in config.compare if number <= most]
    if left := [number for number in config.compare if number > most]:
        say(f"left out of the table: {left} dimensions; at most {most} can be learned")
    rows = _table(kind, sorted({*wanted, dims}), data, settings)
    say(errors_table(rows))
    if rows[0].variance is not None and [s["data"] for s in data.sources] == ["synthetic"]:
        say("the paper: 97.4 % of the variance in three components, 97.5 % in four")

    model = folder / "pose_space.npz"
    save_pose_space(space, model, data.sources)
    drawn = (
        ("poses.png", poses_figure),
        ("manifold.png", manifold_figure),
        ("traversals.png", traversals_figure),
        ("corners.png", corners_figure),
    )
    figures = write_figures(folder, [(name, partial(draw, space)) for name, draw in drawn])
    asked = next(row for row in rows if row.dims == dims)
    measured = asked.training if clips == 1 else asked.reached
    error = math.inf if measured is None else measured.degrees
    summary = _summary(kind, data, rows, asked)
    write_json(folder / "summary.json", summary)
    say("\n".join(f"  {path}" for path in (model, *figures, folder / "summary.json")))
    say(f"use it: {_command(model)}")
    if in_sweep():
        line = f"{len(data)} training poses, error {error:.2f} degrees; {folder}"
        shutdown.say(f"{job_words()}: {line}", sys.stdout)
    return error


def _command(model: Path) -> str:
    """How to track in the space that was learned."""
    hydra = HydraConfig.get()
    own = [place.path for place in hydra.runtime.config_sources if place.provider == "command-line"]
    words = ["toftrack", "track", *(word for path in own for word in ("--config-dir", path))]
    words.append(f"pose_space={hydra.runtime.choices['pose_space']}")
    words += [word for word in hydra.overrides.task if word.startswith("pose_space.dims")]
    return typed([*words, f"pose_space.file={model}"])


def _table(kind: str, dims: list[int], data: PoseData, settings: dict[str, Any]) -> list[Row]:
    """A row of errors for each number of dimensions, with progress where that takes long."""
    with tqdm(
        total=len(dims) * spaces_to_learn(data),
        desc="learning spaces for the table of errors"
        + (" (compare=[] takes fewer)" if len(dims) > 1 else ""),
        file=sys.stderr,
        disable=None,
        unit=" spaces",
        delay=1.0,  # what is done sooner needs no progress shown
        leave=not in_sweep(),
    ) as bar:
        return [evaluate_space(kind, number, data, settings, bar.update) for number in dims]


def _summary(kind: str, data: PoseData, rows: list[Row], asked: Row) -> dict[str, Any]:
    def plain(row: Row) -> dict[str, Any]:
        cells = row._asdict().items()
        return {name: one._asdict() if isinstance(one, Errors) else one for name, one in cells}

    found = {
        f"{name}_{unit}": value
        for name, errors in plain(asked).items()
        if isinstance(errors, dict)
        for unit, value in errors.items()
    }
    table = list(map(plain, rows))
    return {"kind": kind, "dims": asked.dims, "sources": data.sources, **found, "errors": table}
