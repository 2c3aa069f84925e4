"""A camera of one's own: the code and configuration of docs/cameras.md, as they stand there."""

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import programs
from helpers.programs import QUICK
from helpers.tracking import code_of
from hydra.errors import HydraException
from hydra.utils import instantiate

import toftrack
from toftrack.configuration.sentences import sentence
from toftrack.devices.base import BaseDevice
from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import Frame

FRAMES = 12


@pytest.fixture(autouse=True)
def _importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_device", None)  # another test's module has the same name


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """A user's folder: the device, its configuration, and images in the sample's words."""
    (tmp_path / "my_device.py").write_text(code_of("cameras.md", "own-device"), encoding="utf-8")
    conf = tmp_path / "my_conf" / "device"
    conf.mkdir(parents=True)
    (conf / "raw.yaml").write_text(
        code_of("cameras.md", "own-device-configuration"), encoding="utf-8"
    )
    with open(tmp_path / "images.raw", "wb") as images:
        for frame in Sample(stop=FRAMES):
            words = np.rint(np.minimum(frame.depth, 65) * 1000).astype(np.uint16)
            images.write(words.tobytes())
        images.write(b"the beginning of another")
    return tmp_path


@pytest.fixture
def track(workplace: Path) -> Callable[..., tuple[int, str, str]]:
    """`python track.py` as it is run in the user's folder, with that in PYTHONPATH."""
    given = ("--config-dir", "my_conf", "device=raw", "view=none", "hydra.run.dir=out", *QUICK)
    return partial(programs.call, *given, folder=workplace)


def test_the_readmes_camera_is_tracked(workplace: Path, track: Callable) -> None:
    sample = Sample(stop=FRAMES)
    K = sample.camera.K
    assert len(code_of("cameras.md", "own-device").splitlines()) <= 35
    status, _, err = track("device.path=images.raw", f"device.focal_px={K[0, 0]}")
    assert status == 0 and "tracking RawImages (until it ends): " in err, err
    with np.load(workplace / "out" / "track.npz") as result:
        found = result["joints_m"]
        assert not result["lost"].any()
        assert (np.diff(result["timestamp_s"]) > 0).all()
    # The sample's centre is not that of the image; the depth does not care.
    assert found.shape == (FRAMES, 21, 3)
    assert np.abs(found[..., 2] - sample.truth.joints_m[..., 2]).mean() < 0.01


class Tensors(Sample):
    """A camera whose images are tensors."""

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            yield replace(frame, depth=torch.from_numpy(frame.depth))


def test_a_camera_may_give_tensors() -> None:
    found, expected = (
        [estimate.joints_m for estimate in toftrack.track(device(stop=2), *QUICK, "view=none")]
        for device in (Tensors, Sample)
    )
    np.testing.assert_array_equal(found, expected)


def test_its_own_error_is_reported_in_one_sentence(workplace: Path) -> None:
    settings = {"path": "nowhere.raw", "width": 176, "height": 144, "focal_px": 200.0}
    device = instantiate({"_target_": "my_device.RawImages"} | settings)
    with pytest.raises(ToftrackError) as caught, device:
        next(iter(device))
    assert sentence(caught.value) == "'nowhere.raw' cannot be opened: No such file or directory"


@pytest.mark.parametrize(
    ("second", "words"),
    [
        ("yield None", "a device must yield Frame(index, timestamp_s, "),
        ("yield Frame(2, 0.08, None, None, False)", "a device must yield Frame(index, "),
        ("raise OSError(19, 'No such device')", "No such device, in RawImages"),
        ("open('gain.txt')", "'gain.txt': No such file or directory, in RawImages"),
    ],
)
def test_what_goes_wrong_is_told_with_the_place_and_what_came_before_is_kept(
    workplace: Path, track: Callable, second: str, words: str
) -> None:
    code = (workplace / "my_device.py").read_text()
    here = "\n                yield Frame("
    assert here in code
    code = code.replace(
        here, f"\n                if index == 2:\n                    {second}{here}"
    )
    (workplace / "my_device.py").write_text(code)
    status, _, err = track("device.path=images.raw", "device.focal_px=200")
    assert status == 1 and f"error: {words}" in err
    assert ", in RawImages.__iter__ (" in err and "my_device.py, line " in err
    with np.load(workplace / "out" / "track.npz") as result:
        assert len(result["lost"]) == 2


def test_code_that_cannot_be_imported_is_reported(tmp_path: Path) -> None:
    (tmp_path / "my_device.py").write_text("class RawImages(:\n", encoding="utf-8")
    with pytest.raises(HydraException) as caught:
        instantiate({"_target_": "my_device.RawImages"})
    reported = sentence(caught.value)
    assert reported.startswith("the _target_ my_device.RawImages cannot be imported (")
    assert "invalid syntax (my_device.py, line 1)" in reported and "PYTHONPATH" in reported


def test_a_device_without_frames_is_reported() -> None:
    class Empty(BaseDevice): ...

    with Empty(Camera(np.eye(3), 4, 3)) as device:
        with pytest.raises(ToftrackError, match="Empty has no frames; write its method __iter__"):
            next(iter(device))
