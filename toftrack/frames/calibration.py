"""Calibrating a depth camera with a chequerboard (paper, section 2.1; Schiller, Beder, Koch 2008).

1. The board's corners in the amplitude images give the intrinsics and the lens distortion.
2. They also give the board's plane in each frame, and so the true distance along each pixel's ray.
3. A polynomial of the measured distance is fitted to true - measured; its order comes from
   cross-validation over frames.

Distances are radial (along the rays), metres; a board has `columns x rows` inner corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial import Polynomial

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera

_ORDERS = range(1, 8)
# Enlargements, tried in turn: the finder wants squares of more than a few pixels, and puts corners
# least off at 5 (the focal length by 0.1 %, at 3 by 0.2 %).
_SCALES = (5, 3, 7)
_LARGEST_PX = 1300
"""What is wider shows all corners as it is; enlarged it would take a minute an image."""
_QUICK_SCALE, _QUICK_PX = 5, 900
"""A first look enlarges less where an image would be wider than this: 0.2 s an image."""
_FEWEST_VIEWS = 5
_FOLDS = 5
_STEP_M = 0.1  # of true distance, within which pixels are averaged
_OUTLIER = 3.0  # times the median reprojection error
_TURNED_DEG = 20.0
"""Between the most different boards at least: less turned, they fit any focal length."""
_STRETCH = 1.18
"""Of true distances by measured ones: no camera is so wrong over the range of a board."""
_UNDETERMINED = (
    "the corners do not determine the camera; show the board turned in all directions, near and far"
)


@dataclass(frozen=True, eq=False)
class View:
    """A frame in which the board was found: its index, and the corners, (columns * rows, 2) pixels
    of the image as measured, row by row.
    """

    index: int
    corners_px: np.ndarray


@dataclass(frozen=True, eq=False)
class Lens:
    """What the corners say: the camera, without a depth polynomial; the V views in use; in each of
    them the board's (V, 3, 3) rotation and its first corner's (V, 3) place in the camera's frame;
    and the (V,) rms distance between found and projected corners.
    """

    camera: Camera
    views: tuple[View, ...]
    rotations: np.ndarray
    translations_m: np.ndarray
    errors_px: np.ndarray


@dataclass(frozen=True, eq=False)
class DepthPairs:
    """Measured and true distances of M pixels on the board."""

    measured_m: np.ndarray
    true_m: np.ndarray
    weight: np.ndarray
    """Square of the amplitude: a Time-of-Flight camera's noise falls as it grows."""
    view: np.ndarray
    """(M,) number of the view within the lens."""


@dataclass(frozen=True)
class DepthFit:
    """A correction true = measured + sum_i c_i measured^i."""

    polynomial: tuple[float, ...]
    range_m: tuple[float, float]
    """The measured distances that it was fitted to."""
    order: int
    validation_mm: dict[int, float]
    """Order to the rms error of frames that were left out."""


def board_points(board: tuple[int, int], square_m: float) -> np.ndarray:
    """(columns * rows, 3) float32: the inner corners on the board, row by row, Z = 0."""
    columns, rows = board
    down, across = np.mgrid[:rows, :columns]
    flat = np.stack([across.ravel(), down.ravel(), np.zeros(columns * rows)], 1)
    return (flat * square_m).astype(np.float32)


