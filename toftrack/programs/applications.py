"""The two programs that take Hydra's overrides: `toftrack track` and `toftrack train`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import hydra
from omegaconf import DictConfig

from toftrack.configuration.compose import configuration_folder, devices_of_files, setting_names
from toftrack.programs import command_line
from toftrack.programs.recording_argument import options_first, with_recording


@command_line.sweep_job
def track_job(config: DictConfig) -> float:
    """Track, write the results, and return what a sweep minimises."""
    # The device comes before the seconds that torch takes: a missing camera is reported at once.
    device = hydra.utils.instantiate(config.device)
    from toftrack.programs import track as app

    return app.track(config, device)


@command_line.sweep_job
def train_job(config: DictConfig) -> float:
    """Train, write the model and its figures, and return what a sweep minimises."""
    from toftrack.programs.train import train  # takes seconds: an override's error comes before

    return train(config)


def track(arguments: Sequence[str]) -> None:
    """Track as a command line says, which may name a recording."""
    words = with_recording(arguments, setting_names(), devices_of_files())
    start(track_job, "toftrack track", "config", words)


def train(arguments: Sequence[str]) -> None:
    """Train as a command line says."""
    start(train_job, "toftrack train", "train_pose_space", arguments)


def start(
    job: Callable[[DictConfig], float], program: str, config: str, arguments: Sequence[str]
) -> None:
    """Run a Hydra application; it reads the command line of the process."""
    folder = str(configuration_folder())
    application = hydra.main(version_base="1.3", config_path=folder, config_name=config)(job)
    before = sys.argv
    sys.argv = [program, *options_first(arguments)]
    try:
        application()
    finally:
        sys.argv = before
