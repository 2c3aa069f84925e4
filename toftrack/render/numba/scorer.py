"""The CPU's scoring back end: one fused pass a particle, compiled once by numba and cached."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from toftrack.compute.threads import run_shared
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import CHAIN_SLOTS
from toftrack.hand.surface import hand_surface
from toftrack.render.numba.hand import LANES
from toftrack.render.numba.kernel import pack_evidence, score_hands
from toftrack.render.scoring import Counts, Evidence, disc_square, disc_steps

_WORTH_A_THREAD = 8 * LANES
"""Hypotheses for which it pays to wake a second thread; 150 are scored in less than that takes."""


class NumbaScorer:
    """Kinematics, drawing and counting in compiled code, one particle after the other.

    Threads share the particles. Safe to call from several threads. States on another device are
    moved to the CPU and the counts back.
    """

    name = "numba"

    def __init__(self, shape: HandShape) -> None:
        shape = shape.to("cpu", torch.float32)
        surface = hand_surface(shape)
        slots = np.full(25, -1, np.int64)
        slots[list(CHAIN_SLOTS)] = np.arange(6, 27)
        covariances = surface.axes_m @ surface.axes_m.mT
        rows, columns = torch.triu_indices(3, 3)
        self._hand = (
            slots,
            torch.cat((shape.base_frames, shape.base_m[..., None]), -1).contiguous().numpy(),
            shape.bone_lengths_m.contiguous().numpy(),
            np.float32(-1.0 if shape.side == "left" else 1.0),
            surface.frame_index.contiguous().numpy(),
            torch.cat((surface.centres_m, covariances[:, rows, columns]), 1).numpy(),
        )
        self._frame: tuple = (None, ())

    def __call__(self, states: Tensor, evidence: Evidence) -> Counts:
        """See Scorer; particles whose state is not finite count 0."""
        x = _array(states, np.float32)
        counts = np.empty((4, len(x)), np.float32)
        run_shared(self.task(x, evidence, counts), len(x) // _WORTH_A_THREAD)
        return Counts(*torch.from_numpy(counts).to(states.device).unbind(0))

    def task(
        self, states: np.ndarray, evidence: Evidence, counts: np.ndarray
    ) -> Callable[[], None]:
        """What scores states (N, 27) float32 into counts (4, N), in one thread or several."""
        given = states, self._packed(evidence), self._hand, np.zeros(1, np.int64), counts
        return functools.partial(score_hands, *given)

    def _packed(self, evidence: Evidence) -> tuple:
        """The evidence as the kernel wants it, once for all calls of a frame."""
        before, packed = self._frame
        if before is not evidence:
            height, width = evidence.hand.shape
            k = _array(evidence.k, np.float32)
            images, hand = pack_evidence(
                _array(evidence.low, np.float32),
                _array(evidence.high, np.float32),
                _array(evidence.occluder, np.float32),
                _array(evidence.hand, np.bool_),
            )
            steps = disc_steps(disc_square(evidence.radius_px, height, width), height, width)
            packed = (
                np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]),
                images,
                hand,
                height,
                width,
                steps,
                int(steps[:, 1].max()),
            )
            self._frame = evidence, packed
        return packed


def score_rows(scorers: Sequence[Any], states: Tensor, evidences: Sequence[Evidence]) -> Counts:
    """See scoring.score_rows, of NumbaScorers; threads share the particles of all hands."""
    x = _array(states, np.float32)
    counts = np.empty((len(x), 4, x.shape[1]), np.float32)
    rows = zip(scorers, x, evidences, counts, strict=True)
    tasks = [scorer.task(*row) for scorer, *row in rows]

    def all_of_them() -> None:
        for task in tasks:
            task()

    run_shared(all_of_them, x.shape[0] * x.shape[1] // _WORTH_A_THREAD)
    found = torch.from_numpy(counts).to(states.device)
    return Counts(*found.unbind(1))


def _array(tensor: Tensor, dtype: type) -> np.ndarray:
    here = tensor.numpy() if tensor.device.type == "cpu" else tensor.cpu().numpy()
    return np.ascontiguousarray(here, dtype)  # torch's conversions take ten times as long
