"""What looks wrong in a recording: images of nothing, units, times, the lens.

What cannot be used at all is an error where it is read; what is said here is a warning, as it may
be right: the run goes on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.frames.frame import NO_HAND_M, median_reading, nearest_reading
from toftrack.recordings.frame_store import FrameStore
from toftrack.recordings.npz import some_images

_NO_CAMERA_M, _NO_SCENE_M = 0.1, 0.3
"""No camera sees what is nearer, no hand's background is so near."""
_NEAREST_M = (0.15, 1.5)
"""Between these lies what is nearest in an image of a hand."""
_STEP_S, _FASTEST_S = (0.005, 5.0), 0.0005
"""Between frames of a hand that is to be followed; of the fastest camera."""
_EIGHTH_M = 0.000125
"""A step of two cameras, nearer to a tenth of a millimetre than to one: named beside the tenth."""
_TIME_UNITS = (
    ("milliseconds", 1e3),
    ("microseconds", 1e6),
    ("a Kinect V2's ticks of 100 ns", 1e7),
    ("a Kinect V1's ticks, 60 a microsecond", 6e7),
    ("nanoseconds", 1e9),
    ("thousands of seconds", 1e-3),
)
"""Names of units and how many of them a second has. Of several that fit, that one is meant with
which the rate is nearest to the usual one."""
_USUAL_FPS = 30.0
_LONG_STEP = 1.5
"""Times the usual step between frames, beyond which some are missing."""
_MOST_NAMED = 10
"""Gaps between file names, of which each is named."""
_OFF_MIDDLE = 0.3
"""Of the way from the image's middle to its border, beyond which a lens's centre is doubted."""
_KEPT, _LEFT_BY_RIGHT_ONE = 0.7, 0.85
"""Share of the image that is left when a lens is undone: one that leaves less is doubted; one that
may have been meant leaves more than the other."""


def doubts(store: FrameStore, camera: Camera) -> tuple[str, ...]:
    """What speaks against a recording that could be read; a sentence each.

    camera: of the images, which may be another one than the recording's.
    """
    times = store.timestamp_s
    counted = np.array_equal(times, np.arange(len(store)) / store.fps)
    of_time = (counted and names_doubt(store.names)) or times_doubt(times)
    of_gaps = "" if of_time else gaps_doubt(times)
    found = (_images_doubt(store), centre_doubt(camera), of_time, lens_doubt(camera), of_gaps)
    return tuple(filter(None, found))


def _images_doubt(store: FrameStore) -> str:
    depth = getattr(store, "depth", None)
    try:
        some = store.image(0)[0] if depth is None else some_images(depth)
    except ToftrackError:  # told when its turn comes
        return ""
    readings = some[(some > 0) & (some < np.inf)]
    if not readings.size:
        if depth is None:  # a camera's first image may be empty
            return ""
        return "no pixel has a reading (0 = none); was the depth saved, and not another image?"
    if readings.size > 1 and readings.min() == readings.max():
        return f"every reading is {readings[0]:g} m, which no camera measures; was it saved whole?"
    return _unit_doubt(some, store.unit_m)


def _unit_doubt(depth_m: np.ndarray, unit_m: float | None) -> str:
    """unit_m: metres of one step, where the images are whole numbers."""
    nearest, median = nearest_reading(depth_m), median_reading(depth_m)
    if nearest > NO_HAND_M:
        where = f"nearly all readings are farther than {nearest:.3g} m, where no hand is tracked"
    elif nearest < _NO_CAMERA_M and median < _NO_SCENE_M:
        where = f"readings are as near as {nearest:.2g} m, half of them within {median:.2g} m"
    else:
        return ""
    for power in (1, -1, 2, -2, 3, -3):
        if _NEAREST_M[0] <= nearest * 10.0**power <= _NEAREST_M[1]:
            right = f"{10.0**power:g} times the distances would fit"
            if unit_m is not None:
                step = unit_m * 10.0**power
                near = 0.5 * _EIGHTH_M < step < _EIGHTH_M
                eighth = f", or {_EIGHTH_M:g} of an SR300 or SR305" if near else ""
                right += (
                    f", {step:.3g} m a step instead of {unit_m:g}{eighth} (device.unit_m, "
                    "depth_unit_m in camera.json, or convert --source-unit)"
                )
            return f"{where}; {right}"
    return f"{where}; is its unit right?"


def times_doubt(timestamp_s: np.ndarray) -> str:
    """What speaks against the times (T,) of frames; "" for nothing."""
    steps = np.diff(timestamp_s)
    if not steps.size:
        return ""
    remedy = "or leave them out and give the frame rate (fps)"
    standing = int(np.count_nonzero(steps <= 0))
    if standing > steps.size / 2:
        return (
            f"{standing} of {len(timestamp_s)} time stamps repeat the one before; give the seconds "
            f"of each frame, {remedy}"
        )
    step = float(np.median(steps[steps > 0]))
    if _FASTEST_S <= step < _STEP_S[1]:
        return ""
    fitting = [unit for unit in _TIME_UNITS if _STEP_S[0] <= step / unit[1] < _STEP_S[1]]
    if not fitting:
        return ""
    unit, in_a_second = min(fitting, key=lambda unit: abs(np.log(step / unit[1] * _USUAL_FPS)))
    right = f"divide them by {in_a_second:.0f}"
    if in_a_second < 1:
        right = f"multiply them by {1 / in_a_second:.0f}"
    what = f"the time stamps look like {unit}: their median step is {step:.6g}"
    return f"{what}; {right}, {remedy}"


