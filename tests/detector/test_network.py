"""The networks' answers are hands, whatever they are shown."""

import pytest
import torch
from helpers.detection import small_networks

from toftrack.detector.crops import CROP, CROP_CHANNELS
from toftrack.detector.network import STRIDE, PoseNet, Proposed, cube_rotations
from toftrack.hand.skeleton import ANGLE_LIMITS


def test_the_anchors_are_the_24_rotations_of_the_cube() -> None:
    anchors = cube_rotations()
    assert anchors.shape == (24, 3, 3)
    assert torch.equal(anchors @ anchors.mT, torch.eye(3).expand(24, 3, 3))
    assert (torch.linalg.det(anchors) == 1).all()
    different = (anchors[:, None] - anchors[None]).abs().amax((2, 3)) > 0.5
    assert torch.equal(different, ~torch.eye(24, dtype=torch.bool))


def answers(image: torch.Tensor, scale: float = 1.0) -> Proposed:
    torch.manual_seed(3)
    network = PoseNet(4).eval()
    with torch.no_grad():
        network.heads.weight *= scale
        network.keypoints.weight *= scale
        return network(image)


@pytest.mark.parametrize("scale", [0.0, 1.0, 300.0])
@pytest.mark.parametrize("kind", ["random", "zeros", "ones"])
def test_every_hypothesis_is_a_hand(kind: str, scale: float) -> None:
    size = (3, CROP_CHANNELS, CROP, CROP)
    images = {
        "random": 2 * torch.rand(size, generator=torch.Generator().manual_seed(0)) - 1,
        "zeros": torch.zeros(size),
        "ones": torch.ones(size),
    }
    p = answers(images[kind], scale)
    for name, value in p._asdict().items():
        assert value.isfinite().all(), name
    assert p.rotation.shape == (3, 24, 3, 3) and p.angles.shape == (3, 24, 21)
    eye = torch.eye(3).expand(3, 24, 3, 3)
    assert torch.allclose(p.rotation @ p.rotation.mT, eye, atol=1e-4)
    assert torch.linalg.det(p.rotation) == pytest.approx(1, abs=1e-3)
    low, high = torch.tensor(ANGLE_LIMITS).unbind(1)
    assert (p.angles >= low - 1e-5).all() and (p.angles <= high + 1e-5).all()
    assert p.log_probability.exp().sum(1) == pytest.approx(1, abs=1e-4)
    assert (p.error_m > 0).all() and (p.sigma_m > 0).all()


def test_an_untrained_network_s_hypotheses_are_its_anchors() -> None:
    p = answers(torch.zeros(1, CROP_CHANNELS, CROP, CROP), 0.0)
    trace = (p.rotation[0] * cube_rotations()).sum((1, 2))
    assert trace == pytest.approx(3, abs=0.2)


def test_the_finder_has_a_cell_for_every_few_pixels() -> None:
    _, finder = small_networks()
    found = finder(torch.rand(2, 2, 80, 96, generator=torch.Generator().manual_seed(0)))
    for value in found:
        assert value.shape == (2, 80 // STRIDE, 96 // STRIDE) and value.isfinite().all()
    # Before it has learned anything, it finds no hands.
    assert (found.heat.sigmoid() < 0.2).all()
