"""What the networks see: the same of a scene at any resolution, and something of any image."""

import math

import cv2
import numpy as np
import pytest
import torch
from helpers.detection import channels, intrinsics, small_networks
from helpers.settings import detector_settings
from helpers.tracking import sample

from toftrack.compute.rigid import PIVOT_M
from toftrack.compute.rotations import rotmat_to_rotvec
from toftrack.detector.crops import (
    CROP,
    CROP_CHANNELS,
    CROP_M,
    WIDE_F_PX,
    WIDE_LARGEST_PX,
    WIDE_MULTIPLE,
    WIDE_RANGE_M,
    crop_at,
    crop_rotation,
    thinned,
    wide,
)
from toftrack.detector.detection import OF_HYPOTHESES, Detection, doubted_sigma_m
from toftrack.detector.hand_detector import HandDetector
from toftrack.detector.network import STRIDE, Finder, Found, PoseNet
from toftrack.detector.proposals import KEPT
from toftrack.detector.weights import load_weights
from toftrack.hand.shape import DEFAULT_HAND_LENGTH_M, default_hand_shape
from toftrack.hand.skeleton import forward_kinematics

K = intrinsics(200.0, 144, 176)
PLACES = [(0.0, 0.0, 0.45), (0.198, 0.0, 0.45), (0.0, -0.16, 0.45)]  # the others at the border
PLACES += [(2.0, 0.0, 0.3), (0.0, 0.0, 0.01), (-5.0, 3.0, 0.2)]  # and beyond it


def numbers(seen: list[Detection]) -> dict[str, torch.Tensor]:
    """(C, ...) of C detections."""
    values = {name: torch.stack([getattr(one, name) for one in seen]) for name in OF_HYPOTHESES}
    values["keypoints_m"] = torch.stack([one.keypoints.points_m for one in seen])
    values["sigma_m"] = torch.stack([one.keypoints.sigma_m for one in seen])
    values["present"] = torch.tensor([one.present for one in seen])
    values["right_side"] = torch.tensor([one.right_side for one in seen])
    values["parts"] = torch.stack([torch.from_numpy(one.parts.kind) for one in seen])
    return values


