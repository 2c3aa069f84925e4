"""The recordings that come with the package: `device=sample device.name=NAME`."""

from __future__ import annotations

from importlib import resources

import pytest

from toftrack.devices.sample import Sample
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
