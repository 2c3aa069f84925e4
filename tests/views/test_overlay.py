"""The overlay: what is drawn where, and files that can be opened again."""

import dataclasses
import math
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
from helpers.hands import hand_estimate, lost_hand
from helpers.videos import video_frames

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.estimate import Estimate
from toftrack.hand.shape import default_hand_shape
from toftrack.views import overlay
from toftrack.views.overlay import CAPTION_PX, VideoView
from toftrack.views.skeleton import SLOT_RGB

W, H = 176, 144
CAMERA = Camera(np.array([[200.0, 0, 88], [0, 200.0, 72], [0, 0, 1]]), W, H)
DEPTH = np.full((H, W), 1.5, np.float32)
AMPLITUDE = np.full((H, W), 1000, np.uint16)
THUMB, LITTLE = (0, 159, 230), (167, 121, 204)  # BGR


def hand(lost: bool = False) -> Estimate:
    """Half a metre away, the thumb to the right."""
    return hand_estimate(7, lost=lost, joint_ok=np.full(21, not lost))


def sides(panel: np.ndarray, scale: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    caption = panel[: panel.shape[0] - scale * H]
    body = panel[caption.shape[0] :]
    return caption, body[:, : scale * W], body[:, scale * W :]


def colour_share(picture: np.ndarray, bgr: tuple[int, int, int]) -> float:
    return float((np.abs(picture.astype(int) - bgr).max(axis=-1) < 12).mean())


def is_grey(picture: np.ndarray) -> bool:
    return bool((picture.max(axis=-1) == picture.min(axis=-1)).all())


def other_hand() -> Estimate:
    """Another one, 10 cm to the left and 10 cm farther away, of a left hand that is nearly sure."""
    joints = hand().joints_m + np.array([-0.1, 0, 0.1], np.float32)
    return dataclasses.replace(hand(), joints_m=joints, side="left", side_probability=0.83)


def panel_sides(
    *estimates: Estimate,
    amplitude: np.ndarray | None = AMPLITUDE,
    models: tuple[np.ndarray, ...] = (0 * DEPTH,),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a panel: the caption and both sides.  models: what the hands' surfaces are, (H, W) m."""
    shapes = [default_hand_shape()] * len(estimates)
    with patch.object(overlay, "model_range_image", side_effect=models):
        return sides(overlay.draw_panel(DEPTH, amplitude, CAMERA, estimates, shapes))


def two(one: Estimate, other: Estimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    near, far = np.zeros((H, W)), np.zeros((H, W))
    near[20:80, 100:150], far[20:80, 20:120] = 0.5, 0.6
    return panel_sides(one, other, models=(near, far))


def test_two_hands_are_drawn_in_the_colours_of_their_slots() -> None:
    alone = panel_sides(hand())[1]
    caption, left, right = two(hand(), other_hand())
    assert colour_share(left, THUMB) > 1.3 * colour_share(alone, THUMB)
    for rgb in SLOT_RGB[:2]:
        assert colour_share(alone, rgb[::-1]) < 1e-4 < colour_share(left, rgb[::-1])
        assert colour_share(caption, rgb[::-1]) > 1e-3
    blue, orange = right[150, 330], right[150, 90]
    assert int(blue[0]) > int(blue[2]) + 50, "the nearer hides the farther"
    assert int(orange[2]) > int(orange[0]) + 50
    assert (right[300, 300] == 255).all()


@pytest.mark.parametrize("amplitude", [AMPLITUDE, None])
def test_each_joint_is_drawn_in_its_fingers_colour(amplitude: np.ndarray | None) -> None:
    one = hand()
    _, left, right = panel_sides(one, amplitude=amplitude)
    for joint, colour in ((4, THUMB), (2, THUMB), (20, LITTLE), (18, LITTLE)):
        u, v = np.round((CAMERA.project(one.joints_m[joint]) + 0.5) * 3 - 0.5).astype(int)
        np.testing.assert_allclose(left[v, u], colour, atol=2)
    assert is_grey(right)


def test_joints_that_are_not_ok_are_hollow_and_their_bones_dashed() -> None:
    ok = np.arange(21) != 4
    one = dataclasses.replace(hand(), joint_ok=ok)
    left = panel_sides(one)[1]
    for joint, colour in ((4, (0, 0, 0)), (20, LITTLE)):
        u, v = np.round((CAMERA.project(one.joints_m[joint]) + 0.5) * 3 - 0.5).astype(int)
        np.testing.assert_allclose(left[v, u], colour, atol=2)
    whole = panel_sides(hand())[1]
    assert 0 < colour_share(left, THUMB) < colour_share(whole, THUMB)
    assert colour_share(left, LITTLE) == colour_share(whole, LITTLE)
    along = np.linspace(one.joints_m[3], one.joints_m[4], 40)[10:30]
    pixels = np.round((CAMERA.project(along) + 0.5) * 3 - 0.5).astype(int)
    gaps = np.abs(left[pixels[:, 1], pixels[:, 0]].astype(int) - THUMB).max(1) > 60
    assert 0.2 < gaps.mean() <= 1
    assert (np.abs(whole[pixels[:, 1], pixels[:, 0]].astype(int) - THUMB).max(1) < 12).all()


def test_no_skeleton_without_an_estimate_behind_the_camera_or_far_outside_the_image() -> None:
    behind = dataclasses.replace(hand(), joints_m=-hand().joints_m)
    away = hand().joints_m + np.array([1e6, 0, 0], np.float32)
    outside = dataclasses.replace(hand(), joints_m=away)
    for one in (dataclasses.replace(lost_hand(7), lost=False), behind, outside):
        assert is_grey(panel_sides(one)[1])


def test_range_image_is_darker_where_nearer_on_white() -> None:
    model = np.zeros((H, W), np.float32)
    model[40:80, 40:80], model[40:80, 100:140] = 0.4, 0.6
    model[0, 0], model[0, 1] = np.nan, np.inf
    _, _, right = panel_sides(hand(), models=(model,))
    near, far, background = right[180, 180, 0], right[180, 360, 0], right[400, 30, 0]
    assert near < far < background == 255
    assert right[1, 1, 0] == right[1, 4, 0] == 255
    # The upscaling must not mix hand and background into other greys.
    assert set(np.unique(right)) == {near, far, 255}


def test_lost_is_red_and_tracking_is_not() -> None:
    red = (40, 40, 220)
    for lost in (True, False):
        caption, left, right = panel_sides(hand(lost))
        assert (colour_share(caption, red) > 0.5) == lost
        assert (colour_share(left[:, :3], red) > 0.9) == lost
        assert (colour_share(right[:, -3:], red) > 0.9) == lost


def panel_of(value: int, size: tuple[int, int] = (CAPTION_PX + 50, 160)) -> np.ndarray:
    return np.full((*size, 3), value, np.uint8)


def read_video(path: Path) -> tuple[list[np.ndarray], float]:
    return video_frames(path), cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS)


def test_video_has_every_panel_at_the_rate(tmp_path: Path) -> None:
    with VideoView(tmp_path, 12.5, 30) as view:
        for i in range(30):
            view.add(panel_of(8 * i))
    frames, fps = read_video(tmp_path / "overlay.mp4")
    assert fps == pytest.approx(12.5) and {frame.shape for frame in frames} == {(96, 160, 3)}
    assert [frame.mean() for frame in frames] == pytest.approx([8 * i for i in range(30)], abs=6)


@pytest.mark.parametrize("fps", [29.97002997, 1e-3, math.nan])
def test_odd_rates_and_sizes_give_a_readable_video(tmp_path: Path, fps: float) -> None:
    """Panels of other and odd sizes share an even one."""
    with VideoView(tmp_path, fps, None) as view:
        view.add(panel_of(10, (97, 161)))
        view.add(panel_of(20, (200, 300)))
    frames, found = read_video(tmp_path / "overlay.mp4")
    assert [frame.shape for frame in frames] == [(96, 160, 3)] * 2 and 1 <= found <= 120


@pytest.mark.parametrize(("count", "known"), [(10, True), (100, True), (170, False)])
def test_filmstrip_is_ten_evenly_spread_panels(tmp_path: Path, count: int, known: bool) -> None:
    with VideoView(tmp_path, 25, count if known else None) as view:
        for i in range(count):
            view.add(panel_of(round(250 * i / count), (CAPTION_PX + 4, 32)))
    strip = cv2.imread(str(tmp_path / "overlay.png"))
    height, width = strip.shape[0] // 2, strip.shape[1] // 5
    shown = [
        strip[height * row + height // 2, width * column + width // 2, 0] / 250 * count
        for row in range(2)
        for column in range(5)
    ]
    np.testing.assert_allclose(shown, np.linspace(0, count - 1, 10), atol=0.035 * count + 0.6)


def test_a_video_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="overlay.mp4.*view=none"):
        VideoView(tmp_path / "nowhere", 25, 10).add(panel_of(1))
