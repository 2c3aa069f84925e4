"""A finished run is read, or what is wrong with it is told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.hands import hand_estimate

from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.results import ResultWriter
from toftrack.output.run_folder import read_run


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with ResultWriter(tmp_path, {}, JOINT_NAMES) as writer:
        writer.append((hand_estimate(0),))
    default_hand_shape().save(tmp_path / "hand_shape.json")
    return tmp_path


def test_a_run_that_does_not_say_where_it_ran_is_read(folder: Path) -> None:
    facts = json.loads((folder / "run.json").read_text())
    facts.pop("working_folder", None)
    (folder / "run.json").write_text(json.dumps(facts))
    assert read_run(folder).found("recording.npz") == Path("recording.npz")


def test_a_summary_that_is_no_object_is_reported(folder: Path) -> None:
    (folder / "summary.json").write_text("[]")
    with pytest.raises(ToftrackError, match="summary.json' cannot be read"):
        read_run(folder)


def test_a_configuration_that_is_no_object_is_reported(folder: Path) -> None:
    with np.load(folder / "track.npz") as content:
        arrays = dict(content)
    np.savez(folder / "track.npz", **(arrays | {"metadata": np.array('{"config": [1]}')}))
    with pytest.raises(ToftrackError, match="does not say with which likelihood"):
        read_run(folder).likelihood()
