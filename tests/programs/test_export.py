"""`toftrack export RUN --to ...`: the file goes into the run's folder."""

import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.animation import Gltf, read_bvh
from helpers.hands import hand_estimate, lost_hand

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.results import ResultWriter
from toftrack.output.summary import shape_file
from toftrack.programs import export

FRAMES, MISSED, LOST = 9, 4, 6
"""Of the run, how many; which was dropped; in which no hand was found."""


def run_of(folder: Path, *sides: str | None) -> Path:
    """A run with a slot for each side; None: one that never had a hand."""
    with ResultWriter(folder, {"config": {}}, JOINT_NAMES) as results:
        for slot in range(len(sides)):
            default_hand_shape().save(folder / shape_file(slot))
        for index in range(FRAMES):
            if index != MISSED:
                there = [side if index != LOST else None for side in sides]
                results.append(tuple(estimate(index, side) for side in there))
    return folder


def estimate(index: int, side: str | None) -> Estimate:
    if side is None:
        return lost_hand(index)
    sigma, confidence = np.full((21, 3), 0.01, np.float32), np.full(21, 0.9, np.float32)
    made = hand_estimate(index, side, bent=0.1 * index)
    return made.updated(joint_sigma_m=sigma, joint_confidence=confidence)


SLOTS = [("right",), ("right", "left"), (None, "left", None, "right")]


@pytest.mark.parametrize("sides", SLOTS)
def test_a_glb_loads_and_moves_each_hand_that_was_there(
    sides: tuple[str | None, ...], tmp_path: Path
) -> None:
    pygltflib = pytest.importorskip("pygltflib", reason="pip install '.[export]'")
    (made,) = export.export(run_of(tmp_path / "run", *sides), "glb")
    assert made.name == "hand.glb"
    there = [side for side in sides if side]
    document = pygltflib.GLTF2().load_binary(str(made))
    assert len(document.skins) == len(document.meshes) == len(there)
    assert all(len(skin.joints) == 26 for skin in document.skins)
    gltf = Gltf(made.read_bytes())
    for side in there:
        letter = side[0].upper()
        names, channels = [f"{n.title()}_{letter}" for n in OPENXR_JOINT_NAMES], gltf.channels()
        _, shown, _ = channels[f"Hand_{letter}", "scale"]
        assert np.flatnonzero(shown[:, 0] == 0).tolist() == [LOST]
        for key in ((name, path) for name in names for path in ("translation", "rotation")):
            time_s, values, steps = channels[key]
            assert np.allclose(time_s, np.arange(FRAMES) / 25)
            assert len(values) == FRAMES and steps == "LINEAR"
        for frame in (0, 3, MISSED, FRAMES - 1):
            as_in = frame - 1 if frame == MISSED else frame
            seen, world = hand_estimate(as_in, side, bent=0.1 * as_in), gltf.world(frame)
            places = [world[name][:3, 3] for name in names]
            assert np.allclose(places, seen.openxr_position_m, atol=2e-6)


@pytest.mark.parametrize("sides", SLOTS)
def test_a_bvh_has_the_skeleton_of_a_hand_that_was_there(
    sides: tuple[str | None, ...], tmp_path: Path
) -> None:
    made = export.export(run_of(tmp_path / "run", *sides), "bvh")
    slots = {f"hand{slot}.bvh": side for slot, side in enumerate(sides, 1) if side}
    assert [path.name for path in made] == (["hand.bvh"] if len(sides) == 1 else list(slots))
    for path, side in zip(made, slots.values(), strict=True):
        text = path.read_text()
        names, places = read_bvh(text)
        assert f"Frames: {FRAMES}\nFrame Time: 0.040000000\n" in text
        assert len(names) == 25 and names[0] == f"Wrist_{side[0].upper()}"
        assert len(places) == FRAMES and np.allclose(places[[MISSED]], places[3])
        for frame in (0, FRAMES - 1):
            there = 100 * hand_estimate(frame, side, bent=0.1 * frame).openxr_position_m[1:]
            assert np.allclose(places[frame, -1], there[0], atol=0.001)  # the root ends last
            away = np.linalg.norm(places[frame] - there[:, None], axis=-1)
            assert away.min(1).max() < 0.01  # every joint is somewhere


def test_a_bvh_lasts_as_long_as_frames_whose_times_are_whole_milliseconds(tmp_path: Path) -> None:
    default_hand_shape().save(tmp_path / shape_file(0))
    with ResultWriter(tmp_path, {"config": {}}, JOINT_NAMES) as results:
        for index in range(31):
            results.append((estimate(index, "right").updated(timestamp_s=round(index / 30, 3)),))
    text = export.export(tmp_path, "bvh")[0].read_text()
    (seconds,) = re.findall(r"Frame Time: (\S+)", text)
    assert float(seconds) == pytest.approx(1 / 30, abs=1e-8)


@pytest.mark.parametrize("sides", SLOTS)
def test_a_csv_has_a_row_a_frame_and_slot(sides: tuple[str | None, ...], tmp_path, capsys) -> None:
    made = run_of(tmp_path / "run", *sides) / "hand.csv"
    export.main([str(made.parent), "--to", "csv"])
    assert capsys.readouterr().out == f"  {made}\n"
    rows = list(csv.DictReader(io.StringIO(made.read_text())))
    assert len(rows) == FRAMES * len(sides)
    for number, row in enumerate(rows):
        frame, slot = divmod(number, len(sides))
        assert row["index"] == str(frame)
        assert row.get("slot", "0") == str(slot)
        there = sides[slot] is not None and frame != LOST
        assert (row["side"], row["lost"]) == ((sides[slot], "0") if there else ("", "1"))
        assert (row["wrist_x_m"] != "") == there
        assert (row["little_dip_flexion_rad"] != "") == there
        sure = row["little_tip_confidence"], row["wrist_sigma_ray_m"], row["wrist_sigma_across_m"]
        assert sure == (("0.9", "0.01", "0.01") if there else ("", "", ""))
        if there and frame != MISSED:
            assert float(row["timestamp_s"]) == pytest.approx(frame / 25, abs=1e-6)
            hand = estimate(frame, sides[slot])
            for joint, name in enumerate(JOINT_NAMES):
                place = [float(row[f"{name}_{axis}_m"]) for axis in "xyz"]
                assert place == pytest.approx(hand.joints_m[joint].tolist(), abs=1e-5)
                assert row[f"{name}_ok"] == "1"
            assert row["pointing_origin_x_m"] == ""
            assert row["side_probability"] == "1.0"  # a number that need not be whole


def test_of_two_hands_of_one_side_the_joints_have_names_of_their_own(tmp_path: Path) -> None:
    made = export.export(run_of(tmp_path / "run", "left", "left"), "bvh")
    names = [read_bvh(path.read_text())[0] for path in made]
    assert names[0][0] == "Wrist_L" and names[1][0] == "Wrist_L_2"
    assert not set(names[0]) & set(names[1])


def test_what_is_no_run_or_has_no_hand_is_reported(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", None)
    with pytest.raises(ToftrackError, match="is not the output folder of a run"):
        export.main([str(tmp_path), "--to", "csv"])
    with pytest.raises(ToftrackError, match="nothing to export"):
        export.main([str(run), "--to", "bvh"])
