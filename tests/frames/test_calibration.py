"""The calibration finds a known camera again, from chequerboards that are rendered for it."""

import json
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.frames import calibration
from toftrack.frames.calibration import View
from toftrack.frames.camera import Camera
from toftrack.programs import calibrate, command_line
from toftrack.recordings.sr_frame import encode_frame, nominal_camera
from toftrack.recordings.srs import SrsFacts, SrsWriter

RANGE_M = 7.4948
_GAIN = 1070.0  # amplitude of a white surface at 1 m
_WALL_M = 3.0
_SAMPLES = 3  # a side of a pixel


def wiggle(radial_m: np.ndarray) -> np.ndarray:
    """A depth error: 3 mm sinusoidal plus 10 mm a metre."""
    return 0.003 * np.sin(2 * np.pi * radial_m / 1.874 + 0.6) + 0.010 * radial_m


BOARD, SQUARE_M = (7, 5), 0.03
"""Columns and rows of inner corners."""
# The nominal camera, off by 5 %, and a barrel distortion.
TRUE = Camera(np.array([[210.0, 0, 96.6], [0, 210.0, 63], [0, 0, 1]]), 176, 144, [-0.2, 0, 0, 0, 0])


def board_poses(count: int, near_m: float, far_m: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations (3, 3) and translations (3,) of boards that are mostly in view, turned by up to 40
    degrees, from near to far; the board's middle is its origin."""
    rng, poses = np.random.default_rng(0), []
    half_m = (np.array(BOARD) + 2) * SQUARE_M / 2
    for z in near_m * (far_m / near_m) ** np.linspace(0, 1, count):
        turn = rng.uniform(-0.7, 0.7, 3) * (1, 1, 0.3)
        free = np.maximum(0.0, np.multiply((0.40, 0.30), z) - half_m)
        middle = np.append(rng.uniform(-free, free), z)
        poses.append((cv2.Rodrigues(turn)[0], middle))
    return poses


def render_board(
    pose: tuple[np.ndarray, np.ndarray], rng: np.random.Generator | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The radial distance, (H, W) float32 m, and the amplitude, uint16, of one board, by TRUE.

    The board has a white margin of one square, before a grey wall. Each pixel sums the phasors of
    3 x 3 samples, so that edges mix as in the camera. With `rng`: the depth error, and noise as of
    the mesh-hand recordings, 3.5 mm at an amplitude of 2560.
    """
    rotation, middle = pose
    rays = _sample_rays()
    lengths = np.sqrt(1 + (rays**2).sum(-1))
    directions = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
    z = (middle @ rotation[:, 2]) / (directions @ rotation[:, 2])
    on_board = (directions * z[..., None] - middle) @ rotation  # (..., 3), the third is 0
    across = on_board[..., 0] / SQUARE_M + (BOARD[0] - 1) / 2
    down = on_board[..., 1] / SQUARE_M + (BOARD[1] - 1) / 2
    squares = (across > -1) & (across < BOARD[0]) & (down > -1) & (down < BOARD[1])
    margin = (across > -2) & (across < BOARD[0] + 1) & (down > -2) & (down < BOARD[1] + 1)
    black = squares & ((np.floor(across) + np.floor(down)) % 2 == 0)
    seen = margin & (z > 0)
    z = np.where(seen, z, _WALL_M)
    albedo = np.where(seen, np.where(black, 0.12, 0.85), 0.4)
    facing = np.abs(directions @ rotation[:, 2]) / lengths
    radial = z * lengths
    amplitude = _GAIN * albedo * np.where(seen, facing, 1.0) / radial**2
    phasors = (amplitude * np.exp(2j * np.pi * radial / RANGE_M)).mean(axis=(2, 3))
    if rng is not None:
        sigma = 0.0035 * 2560 * 2 * np.pi / RANGE_M
        phasors = phasors + sigma * (
            rng.standard_normal(phasors.shape) + 1j * rng.standard_normal(phasors.shape)
        )
    measured = np.angle(phasors) % (2 * np.pi) * RANGE_M / (2 * np.pi)
    if rng is not None:
        measured = measured + wiggle(measured)
    strength = np.clip(np.abs(phasors), 0, 65535).astype(np.uint16)
    return measured.astype(np.float32), strength


@cache
def _sample_rays() -> np.ndarray:
    """(H, W, S, S, 2) x and y at Z = 1 of the samples of each pixel."""
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    v, u, dv, du = np.meshgrid(
        np.arange(TRUE.height), np.arange(TRUE.width), steps, steps, indexing="ij"
    )
    pixels = np.stack([u + du, v + dv], -1)
    rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), TRUE.K, TRUE.distortion)
    return rays.reshape(pixels.shape)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board from 0.33 to 1.5 m, with noise and a depth error; nothing is said of the camera."""
    path, rng = tmp_path_factory.mktemp("calibration") / "board.srs", np.random.default_rng(0)
    with closing(SrsWriter(path, facts=SrsFacts(RANGE_M))) as writer:
        for number, pose in enumerate(board_poses(24, 0.33, 1.5)):
            images = render_board(pose, rng)
            writer.append(encode_frame(*images, RANGE_M), number / 25)
    return path


@pytest.fixture(scope="module")
def calibrated(recording: Path) -> tuple[Camera, Path]:
    """The camera file's camera, and the folder of the report."""
    folder = recording.parent
    out, report = folder / "camera.json", folder / "report"
    calibrate.main(
        [str(recording), "--board", "7x5", "--square", "0.03", "--out", str(out)]
        + ["--report", str(report)]
    )
    return Camera.load(out), report


def depth_error_m(camera: Camera) -> np.ndarray:
    """What is left of the depth error from 0.3 to 1.5 m."""
    true = np.linspace(0.3, 1.5, 500)
    # The rays of its first row hardly part: radial distance and Z are the same.
    K = np.diag((1e5, 1e5, 1))
    flat = replace(camera, K=K, width=500, height=2000, distortion=np.zeros(5))
    measured = np.tile((true + wiggle(true)).astype(np.float32), (2000, 1))
    return flat.rectify(measured, True)[0] - true


def test_finds_the_lens_again(calibrated: tuple[Camera, Path]) -> None:
    camera, _ = calibrated
    np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], 210, rtol=0.005)
    np.testing.assert_allclose(camera.K[:2, 2], (96.6, 63), atol=1.0)
    gap = camera.normalised_rays() - TRUE.normalised_rays()
    assert np.abs(gap).max() < 0.008  # the corners are beyond most boards
    assert np.sqrt((gap**2).mean()) < 0.002


