"""The camera: projection, radial distance, distortion and depth correction agree."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import checked_image

W, H = 176, 144
K = np.array([[200.0, 0, 88.5], [0, 210.0, 71], [0, 0, 1]])
DISTORTION = np.array([-0.35, 0.15, 0.002, -0.001, 0.01])


def plane_z(rays: np.ndarray) -> np.ndarray:
    """Z of the plane 0.2 x + 0.1 y + z = 0.8 along the rays."""
    return 0.8 / (1 + rays @ (0.2, 0.1))


def test_project_undoes_the_rays() -> None:
    camera = Camera(K, W, H)
    z = np.random.default_rng(0).uniform(0.3, 2, (H, W, 1))
    points = np.concatenate([camera.normalised_rays() * z, z], axis=-1)
    v, u = np.mgrid[:H, :W]
    np.testing.assert_allclose(camera.project(points), np.stack([u, v], axis=-1), atol=1e-9)


def test_points_before_the_camera_have_an_image() -> None:
    camera = Camera(K, W, H)
    assert np.isnan(camera.project(np.array([[0.1, 0.1, 0.0], [0.1, 0.1, -1.0]]))).all()
    at = camera.project(np.array([0.0, 0.0, 0.5]))
    np.testing.assert_array_equal(at, (88.5, 71), "pixels' centres lie at integers")


RATIONAL = (0.5, -0.1, 2e-3, -1e-3, 0.01, 0.85, 0.02, -0.005)
LENSES = {
    4: (-0.15, 0.03, 2e-3, -1e-3),
    5: (-0.15, 0.03, 2e-3, -1e-3, 0.005),
    8: RATIONAL,
    12: (*RATIONAL, 0.002, -0.001, 0.003, 0.001),
    14: (*RATIONAL, 0.002, -0.001, 0.003, 0.001, 0.01, -0.02),
}


def seen(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Where the camera's own lens shows points (n, 3): OpenCV's forward projection, (n, 2)."""
    zero, points = np.zeros(3), points.reshape(-1, 1, 3)
    if camera.lens == "fisheye":
        return cv2.fisheye.projectPoints(points, zero, zero, camera.K, camera.distortion)[0][:, 0]
    return cv2.projectPoints(points, zero, zero, camera.K, camera.distortion)[0][:, 0]


def some_lens(count: int) -> Camera:
    """A wide lens: the image's corners lie 45 degrees off the axis."""
    K = np.array([[115.0, 0, 88.5], [0, 118.0, 71], [0, 0, 1]])
    if count:
        return Camera(K, W, H, np.array(LENSES[count]))
    return Camera(K, W, H, np.array((0.05, -0.02, 0.01, -0.004)), lens="fisheye")


@pytest.mark.parametrize("count", [0, *LENSES])
def test_every_lens_of_opencvs_is_undone(count: int) -> None:
    camera, radial = some_lens(count), count in (0, 5, 12)
    rays = camera.normalised_rays().reshape(-1, 2)
    v, u = np.mgrid[:H, :W]
    pixels = np.column_stack([u.ravel(), v.ravel()])
    np.testing.assert_allclose(
        seen(camera, np.column_stack([rays, np.ones(len(rays))])), pixels, atol=0.01
    )
    measured = plane_z(camera.normalised_rays()).astype(np.float32)
    pinhole = Camera(camera.K, W, H)
    lengths = np.sqrt(1 + (rays**2).sum(-1)).reshape(H, W) if radial else 1.0
    z = camera.rectify((measured * lengths).astype(np.float32), radial)
    inside = z > 0
    assert inside.mean() > 0.8
    expected = plane_z(pinhole.normalised_rays())
    np.testing.assert_allclose(z[inside], expected[inside], atol=0.006)
    far = np.abs(measured - expected)[inside].max()
    assert far > 0.02, "without undoing the lens the plane would be elsewhere"


def test_a_fisheye_of_zeros_is_still_one() -> None:
    camera = Camera(some_lens(0).K, W, H, np.zeros(4), lens="fisheye")
    angle = np.hypot(88.5 / 115, 71 / 118)
    assert np.linalg.norm(camera.normalised_rays()[0, 0]) == pytest.approx(np.tan(angle), rel=1e-6)


def test_no_reading_is_zero() -> None:
    camera = Camera(np.eye(3), 6, 1)
    depth = np.array([[0.5, np.nan, np.inf, -np.inf, -1.0, 0.0]], np.float32)
    for radial in (False, True):
        z = camera.rectify(depth, radial)
        assert z.dtype == np.float32
        assert (z[0, 1:] == 0).all()
        assert z[0, 0] > 0


