"""docs/measure_angles.py, and what docs/formats.md says of the joint angles."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.hands import hand_estimate
from helpers.tracking import ROOT, code_of

import toftrack
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.output.results import ResultWriter

sys.path.insert(0, str(ROOT / "docs"))
from measure_angles import bent_deg, every_neighbour


def joints(**angles_rad: float) -> np.ndarray:
    """(1, 21, 3) of a right hand at the origin, in its own axes."""
    state = torch.zeros(1, 27)
    for name, angle in angles_rad.items():
        state[0, 6 + toftrack.ANGLE_NAMES.index(name)] = angle
    return forward_kinematics(state, default_hand_shape()).joints_m.numpy()


def test_what_is_measured_is_the_flexion_of_the_outer_joints() -> None:
    found = bent_deg(joints(ring_pip_flexion=1.0, little_dip_flexion=0.5, thumb_ip_flexion=-0.2))
    assert found.shape == (1, 5, 3)
    outer = found[0, [3, 4, 0, 1], [1, 2, 2, 1]]
    assert outer == pytest.approx(np.degrees([1.0, 0.5, 0.2, 0.0]), abs=0.1)


def test_an_angle_is_ok_where_its_three_joints_are() -> None:
    ok = np.ones((1, 21), bool)
    ok[0, toftrack.JOINT_NAMES.index("index_dip")] = False
    assert np.argwhere(~every_neighbour(ok)[0]).tolist() == [[1, 1], [1, 2]]


def test_the_table_of_degrees_says_which_are_ok(tmp_path: Path) -> None:
    pytest.importorskip("pandas", reason="pip install '.[pandas]'")
    dice = np.random.default_rng(0)
    with ResultWriter(tmp_path, {}, toftrack.JOINT_NAMES) as writer:
        for index in range(30):
            writer.append((hand_estimate(index, bent=0.5, joint_ok=dice.random(21) < 0.8),))
    results = toftrack.Results(toftrack.read_results(tmp_path / "track.npz"))
    code = code_of("formats.md", "degrees")
    known = {"np": np, "toftrack": toftrack, "results": results}
    exec(code.replace('toftrack.track("hand.npz").results()', "results"), known)
    table, ok = known["table"], every_neighbour(results.joint_ok)
    for name in toftrack.ANGLE_NAMES:
        finger, joint = divmod(toftrack.JOINT_NAMES.index(name.rpartition("_")[0]) - 1, 4)
        assert table[f"{name}_ok"].tolist() == ok[:, finger, joint].tolist(), name
    pip = results.state[:, 6 + toftrack.ANGLE_NAMES.index("ring_pip_flexion")]
    assert table.ring_pip_flexion_deg.to_numpy() == pytest.approx(np.degrees(pip))


@pytest.mark.parametrize(
    ("angle", "tip", "axis", "sign"),
    [
        ("index_mcp_abduction", "index_tip", 0, 1),  # towards the thumb
        ("little_mcp_abduction", "little_tip", 0, 1),
        ("index_pip_flexion", "index_tip", 2, -1),  # out of the palm
        ("thumb_cmc_abduction", "thumb_tip", 2, -1),
        ("thumb_cmc_abduction", "thumb_tip", 1, 1),  # back to the wrist
        ("thumb_cmc_flexion", "thumb_tip", 0, -1),  # towards the fingers
        ("thumb_ip_flexion", "thumb_tip", 0, -1),
    ],
)
def test_positive_angles_turn_as_the_page_says(angle: str, tip: str, axis: int, sign: int) -> None:
    moved = (joints(**{angle: 0.3}) - joints())[0, toftrack.JOINT_NAMES.index(tip)]
    assert sign * moved[axis] > 0.004
