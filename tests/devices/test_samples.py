"""The recordings that come with the package."""

from importlib import resources

import numpy as np
import pytest

import toftrack
from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.recordings.store import SAMPLES, sample_file

DATA = resources.files("toftrack") / "data"


@pytest.mark.parametrize("name", SAMPLES[1:])
def test_a_sample_is_small_and_keeps_its_truth_its_licence_and_its_origin(name: str) -> None:
    device = Sample(name=name)
    assert device.truth is not None and device.truth.visible.mean() > 0.9
    assert device.metadata["licence"].startswith("CC0") and device.metadata["origin"]
    assert len((DATA / sample_file(name)).read_bytes()) <= 2e6
    assert f"`{sample_file(name)}`" in (DATA / "README.md").read_text(encoding="utf-8")


def test_a_name_that_no_sample_has_is_answered_with_those_that_there_are() -> None:
    with pytest.raises(ToftrackError, match="'lefthand'.*right_hand, .*; did you mean left_hand"):
        Sample(name="lefthand")


@pytest.mark.parametrize(
    ("name", "start", "least"),
    [("left_hand", 30, 0.6), ("two_hands", 0, 0.5), ("point_and_pinch", 60, 0.5)],
)
def test_a_sample_is_tracked(name: str, start: int, least: float, one_thread: None) -> None:
    """Estimates of which every joint is within 40 mm and which are not flagged, of the later ones
    of 30 frames."""
    hands = 2 if name == "two_hands" else 1
    tracker = toftrack.make_hands_tracker(f"hands={hands}", "seed=0")
    device, usable = Sample(name=name, start=start, stop=start + 30), []
    with np.load(DATA / sample_file(name)) as file:
        truths = [file[key][start:] for key in ("joints_m", "joints2_m")[:hands]]
    for row, frame in enumerate(device):
        depth = device.camera.rectify(frame.depth, frame.radial)
        found = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
        for truth in truths:
            errors = [np.linalg.norm(one.joints_m - truth[row], axis=1).max() for one in found]
            right = [not one.lost for one, far in zip(found, errors, strict=True) if far < 0.04]
            usable.append(any(right))
    assert np.mean(usable[len(usable) // 3 :]) > least


def test_the_first_sample_is_small_and_keeps_its_licence() -> None:
    assert len((DATA / "sample.npz").read_bytes()) <= 4_500_000
    licence = (DATA / "README.md").read_text(encoding="utf-8")
    assert "MIT" in licence and "2019 Amazon" in licence
