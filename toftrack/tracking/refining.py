"""Refinement in the tracker: the estimate of a frame, and what takes its place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toftrack.compute.pace import FRAME_S
from toftrack.refinement.seen_points import seen_points
from toftrack.refinement.steadying import steadied
from toftrack.tracking.detect import candidates, keypoints_of, track_of
from toftrack.tracking.features import out_of_sight
from toftrack.tracking.life_cycle import extended, log_odds, reached
from toftrack.tracking.model import DetectedFrame
from toftrack.tracking.select import rivals_of, scored, select, with_other_fingers
from toftrack.tracking.state import Contender, Track

_EXCHANGED = 4
"""Single fingers are taken from so many of the networks' poses."""
_COVERED = 0.6
"""Share of the joints behind something from which on a hand stays where it was."""
_UNSEEN = 0.3
"""Share of the joints that must be out of sight for the networks not to be heard."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A frame's estimate.

    pose: (1, 27).  trend: (27,) see steadying.
    rival: (1, 27) a pose of the networks that is another one, and better; None where there is none.
    contender: the pose with other fingers that is ahead; None where there is none.
    """

    pose: Tensor
    trend: Tensor | None
    rival: Tensor | None = None
    contender: Contender | None = None


def refined(
    track: Track, mean: Tensor, dt_s: float, frame: DetectedFrame, generator: torch.Generator
) -> Refined:
    """The frame's estimate from the filter's mean (1, 6 + d)."""
    model = frame.model
    pose = model.decode(mean, track.offset)
    if not model.refinement.iterations:
        return Refined(pose, track.trend)
    if _covered(track.pose, frame):
        return Refined(track.pose, None)
    outcome = _onto_points(pose, track, dt_s, frame, generator)
    steadying, motions = model.refinement.steadying, model.backend.motions
    steady, trend = steadied(outcome.pose, track.pose, track.trend, dt_s, steadying, motions)
    return replace(outcome, pose=steady, trend=trend)


def challenged(
    track: Track, outcome: Refined, dt_s: float, frame: DetectedFrame
) -> tuple[Track, Tensor, Tensor | None]:
    """The track, the pose (1, 27) and the trend to go on with, after a rival was heard.

    A rival takes over when it was better for a while; never while something hides the hand.
    """
    settings, rival = frame.model.detector.settings, outcome.rival
    track = replace(track, contender=outcome.contender)
    if frame.detection is None:
        return track, outcome.pose, outcome.trend
    if rival is None or frame.hidden:
        return replace(track, challenged_s=0.0), outcome.pose, outcome.trend
    since = extended(track.challenged_s, dt_s)
    if track.age_s > 0 and not reached(since, settings.rival_frames):
        return replace(track, challenged_s=since), outcome.pose, outcome.trend
    return replace(track_of(rival, frame.model), believed=track.believed), rival, None


def _onto_points(
    state: Tensor, track: Track, dt_s: float, frame: DetectedFrame, generator: torch.Generator
) -> Refined:
    """The filter's hand (1, 27) brought onto the seen points, and what speaks against it."""
    refiner, cfg = frame.hand.refiner, frame.model.refinement
    seen = seen_points(frame.observation)
    detection = None if _mostly_unseen(state, frame) else frame.detection
    frame = replace(frame, detection=detection)
    keypoints = None if detection is None else keypoints_of(detection, frame.model)

    def onto_points(starts: Tensor) -> Tensor:
        return refiner(starts, starts[:, 6:], seen, cfg, keypoints)

    # The pose of the last frame stands until another one is clearly better: what the image does
    # not decide, such as a hidden finger, must not flicker. A contender moves along with it.
    starts = [torch.cat((state[:, :6], track.pose[:, 6:]), 1), state]
    if track.contender is not None:
        starts.append(torch.cat((state[:, :6], track.contender.pose[:, 6:]), 1))
    mine = len(starts)
    rivals = frame.model.detector.settings.rivals
    likely = state[:0] if detection is None else candidates(detection, frame, rivals)
    considers, swaps = (True, True) if frame.hidden else rotations(track, cfg.sure)
    considered = likely if considers else likely[:0]
    tried = scored(onto_points(torch.cat((*starts, considered))), frame)
    first = 0 if tried.scores[0] + cfg.keep_gain >= tried.scores[1] else 1
    rows = torch.arange(len(tried.scores), device=state.device)
    found, others, rival = tried.rows(rows[first : first + 1]), tried.rows(rows[2:mine]), None
    if len(considered):
        near, rival = rivals_of(found, tried.rows(rows[mine:]), frame)
        others = others.and_(near)
    swapped = state[:0]
    if swaps:
        swapped = with_other_fingers(found, likely[:_EXCHANGED, 6:], frame, cfg, generator)
    if len(swapped):
        others = others.and_(scored(torch.cat((swapped, onto_points(swapped))), frame))
    pose, contender = select(found, others, track, dt_s, frame)
    return Refined(pose, None, rival, contender)


def rotations(track: Track, sure: float) -> tuple[bool, bool]:
    """Whether the networks' poses are heard in a frame, and whether other fingers are tried.

    Both, but in turn where a track is believed and nothing challenges it.
    """
    believed = sure < 1 and track.log_odds is not None and track.log_odds >= log_odds(sure)
    if track.challenged_s > 0 or not believed:
        return True, True
    first = round(track.age_s / FRAME_S) % 2 == 0
    return first, not first


def _covered(state: Tensor, frame: DetectedFrame) -> bool:
    """Whether something hides so much of a hand (1, 27) that it is best left where it was.

    What is still seen about it belongs to the thing that hides it, as often as not.
    """
    joints, image = frame.hand.refiner.joints(state)[0].cpu(), frame.observation
    return out_of_sight(joints, image.depth_m, image.k)[1] > _COVERED


def _mostly_unseen(state: Tensor, frame: DetectedFrame) -> bool:
    """Whether so much of a hand (1, 27) is out of sight that the networks know less than a track.

    What is hidden or cut off moves on as it did; the networks see another hand in the rest of it.
    """
    joints, image = frame.hand.refiner.joints(state)[0].cpu(), frame.observation
    return sum(out_of_sight(joints, image.depth_m, image.k)) > _UNSEEN