def find_corners(amplitude: np.ndarray, board: tuple[int, int]) -> np.ndarray | None:
    """The board's inner corners in an (H, W) uint16 amplitude image, (columns * rows, 2) pixels.

    None when the board is not, or not wholly, in view.
    """
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    most = max(1.0, _LARGEST_PX / amplitude.shape[1])
    for scale in dict.fromkeys(min(scale, most) for scale in _SCALES):
        grey = _enlarged(amplitude, scale)
        if grey is None:
            return None
        found, corners = cv2.findChessboardCornersSB(grey, board, None, flags)
        if found:
            # Pixel centres lie at integers in both images.
            return (corners.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5
    return None


def shows_board(amplitude: np.ndarray, board: tuple[int, int]) -> bool:
    """Whether a quick look finds the board in an (H, W) uint16 amplitude image: ten times faster
    than `find_corners`, which also finds boards that are far or much turned.
    """
    grey = _enlarged(amplitude, max(1.0, min(_QUICK_SCALE, _QUICK_PX / amplitude.shape[1])))
    return grey is not None and cv2.findChessboardCornersSB(grey, board, None, 0)[0]


def _enlarged(amplitude: np.ndarray, scale: float) -> np.ndarray | None:
    """An enlarged uint8 image of even brightness; None where there is nothing to see."""
    # The root evens out what falls with the square of the distance.
    image = np.sqrt(amplitude.astype(np.float32))
    low, high = np.percentile(image, (1, 99))
    if high - low < 1:
        return None
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.clip((large - low) * (255 / (high - low)), 0, 255).astype(np.uint8)


def fit_lens(views: Sequence[View], board: tuple[int, int], square_m: float, guess: Camera) -> Lens:
    """Intrinsics and lens distortion (k1, k2) from corners of at least five views from different
    sides; views that do not fit are left out.

    board: columns, rows of inner corners.  square_m: side of a square.  guess: where to start, and
    the image's size. ToftrackError: there are too few views, or they do not determine the camera.
    """
    views, points = _enough(views, board), board_points(board, square_m)
    # Coefficients of another model (rational, fisheye) mean something else, and are no start.
    known = guess.distortion if guess.distortion.size == 5 else np.zeros(5)
    # More terms than two radial ones are not to be had from so few pixels; they only fit noise.
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    while True:
        try:
            _, K, distortion, rvecs, tvecs, _, _, errors = cv2.calibrateCameraExtended(
                [points] * len(views),
                [view.corners_px.astype(np.float32) for view in views],
                (guess.width, guess.height),
                guess.K.copy(),
                known.copy(),
                flags=flags,
            )
        except cv2.error as error:
            raise ToftrackError(_UNDETERMINED) from error
        errors = errors.ravel()
        good = errors <= max(_OUTLIER * float(np.median(errors)), 0.05)
        if good.all() or good.sum() < _FEWEST_VIEWS:
            break
        views = [view for view, keep in zip(views, good, strict=True) if keep]
    K[0, 1] = 0.0
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise ToftrackError(_UNDETERMINED)
    normals = np.stack([cv2.Rodrigues(rvec)[0][:, 2] for rvec in rvecs])
    if (normals @ normals.T).min() > np.cos(np.radians(_TURNED_DEG)):
        raise ToftrackError(_UNDETERMINED)
    camera = Camera(K, guess.width, guess.height, distortion.ravel()[:5])
    return _lens(camera, views, rvecs, tvecs, errors)


def known_lens(
    views: Sequence[View], board: tuple[int, int], square_m: float, camera: Camera
) -> Lens:
    """The board's place in each view where the camera is known already; errors as `fit_lens`."""
    views = _enough(views, board)
    if camera.lens == "fisheye":
        raise ToftrackError(
            "a fisheye lens cannot be kept; leave out --keep-lens, so that another model is fitted"
        )
    points, rvecs, tvecs, errors = board_points(board, square_m), [], [], []
    for view in views:
        _, rvec, tvec = cv2.solvePnP(points, view.corners_px, camera.K, camera.distortion)
        projected, _ = cv2.projectPoints(points, rvec, tvec, camera.K, camera.distortion)
        rvecs.append(rvec)
        tvecs.append(tvec)
        gap = projected.reshape(-1, 2) - view.corners_px
        errors.append(float(np.sqrt((gap**2).sum(1).mean())))
    plain = Camera(camera.K, camera.width, camera.height, camera.distortion)
    return _lens(plain, views, rvecs, tvecs, np.array(errors))


def _enough(views: Sequence[View], board: tuple[int, int]) -> list[View]:
    if len(views) < _FEWEST_VIEWS:
        raise ToftrackError(
            f"the {board[0]}x{board[1]} chequerboard was found in {len(views)} frames, but at "
            f"least {_FEWEST_VIEWS} are needed; check --board (inner corners, columns x rows) and "
            "show the whole board, near and far, turned in all directions"
        )
    return list(views)


def true_distances(lens: Lens, number: int, board: tuple[int, int], square_m: float) -> np.ndarray:
    """(H, W) float64 distance along each pixel's ray to view `number`'s board, NaN beside it."""
    rotation, corner = lens.rotations[number], lens.translations_m[number]
    rays = lens.camera.normalised_rays()
    directions = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (corner @ rotation[:, 2]) / (directions @ rotation[:, 2])
    place = (directions * z[..., None] - corner) @ rotation / square_m
    # Half a square beyond the outer corners: surely on the board.
    within = (
        (z > 0)
        & (np.abs(place[..., 0] - (board[0] - 1) / 2) < board[0] / 2)
        & (np.abs(place[..., 1] - (board[1] - 1) / 2) < board[1] / 2)
    )
    return np.where(within, z * np.sqrt(1 + (rays**2).sum(-1)), np.nan)


def depth_pairs(
    lens: Lens,
    board: tuple[int, int],
    square_m: float,
    images: Sequence[tuple[np.ndarray, np.ndarray]],
) -> DepthPairs:
    """Measured against true distances on the boards of a lens's V views; board, square_m as above.

    images: for each view the (H, W) radial distance in metres and the amplitude. ToftrackError: no
    pixel on any board has a reading.
    """
    measured, true, weight, view = [], [], [], []
    for number, (radial, amplitude) in enumerate(images):
        distance = true_distances(lens, number, board, square_m)
        usable = np.isfinite(distance) & (radial > 0) & (radial < np.inf) & (amplitude > 0)
        measured.append(radial[usable].astype(np.float64))
        true.append(distance[usable])
        weight.append(amplitude[usable].astype(np.float64) ** 2)
        view.append(np.full(int(usable.sum()), number))
    pairs = DepthPairs(*map(np.concatenate, (measured, true, weight, view)))
    if len(pairs.view) == 0:
        raise ToftrackError("no pixel on the board has a distance; is the board in range?")
    return pairs


def frame_errors(
    pairs: DepthPairs, polynomial: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Mean true distance and mean error (corrected - true) of each view's board, metres.

    The means leave the systematic error and take away the noise; views without pixels are left out.
    """
    residual = pixel_errors(pairs, polynomial)
    weight = np.bincount(pairs.view, pairs.weight)
    there = weight > 0
    distance = np.bincount(pairs.view, pairs.weight * pairs.true_m)[there] / weight[there]
    error = np.bincount(pairs.view, pairs.weight * residual)[there] / weight[there]
    return distance, error


def pixel_errors(pairs: DepthPairs, polynomial: tuple[float, ...] = ()) -> np.ndarray:
    """(M,) error (corrected - true) of each pixel, metres, its noise included."""
    correction = Polynomial(polynomial)(pairs.measured_m) if polynomial else 0.0
    return pairs.measured_m + correction - pairs.true_m


def fit_depth(pairs: DepthPairs) -> DepthFit:
    """The polynomial whose order predicts left-out frames best, by weighted least squares;
    ToftrackError where the boards are all at about one distance, or are not of the size given.
    """
    pairs = _averaged(pairs)
    used = np.unique(pairs.view)
    near, far = float(pairs.measured_m.min()), float(pairs.measured_m.max())
    if len(used) < _FOLDS or far - near < 0.05:
        raise ToftrackError(
            f"the boards lie between {near:.2f} and {far:.2f} m in {len(used)} frames, which is "
            "too little to correct the depth; show the board near and far"
        )
    everything = np.ones(len(pairs.view), bool)
    stretch = 1 + _fit(pairs, everything, 1, near, far)[1]
    if not 1 / _STRETCH < stretch < _STRETCH:
        raise ToftrackError(
            f"by their corners the boards are {stretch:.2g} times as far apart as the depth says; "
            "check --square (metres), a .srs's --modulation and the depth's unit, and turn the "
            "board in all directions"
        )
    fold = np.searchsorted(used, pairs.view) % _FOLDS
    validation = {}
    for order in _ORDERS:
        square, total = 0.0, 0.0
        for number in range(_FOLDS):
            out = fold == number
            coefficients = _fit(pairs, ~out, order, near, far)
            left_out = DepthPairs(*(array[out] for array in vars(pairs).values()))
            _, error = frame_errors(left_out, coefficients)
            square += float((error**2).sum())
            total += len(error)
        validation[order] = 1000 * float(np.sqrt(square / total))
    order = min(validation, key=validation.__getitem__)
    polynomial = _fit(pairs, everything, order, near, far)
    return DepthFit(polynomial, (near, far), order, validation)


def _averaged(pairs: DepthPairs) -> DepthPairs:
    """Means over the pixels of a view at about the same true distance.

    A pixel's noise is in its measured distance and, with the opposite sign, in the correction it
    asks for: fitted to single pixels, the polynomial would follow that line. Chosen by their true
    distance, the noise of many pixels averages out of both.
    """
    step = np.floor(pairs.true_m / _STEP_M).astype(np.int64)
    key = pairs.view * (int(step.max()) + 1) + step
    _, group = np.unique(key, return_inverse=True)
    weight = np.bincount(group, pairs.weight)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, pairs.weight * values) / weight

    view = np.bincount(group, pairs.view) / np.bincount(group)
    return DepthPairs(
        mean(pairs.measured_m), mean(pairs.true_m), weight, np.rint(view).astype(np.int64)
    )


def _fit(
    pairs: DepthPairs, rows: np.ndarray, order: int, near: float, far: float
) -> tuple[float, ...]:
    measured, wanted = pairs.measured_m[rows], (pairs.true_m - pairs.measured_m)[rows]
    # Each frame counts the same, however near and bright its board is.
    share = pairs.weight / np.bincount(pairs.view, pairs.weight)[pairs.view]
    fitted = Polynomial.fit(measured, wanted, order, domain=(near, far), w=np.sqrt(share[rows]))
    return tuple(map(float, fitted.convert().coef))


def _lens(
    camera: Camera,
    views: Sequence[View],
    rvecs: Sequence[np.ndarray],
    tvecs: Sequence[np.ndarray],
    errors: np.ndarray,
) -> Lens:
    rotations = np.stack([cv2.Rodrigues(rvec)[0] for rvec in rvecs])
    translations = np.stack([np.ravel(tvec) for tvec in tvecs])
    return Lens(camera, tuple(views), rotations, translations, errors)
