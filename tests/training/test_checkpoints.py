"""What a training goes on from: its own checkpoint, and the weights of another."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from toftrack.detector.network import Finder, PoseNet
from toftrack.detector.weights import go_on_from, save_weights
from toftrack.errors import ToftrackError
from toftrack.training.checkpoints import Checkpoints, Progress, save


def test_a_checkpoint_of_another_training_is_refused(tmp_path: Path) -> None:
    network = torch.nn.Linear(2, 2)
    progress = Progress(network, network, torch.optim.AdamW(network.parameters()), 24)
    resumed = Checkpoints(tmp_path, 1.0, resume=tmp_path)
    path = tmp_path / "poses.checkpoint.pt"
    save(path, progress, {"batch": 24, "seed": 0})
    resumed.restore("poses", progress, {"batch": 24, "seed": 0})
    with pytest.raises(ToftrackError, match="a training with batch=24, but now batch=32"):
        resumed.restore("poses", progress, {"batch": 32, "seed": 0})
    other = torch.nn.Linear(3, 2)
    wrong = Progress(other, other, torch.optim.AdamW(other.parameters()), 24)
    with pytest.raises(ToftrackError, match=r"poses.checkpoint.pt is no checkpoint"):
        resumed.restore("poses", wrong, {"batch": 24})
    for content in (b"PK no archive", pickle.dumps({"settings": Path()}), b""):
        path.write_bytes(content)
        with pytest.raises(ToftrackError, match="is no checkpoint") as refused:
            resumed.restore("poses", progress, {})
        assert "weights_only" not in str(refused.value)  # torch's advice to trust the file
    with pytest.raises(ToftrackError, match="there is no checkpoint"):
        Checkpoints(tmp_path, 1.0, resume=tmp_path / "gone").restore("poses", progress, {})


def test_training_goes_on_from_the_weights_of_a_file(tmp_path: Path) -> None:
    network, going_on, file = PoseNet(4), PoseNet(4), tmp_path / "weights.npz"
    save_weights(file, network, Finder(8), {})
    go_on_from(file, going_on)
    for name, value in network.state_dict().items():
        torch.testing.assert_close(going_on.state_dict()[name], value, atol=1e-3, rtol=1e-3)
    for width in (6, 10):
        with pytest.raises(ToftrackError, match=f"width of 8, and the width to train is {width}"):
            go_on_from(file, Finder(width))
