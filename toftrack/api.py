"""toftrack in a program of one's own: trackers and devices from the same configuration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from toftrack.compute.collector import collector_paused
from toftrack.configuration.check import check_groups, check_tracker
from toftrack.configuration.compose import configuration, one_sentence
from toftrack.errors import ToftrackError, check_choice

if TYPE_CHECKING:
    import torch

    from toftrack.compute.quality import Pace
    from toftrack.devices.base import BaseDevice
    from toftrack.tracking.backend import Backend
    from toftrack.tracking.model import FilterModel
    from toftrack.tracking.tracker import HandsTracker, Tracker


@collector_paused()
def make_tracker(*overrides: str, config_dir: str | Path | None = None) -> Tracker:
    """A tracker of one hand as `python track.py` with these overrides has it:
    `tracker.step(depth_m, K)`.

    Any number of them may work in one process, each in a thread of its own; one tracker must not be
    used by two threads at once.

    overrides: as on the command line, "hand.side=left" or "filter.particles=1000"; those of device,
        view, stream, smooth and of files are without effect on a tracker by itself.
    config_dir: a folder with choices of your own, GROUP/NAME.yaml, beside toftrack's; or with a
        config.yaml and all its groups, instead of them.

    Raises ToftrackError: an override or a file that it names cannot be used, or hands is above 1.
    """
    config = configuration(*overrides, config_dir=config_dir)
    if config.get("hands", 1) != 1:
        raise ToftrackError(
            f"make_tracker follows one hand, but hands={config.hands} is given; "
            "toftrack.make_hands_tracker follows several"
        )
    with one_sentence():
        return build_tracker(config)


@collector_paused()
def make_hands_tracker(*overrides: str, config_dir: str | Path | None = None) -> HandsTracker:
    """A tracker whose `step` gives a tuple of estimates, one for each of the N slots of `hands=N`.

        tracker = make_hands_tracker("hands=2")
        first, second = tracker.step(depth_m, K)

    A slot keeps to its hand; Estimate.side says whose it is. A slot without a hand is lost, and its
    arrays are NaN.

    Args and raises as make_tracker, but for the number of hands.
    """
    config = configuration(*overrides, config_dir=config_dir)
    with one_sentence():
        return build_hands_tracker(config)


def make_device(*overrides: str, config_dir: str | Path | None = None) -> BaseDevice:
    """The camera or recording of `python track.py` with these overrides, for a `with` and a `for`.

    Its frames are as the camera took them; `device.camera.rectify(frame.depth, frame.radial)` is
    what a tracker wants, together with `device.camera.K`.

    overrides: as on the command line, "device=replay" and "device.path=FILE.npz".
    config_dir: as for make_tracker.

    Raises ToftrackError: an override cannot be used, or the device cannot deliver.
    """
    config = configuration(*overrides, config_dir=config_dir)
    with one_sentence():
        return instantiate(config.device)


def build_tracker(config: DictConfig) -> Tracker:
    """The tracker of one hand of a configuration (conf/config.yaml composed)."""
    # These take seconds: an override's error comes before.
    from toftrack.compute.threads import small_operations
    from toftrack.tracking.tracker import Tracker

    with small_operations():
        return Tracker(build_model(config), config.seed, pace=_pace(config))


def build_hands_tracker(config: DictConfig) -> HandsTracker:
    """The tracker of as many hands as a configuration says."""
    from toftrack.compute.threads import small_operations
    from toftrack.tracking.tracker import HandsTracker

    with small_operations():
        model, hands = build_model(config), config.get("hands", 1)
        return HandsTracker(model, config.seed, hands, _pace(config))


def _pace(config: DictConfig) -> Pace:
    """Who gives a budget to a tracker of their own has a camera that does not wait."""
    from toftrack.compute.quality import pace_within

    # A configuration of one's own may do without.
    return pace_within((config.get("tracker") or {}).get("budget_ms"))


def build_model(config: DictConfig) -> FilterModel:
    """The parts of a tracker of a configuration; those of the paper's where it has no networks.

    Raises ToftrackError for parts of one tracker in the other.
    """
    from toftrack.tracking.model import TrackerModel
    from toftrack.tracking.paper import PaperModel

    check_groups(config)
    check_tracker(config)
    device = compute_device(config.compute)
    detector, likelihood = instantiate(config.detector), instantiate(config.likelihood)
    backend: Backend = instantiate(config.renderer, device=device)
    parts: dict[str, Any] = {
        "configured": instantiate(config.hand),
        "space": instantiate(config.pose_space),
        "segmentation": instantiate(config.segmentation),
        "likelihood": likelihood,
        "filter": instantiate(config.filter),
        "gestures": instantiate(config.gestures),
        "backend": backend.judged_by(likelihood),
        "lost": instantiate(config.lost),
    }
    if detector is None:
        return PaperModel(**parts, start=instantiate(config.start))
    return TrackerModel(
        **parts,
        detector=detector.to(device),
        refinement=instantiate(config.refine),
        posterior=instantiate(config.posterior),
    )


def compute_device(name: str) -> torch.device:
    """The torch device of compute=auto|cpu|cuda; ToftrackError when there is none of that name."""
    import torch

    check_choice("compute", name, ("auto", "cpu", "cuda"))
    if name == "cuda":
        try:
            torch.cuda.init()
        except (AssertionError, RuntimeError) as error:
            if "fork" not in str(error):
                raise ToftrackError(
                    "compute=cuda, but torch finds no CUDA GPU here; give compute=cpu"
                ) from None
            raise ToftrackError(
                "compute=cuda: the process that this one was forked from has used the GPU, which "
                "CUDA does not allow; start it by multiprocessing's spawn, or give compute=cpu"
            ) from None
    # A GPU is right, and not faster: docs/lab/gpu.md.
    return torch.device("cpu" if name == "auto" else name)
