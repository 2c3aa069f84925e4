"""Poses to learn from: users' files, mixtures, held-out clips, the command."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import hydra
import numpy as np
import pytest
import torch
from helpers import programs
from helpers.detection import dice
from helpers.tracking import ROOT, configuration
from reference.refinement import moved

from toftrack.errors import ToftrackError
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import ANGLE_LIMITS, ANGLE_NAMES, forward_kinematics
from toftrack.pose_space.data.leap import leap_data
from toftrack.pose_space.data.pose_data import (
    PoseData,
    drawn_poses,
    mixed_data,
    natural_data,
    recorded_poses,
    spread_out,
    synthetic_data,
)
from toftrack.pose_space.data.pose_files import file_data, run_data
from toftrack.pose_space.files import fit_pose_space, load_pose_space, make_pose_space
from toftrack.pose_space.held_out import (
    clip_folds,
    errors_table,
    evaluate_space,
    nearest_latents,
    reconstruction,
)
from toftrack.pose_space.inverse_kinematics import fit_angles, joint_jacobian, shape_of_joints
from toftrack.training.shown_poses import shown_poses
from toftrack.views.figures.poses import corners_figure, manifold_figure, traversals_figure

LOW, HIGH = torch.tensor(ANGLE_LIMITS, dtype=torch.float64).unbind(1)


def random_angles(count: int, seed: int = 0, part: float = 0.6) -> torch.Tensor:
    """Poses in the inner part of the joint limits, (count, 21) float64."""
    unit = torch.rand(count, 21, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (LOW + HIGH) / 2 + part * (unit - 0.5) * (HIGH - LOW)


def write_csv(path: Path, angles: np.ndarray, names=ANGLE_NAMES, units="degrees") -> str:
    lines = [f"# units: {units}"] if units else []
    lines.append(",".join(names))
    lines += [",".join(f"{value:.6f}" for value in row) for row in angles]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@pytest.mark.parametrize("units", ["degrees", "radians"])
@pytest.mark.parametrize("said_by", ["file", "setting"])
def test_a_csv_of_angles_is_read_in_its_units_and_any_order(
    tmp_path: Path, units: str, said_by: str
) -> None:
    radians = random_angles(6)
    values = (radians.rad2deg() if units == "degrees" else radians).numpy()
    said, given = (units, None) if said_by == "file" else (None, units)
    path = write_csv(tmp_path / "mine.csv", values[:, ::-1], ANGLE_NAMES[::-1], said)
    data = file_data(path, given)
    torch.testing.assert_close(data.angles_rad, radians, atol=1e-5, rtol=0)
    assert data.labels == ("mine",) * 6


def test_an_npz_of_angles_is_read(tmp_path: Path) -> None:
    radians = random_angles(4)
    np.savez(
        tmp_path / "mine.npz",
        angles=radians.numpy()[:, ::-1],
        angle_names=np.array(ANGLE_NAMES[::-1]),
        units=np.array("radians"),
        labels=np.array(["p", "q", "p", "q"]),
    )
    data = file_data(str(tmp_path / "mine.npz"))
    torch.testing.assert_close(data.angles_rad, radians)
    assert data.clips.tolist() == [0, 1, 0, 1]


def write_run(folder: Path, angles: torch.Tensor, slots: int = 1, **changes) -> Path:
    """A track.npz with these angles, of two slots in both."""
    state = np.concatenate([np.zeros((len(angles), 6)), angles.numpy()], 1).astype(np.float32)
    state = state if slots == 1 else np.stack([state, state], 1)
    shape = state.shape[:-1]
    arrays = {"state": state, "lost": np.zeros(shape, bool), "confidence": np.full(shape, 0.95)}
    folder.mkdir(exist_ok=True)
    np.savez(folder / "track.npz", **(arrays | changes))
    return folder


@pytest.mark.parametrize("slots", [1, 2])
def test_the_poses_of_a_run_are_those_that_are_sure(tmp_path: Path, slots: int) -> None:
    radians = random_angles(200)
    shape = (200,) if slots == 1 else (200, 2)
    lost, sure = np.zeros(shape, bool), np.full(shape, 0.9)
    lost[:10], sure[10:20] = True, 0.5
    folder = write_run(tmp_path / "mine", radians, slots, lost=lost, confidence=sure)
    data = run_data(str(folder), None, 0.8)
    expected = torch.cat([radians[20:]] * slots)
    torch.testing.assert_close(data.angles_rad, expected, atol=1e-6, rtol=0)
    assert set(data.labels) == {"mine"} and len(data.clips.unique()) > 2
    assert len(run_data(str(folder / "track.npz"), 50, 0.0)) == 50


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lost": np.ones(9, bool)}, "9 frames of the run .* 0 are not lost"),
        ({"state": np.zeros((9, 20), np.float32)}, "no states of 27 numbers"),
        ({"confidence": np.ones(8)}, "damaged"),
    ],
)
def test_a_run_that_cannot_be_learned_from_is_reported(tmp_path, changes, words) -> None:
    folder = write_run(tmp_path / "mine", random_angles(9), **changes)
    with pytest.raises(ToftrackError, match=words):
        run_data(str(folder), None, 0.8)
    with pytest.raises(ToftrackError, match="give data=run data.path="):
        file_data(str(folder / "track.npz"))


def test_the_documentation_s_labels_and_clips_are_read_and_another_column_left_alone(
    tmp_path: Path,
) -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    example = text.split("```\n# units")[1].split("```")[0]
    units, header, *rows = ("# units" + example).splitlines()
    lines = [units, f"{header},note", *(f"{row},hello" for row in rows)]
    (tmp_path / "mine.csv").write_text("\n".join(lines))
    data = file_data(str(tmp_path / "mine.csv"))
    assert data.labels == ("open", "half", "fist") and data.clips.tolist() == [0, 0, 1]


GIVEN = random_angles(5).rad2deg().numpy()
OF_RUN = tuple(f"{name}_rad" for name in ANGLE_NAMES)
NAN, SIGNS = GIVEN.copy(), GIVEN.copy()
NAN[3, 2], SIGNS[:, 6::4] = np.nan, -80.0


@pytest.mark.parametrize(
    ("values", "names", "units", "more", "part"),
    [
        (GIVEN[:, :-1], ANGLE_NAMES[:-1], "degrees", b"", "no column 'little_dip_flexion'"),
        (GIVEN, OF_RUN, None, b"", "was exported from a run; give data=run data.path=RUN"),
        (GIVEN, ANGLE_NAMES, "degrees", b"1," * 20 + b"much", "pose 6 is 'much', not a number"),
        (GIVEN, ANGLE_NAMES, "degrees", b"1,2", "pose 6 has 2 values for 21 columns"),
        (NAN, ANGLE_NAMES, "degrees", b"", "thumb_mcp_abduction of pose 4 is not a finite number"),
        (np.radians(GIVEN), ANGLE_NAMES, "degrees", b"", "data.units=radians"),
        (GIVEN, ANGLE_NAMES, "radians", b"", "data.units=degrees"),
        (GIVEN, ANGLE_NAMES, None, b"", "does not say its units"),
        (SIGNS, ANGLE_NAMES, "degrees", b"", "beyond a hand's joint limits"),
        (GIVEN, ANGLE_NAMES, "degrees", bytes(range(256)), "comma-separated UTF-8"),
    ],
)
def test_a_bad_csv_is_one_clear_sentence(tmp_path, values, names, units, more, part) -> None:
    path = write_csv(tmp_path / "mine.csv", values, names, units)
    with Path(path).open("ab") as file:
        file.write(more)
    with pytest.raises(ToftrackError, match=part) as error:
        file_data(path)
    assert path in str(error.value)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        ({"poses": np.zeros((3, 21))}, "no array 'angles'"),
        ({"angles": np.array([{}] * 21, dtype=object)}, "'angles' holds pickled objects"),
        ({"angles": np.ones((3, 21)), "labels": np.array(["a"])}, "1 'labels' for 3 poses"),
        ({"angles": np.ones((3, 21)), "angle_names": np.array(["a"] * 21)}, "does not name"),
    ],
)
def test_a_bad_npz_is_one_clear_sentence(tmp_path: Path, content: dict, part: str) -> None:
    np.savez(tmp_path / "mine.npz", **content)
    with pytest.raises(ToftrackError, match=part):
        file_data(str(tmp_path / "mine.npz"), "radians")


def test_a_file_that_is_missing_or_of_another_kind_is_one_clear_sentence(tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="data.path=FILE"):
        file_data(str(tmp_path / "nothing.csv"))
    with pytest.raises(ToftrackError, match="neither .csv nor .npz"):
        file_data(str(tmp_path / "mine.xlsx"))


def test_poses_a_little_beyond_the_limits_are_clamped_and_counted(tmp_path: Path) -> None:
    values = random_angles(4).rad2deg().numpy()
    values[2, 5] = 29.0
    data = file_data(write_csv(tmp_path / "mine.csv", values))
    assert float(data.angles_rad[2, 5]) == pytest.approx(math.radians(25))
    assert "1 of them clamped" in data.notes[0]


def test_the_poses_that_cover_a_set_are_its_extremes_first() -> None:
    line = torch.linspace(0, 1, 101).double()[:, None]
    assert spread_out(line, 3).tolist() == [0, 50, 100]
    assert spread_out(line, 500).tolist() == list(range(101))


def test_a_mixture_keeps_clips_and_sources_apart(tmp_path: Path) -> None:
    mine = file_data(write_csv(tmp_path / "mine.csv", random_angles(300).rad2deg().numpy()))
    both = mixed_data({"synthetic": synthetic_data(), "mine": mine}, poses=100)
    assert len(both) == 179
    assert both.labels.count("mine") == 100
    assert len(both.clips.unique()) == len(synthetic_data().clips.unique()) + 1
    assert [source["data"] for source in both.sources] == ["synthetic", "file"]
    with pytest.raises(ToftrackError, match="data.parts"):
        mixed_data({}, poses=None)


def test_natural_poses_are_recorded_sampled_and_the_papers_always_the_same() -> None:
    data = natural_data(60)
    assert len(data) == 3 * 60
    assert {source.get("part", source["data"]) for source in data.sources} == {
        "synthetic",
        "recorded",
        "sampled",
    }
    assert torch.equal(data.angles_rad, natural_data(60).angles_rad)
    assert (data.angles_rad >= LOW - 1e-4).all() and (data.angles_rad <= HIGH + 1e-4).all()
    assert len(data.clips.unique()) > 3, "held out in parts"


def test_a_space_of_natural_poses_describes_natural_poses_better() -> None:
    poses = torch.cat((recorded_poses()[::7], shown_poses(115, dice()))).double()

    def error(data: str) -> float:
        space = make_pose_space("pca", 4, None, data).to("cpu", torch.float64)
        return float((space.decode(space.encode(poses)) - poses).square().mean().sqrt())

    assert error("natural") < 0.95 * error("synthetic")


def test_folds_hold_out_whole_clips_and_every_pose_once() -> None:
    clips = torch.tensor([0] * 50 + [1] * 3 + [2] * 20 + [3] * 20 + [4])
    seen = []
    for training, out in clip_folds(clips, 3):
        assert not set(clips[training].tolist()) & set(clips[out].tolist())
        assert len(training) + len(out) == len(clips)
        seen += out.tolist()
    assert sorted(seen) == list(range(len(clips)))
    assert list(clip_folds(torch.zeros(9))) == []


def test_held_out_clips_are_described_worse_than_training_poses() -> None:
    row = evaluate_space("pca", 4, synthetic_data())
    assert row.variance == pytest.approx(0.9788, abs=0.001)
    assert row.training.degrees == pytest.approx(2.96, abs=0.03)
    assert row.held_out is not None and row.held_out.degrees > row.training.degrees
    assert 0 < row.training.mm < row.held_out.mm
    # The projection of PCA may leave the box, but not by more than a little.
    assert row.reached is not None and row.reached.degrees > 0.98 * row.held_out.degrees
    text = errors_table([row])
    assert f"{row.held_out.degrees:.2f} deg" in text and f"{row.held_out.mm:.2f} mm" in text


def test_the_nearest_point_of_the_box_is_no_worse_than_the_encoded_one_moved_into_it() -> None:
    poses = synthetic_data()
    space = fit_pose_space("lle", 3)
    found = nearest_latents(space, poses.angles_rad[::4])
    assert (found >= space.lower - 1e-6).all() and (found <= space.upper + 1e-6).all()
    encoded = space.encode(poses.angles_rad[::4].float()).clamp(space.lower, space.upper)
    with_search, _ = reconstruction(space, poses.angles_rad[::4], found)
    without, _ = reconstruction(space, poses.angles_rad[::4], encoded)
    assert (with_search.sum(1) <= without.sum(1) + 1e-6).all()


def test_a_single_clip_has_no_held_out_figures() -> None:
    data = PoseData(random_angles(30), ("mine",) * 30, torch.zeros(30), ({},))
    row = evaluate_space("pca", 2, data)
    assert row.held_out is None
    assert " - " in errors_table([row])


@pytest.mark.parametrize("dims", [1, 4])
def test_figures_of_any_data_are_drawn(dims: int) -> None:
    data = PoseData(random_angles(30), ("mine",) * 30, torch.zeros(30), ({},))
    space = fit_pose_space("pca", dims, data)
    assert manifold_figure(space).std() > 0
    assert traversals_figure(space, steps=3, size=60).shape == (dims * 92, 180, 3)
    assert corners_figure(space, size=60).std() > 0


def test_the_command_trains_on_a_users_file_and_records_it(tmp_path: Path) -> None:
    mine = write_csv(tmp_path / "mine.csv", random_angles(40).rad2deg().numpy())
    out = tmp_path / "out"
    given = ("pose_space=lle", "pose_space.dims=2", "data=file", f"data.path={mine}")
    given += ("compare=[1,30]", "hydra.run.dir=out")
    status, printed, err = programs.call(*given, folder=tmp_path, program="train_pose_space.py")
    assert status == 0, err
    assert "40 training poses" in printed and " deg," in printed
    assert "left out of the table: [30] dimensions; at most 21" in printed
    assert load_pose_space(out / "pose_space.npz").dims == 2
    header = json.loads(str(np.load(out / "pose_space.npz")["header"]))
    assert header["sources"][0]["file"] == "mine.csv"
    for name in ("poses.png", "manifold.png", "traversals.png", "corners.png"):
        assert cv2.imread(str(out / name)).std() > 0
    errors = json.loads((out / "summary.json").read_text())["errors"]
    assert [row["dims"] for row in errors] == [1, 2]


def test_the_recorded_poses_are_those_of_hands() -> None:
    recorded = recorded_poses()
    assert recorded.shape == (800, 21)
    # Recorded hands bend a little beyond what clinics tabulate.
    assert (recorded > LOW - 0.35).all() and (recorded < HIGH + 0.35).all()


def test_the_drawn_poses_are_within_the_limits_and_of_all_kinds() -> None:
    angles = drawn_poses()
    assert (angles >= LOW.float()).all() and (angles <= HIGH.float()).all()
    # Fingers straight and curled, each of them.
    bent = angles[:, 5:].unflatten(1, (4, 4))[:, :, 1:].sum(2)
    for share in ((bent < 0.7).float().mean(0), (bent > 3.0).float().mean(0)):
        assert (share > 0.1).all() and (share < 0.8).all()


def test_a_sweep_prefers_no_space_that_held_out_clips_could_not_judge(tmp_path: Path) -> None:
    clips = ",".join(("clip", *ANGLE_NAMES))
    poses = np.degrees(random_angles(8).numpy())
    rows = [",".join((str(n // 2), *(f"{a:.4f}" for a in pose))) for n, pose in enumerate(poses)]
    (tmp_path / "poses.csv").write_text("\n".join(("# units: degrees", clips, *rows)) + "\n")
    given = ["-m", "data=file", f"data.path='{tmp_path}/poses.csv'", "pose_space.dims=3,7"]
    given += ["compare=[]", "hydra.sweep.dir=sweep"]
    status, out, err = programs.call(*given, folder=tmp_path, program="train_pose_space.py")
    assert status == 0, err
    # Seven dimensions describe the eight poses that they were learned from exactly.
    few, many = (line for line in out.splitlines() if line.startswith("#"))
    assert "error inf degrees" in many and "error inf degrees" not in few


def test_a_sweep_whose_lines_nobody_reads_goes_on(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-um", "toftrack", "train", "-m", "pose_space.dims=2", "compare=[]"]
    with open(writing, "w") as pipe:
        done = subprocess.run(command, cwd=tmp_path, stdout=pipe, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")


def joints_of(angles: torch.Tensor, scale: float = 1.0, seed: int = 0) -> torch.Tensor:
    """(T, 5, 4, 3) metres of hands anywhere in space."""
    generator = torch.Generator().manual_seed(seed)
    placed = torch.randn(len(angles), 6, generator=generator, dtype=torch.float64)
    shape = default_hand_shape(scale * DEFAULT_HAND_LENGTH_M).to(torch.float64)
    joints = forward_kinematics(torch.cat((placed, angles), 1), shape).joints_m[:, 1:]
    return joints.unflatten(1, (5, 4))


def test_inverse_kinematics_finds_the_angles_that_the_joints_were_made_from() -> None:
    angles = random_angles(30)
    fit = fit_angles(joints_of(angles), default_hand_shape(), iterations=40, prior=1e-9)
    assert float(fit.error_m.max()) < 1e-5
    assert math.degrees(float((fit.angles_rad - angles).abs().max())) < 0.1


def test_inverse_kinematics_stays_within_the_joint_limits() -> None:
    angles = random_angles(20, part=1.5)
    fit = fit_angles(joints_of(angles), default_hand_shape())
    assert (fit.angles_rad >= LOW - 1e-9).all() and (fit.angles_rad <= HIGH + 1e-9).all()
    assert float(fit.error_m.mean()) < 0.01


def test_the_jacobian_of_the_joints_is_their_derivative() -> None:
    shape = default_hand_shape().to(torch.float64)
    state = torch.cat((0.3 * torch.ones(3, 6, dtype=torch.float64), random_angles(3)), 1)

    def joints_after(step: torch.Tensor) -> torch.Tensor:
        return forward_kinematics(moved(state, step.expand_as(state)), shape).joints_m[:, 1:]

    found = joint_jacobian(forward_kinematics(state, shape), shape)
    expected = torch.func.jacfwd(joints_after)(state.new_zeros(27)).flatten(1, 2)
    torch.testing.assert_close(found, expected, atol=1e-8, rtol=0)


def test_a_recorded_hand_gives_its_own_bones() -> None:
    shape = shape_of_joints(joints_of(random_angles(10), scale=0.9), default_hand_shape())
    expected = default_hand_shape(0.9 * DEFAULT_HAND_LENGTH_M)
    torch.testing.assert_close(shape.bone_lengths_m, expected.bone_lengths_m, atol=1e-6, rtol=0)
    torch.testing.assert_close(shape.base_m, expected.base_m, atol=1e-5, rtol=0)


def motion(frames: int, seed: int) -> torch.Tensor:
    """A smooth movement between random poses, (frames, 21)."""
    ends = random_angles(2, seed)
    return torch.lerp(ends[0], ends[1], torch.linspace(0, 1, frames).double()[:, None])


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Two right-handed clips, the first again at half rate, and a left-handed clip."""
    first, second, third = (
        joints_of(motion(40, 1), seed=1),
        joints_of(motion(30, 2), 1.1, seed=2),
        joints_of(motion(20, 3), 0.9, seed=3) * torch.tensor([-1.0, 1.0, 1.0]),
    )
    clips = [first[::2], first, second, third]
    path = tmp_path / "joints.npz"
    np.savez(
        path,
        joints_mm=torch.cat(clips).numpy().astype(np.float32) * 1e3,
        is_left=np.repeat([False, False, False, True], [20, 40, 30, 20]),
        seq_name=np.array(["a-half.json.lz", "a.json.lz", "b.json.lz", "c.json.lz"]),
        seq_len=np.array([20, 40, 30, 20]),
    )
    return path


