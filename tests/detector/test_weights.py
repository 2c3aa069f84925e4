"""The file of weights: written, read again, and refused with a sentence where it is broken."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.detection import used
from helpers.tracking import configuration
from torch import nn

from toftrack.api import build_tracker
from toftrack.detector import weights as module
from toftrack.detector.crops import CROP_CHANNELS
from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.weights import DEFAULT_FILE, load_weights, save_weights
from toftrack.errors import ToftrackError

CROPS = 2 * torch.rand(2, CROP_CHANNELS, 64, 64, generator=torch.Generator().manual_seed(0)) - 1
WHOLE = torch.rand(1, 2, 32, 48, generator=torch.Generator().manual_seed(0))
ABOUT = {"seed": 3, "images": 12}


@pytest.fixture(scope="module")
def networks() -> tuple[nn.Module, nn.Module]:
    torch.manual_seed(1)
    return used(PoseNet(4), CROPS), used(Finder(8), WHOLE)


@pytest.fixture
def file(networks: tuple[nn.Module, nn.Module], tmp_path: Path) -> Path:
    path = tmp_path / "weights.npz"
    save_weights(path, *networks, ABOUT)
    return path


def rewritten(path: Path, **changes: object) -> None:
    """The same file with other arrays, or other entries of its metadata."""
    with np.load(path) as content:
        arrays = dict(content)
    metadata = json.loads(str(arrays["metadata"]))
    for name, value in changes.items():
        if name in metadata:
            metadata[name] = value
        else:
            arrays[name.replace("__", ".")] = value
    arrays["metadata"] = np.array(json.dumps(metadata))
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})


def refused(path: Path, words: str) -> None:
    with pytest.raises(ToftrackError, match=words) as error:
        load_weights(path)
    assert "\n" not in str(error.value) and "give other detector.weights" in str(error.value)


@torch.no_grad()
def test_what_is_read_answers_as_what_was_written(
    file: Path, networks: tuple[nn.Module, nn.Module]
) -> None:
    read = load_weights(str(file))
    assert read.about == ABOUT
    for before, after, image in zip(networks, read[:2], (CROPS, WHOLE), strict=True):
        assert not after.training and not any(p.requires_grad for p in after.parameters())
        assert not any(isinstance(part, nn.BatchNorm2d) for part in after.modules())
        for one, two in zip(before(image), after(image), strict=True):
            assert torch.allclose(one, two, atol=2e-3, rtol=1e-3)


def test_the_package_s_own_weights_are_small_and_can_be_read() -> None:
    assert DEFAULT_FILE.stat().st_size < 8e6
    pose, finder, about, *_ = load_weights()
    assert isinstance(pose, PoseNet) and isinstance(finder, Finder) and about
    with np.load(DEFAULT_FILE, allow_pickle=False) as content:
        kinds = {content[name].dtype.kind for name in content.files}
    assert kinds <= set("fiuU"), "numbers and text"


def test_a_changed_number_is_noticed(file: Path) -> None:
    with np.load(file) as content:
        bias = content["pose.heads.bias"].copy()
    bias[0] += np.float16(0.25)
    rewritten(file, pose__heads__bias=bias)
    refused(file, "is damaged, its checksum is wrong")


def test_a_damaged_byte_anywhere_is_an_error_of_ours_or_harmless(file: Path) -> None:
    content, refusals = file.read_bytes(), 0
    rng = np.random.default_rng(0)
    for at in [0, 30, len(content) - 1, *rng.integers(len(content), size=12).tolist()]:
        broken = bytearray(content)
        broken[at] ^= 0xFF
        file.write_bytes(bytes(broken))
        try:
            assert load_weights(file).about == ABOUT
        except ToftrackError as error:
            assert str(file) in str(error)
            refusals += 1
    assert refusals > 10


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"version": 2}, "weights of version 2, and this toftrack reads version 1"),
        ({"format": "toftrack-pose-space"}, "is not a file of the detector's weights"),
        *(({"pose_width": width}, "another network; give") for width in (6, 0, 10**6, "24", True)),
    ],
)
def test_weights_that_say_that_they_are_others_are_refused(
    file: Path, change: dict, words: str
) -> None:
    rewritten(file, **change)
    refused(file, words)


def test_what_is_no_archive_or_cut_off(file: Path) -> None:
    path, content = file, file.read_bytes()
    refused(path.with_name("gone.npz"), "there are no weights of the detector at")
    for part in (b"weights", *(content[: int(part * len(content))] for part in (0.0, 0.3, 0.999))):
        path.write_bytes(part)
        refused(path, "is no file of the detector's weights")
    with path.open("wb") as stream:
        np.save(stream, np.zeros(3))
    refused(path, "is no file of the detector's weights")
    np.savez(path, nothing=np.zeros(3))
    refused(path, "is no file of the detector's weights")
    np.savez(path, metadata=np.array("{"))
    refused(path, "is no file of the detector's weights")


def test_pickled_objects_are_never_loaded(file: Path, tmp_path: Path) -> None:
    rewritten(file, pose__heads__bias=np.array([Touches(tmp_path / "touched")], object))
    refused(file, "is no file of the detector's weights .*pickled")
    assert not (tmp_path / "touched").exists()


class Touches:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_a_file_that_is_too_large(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    with path.open("wb") as stream:
        stream.truncate(module._LARGEST_BYTES + 1)
    refused(path, "is too large for weights of the detector")


def test_without_networks_their_weights_are_not_read(monkeypatch, tmp_path) -> None:
    broken = tmp_path / "detector.npz"
    broken.write_bytes(b"no weights")
    monkeypatch.setattr(module, "DEFAULT_FILE", broken)
    build_tracker(configuration("experiment=paper"))
    with pytest.raises(Exception, match="no file of the detector's weights"):
        build_tracker(configuration())
