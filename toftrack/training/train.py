"""What `python -m toftrack.training train` does: train both networks, write weights and figures."""

from __future__ import annotations

import math
import os
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import to_absolute_path
from omegaconf import DictConfig

from toftrack.configuration.sentences import sentence
from toftrack.errors import ToftrackError, check_number
from toftrack.files.json_text import write_json
from toftrack.programs.command_line import sweep_job
from toftrack.views.pictures import write_picture


@sweep_job
def train(config: DictConfig) -> float:
    """Train, write weights, their ONNX files and figures into Hydra's output folder.

    Returns the mean joint error of the pose network's last images, mm; NaN if it saw none.
    """
    # Threads that wait must not keep the processes that make images from working.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    import torch

    from toftrack.api import compute_device
    from toftrack.detector.network import Finder, PoseNet
    from toftrack.detector.onnx_networks import COMMAND
    from toftrack.detector.weights import load_weights, save_weights
    from toftrack.training.checkpoints import Checkpoints
    from toftrack.training.descent import train_network
    from toftrack.training.figures import course_figure, images_figure
    from toftrack.training.onnx_export import export_networks, missing_packages, needed

    folder = Path(HydraConfig.get().runtime.output_dir)
    path = folder / config.output
    missing = missing_packages()
    if missing:
        print(
            f"{needed(missing)}; otherwise training writes only {config.output}, and {COMMAND}"
            f" {path} makes them later"
        )
    found = "cuda" if torch.cuda.is_available() else "cpu"
    device = compute_device(found if config.compute == "auto" else config.compute)
    if path.suffix != ".npz" or not path.parent.is_dir():
        raise ToftrackError(
            f"output={config.output} is not possible; give a name that ends in .npz, in a folder "
            "that exists"
        )
    schedules = []
    for name in ("poses", "finder"):
        try:
            schedules.append(hydra.utils.instantiate(config[name]))
        except HydraException as error:
            raise ToftrackError(f"{name}: {sentence(error)}") from None
        if schedules[-1].start is not None:
            load_weights(schedules[-1].start)  # an error now, not after hours
    poses, finder = schedules
    check_number("shapes", config.shapes, 1, whole=True)
    check_number("checkpoint_minutes", config.checkpoint_minutes, 0, above=True)
    resume = None if config.resume is None else Path(to_absolute_path(config.resume))
    checkpoints = Checkpoints(folder, config.checkpoint_minutes, resume)
    write_picture(folder / "images.png", images_figure(config.seed))
    each = (config.shapes, config.seed, checkpoints, device)
    finder_network, finder_course = train_network(Finder, finder, *each)
    pose_network, pose_course = train_network(PoseNet, poses, *each)
    courses = [course for course in (finder_course, pose_course) if course]
    minutes = round(sum(course[-1]["seconds"] for course in courses) / 60, 1)
    about = {
        "seed": config.seed,
        "shapes": config.shapes,
        "pose_images": poses.images,
        "finder_images": finder.images,
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "minutes": minutes,
    }
    for name, schedule in (("pose", poses), ("finder", finder)):
        if schedule.start is not None:
            about[f"{name}_start"] = load_weights(schedule.start).about
        if schedule.restart_images > 0 and schedule.images > 0:
            about[f"{name}_restart_images"] = schedule.restart_images
    save_weights(path, pose_network, finder_network, about)
    summary = about | {"poses": pose_course, "finder": finder_course}
    write_json(folder / "summary.json", summary)
    error_mm, learned, pictures = math.nan, "", ["images.png"]
    if pose_course:
        write_picture(folder / "course.png", course_figure(pose_course))
        pictures.append("course.png")
        last = pose_course[-1]
        error_mm = float(last["keypoints_mm"])
        learned = (
            f"; on the last training images: joints {error_mm:.1f} mm by keypoints,"
            f" {last['joints_mm']:.1f} mm by the likeliest hypothesis"
        )
    derived = [] if missing else [file.name for file in export_networks(path)]
    print(f"trained in {minutes} minutes{learned}")
    for name in (config.output, *derived, *pictures, "summary.json"):
        print(f"  {folder / name}")
    print(
        f"use it: toftrack track detector.weights={path}\n"
        f"fit its confidence: python -m toftrack.training fit-confidence detector.weights={path}"
    )
    return error_mm