def test_recorded_motion_becomes_joint_angles(recorded: Path) -> None:
    data = leap_data(str(recorded), poses=None, worst_fit_mm=10.0)
    assert list(dict.fromkeys(data.labels)) == ["a", "b", "c"]
    assert data.clips.tolist() == [0] * 40 + [1] * 30 + [2] * 20
    source = data.sources[0]
    assert source["file"] == "joints.npz" and source["clips"] == ["a", "b", "c"]
    assert source["fit_mean_mm"] < 1.0
    expected = torch.cat((motion(40, 1), motion(30, 2), motion(20, 3)))
    # The palm's direction is a convention: all abductions may be off by the same turn.
    flexions = [i for i, name in enumerate(ANGLE_NAMES) if "flexion" in name and i > 4]
    off = (data.angles_rad - expected)[:, flexions]
    assert math.degrees(float(off.square().mean().sqrt())) < 6.0
    assert "1 repeat another" in data.notes[0] and "20 of 110" in data.notes[0]


def test_a_recording_is_thinned_to_poses_that_cover_it(recorded: Path) -> None:
    data = leap_data(str(recorded), poses=12, worst_fit_mm=10.0)
    assert len(data) == 12
    assert set(data.labels) == {"a", "b", "c"}


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"joints_mm": None}, "joints_mm"),
        ({"seq_len": np.array([1, 2, 3, 4])}, "10 frames together"),
        ({"joints_mm": np.zeros((110, 5, 3, 3), np.float32)}, "joints_mm .110, 5, 3, 3., is_left"),
        ({"joints_mm": np.full((110, 5, 4, 3), np.nan, np.float32)}, "NaN"),
        ({"seq_name": np.array([{}] * 4, dtype=object)}, "pickled"),
    ],
)
def test_a_bad_recording_is_one_clear_error(recorded: Path, changes: dict, part: str) -> None:
    with np.load(recorded) as archive:
        content = dict(archive) | changes
    np.savez(recorded, **{name: value for name, value in content.items() if value is not None})
    with pytest.raises(ToftrackError, match=part) as error:
        leap_data(str(recorded), None, 10.0)
    assert str(recorded) in str(error.value)


def test_sources_are_mixed_by_the_configuration(recorded: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.npz"
    np.savez(mine, angles=random_angles(6).numpy(), units=np.array("radians"))
    more = ["+data@data.parts.mine=file", f"data.parts.mine.path={mine}", "data.poses=30"]
    given = ("data=mixture", f"data.parts.leap.path={recorded}", *more)
    config = configuration(*given, name="train_pose_space")
    data = hydra.utils.instantiate(config.data)
    assert [source["data"] for source in data.sources] == ["synthetic", "leap", "file"]
    assert len(data) == 30 + 30 + 6
