"""Settings, choices and classes that have another name now, or none: what to give instead."""

from __future__ import annotations

_OR_PAPER = "or give experiment=paper, the tracker without networks"
_NETWORKS = "the networks find hands"
_CONFIDENCE = (
    "lost.confidence (in experiment=paper lost.score) says which estimates count: give that"
)
_MEMORY = "orientations are not remembered: leave it out"


MOVED = {
    "relocation": "detector",
    "relocation=network": "detector=network",
    **{
        f"relocation.{name}": f"detector.{name}"
        for name in "weights places least merit hypotheses every search sure".split()
    },
    "relocation.rivals": "detector.candidates",
    "relocation.landmark_m": "detector.keypoint_m",
    "relocation.landmark_sigmas": "detector.keypoint_sigmas",
    "relocation.landmark_weight": "detector.keypoint_weight",
    "relocation.votes": "posterior.keypoints",
    "relocation.rival_m": "hysteresis.place_m",
    "relocation.rival_gain": "hysteresis.place_lead",
    "relocation.rival_frames": "hysteresis.place_frames",
    "refine.swaps": "hysteresis.exchanged",
    "refine.swap_gain": "hysteresis.lead",
    "refine.drift": "hysteresis.drift",
    "refine.sure": "hysteresis.alternate",
    "refine.overlap": "posterior.overlap",
    "hand.adapt.votes": "hand.adapt.keypoints",
    "hand.sides.unsure_s": "hand.sides.interval_unsure_s",
    "hand.sides.sure_s": "hand.sides.interval_sure_s",
    "lost.weights.votes_off": "lost.weights.keypoints_off",
    "lost.weights.farthest_vote_off": "lost.weights.farthest_keypoint_off",
    "lost.joints.weights.vote_off": "lost.joints.weights.keypoint_off",
}
"""Old names of groups, choices and settings, and the new ones, which mean the same."""

GONE = {
    "relocation=none": "only experiment=paper does without networks: give that, or leave it out",
    "relocation.prior": "poses are compared without the detector's own probability: leave it out",
    "refine.keep_gain": "it cost accuracy: leave it out, or give hysteresis.lead",
    "filter.density": "particles are weighed by the image alone: leave it out",
    "start=prior": "nothing is left of it: leave it out",
    **dict.fromkeys(("posterior.forearm", "start.forearm"), "it changed nothing: leave it out"),
    "start=search": f"{_NETWORKS}: leave it out, {_OR_PAPER}",
    **dict.fromkeys(("start.memory", "start.memory_rad", "start.memory_s"), _MEMORY),
    "start.hypotheses": f"{_NETWORKS}: leave it out, or give detector.hypotheses",
    **dict.fromkeys(
        (
            *("start.islands", "start.samples", "start.improved", "start.coverage"),
            *("start.tilt_rad", "start.arm_rad"),
        ),
        f"{_NETWORKS}: leave it out, {_OR_PAPER}",
    ),
    "lost=score": f"the networks' features count, too: leave it out, {_OR_PAPER}",
    "lost.score": f"lost.confidence says which estimates count: give that, {_OR_PAPER}",
    **dict.fromkeys(("lost.start_score", "lost.rival_gain", "lost.outside_rad"), _CONFIDENCE),
    "hand.fit": "the whole shape is fitted, by the settings of hand.adapt: give those",
}
"""Groups, choices and settings that are gone, and what is to be done instead."""

PAPERS = ("start", "start=rough", "start.pose", "start.position_m", "start.rotation_rad")
"""Names that experiment=paper alone has."""

TARGETS = {
    "toftrack.relocation.relocaliser.make_relocaliser": (
        "toftrack.detector.hand_detector.make_detector"
    ),
    "toftrack.relocation.relocaliser.no_relocaliser": "toftrack.detector.hand_detector.no_detector",
    "toftrack.relocation.training.Schedule": "toftrack.detector.training.Schedule",
    "toftrack.tracking.belief.CalibratedBelief": "toftrack.tracking.confidence.ConfidenceModel",
    "toftrack.tracking.joint_belief.JointBelief": "toftrack.tracking.confidence.JointConfidence",
    "toftrack.tracking.particle_filter.FilterSettings": (
        "toftrack.compute.particle_filter.FilterSettings"
    ),
    "toftrack.tracking.particle_filter.Spread": "toftrack.compute.particle_filter.Spread",
    "toftrack.tracking.prior.Prior": "toftrack.tracking.posterior.PosteriorWeights",
    "toftrack.tracking.shape_fit.ShapeFit": "toftrack.refinement.shape_fit.ShapeFit",
    "toftrack.tracking.side_belief.SideFit": "toftrack.tracking.handedness.HandednessSettings",
}
"""Old values of _target_ in configurations of one's own, and the new ones."""

PROGRAMS = {"train_relocaliser": "train_detector", "fit_belief": "fit_confidence"}
"""Old names of toftrack.programs' modules, and the new ones."""


def answer(key: str, value: str = "") -> str | None:
    """One sentence for an old setting or choice, KEY=VALUE; None where it never had a meaning."""
    names = [key]
    while "." in names[-1]:
        names.append(names[-1].rpartition(".")[0])
    for name in (f"{key}={value}", *names):
        what = f"no {name}" if "=" in name else f"no setting {key}"
        if name in MOVED:
            return f"there is {what} any more; give {MOVED[name]}"
        if name in GONE:
            return f"there is {what} any more, since {GONE[name]}"
        if name in PAPERS:
            given = name if "=" in name else key
            return (
                f"{given} belongs to experiment=paper; give experiment=paper as well, or leave "
                f"{given} out"
            )
    return None


def program_answer(name: str) -> str:
    """One sentence for a module of toftrack.programs that has another name now."""
    return (
        f"there is no toftrack.programs.{name} any more; "
        f"give python -m toftrack.programs.{PROGRAMS[name]}"
    )


def target_answer(target: str) -> str | None:
    """One sentence for an old _target_; None where it never was one of toftrack's."""
    if target not in TARGETS:
        return None
    return f"there is no {target} any more; give _target_: {TARGETS[target]}"