def crop(depth_m: np.ndarray, k: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """(CROP_CHANNELS, CROP, CROP)."""
    image = np.empty((CROP_CHANNELS, CROP, CROP), np.float32)
    crop_at(depth_m, False, k, centre_m, crop_rotation(centre_m), image)
    return image


def reference_crop(
    depth_m: np.ndarray, k: np.ndarray, centre_m: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """The same by OpenCV."""
    distance, samples = float(np.linalg.norm(centre_m)), 2 * CROP
    focal, middle = samples * distance / CROP_M, (samples - 1) / 2
    pinhole = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    mapping = k @ rotation @ np.linalg.inv(pinhole)

    def warped(image: np.ndarray) -> np.ndarray:
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(image, mapping, (samples, samples), flags=nearest)

    # Z of the camera to z of the crop: along a ray d of the crop, z_crop = Z / (R d)_z.
    steps = (np.arange(samples) - middle) / focal
    slope = rotation[2, 0] * steps[None, :] + rotation[2, 1] * steps[:, None] + rotation[2, 2]
    read = np.where(slope > 0.05, warped(depth_m) / np.maximum(slope, 0.05), 0).astype(np.float32)
    inside = (warped(np.ones(depth_m.shape, np.uint8)) > 0) & (slope > 0.05)
    return channels(read[None], inside[None], np.array([distance], np.float32))[0]


@torch.inference_mode()
def reference(
    pose: PoseNet,
    depth_m: np.ndarray,
    k: np.ndarray,
    centres_m: np.ndarray,
    side: str,
    up: np.ndarray | None,
) -> dict[str, torch.Tensor]:
    """What HandDetector.detect says, by PoseNet.decode of the reference's crops."""
    flip = np.array([-1.0 if side == "left" else 1.0, 1.0, 1.0])
    mirror, mirror_turn = torch.from_numpy(flip).float(), torch.from_numpy(flip[[1, 0, 0]]).float()
    if side == "left":  # as a mirror shows it
        depth_m, k = np.ascontiguousarray(depth_m[:, ::-1]), k.copy()
        k[0, 2] = depth_m.shape[1] - 1 - k[0, 2]
    ups = [None] * len(centres_m) if up is None else list(up * flip)
    centres_m = centres_m * flip
    turns = [crop_rotation(*one) for one in zip(centres_m, ups, strict=True)]
    crops = [reference_crop(depth_m, k, *one) for one in zip(centres_m, turns, strict=True)]
    p = pose(torch.from_numpy(np.stack(crops)))
    turn, centre = torch.from_numpy(np.stack(turns)).float(), torch.from_numpy(centres_m).float()
    order = p.log_probability.argsort(1, descending=True)[:, :KEPT]

    def ordered(values: torch.Tensor) -> torch.Tensor:
        return values[torch.arange(len(order))[:, None], order]

    found = {name: ordered(getattr(p, name)) for name in ("angles", "log_size", "error_m")}
    found["log_probability"] = ordered(p.log_probability)
    found["pivot_m"] = (ordered(p.pivot_m) @ turn.mT + centre[:, None]) * mirror
    found["rotvec"] = rotmat_to_rotvec(turn[:, None] @ ordered(p.rotation)) * mirror_turn
    found["keypoints_m"] = (p.joints_m @ turn.mT + centre[:, None]) * mirror
    flat = [found[name].flatten(0, 1) for name in ("rotvec", "angles")]
    states = torch.cat((torch.zeros_like(flat[0]), *flat), 1)
    hand = forward_kinematics(states, default_hand_shape(side=side))
    away = hand.joints_m - (hand.frames[:, 0] @ torch.tensor(PIVOT_M))[:, None]
    away = away.unflatten(0, order.shape) * found["log_size"].exp()[..., None, None]
    found["joints_m"] = found["pivot_m"][:, :, None] + away
    lengths_m = DEFAULT_HAND_LENGTH_M * found["log_size"][:, 0].exp()
    each = zip(found["keypoints_m"], p.sigma_m, lengths_m.tolist(), strict=True)
    found["sigma_m"] = torch.stack([doubted_sigma_m(*one) for one in each])
    found |= {"present": p.present.sigmoid(), "right_side": p.right.sigmoid()}
    return found | {"parts": p.parts.argmax(1).byte()}


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.5), (0.3, 0.2, 0.4)])
@pytest.mark.parametrize("up", [None, (1.0, 0.0, 0.0), (-0.5, 0.7, 0.4), (0.0, -1.0, 0.0)])
def test_a_crop_faces_its_centre_and_what_is_said_to_be_up_is_up_in_it(
    centre: tuple[float, float, float], up: tuple[float, float, float] | None
) -> None:
    rotation = crop_rotation(np.array(centre), None if up is None else np.array(up))
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert rotation[:, 2] == pytest.approx(np.array(centre) / np.linalg.norm(centre))
    assert np.linalg.det(rotation) == pytest.approx(1)
    if up is not None:
        across, down, _ = np.array(up) @ rotation
        assert across == pytest.approx(0, abs=1e-12) and down < 0


def test_the_whole_image_keeps_its_rays() -> None:
    for focal, height, width in ((200.0, 144, 176), (365.0, 424, 512), (60.0, 50, 80)):
        k = intrinsics(focal, height, width)
        depth = np.zeros((height, width), np.float32)
        row, column = int(0.7 * height), int(0.3 * width)
        near = max(1, math.ceil(focal / WIDE_F_PX))
        depth[row - near : row + near + 1, column - near : column + near + 1] = 0.8
        image, new_k = wide(depth, k)
        assert (
            image.shape[:2] == (1, 2)
            and image.shape[2] % WIDE_MULTIPLE == image.shape[3] % WIDE_MULTIPLE == 0
        )
        v, u = image[0, 1].nonzero().double().mean(0).tolist()
        ray = ((u - new_k[0, 2]) / new_k[0, 0], (v - new_k[1, 2]) / new_k[1, 1])
        true = ((column - k[0, 2]) / focal, (row - k[1, 2]) / focal)
        assert ray == pytest.approx(true, abs=1.0 / WIDE_F_PX)