def test_takes_the_depth_error_away(calibrated: tuple[Camera, Path]) -> None:
    rms = np.sqrt((depth_error_m(calibrated[0]) ** 2).mean())
    assert rms < 0.002
    true = np.linspace(0.3, 1.5, 500)
    assert np.sqrt((wiggle(true) ** 2).mean()) > 0.008


def test_report_tells_before_and_after(calibrated: tuple[Camera, Path]) -> None:
    camera, folder = calibrated
    facts = json.loads((folder / "report.json").read_text())
    assert facts["before"]["fx"] == 200
    assert facts["after"]["fx"] == camera.K[0, 0]
    assert facts["before"]["board_rms_mm"] > 5
    assert facts["after"]["board_rms_mm"] < 2
    assert facts["order"] in range(1, 8)
    assert facts["frames_used"] >= 20
    assert "before" in (folder / "report.txt").read_text()
    for name in ("corners.png", "depth_error.png"):
        picture = cv2.imread(str(folder / name))
        assert picture.std() > 10


def test_a_known_lens_is_kept(recording: Path, tmp_path: Path) -> None:
    TRUE.save(tmp_path / "start.json")
    out = tmp_path / "camera.json"
    calibrate.main(
        [str(recording), "--board", "7x5", "--square", "0.03", "--keep-lens", "--frames", "10"]
        + ["--camera", str(tmp_path / "start.json"), "--out", str(out)]
    )
    camera = Camera.load(out)
    np.testing.assert_array_equal(camera.K, TRUE.K)
    np.testing.assert_array_equal(camera.distortion, TRUE.distortion)
    assert np.sqrt((depth_error_m(camera) ** 2).mean()) < 0.002
    assert (tmp_path / "camera.report" / "report.txt").exists()


