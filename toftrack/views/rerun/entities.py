"""What `view=rerun` logs of each frame, and how the viewer opens.

Entities, on the timelines `frame` (its number) and `time` (seconds of the recording):

| entity | what |
| --- | --- |
| `world/camera` | the camera, with `depth` (a cloud of points in 3-D) and `amplitude` |
| `world/tracker` | the image that the tracker works on, with `segmentation` and `classified` |
| `world/hand` | the estimate: `ellipsoids`, `skeleton`, `joints`; and `particles`, by weight |
| `plots` | `score` (confidence, lost), `latent` coordinates, `pinch`, `time` (milliseconds) |
| `log` | changes of state, gesture and pinching |

Of several hands the second one's are `world/hand_2`, `world/tracker_2` and, in the same plots,
`plots/score/hand_2`, and so on; `label` in each hand says whose it is.

The world is the camera's frame: x right, y down, z forward, metres.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from toftrack.compute.rigid import rotated_pivot
from toftrack.compute.threads import small_operations
from toftrack.errors import reported_errors
from toftrack.estimate import Estimate, gesture_words, is_vacant, state_words
from toftrack.hand.shape import HandShape
from toftrack.render.likelihood import FMeasure
from toftrack.render.model_image import cpu_surface, parted, posed_hand
from toftrack.render.segmentation import Observation
from toftrack.tracking.state import StepInfo
from toftrack.views.base import TrackedFrame, TrackedHand
from toftrack.views.classified import CLASS_RGB, CLASSES, classify
from toftrack.views.skeleton import FINGER_RGB, SLOT_RGB, side_words

with reported_errors(
    "view=rerun needs the package rerun-sdk",
    "install it with pip install -e '.[rerun]', or choose another view",
    ImportError,
):
    import rerun as rr
    import rerun.blueprint as rrb

_STEPS_A_METRE = 5000.0
"""Depth goes out in whole steps of 0.2 mm, up to 13 m: half the size of floating point."""
_SHOWN_M = (0.2, 1.2)
"""Range of the depth colours."""
_PALM_RGB, _LOST_RGB = (170, 170, 170), (213, 94, 0)
_SEGMENTS = (
    (0, "background", (40, 40, 40)),
    (1, "hand", (86, 180, 233)),
    (2, "occluder", (230, 159, 0)),
)
_SCORE_RGB = ((86, 180, 233), (0, 158, 115), _LOST_RGB)
_DASHES = ((0.15, 0.3), (0.45, 0.6), (0.75, 0.9))
"""Parts of a bone that are drawn where its joint is not ok."""
_SKELETONS = ("world/hand/skeleton", "world/hand_2/skeleton")
_BONE_M, _JOINT_M, _PARTICLE_M = 0.003, 0.003, 0.0012


class Entities:
    """Logs frame after frame to a stream; one thread at a time.

    likelihood: tells correct, false and missed pixels.
    """

    def __init__(self, stream: rr.RecordingStream, likelihood: FMeasure) -> None:
        self._stream = stream
        self._likelihood = likelihood
        self._pinholes: dict[str, tuple[bytes, int, int]] = {}
        self._reported: dict[int, tuple[str, ...]] = {}
        self._named: set[int] = set()
        """Slots whose plots have names."""
        self._log_constants()

    @small_operations()
    def log(self, tracked: TrackedFrame) -> None:
        """Log one frame."""
        estimate = tracked.estimates[0]
        self._stream.set_time("frame", sequence=estimate.index)
        self._stream.set_time("time", duration=estimate.timestamp_s)
        self._log_images(tracked)
        for slot, hand in enumerate(tracked.hands):
            self._log_slot(hand, slot)
            if len(tracked.hands) > 1:
                self._log_label(hand.estimate, slot)
        self._stream.log("plots/time", rr.Scalars([1e3 * estimate.compute_s]))

    def _log_slot(self, hand: TrackedHand, slot: int) -> None:
        of_hand, of_tracker = _of_slot("world/hand", slot), _of_slot("world/tracker", slot)
        if hand.insight is None:
            for gone in (f"{of_tracker}/segmentation", f"{of_tracker}/classified"):
                self._stream.log(gone, rr.Clear(recursive=False))
            self._stream.log(f"{of_hand}/particles", rr.Clear(recursive=False))
        else:
            self._log_observation(of_tracker, hand, hand.insight.observation)
            self._log_particles(of_hand, hand.insight)
        self._log_hand(of_hand, hand)
        self._log_plots(hand.estimate, slot)
        self._log_changes(hand.estimate, slot)

    def _log_label(self, estimate: Estimate, slot: int) -> None:
        """Whose hand it is, beside its wrist."""
        entity = f"{_of_slot('world/hand', slot)}/label"
        if is_vacant(estimate):
            self._stream.log(entity, rr.Clear(recursive=False))
            return
        words, colour = side_words(estimate) or "?", SLOT_RGB[slot]
        label = rr.Points3D(
            estimate.joints_m[:1], labels=[words], colors=[colour], radii=2 * _JOINT_M
        )
        self._stream.log(entity, label)

    def _log_constants(self) -> None:
        stream = self._stream
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        stream.log("world/tracker/segmentation", rr.AnnotationContext(_SEGMENTS), static=True)
        classes = tuple(enumerate(CLASSES))
        context = rr.AnnotationContext([(n, name, CLASS_RGB[n]) for n, name in classes])
        stream.log("world/tracker/classified", context, static=True)
        stream.log("plots/time", rr.SeriesLines(names=["ms"], colors=[(0, 158, 115)]), static=True)

    def _log_pinhole(self, entity: str, k: np.ndarray, height: int, width: int) -> None:
        """The camera of an image, when it is not the one before."""
        key = (np.asarray(k, np.float32).tobytes(), height, width)
        if self._pinholes.get(entity) == key:
            return
        self._pinholes[entity] = key
        pinhole = rr.Pinhole(
            image_from_camera=k,
            resolution=(width, height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.1,
        )
        self._stream.log(entity, pinhole)

    def _log_images(self, tracked: TrackedFrame) -> None:
        depth, camera = tracked.depth_m, tracked.camera
        self._log_pinhole("world/camera", camera.K, *depth.shape)
        steps = _STEPS_A_METRE * depth
        near, far = (_STEPS_A_METRE * limit for limit in _SHOWN_M)
        image = rr.DepthImage(
            np.where(steps < 2**16, steps, 0).round().astype(np.uint16),
            meter=_STEPS_A_METRE,
            depth_range=(near, far),
            colormap="viridis",
            point_fill_ratio=0.4,
        )
        self._stream.log("world/camera/depth", image)
        amplitude = camera.undistort_amplitude(tracked.frame.amplitude)
        if amplitude is not None:
            self._stream.log("world/camera/amplitude", rr.Image(amplitude))

    def _log_observation(self, entity: str, tracked: TrackedHand, observation: Observation) -> None:
        """How each pixel of the tracker's own image counts."""
        observation = observation.to(torch.device("cpu"))
        hand, occluder = observation.hand.numpy(), observation.occluder.numpy()
        self._log_pinhole(entity, observation.k.numpy(), *hand.shape)
        segments = hand.astype(np.uint8)
        segments[occluder] = 2
        self._stream.log(f"{entity}/segmentation", rr.SegmentationImage(segments))
        pixels = classify(tracked.estimate.state, tracked.shape, observation, self._likelihood)
        labels = rr.SegmentationImage(pixels.labels())
        self._stream.log(f"{entity}/classified", labels)

    def _log_particles(self, entity: str, insight: StepInfo) -> None:
        """The middles of the hands that the particles stand for, brighter with their weight."""
        particles = insight.particles.detach().cpu()
        middles = particles[:, :3] + rotated_pivot(particles[:, 3:6])
        weights = insight.weights.detach().cpu().numpy()
        shades = np.round(255 * weights / max(float(weights.max()), 1e-12)).astype(np.uint8)
        colours = cv2.applyColorMap(shades[:, None], cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
        points = rr.Points3D(middles.numpy(), colors=colours, radii=_PARTICLE_M)
        self._stream.log(f"{entity}/particles", points)

    def _log_hand(self, entity: str, tracked: TrackedHand) -> None:
        estimate, log = tracked.estimate, self._stream.log
        if is_vacant(estimate):
            for part in ("ellipsoids", "skeleton", "joints"):
                log(f"{entity}/{part}", rr.Clear(recursive=False))
            return
        log(f"{entity}/ellipsoids", ellipsoids(estimate, tracked.shape))
        joints = estimate.joints_m
        strips, colours = bone_strips(joints, estimate.joint_ok | estimate.lost)
        lines = rr.LineStrips3D(strips, colors=colours, radii=_BONE_M / 2)
        log(f"{entity}/skeleton", lines)
        colours = [_PALM_RGB, *(rgb for rgb in FINGER_RGB for _ in range(4))]
        log(f"{entity}/joints", rr.Points3D(joints, colors=colours, radii=_JOINT_M))

    def _log_plots(self, estimate: Estimate, slot: int) -> None:
        values: dict[str, list[float]] = {
            "score": [estimate.score, estimate.confidence, float(estimate.lost)],
            "latent": estimate.latent.tolist(),
            "pinch": [estimate.pinch],
        }
        if slot not in self._named:
            self._named.add(slot)
            self._name_plots(len(estimate.latent), slot)
        for name, numbers in values.items():
            self._stream.log(_plot(name, slot), rr.Scalars(numbers))

    def _name_plots(self, dims: int, slot: int) -> None:
        which = f", hand {slot + 1}" if slot else ""
        coordinates = [f"coordinate {n}" for n in range(1, dims + 1)]
        for plot, names, colours in (
            ("score", ["score", "confidence", "lost"], _SCORE_RGB),
            ("latent", coordinates, [FINGER_RGB[n % len(FINGER_RGB)] for n in range(dims)]),
            ("pinch", ["pinch"], [FINGER_RGB[1]]),
        ):
            # Paler, so that the first hand's lines are told from the others'.
            shown = [tuple((c + 255) // 2 for c in rgb) if slot else rgb for rgb in colours]
            lines = rr.SeriesLines(names=[f"{name}{which}" for name in names], colors=shown)
            self._stream.log(_plot(plot, slot), lines, static=True)

    def _log_changes(self, estimate: Estimate, slot: int) -> None:
        now = (estimate.state_name, gesture_words(estimate), str(estimate.lost))
        if now == self._reported.get(slot):
            return
        self._reported[slot] = now
        which = f"hand {slot + 1}" if slot else ""
        lost = "lost" if estimate.lost else ""
        words = (which, lost, state_words(estimate), gesture_words(estimate))
        text = ", ".join(filter(None, words))
        level = rr.TextLogLevel.WARN if estimate.lost else rr.TextLogLevel.INFO
        self._stream.log("log", rr.TextLog(text, level=level))


def _of_slot(entity: str, slot: int) -> str:
    return entity if slot == 0 else f"{entity}_{slot + 1}"


def _plot(name: str, slot: int) -> str:
    return f"plots/{name}" if slot == 0 else f"plots/{name}/hand_{slot + 1}"


def bone_strips(
    joints_m: np.ndarray, ok: np.ndarray
) -> tuple[list[np.ndarray], list[tuple[int, int, int]]]:
    """Lines (n, 3), m, and their colours: a bone each, in dashes where its joint is not ok.

    joints_m: (21, 3).  ok: (21,) bool.
    """
    strips, colours = [], []
    for finger, colour in enumerate(FINGER_RGB):
        chain = (0, *range(4 * finger + 1, 4 * finger + 5))
        for a, b in itertools.pairwise(chain):
            begin, way = joints_m[a], joints_m[b] - joints_m[a]
            parts = ((0.0, 1.0),) if ok[b] else _DASHES
            strips += [np.stack((begin + low * way, begin + high * way)) for low, high in parts]
            colours += [colour] * len(parts)
    return strips, colours


def ellipsoids(estimate: Estimate, shape: HandShape) -> rr.Ellipsoids3D:
    """The posed hand without its wrist, in the fingers' colours; all in one when it is lost."""
    hand, _ = parted(posed_hand(estimate.state, shape))
    axes = hand.axes_m[0]
    sizes = axes.norm(dim=-2)
    rotations = axes / sizes[:, None]
    # A left hand's frames are mirrored. An ellipsoid does not mind turning an axis around.
    rotations[..., 0] *= torch.linalg.det(rotations).sign()[:, None]
    bones = cpu_surface(shape).frame_index[:-1]
    palette = torch.tensor((_PALM_RGB, *FINGER_RGB))
    colours = palette[torch.where(bones > 0, 1 + (bones - 1) // 3, 0)].numpy()
    return rr.Ellipsoids3D(
        centers=hand.centres_m[0].numpy(),
        half_sizes=sizes.numpy(),
        quaternions=Rotation.from_matrix(rotations.numpy()).as_quat(),
        colors=[_LOST_RGB] if estimate.lost else colours,
        fill_mode="majorwireframe",
    )


def blueprint() -> rrb.Blueprint:
    """How the viewer opens: the scene in 3-D, the images beside it, and the plots below."""
    scene = rrb.Spatial3DView(
        origin="world",
        contents=[
            "+ world/**",
            "- world/camera/amplitude",
            "- world/tracker/**",
            "- world/tracker_2/**",
        ],
        name="hand, points and particles",
        eye_controls=rrb.EyeControls3D(
            position=(0.2, -0.1, 0.15), look_target=(0, 0, 0.5), eye_up=(0, -1, 0)
        ),
    )
    seen = "world/camera"
    images = rrb.Tabs(
        _image(seen, "amplitude and skeleton", f"{seen}/amplitude", *_SKELETONS),
        _image(seen, "depth", f"{seen}/depth", *_SKELETONS),
    )
    labels = rrb.Tabs(
        _image("world/tracker", "classified pixels", "world/tracker/classified"),
        _image("world/tracker", "segmentation", "world/tracker/segmentation"),
        rrb.TextLogView(origin="log", name="changes"),
    )
    plots = rrb.Horizontal(
        rrb.TimeSeriesView(
            origin="plots/score",
            name="score, confidence, lost",
            axis_y=rrb.ScalarAxis(range=(0.0, 1.05)),
        ),
        rrb.TimeSeriesView(origin="plots/latent", name="latent coordinates"),
        rrb.TimeSeriesView(origin="plots/pinch", name="pinch"),
        rrb.TimeSeriesView(origin="plots/time", name="ms a frame"),
    )
    above = rrb.Horizontal(scene, rrb.Vertical(images, labels), column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(above, plots, row_shares=[3, 1]),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _image(origin: str, name: str, *contents: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(origin=origin, contents=contents, name=name)