def test_undistortion_never_mixes_two_depths() -> None:
    camera = Camera(K, W, H, DISTORTION)
    depth = np.where(np.arange(W) < W // 2, 0.5, 1.5).astype(np.float32) * np.ones((H, 1))
    found = set(np.unique(camera.rectify(depth.astype(np.float32), False)).tolist())
    assert {0.5, 1.5} <= found <= {0, 0.5, 1.5}


def test_amplitude_moves_with_the_depth() -> None:
    image = np.random.default_rng(0).integers(1, 60000, (H, W), dtype=np.uint16)
    camera = Camera(K, W, H, DISTORTION)
    moved = camera.undistort_amplitude(image)
    assert moved.dtype == np.uint16
    np.testing.assert_array_equal(moved, camera.rectify(image.astype(np.float32), False))
    assert not np.array_equal(moved, image)
    np.testing.assert_array_equal(Camera(K, W, H).undistort_amplitude(image), image)
    assert camera.undistort_amplitude(None) is None


@pytest.mark.parametrize("radial", [False, True])
def test_depth_polynomial_corrects_the_radial_distance(radial: bool) -> None:
    coefficients = (0.01, -0.02, 0.03)
    camera = Camera(K, W, H, depth_polynomial=coefficients)
    measured = np.random.default_rng(0).uniform(0.3, 1.5, (H, W))
    measured[0, 0] = 0
    lengths = np.sqrt(1 + (camera.normalised_rays() ** 2).sum(axis=-1))
    corrected = measured + 0.01 - 0.02 * measured + 0.03 * measured**2
    image = measured if radial else measured / lengths
    z = camera.rectify(image.astype(np.float32), radial)
    assert z[0, 0] == 0, "the correction must not invent a reading"
    np.testing.assert_allclose(z.ravel()[1:], (corrected / lengths).ravel()[1:], rtol=1e-5)


def test_image_of_another_size_is_reported() -> None:
    with pytest.raises(ToftrackError, match="176x144"):
        Camera(K, W, H).rectify(np.ones((W, H), np.float32), False)


@pytest.mark.parametrize("count", [0, *LENSES])
def test_save_and_load_keep_the_lens(tmp_path: Path, count: int) -> None:
    camera = replace(some_lens(count), depth_polynomial=(0.01, -0.002))
    camera.save(tmp_path / "camera.json")
    assert Camera.load(tmp_path / "camera.json").to_dict() == camera.to_dict()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "other"}, "not a camera file"),
        ({"K": None}, "lacks the key 'K'"),
        ({"width": "wide"}, "whole number"),
        ({"distortion": [0, 0]}, "4, 5, 8, 12, 14 numbers.*has 2"),
        ({"lens": "mirror"}, "opencv or fisheye.*mirror"),
        ({"depth_polynomial": [0.1] * 10**5}, "100000 coefficients"),
        ({"depth_polynomial_range_m": [1.5, 0.3]}, "nearest, then farthest"),
        ({"depth_polynomial_range_m": [[1], [1, 2]]}, "has numbers that cannot be read"),
    ],
)
def test_bad_camera_file_is_reported(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = tmp_path / "camera.json"
    Camera(K, W, H).save(path)
    content = json.loads(path.read_text()) | change
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    with pytest.raises(ToftrackError, match=words) as caught:
        Camera.load(path)
    assert "camera.json" in str(caught.value)


def test_files_that_are_no_camera_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    for content in (b"", b"[]", b"\xff\xfe\x00"):
        path.write_bytes(content)
        with pytest.raises(ToftrackError, match="camera.json"):
            Camera.load(path)
    with pytest.raises(ToftrackError, match="cannot be read"):
        Camera.load(tmp_path / "nope.json")
    with pytest.raises(ToftrackError, match="cannot be written"):
        Camera(K, W, H).save(tmp_path / "nowhere" / "camera.json")


@pytest.mark.parametrize(
    ("place", "value"),
    [((0, 0), 1e-300), ((1, 1), 1e300), ((0, 2), 5000.0), ((1, 2), -900.0)],
)
def test_a_matrix_that_no_camera_has_is_refused_with_one_that_is_plausible(place, value) -> None:
    strange = K.copy()
    strange[place] = value
    words = r"of 176x144 pixels .*; a plausible one is \[\[194, 0, 88\]"
    for matrix in (strange, np.eye(3)):
        with pytest.raises(ToftrackError, match=words):
            Camera(matrix, W, H)


@pytest.mark.parametrize(
    ("K", "size"),
    [
        ([[212.0, 0, 256], [0, 212.0, 212]], (512, 424)),  # a wide fisheye
        ([[600.0, 0, -250], [0, 600.0, 400]], (64, 64)),  # a part beside the whole image's middle
        ([[1400.0, 0, 320], [0, 700.0, 120]], (640, 240)),  # every second row
        ([[5000.0, 0, 320], [0, 5000.0, 240]], (640, 480)),  # a narrow view
    ],
)
def test_unusual_cameras_are_plausible(K: list, size: tuple[int, int]) -> None:
    assert Camera(np.array([*K, [0, 0, 1]]), *size).width == size[0]


def test_a_rectified_image_is_the_callers_own() -> None:
    depth = np.full((H, W), 0.6, np.float32)
    Camera(K, W, H).rectify(depth, radial=False)[:] = 9.0
    assert depth.max() < 1


def test_what_a_correction_brings_behind_the_camera_is_no_reading() -> None:
    corrected = Camera(K, W, H, depth_polynomial=(-0.5,)).rectify(
        np.full((H, W), 0.3, np.float32), radial=True
    )
    assert (corrected == 0).all()


def test_masked_pixels_are_no_readings() -> None:
    masked = np.zeros((H, W), bool)
    masked[:15] = True
    image, _ = checked_image(np.ma.masked_array(np.full((H, W), 0.6, np.float32), masked), K)
    assert (image[:15] == 0).all() and (image[15:] > 0).all()