def corners_of(poses: list[tuple[np.ndarray, np.ndarray]], sigma_px: float) -> list[View]:
    """The corners that TRUE sees, found with some noise."""
    points, rng, views = calibration.board_points(BOARD, SQUARE_M), np.random.default_rng(1), []
    for index, (rotation, middle) in enumerate(poses):
        origin, turn = middle - rotation @ points.mean(0), cv2.Rodrigues(rotation)[0]
        pixels, _ = cv2.projectPoints(points, turn, origin, TRUE.K, TRUE.distortion)
        views.append(View(index, pixels.reshape(-1, 2) + rng.normal(0, sigma_px, (len(points), 2))))
    return views


def test_exact_corners_give_the_exact_lens_and_planes() -> None:
    poses = board_poses(12, 0.35, 1.2)
    views = corners_of(poses, 0.0)
    lens = calibration.fit_lens(views, BOARD, SQUARE_M, nominal_camera())
    np.testing.assert_allclose(lens.camera.K, TRUE.K, atol=0.01)
    known = calibration.known_lens(views, BOARD, SQUARE_M, TRUE)
    assert known.errors_px.max() < 1e-3
    for number, pose in enumerate(poses):
        distance = calibration.true_distances(known, number, BOARD, SQUARE_M)
        radial, _ = render_board(pose)
        on_board = np.isfinite(distance)
        assert on_board.sum() > 300
        # Rendered from samples within each pixel; slanted pixels differ a little.
        assert np.abs(distance - radial)[on_board].max() < 0.002


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--board", "7", "--square", "0.03"], "COLUMNSxROWS"),
        (["--board", "7x5", "--square", "30"], "metres"),
        (["--board", "9x6", "--square", "0.03", "--out", "gone/camera.json"], "No such file"),
        (["--board", "9x6", "--square", "0.03", "--out", "."], "Is a directory"),
        (["--board", "9x6", "--square", "0.03", "--frames", "3"], "no 9x6 chequerboard"),
        (["--board", "7x5", "--square", "0.025", "--frames", "10"], "0.83 times as far apart"),
    ],
)
def test_errors_are_one_sentence(
    recording: Path,
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command_line.run(lambda: calibrate.main([str(recording), *arguments])) == 1
    last = capfd.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert words in last


def test_boards_that_are_hardly_turned_are_refused() -> None:
    # Any focal length fits them: 2600 pixels came out here, of 210, without a word.
    middles = [middle for _, middle in board_poses(20, 0.35, 1.2)]
    slanted = cv2.Rodrigues(np.array([0.5, 0.0, 0.0]))[0]
    for rotation in (np.eye(3), slanted):
        views = corners_of([(rotation, middle) for middle in middles], 0.05)
        with pytest.raises(ToftrackError, match="turned in all directions"):
            calibration.fit_lens(views, BOARD, SQUARE_M, nominal_camera())


def test_large_images_are_searched_once_and_hardly_enlarged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = Mock(return_value=(False, None))
    monkeypatch.setattr(cv2, "findChessboardCornersSB", search)
    ramp = np.tile(np.arange(1280, dtype=np.uint16), (720, 1))
    assert calibration.find_corners(ramp, BOARD) is None
    search.assert_called_once()
    assert search.call_args.args[0].shape[1] < 1400


def test_a_recording_without_amplitude_is_reported(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", depth_m=np.ones((2, 6, 8), np.float32), K=np.diag((9.0, 9, 1)))
    with pytest.raises(ToftrackError, match="no amplitude"):
        calibrate.main([str(tmp_path / "a.npz"), "--board", "7x5", "--square", "0.03"])
