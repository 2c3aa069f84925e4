"""ONNX Runtime says what torch says; its files are those of the weights, or are not used."""

import contextlib
import logging
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from helpers.detection import small_networks
from helpers.settings import detector_settings
from helpers.tracking import ROOT, sample

from toftrack.detector import onnx_networks
from toftrack.detector.crops import CROP, CROP_CHANNELS, wide
from toftrack.detector.hand_detector import HandDetector
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.onnx_networks import DIGEST, OnnxFinder, OnnxPoseNet, digest, load_networks
from toftrack.detector.weights import DEFAULT_FILE, load_weights, save_weights
from toftrack.errors import ToftrackError
from toftrack.training import onnx_export
from toftrack.training.__main__ import main

NETWORKS = {"pose": 3, "finder": 2}
"""How many of their convolutions are the first and the last ones."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of small networks, and their files, by the program."""
    path = tmp_path_factory.mktemp("exported") / "small.npz"
    torch.manual_seed(1)
    save_weights(path, PoseNet(4), Finder(8), {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_export, "CALIBRATION", 32)
        main(["export", str(path)])
    return path


@pytest.fixture
def weights(exported: Path, tmp_path: Path) -> Path:
    """A copy of them."""
    return Path(shutil.copytree(exported.parent, tmp_path / "copy")) / exported.name


def torch_runs(path: Path, caplog: pytest.LogCaptureFixture) -> str:
    """What is said when torch runs the networks."""
    onnx_networks._warn.cache_clear()
    with caplog.at_level(logging.WARNING):
        pose, finder = load_networks(path)
        load_networks(path)
    assert isinstance(pose, PoseNet) and isinstance(finder, Finder)
    [record] = caplog.records  # once
    assert f"python -m toftrack.training export {path}" in record.message
    return record.message


@torch.no_grad()
def test_a_file_of_weights_is_exported_and_answers_like_torch_at_any_size(weights: Path) -> None:
    pose, finder = load_networks(weights)
    assert isinstance(pose, OnnxPoseNet) and isinstance(finder, OnnxFinder)
    reference = load_weights(weights)
    draw = torch.Generator().manual_seed(0)
    for count in (1, 4):
        crops = torch.rand(count, CROP_CHANNELS, CROP, CROP, generator=draw)
        expected = reference.pose.features(crops)
        outputs = pose.outputs(crops.numpy())
        assert len(outputs) == 3
        for one, two in zip(outputs, expected, strict=False):
            away = torch.from_numpy(one) - two
            assert 0 < away.square().mean().sqrt() < 0.1 * two.std()
    for size in ((1, 2, 16, 16), (2, 2, 80, 48)):
        images = torch.rand(size, generator=draw)
        for one, two in zip(finder(images), reference.finder(images), strict=True):
            assert 0 < (one - two).square().mean().sqrt() < 0.15 * two.std()


def test_the_package_s_files_are_those_of_its_weights_and_say_the_same_of_a_hand() -> None:
    pose, finder = load_networks()
    assert isinstance(pose, OnnxPoseNet) and isinstance(finder, OnnxFinder)
    reference = load_weights()
    scene = sample().cut(30)
    centres = scene.joints_m[0, [0, 9]]
    for side in ("right", "left"):
        seen = [
            HandDetector(network, finder, detector_settings()).detect(
                scene.depth_m[0], scene.k, centres, side
            )
            for network in (pose, reference.pose)
        ]
        found, expected = (torch.stack([one.keypoints.points_m for one in each]) for each in seen)
        away = (found - expected).norm(dim=-1).mean()
        assert float(away) < (0.003 if side == "right" else 0.010), "of the other side it guesses"
    image, _ = wide(scene.depth_m[0], scene.k)
    with torch.no_grad():
        for one, two in zip(finder(image), reference.finder(image), strict=True):
            assert float((one - two).square().mean().sqrt() / two.std()) < 0.15


def test_the_files_are_in_8_bits_and_say_so_and_bad_ones_are_refused(exported: Path) -> None:
    reference = load_weights(exported)
    models = {name: onnx.load(onnx_networks.onnx_file(exported, name)) for name in NETWORKS}
    for name, ends in NETWORKS.items():
        model = models[name]
        assert "int8" in [one.value for one in model.metadata_props if one.key == "precision"]
        kinds = [part.data_type for part in model.graph.initializer if len(part.dims) == 4]
        assert kinds.count(onnx.TensorProto.INT8) == len(kinds) - ends, "not the first and the last"
    crops, other = onnx_export.example_crops()[:4], small_networks()
    onnx_export.compare(reference.pose, models["pose"], crops)
    with pytest.raises(ToftrackError, match=r"mm away .* give --float"):
        onnx_export.compare(other[0], models["pose"], crops)
    images = torch.rand(4, 2, 32, 48, generator=torch.Generator().manual_seed(0)).numpy()
    onnx_export.compare(reference.finder, models["finder"], images)
    with pytest.raises(ToftrackError, match=r"its spread away .* give --float"):
        onnx_export.compare(other[1], models["finder"], images)


@pytest.mark.parametrize("network", ["pose", "finder"])
def test_weights_without_a_file_are_run_by_torch_which_is_said_once(
    network: str, weights: Path, caplog: pytest.LogCaptureFixture
) -> None:
    onnx_networks.onnx_file(weights, network).unlink()
    assert f"there is no {weights.with_suffix('')}.{network}.onnx" in torch_runs(weights, caplog)


def test_a_file_of_other_weights_is_not_used(
    weights: Path, caplog: pytest.LogCaptureFixture
) -> None:
    torch.manual_seed(2)
    save_weights(weights, PoseNet(4), Finder(8), {})
    assert "small.pose.onnx belongs to other weights" in torch_runs(weights, caplog)


def test_a_file_that_is_damaged_or_no_network_is_refused_in_a_sentence(weights: Path) -> None:
    file = onnx_networks.onnx_file(weights, "pose")
    content = file.read_bytes()
    changed = bytearray(content)
    changed[len(content) // 2] ^= 1
    damaged = [b"", content[: len(content) // 3], content[:-1], bytes(changed)]
    # Of these the checksum is right.
    others = [text + digest(text) for text in (b"", b"no network", content[: -2 * DIGEST])]
    cases = [(each, "small.pose.onnx is damaged.* make it anew with") for each in damaged]
    for broken, words in cases + [(each, "ONNX Runtime refuses .*make it anew") for each in others]:
        file.write_bytes(broken)
        with pytest.raises(ToftrackError, match=words) as error:
            load_networks(weights)
        assert "\n" not in str(error.value)
    file.unlink()
    file.mkdir()
    with pytest.raises(ToftrackError, match="small.pose.onnx cannot be read"):
        load_networks(weights)
    longest = weights.rename(weights.with_name(251 * "w" + ".npz"))
    with contextlib.suppress(ToftrackError):  # newer versions of Python say that it is not there
        load_networks(longest)


def test_outputs_of_another_shape_never_reach_compiled_code(weights: Path) -> None:
    pose, _ = load_networks(weights)
    assert isinstance(pose, OnnxPoseNet)

    class Other:
        def run(self, *given: object) -> list[np.ndarray]:
            maps = (np.zeros((1, count, 16, 16), np.float32) for count in (105, 20))
            return [np.zeros((1, 7), np.float32), *maps]

    crops = np.zeros((1, CROP_CHANNELS, CROP, CROP), np.float32)
    with pytest.raises(ToftrackError, match="belongs to another network"):
        OnnxPoseNet(weights, Other()).outputs(crops)


def test_several_threads_and_batches_get_the_same_answers() -> None:
    pose, finder = load_networks()
    scene = sample().cut(10)
    detector = HandDetector(pose, finder, detector_settings())
    centres = scene.joints_m[0, [0, 9, 12]]
    alone = [
        detector.detect(scene.depth_m[0], scene.k, centre[None], "right")[0] for centre in centres
    ]
    reported: list[list] = [[], []]

    def detect(into: list) -> None:
        into += detector.detect(scene.depth_m[0], scene.k, centres, "right")

    threads = [threading.Thread(target=detect, args=(into,)) for into in reported]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for found in reported:
        for one, two in zip(found, alone, strict=True):
            assert torch.equal(one.keypoints.points_m, two.keypoints.points_m)


def test_onnx_runtime_sends_nothing_and_keeps_no_number_of_the_machine(tmp_path: Path) -> None:
    code = "from toftrack.detector.onnx_networks import load_networks; load_networks()"
    places = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    env = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=env | places, check=True)
    assert not [path for path in tmp_path.rglob("*") if "onnxruntime" in path.name]


def test_on_another_device_torch_runs_them() -> None:
    pose, finder = load_networks()
    here = HandDetector(pose, finder, detector_settings())
    assert here.to(torch.device("cpu")).pose is pose
    there = here.to(torch.device("meta"))
    assert isinstance(there.pose, PoseNet) and there.pose.device.type == "meta"
    assert isinstance(there.finder, Finder)


def test_without_what_an_export_needs_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_export.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ToftrackError, match=r"onnx and onnxscript: pip install .toftrack\[train\]"):
        main(["export", str(DEFAULT_FILE)])


def test_an_export_that_does_not_agree_with_torch_is_an_error(exported: Path) -> None:
    model = onnx.load(onnx_networks.onnx_file(exported, "pose"))
    other, _ = small_networks()
    with pytest.raises(ToftrackError, match="away from torch's"):
        onnx_export._compare(
            onnx_export._Features(other), model, "crops", (CROP_CHANNELS, CROP, CROP)
        )
