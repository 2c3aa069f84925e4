"""Whatever an image, K and time are, a step tells of a hand or none, or refuses in one sentence."""

import os
from datetime import timedelta
from functools import partial
from typing import Any

import numpy as np
import pytest
from helpers.programs import QUICK
from helpers.tracking import configuration, sample

from toftrack.api import build_model
from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate, is_vacant
from toftrack.tracking.model import TrackerModel
from toftrack.tracking.tracker import HandsTracker, Tracker

hypothesis = pytest.importorskip("hypothesis", reason="hypothesis is not installed")

from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from hypothesis.extra import numpy as nps  # noqa: E402

pytestmark = pytest.mark.endurance

_PATIENT = settings(
    deadline=timedelta(seconds=30),
    max_examples=int(os.environ.get("ENDURANCE_EXAMPLES", "300")),
    suppress_health_check=list(HealthCheck),
)
_ODD = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-30, 1e30, 0.3, 70.0)
_TIMES = st.one_of(
    *(st.none(), st.floats(), st.floats(-1e9, 1e9)),
    st.sampled_from(["1", "x", 1j, [0.1], np.ones(2), 10**400]),
    st.sampled_from([0.0, 0.04, 0.08, 0.12, -5.0, 1e6, np.nan, np.inf, -np.inf, np.float32(0.2)]),
)


@pytest.fixture(scope="module")
def model() -> TrackerModel:
    return build_model(configuration(*QUICK))


def _plausible(height: int, width: int, focal: float = 1.1) -> np.ndarray:
    size = max(height, width)
    return np.array([[focal * size, 0, width / 2], [0, focal * size, height / 2], [0, 0, 1]])


@st.composite
def _seen(draw: st.DrawFn) -> tuple[Any, Any]:
    """A frame of the sample: as it is, a part, smaller, nearer, with odd readings."""
    scene = sample()
    depth = scene.depth_m[draw(st.integers(0, len(scene) - 1))].copy()
    k = scene.k.copy()
    step = draw(st.sampled_from([1, 1, 2, 5]))
    depth, k[:2] = np.ascontiguousarray(depth[::step, ::step]), k[:2] / step
    rows, columns = (draw(st.integers(1, n)) for n in depth.shape)
    if draw(st.booleans()):
        depth = depth[:rows, :columns]
    if draw(st.booleans()):
        share = draw(st.sampled_from([0.001, 0.1, 0.9]))
        odd = np.random.default_rng(draw(st.integers(0, 99))).random(depth.shape) < share
        depth = np.where(odd, draw(st.sampled_from(_ODD)), depth)
    return (depth * draw(st.sampled_from([1.0, 1.0, 0.3, 3.0]))).astype(np.float32), k


@st.composite
def _made(draw: st.DrawFn) -> tuple[Any, Any]:
    """Small images of anything, with a K that may fit."""
    shape = draw(nps.array_shapes(min_dims=2, max_dims=2, max_side=40))
    elements = st.sampled_from(_ODD) | st.floats(0.2, 1.5)
    kind = draw(st.sampled_from(["f4", "f4", "f4", "f8"]))
    depth = draw(nps.arrays(kind, shape, elements=elements.map(lambda x: float(np.float32(x)))))
    return depth, _plausible(*shape, draw(st.floats(0.05, 60)))


@st.composite
def _noise(draw: st.DrawFn) -> tuple[Any, Any]:
    """Larger images: a slope and noise, and a thing before it."""
    height, width = draw(st.integers(1, 300)), draw(st.integers(1, 300))
    random = np.random.default_rng(draw(st.integers(0, 99)))
    depth = np.linspace(0.3, draw(st.floats(0.3, 4)), height)[:, None].repeat(width, 1)
    depth += draw(st.sampled_from([0, 1e-3, 0.3])) * random.standard_normal(depth.shape)
    top, left = draw(st.integers(0, height - 1)), draw(st.integers(0, width - 1))
    depth[top : top + 60, left : left + 60] = draw(st.floats(0.1, 1))
    return depth.astype(np.float32), _plausible(height, width)


@st.composite
def _anything(draw: st.DrawFn) -> tuple[Any, Any]:
    """What is no image, or no K."""
    kinds = st.one_of(nps.scalar_dtypes(), nps.unicode_string_dtypes(max_len=2))
    arrays = nps.arrays(kinds, nps.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
    things = st.one_of(arrays, st.none(), st.text(max_size=3), st.lists(st.lists(st.floats())))
    plain = (np.full((20, 30), 0.5, np.float32), _plausible(20, 30))
    k = nps.arrays("f8", (3, 3), elements=st.floats(width=64)) | things
    return draw(st.just(plain[0]) | things), draw(st.just(plain[1]) | k)


_FRAMES = st.lists(
    st.tuples(st.one_of(_seen(), _seen(), _made(), _noise(), _anything()), _TIMES),
    min_size=1,
    max_size=5,
)


def _check(estimate: Estimate) -> None:
    assert isinstance(estimate.lost, bool)
    assert estimate.side in ("right", "left", "")
    # The hand is known as a whole, or not at all.
    hand = np.concatenate([estimate.joints_m.ravel(), estimate.state, estimate.latent])
    assert np.isfinite(hand).all() or np.isnan(hand).all()
    assert estimate.lost or not is_vacant(estimate)
    assert 0 <= estimate.score <= 1
    for share in (estimate.confidence, estimate.side_probability, estimate.gesture_probability):
        assert np.isnan(share) or 0 <= share <= 1
    for name, value in estimate.values().items():
        if isinstance(value, np.ndarray):
            assert np.isfinite(value).all() or np.isnan(value).all(), name


def _follow(tracker: Tracker | HandsTracker, frames: list[tuple[tuple[Any, Any], Any]]) -> None:
    for (depth, k), timestamp_s in frames:
        try:
            reported = tracker.step(depth, k, timestamp_s=timestamp_s)
        except ToftrackError as error:
            assert str(error)
            assert "\n" not in str(error)
            continue
        for estimate in reported if isinstance(reported, tuple) else (reported,):
            _check(estimate)


@pytest.mark.parametrize("kind", [Tracker, partial(HandsTracker, hands=2)])
@_PATIENT
@given(frames=_FRAMES)
def test_hands(model: TrackerModel, kind: Any, frames: list[Any]) -> None:
    _follow(kind(model), frames)


@pytest.mark.parametrize("hands", [1, 2])
def test_a_large_image_between_small_ones(model: TrackerModel, hands: int) -> None:
    scene = sample()
    height, width = scene.depth_m.shape[1:]
    large = np.kron(scene.depth_m[1], np.ones((3000 // height + 1, 4000 // width + 1), np.float32))
    large = large[:3000, :4000]
    k = scene.k.copy()
    k[0], k[1] = k[0] * (4000 // width + 1), k[1] * (3000 // height + 1)
    frames = [((scene.depth_m[0], scene.k), 0.0), ((large, k), 0.04)]
    frames += [((np.full((1, 1), 0.5, np.float32), _plausible(1, 1)), 0.08)]
    frames += [((scene.depth_m[2], scene.k), 0.12)]
    _follow(HandsTracker(model, hands=hands), frames)
