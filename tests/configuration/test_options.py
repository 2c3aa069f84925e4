"""Every file of the configuration composes, and what it describes can be made."""

import csv
import sys
from pathlib import Path

import cv2
import hydra
import numpy as np
import pytest
import torch
from helpers import fake_orbbec
from helpers.bags import recording, write_bag
from helpers.tracking import CONF, ROOT, configuration
from omegaconf import OmegaConf

from toftrack.api import build_tracker, make_device
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import ANGLE_NAMES, forward_kinematics
from toftrack.pose_space.data.pose_data import synthetic_data

OPTIONS = sorted((path.parent.name, path.stem) for path in CONF.glob("*/*.yaml"))
OF_EXTRAS = {
    "osc": ("pythonosc", "pip install '.[osc]'"),
    "realsense": ("pyrealsense2", "pyrealsense2 is not installed"),
    "rerun": ("rerun", "of the extra rerun"),
    "triton": ("triton", "triton is not installed"),
}
"""The package that an option needs, and why it is not made without."""
# Without it the kernels' widths are cross-validated, which takes seconds.
FASTER = {
    "isomap": ["pose_space.neighbours=8"],
    "kernel_pca": ["pose_space.gamma=0.1"],
    "lle": ["pose_space.neighbours=8"],
}


@pytest.fixture(scope="module")
def given_for(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], list[str]]:
    """What is given to the options that cannot do without: files, written into a folder."""
    folder = tmp_path_factory.mktemp("given")
    angles = synthetic_data().angles_rad[::8]
    with open(folder / "poses.csv", "w", newline="") as file:
        file.write("# units: radians\n")
        csv.writer(file).writerows([ANGLE_NAMES, *angles.tolist()])
    state = torch.cat((torch.zeros(len(angles), 6), angles.float()), 1)
    joints = forward_kinematics(state, default_hand_shape()).joints_m[:, 1:].unflatten(1, (5, 4))
    clip = {"seq_name": ["one"], "seq_len": [len(joints)], "is_left": np.zeros(len(joints), bool)}
    np.savez(folder / "leap.npz", joints_mm=1e3 * joints.numpy(), **clip)
    run = {"state": np.zeros((3, 27), np.float32), "lost": np.zeros(3, bool)}
    np.savez(folder / "track.npz", confidence=np.ones(3), **run)
    images = folder / "images"
    images.mkdir()
    cv2.imwrite(str(images / "0.png"), np.full((30, 40), 600, np.uint16))
    Camera(np.array([[50, 0, 20], [0, 50, 15], [0, 0, 1]]), 40, 30).save(images / "camera.json")
    sample = ROOT / "toftrack" / "data" / "sample.npz"
    return {
        ("device", "replay"): [f"device.path='{sample}'"],
        ("device", "folder"): [f"device.path='{images}'"],
        ("device", "sr3000"): ["device.transport=emulated"],  # there is no camera here
        ("device", "realsense"): ["device.transport=emulated"],
        ("data", "file"): [f"data.path='{folder}/poses.csv'"],
        ("data", "leap"): [f"data.path='{folder}/leap.npz'"],
        ("data", "run"): [f"data.path='{folder}'"],
        ("data", "mixture"): [f"data.parts.leap.path='{folder}/leap.npz'"],
    }


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_can_be_made(
    group: str, option: str, given_for: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if option in OF_EXTRAS:
        package, reason = OF_EXTRAS[option]
        pytest.importorskip(package, reason=reason)
    if option == "triton" and not torch.cuda.is_available():
        pytest.skip("there is no CUDA device")
    femto = fake_orbbec.Camera("1", {fake_orbbec.DEPTH: [fake_orbbec.profile("y16")]})
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", fake_orbbec.Sdk(femto))
    given = given_for.get((group, option), []) + FASTER.get(option, [])
    if option == "rosbag":
        frames = [np.ones((6, 8), np.float32)]
        bag = write_bag(tmp_path, "bag", recording(frames, Camera(np.diag((9.0, 9, 1)), 8, 6)))
        given = [f"device.path='{bag}'"]
    paper = ["experiment=paper"] if group == "start" else []
    name = "train_pose_space" if group == "data" else "config"
    config = configuration(*paper, f"{group}={option}", *given, name=name)
    part = config if group == "experiment" else config[group]
    missing = OmegaConf.missing_keys(part)
    assert not missing, f"{group}={option} asks for {missing}: give this test values for them"
    OmegaConf.to_container(part, resolve=True)
    if "_target_" in part:
        # What it is called with further on, a view's folder for one, is not there yet.
        made = hydra.utils.instantiate(part, _partial_=True)
        assert callable(made.func)
        if group != "view":
            hydra.utils.instantiate(part)


def test_a_calibrated_camera_reaches_every_device_that_replays(tmp_path: Path) -> None:
    gone = tmp_path / "gone.json"
    for overrides in (["device=sample"], ["device=replay", "device.path=sample.npz"]):
        config = configuration(*overrides, f"camera.file='{gone}'")
        assert config.device.camera_file == str(gone)
    with pytest.raises(hydra.errors.InstantiationException) as caught:
        hydra.utils.instantiate(configuration(f"camera.file='{gone}'").device)
    assert isinstance(caught.value.__cause__, ToftrackError)


def test_a_device_that_would_ignore_a_calibrated_camera_is_refused(tmp_path: Path) -> None:
    (tmp_path / "device").mkdir()
    (tmp_path / "device" / "own.yaml").write_text("_target_: own.Device\n")
    with pytest.raises(ToftrackError, match="this device takes no camera.file"):
        make_device("device=own", "camera.file=lens.json", config_dir=tmp_path)


def test_the_same_seed_reaches_the_tracker_and_the_synthetic_device() -> None:
    config = configuration("device=synthetic", "seed=7")
    assert (config.seed, config.device.seed) == (7, 7)


@pytest.mark.parametrize(
    ("group", "choice"), [("filter", "annealed"), ("segmentation", "nearest"), ("hand", "default")]
)
def test_a_choice_beside_an_experiment_keeps_all_of_its_settings(group: str, choice: str) -> None:
    both = configuration("experiment=paper", f"{group}={choice}")[group]
    assert both == configuration(f"{group}={choice}")[group]


def test_the_paper_s_pose_space_takes_a_file_and_dimensions_of_a_choice(tmp_path: Path) -> None:
    (tmp_path / "pose_space").mkdir()
    text = "defaults: [pca]\ndims: 6\nfile: mine.npz\n"
    (tmp_path / "pose_space" / "mine.yaml").write_text(text)
    given = [f"hydra.searchpath=['{tmp_path}']", "experiment=paper", "pose_space=mine"]
    assert configuration(*given).pose_space.dims == 6


def test_a_tracker_of_mixed_parts_is_not_built() -> None:
    with pytest.raises(ToftrackError, match="detector=none belongs to experiment=paper"):
        build_tracker(configuration("detector=none"))