@pytest.mark.parametrize(
    "focal,height,width,step",
    [(200.0, 144, 176, 1), (499.0, 480, 640, 1), (640.0, 720, 1280, 2), (1500.0, 720, 1281, 6)],
)
def test_a_fine_image_keeps_every_nth_reading_and_its_rays(
    focal: float, height: int, width: int, step: int
) -> None:
    k, (v, u) = intrinsics(focal, height, width), np.indices((height, width), np.float32)
    x, y = (u - k[0, 2]) / focal, (v - k[1, 2]) / focal
    small, new_k = thinned(x.astype(np.float32), k)
    assert small.shape == tuple(len(range((step - 1) // 2, n, step)) for n in (height, width))
    rows, columns = np.indices(small.shape)
    np.testing.assert_allclose(small, (columns - new_k[0, 2]) / new_k[0, 0], atol=1e-6)
    small, _ = thinned(y.astype(np.float32), k)
    np.testing.assert_allclose(small, (rows - new_k[1, 2]) / new_k[1, 1], atol=1e-6)


def test_few_pixels_stay_however_long_the_lens() -> None:
    depth = np.full((12, 16), 0.5, np.float32)
    assert thinned(depth, intrinsics(5000.0, 12, 16))[0] is depth


@pytest.mark.parametrize("height", [48, 50])
def test_nothing_is_seen_beyond_the_whole_image(height: int) -> None:
    depth = np.random.default_rng(0).uniform(-1.0, 2.0, (height, 80)).astype(np.float32)
    image, new_k = wide(depth, k := intrinsics(WIDE_F_PX, height, 80))
    padded = np.pad(depth, ((0, -height % WIDE_MULTIPLE), (0, 0)))
    far = np.where(padded > 0, np.minimum(padded / np.float32(WIDE_RANGE_M), 1), 1)
    assert np.array_equal(image[0], (far, padded > 0)) and np.array_equal(new_k, k)


def test_a_view_as_wide_as_the_sky_is_seen_small() -> None:
    k = intrinsics(2.0, 144, 176)
    image, new_k = wide(np.full((144, 176), 0.5, np.float32), k)
    assert image.shape[2:] == (WIDE_LARGEST_PX, WIDE_LARGEST_PX)
    assert new_k[0, 0] == pytest.approx(2.0 * WIDE_LARGEST_PX / 176)
    assert new_k[1, 2] == pytest.approx((WIDE_LARGEST_PX - 1) / 2)


@pytest.mark.parametrize("centre", [(0.05, -0.02, 0.4), *PLACES[1:4]])
@pytest.mark.parametrize("scale", [1, 2])
def test_a_crop_is_that_of_the_reference(scale: int, centre: tuple[float, float, float]) -> None:
    """At two resolutions, with readings that are missing or beyond the cube, and beyond the image's
    border.
    """
    size, place = (144 * scale, 176 * scale), np.array(centre)
    depth = np.random.default_rng(0).uniform(0.2, 0.7, size).astype(np.float32)
    depth[60:70], depth[:, 80:84] = 0.0, 2.0
    k = intrinsics(200.0 * scale, *size)
    expected = reference_crop(depth, k, place, crop_rotation(place))
    off = np.abs(crop(depth, k, place) - expected)
    assert (off.max(0) < 1e-3).mean() > 0.95, "but for samples between two pixels"


def distinct(log_probability: torch.Tensor) -> torch.Tensor:
    """(C, H) which hypotheses are not as likely as the one before or after: their order is sure."""
    apart = -log_probability.diff(dim=1) > 1e-3
    sure = torch.ones(len(apart), 1, dtype=torch.bool)
    return torch.cat((sure, apart), 1) & torch.cat((apart, sure), 1)


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("network", ["trained", "random"])
def test_the_compiled_crop_is_that_of_the_reference(side: str, network: str) -> None:
    """Of hands, of places at the border, and of places beside the image."""
    networks = load_weights()[:2] if network == "trained" else small_networks()
    detector = HandDetector(*networks, detector_settings())
    for frame in (0, 30, 60):
        scene = sample().cut(frame)
        centres = np.concatenate((scene.joints_m[0, [0, 9]], [[0.2, 0.0, 0.45], [2.0, 0.1, 0.3]]))
        up = np.random.default_rng(frame).normal(size=(4, 3)) if frame else None
        reported = detector.detect(scene.depth_m[0], scene.k, centres, side, up)
        expected = reference(networks[0], scene.depth_m[0], scene.k, centres, side, up)
        ordered = distinct(expected["log_probability"])
        for name, value in expected.items():
            if name == "parts":
                continue
            both = numbers(reported)[name], value
            if value.shape[:2] == ordered.shape:
                both = both[0][ordered], both[1][ordered]
            # The file's weights hold the limits of the angles and the cells' places in half
            # precision, which only the reference uses.
            assert torch.allclose(*both, atol=1e-3, rtol=1e-3), name
        same = numbers(reported)["parts"] == expected["parts"]
        assert same.float().mean() > 0.99, "but for classes that are as likely"


def strange_images() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Images that no camera should take but the first, and their intrinsics."""
    flat = np.full((144, 176), 0.5, np.float32)
    oblong = np.array([[35.0, 0, 88.0], [0, 900.0, 71.5], [0, 0, 1]])
    beside = np.array([[200.0, 0, -300.0], [0, 200.0, 500.0], [0, 0, 1]])
    return {
        "a hand": (sample().depth_m[0], sample().k),
        "3 x 3": (flat[:3, :3], intrinsics(200.0, 3, 3)),
        "no readings": (np.zeros_like(flat), K),
        "no numbers": (np.full_like(flat, np.nan), K),
        "infinite": (np.full_like(flat, np.inf), K),
        "filled by a hand": (np.full_like(flat, 0.45), K),
        "at the lens": (np.full_like(flat, 1e-3), K),
        "pixels that are not square": (flat, oblong),
        "focal length of a millionth": (flat, intrinsics(1e-6, 144, 176)),
        "optical axis beside the image": (flat, beside),
    }


@pytest.mark.parametrize("name", list(strange_images()))
@pytest.mark.parametrize("side", ["right", "left"])
def test_of_any_image_something_finite_is_said(name: str, side: str) -> None:
    depth, k = strange_images()[name]
    for least in (0.0, 0.5):
        detector = HandDetector(*small_networks(), detector_settings(places=3, least=least))
        places = detector.start_search(depth, k)()
        assert places.centre_m.shape == (len(places.probability), 3)
        assert len(places.probability) <= 3
        assert np.isfinite(places.centre_m).all() and (places.centre_m[:, 2] > 0).all()
    for what, value in numbers(detector.detect(depth, k, np.array(PLACES), side)).items():
        assert value.isfinite().all(), what


class SeesTwoPalms(Finder):
    """Says of any image that two palms are so far apart, both at 0.5 m."""

    def __init__(self, apart_m: float) -> None:
        super().__init__()
        self.apart_m = apart_m

    def forward(self, image: torch.Tensor) -> Found:
        height, width = (side // STRIDE for side in image.shape[-2:])
        z, cells = 0.5, 3  # between two peaks; the offset says more exactly where the second is
        heat, column = torch.full((1, height, width), -9.0), torch.zeros(1, height, width)
        heat[0, 10, 10], heat[0, 10, 10 + cells] = 1.0, 0.0
        column[0, 10, 10 + cells] = self.apart_m / z * WIDE_F_PX / STRIDE - cells
        return Found(heat, column, torch.zeros_like(heat), torch.full_like(heat, math.log(z)))


@pytest.mark.parametrize(("apart_m", "places"), [(0.042, 2), (0.03, 1)])
def test_palms_of_hands_that_touch_are_two_places(apart_m: float, places: int) -> None:
    settings = detector_settings(places=3, least=0.1)
    detector = HandDetector(small_networks()[0], SeesTwoPalms(apart_m), settings)
    found = detector.start_search(sample().depth_m[0], sample().k)()
    assert len(found.probability) == places
    if places == 2:
        assert np.linalg.norm(found.centre_m[1] - found.centre_m[0]) == pytest.approx(apart_m)