def gaps_doubt(timestamp_s: np.ndarray) -> str:
    """What speaks against no frame being missing between times (T,); "" for nothing."""
    steps = np.diff(timestamp_s)
    usual = float(np.median(steps)) if steps.size else 0.0
    gaps = np.flatnonzero(steps > _LONG_STEP * usual)
    if usual <= 0 or not gaps.size:
        return ""
    first = gaps[0]
    return (
        f"frames are missing, or came late: {gaps.size} of {steps.size} steps in time are longer "
        f"than {_LONG_STEP:g} times the usual {usual:.3g} s, the first, of {steps[first]:.3g} s, "
        f"after frame {first}; a fast hand is followed less well there"
    )


def names_doubt(names: Sequence[str]) -> str:
    """What speaks against files, in their order, being all frames there were; "" for nothing."""
    numbers = [re.findall(r"[0-9]{1,18}", name) for name in names]
    changing = [of for of in zip(*numbers, strict=False) if len(set(of)) > 1]
    steps = np.diff([int(number) for number in changing[0]]) if len(changing) == 1 else np.zeros(0)
    least = steps.min(initial=10**9)
    # Steps of a clock, whose times may stand in names, too, are no multiples of the least one.
    if least < 1 or (steps % least).any() or (steps == least).all():
        return ""
    rows = np.flatnonzero(steps > least)
    ends = ((int(changing[0][row]) + least, int(changing[0][row + 1]) - least) for row in rows)
    gaps = [f"{first}" if first == last else f"{first}-{last}" for first, last in ends]
    more = ", ..." if len(gaps) > _MOST_NAMED else ""
    return (
        f"the numbers in the files' names leave out {int((steps // least - 1).sum())} "
        f"({', '.join(gaps[:_MOST_NAMED])}{more}), but the frames are timed as if none were "
        "missing; write the seconds of each into timestamps.txt (docs/formats.md)"
    )


def centre_doubt(camera: Camera) -> str:
    """What speaks against a camera matrix being that of images of this size; "" for nothing."""
    size, centre = np.array((camera.width, camera.height)), camera.K[:2, 2]
    if (abs(2 * centre / size - 1) < _OFF_MIDDLE).all():
        return ""
    width, height = 2 * np.maximum(centre, 0.5)
    return (
        f"K has its centre at {centre[0]:g}, {centre[1]:g}, as images of about {width:.0f}x"
        f"{height:.0f} pixels have, but these have {size[0]}x{size[1]}; give K for this size, "
        "unless they are cut out of larger images"
    )


def lens_doubt(camera: Camera) -> str:
    """What speaks against a camera's lens; "" for nothing."""
    kept = _left_by(camera)
    if kept >= _KEPT:
        return ""
    text = (
        f"only {100 * kept:.0f} % of the image is left when the lens's distortion "
        f"{[float(f'{value:.4g}') for value in camera.distortion]} is undone"
    )
    for what, other in _other_lenses(camera):
        if (share := _left_by(other)) >= _LEFT_BY_RIGHT_ONE:
            return f"{text}; {what} would leave {100 * share:.0f} %"
    return f"{text}; are the coefficients OpenCV's k1 k2 p1 p2 k3, and those of this image's size?"


def _left_by(camera: Camera) -> float:
    """The share of the undistorted image that shows something, 0 to 1: what comes from within the
    measured image, and from where the lens's model does not fold it."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    from_u, from_v = (camera.undistort_amplitude(at + 1) for at in (u, v))
    assert from_u is not None and from_v is not None
    shown = from_u > 0
    if min(shown.shape) > 1:
        (u_down, u_right), (v_down, v_right) = np.gradient(from_u), np.gradient(from_v)
        shown &= u_right * v_down >= u_down * v_right
    return float(shown.mean())


def _other_lenses(camera: Camera) -> Iterator[tuple[str, Camera]]:
    """What may have been meant, and how it is said."""
    given = camera.distortion
    if camera.lens == "opencv" and len(given) == 5 and given[2:].any():
        k1, k2, k3, p1, p2 = given
        yield (
            "k1 k2 p1 p2 k3, if they were given as k1 k2 k3 p1 p2,",
            replace(camera, distortion=np.array([k1, k2, p1, p2, k3])),
        )
    yield "the opposite signs", replace(camera, distortion=-given)
    yield "zeros", replace(camera, distortion=np.zeros(5), lens="opencv")
