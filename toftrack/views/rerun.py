"""`view=rerun`: all that the tracker sees and believes, into a file or a running viewer.

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

import logging
import queue
import socket
import threading
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from toftrack.compute.rigid import rotated_pivot
from toftrack.compute.threads import small_operations
from toftrack.errors import MOST_HANDS, ToftrackError, reported_errors
from toftrack.files.safe_files import open_new
from toftrack.frames.estimate import Estimate, gesture_words, is_vacant, state_words
from toftrack.hand.shape import HandShape
from toftrack.hand.skeleton import JOINT_PARENTS
from toftrack.hand.surface import hand_surface
from toftrack.render.likelihood import Likelihood
from toftrack.render.model_image import posed_hand
from toftrack.render.segmentation import Observation
from toftrack.tracking.state import StepInfo
from toftrack.views.base import TrackedFrame, TrackedHand, View
from toftrack.views.classified import CLASS_RGB, CLASSES, classify
from toftrack.views.skeleton import FINGER_RGB, SLOT_RGB, side_words
from toftrack.views.video import writing

with reported_errors(
    "view=rerun needs the package rerun-sdk",
    'install it with pip install "toftrack[rerun]", or choose another view',
    ImportError,
):
    import rerun as rr
    import rerun.blueprint as rrb

FILE_NAME = "track.rrd"

_log = logging.getLogger(__name__)
_QUEUED_FRAMES = 30
"""How many frames the tracker may be ahead of what is logged."""
_ANSWER_S = 5.0
"""How long a viewer may take to answer."""
_PORT = 9876
_ADDRESS = f"rerun+http://127.0.0.1:{_PORT}/proxy"
_RERUN_ERRORS = (OSError, RuntimeError, ValueError)


class RerunView(View):
    """Writes the file track.rrd, or shows in a viewer while tracking goes on.

    A thread of its own does the work, so that the tracker goes on at once. The file gets every
    frame; a viewer that does not keep up misses some, and never holds up the tracker. The settings:
    conf/view/rerun.yaml.

    Raises ToftrackError when there is no viewer, or for both connect and spawn, and by `show` when
    the file cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        fps: float,
        frames: int | None = None,
        *,
        likelihood: Likelihood,
        connect: str | None = None,
        spawn: bool = False,
    ) -> None:
        if connect and spawn:
            raise ToftrackError("view.connect and view.spawn exclude each other; give one of them")
        self._path = None if connect or spawn else Path(folder) / FILE_NAME
        self._stream = rr.RecordingStream("toftrack")
        if self._path is None:
            if spawn:
                _start_viewer(self._stream)
            elif connect:
                _require_answer(connect)
            self._stream.connect_grpc(connect or _ADDRESS, default_blueprint=_blueprint())
        self._entities = _Entities(self._stream, likelihood)
        self._frames: queue.Queue[TrackedFrame | None] = queue.Queue(_QUEUED_FRAMES)
        self._begun, self._left_out = False, 0
        self._failure: Exception | None = None
        # A daemon, because nothing frees a thread that waits for a viewer that is stuck.
        self._thread = threading.Thread(target=self._work, name="toftrack-rerun", daemon=True)
        self._thread.start()

    def show(self, tracked: TrackedFrame) -> None:
        """Hand one frame over; raises ToftrackError when one before it could not be logged."""
        self._raise_failure()
        if self._path is not None:
            if not self._begun:
                with writing(self._path, *_RERUN_ERRORS):
                    open_new(self._path, replace=True).close()  # the library follows links
                    self._stream.save(self._path, default_blueprint=_blueprint())
                self._begun = True
            self._frames.put(tracked)
            return
        try:
            self._frames.put_nowait(tracked)
        except queue.Full:
            self._left_out += 1

    def close(self) -> None:
        """Finish the file, or send the viewer what is left; ToftrackError when it cannot be done.

        A second call does nothing.
        """
        patience_s = None if self._path is not None else _ANSWER_S
        if self._thread.is_alive():
            with suppress(queue.Full):  # the thread is stuck, as is seen below
                self._frames.put(None, timeout=patience_s)
                self._thread.join(patience_s and 2 * patience_s)
        if self._left_out:
            _log.warning("view=rerun: the viewer was too slow for %d frames", self._left_out)
            self._left_out = 0
        if self._thread.is_alive():
            # What Rerun does when python ends would wait for the viewer, too.
            rr.unregister_shutdown()
            raise _viewer_gone("it takes nothing any more")
        self._raise_failure()

    def _work(self) -> None:
        """In the thread: log the frames that come, until None, then finish."""
        # After a failure, frames are still taken, so that nobody waits for room.
        for tracked in iter(self._frames.get, None):
            if self._failure is None:
                try:
                    self._entities.log(tracked)
                except Exception as error:
                    self._failure = error
        try:
            self._stream.flush(timeout_sec=_ANSWER_S)
            self._stream.disconnect()
        except Exception as error:
            self._failure = self._failure or error

    def _raise_failure(self) -> None:
        if self._failure is None:
            return
        if self._path is None and isinstance(self._failure, _RERUN_ERRORS):
            raise _viewer_gone(str(self._failure)) from self._failure
        with writing(self._path or Path(FILE_NAME), *_RERUN_ERRORS):
            raise self._failure


def _start_viewer(stream: rr.RecordingStream) -> None:
    """Start a viewer in a process of its own; ToftrackError when it does not answer."""
    try:
        stream.spawn(port=_PORT, connect=False)
        _require_answer(_ADDRESS)
    except (*_RERUN_ERRORS, ToftrackError) as error:
        raise ToftrackError(
            "view.spawn=true: no viewer could be started, is there a display? Leave it out, and "
            f"open {FILE_NAME} with `rerun` afterwards"
        ) from error


def _require_answer(address: str) -> None:
    """A connection is made in the background, and would be tried for ever."""
    advice = "start one with `rerun` and give the address that it names, or leave out view.connect"
    what = f"view.connect={address} is no address of a viewer, as {_ADDRESS}"
    with reported_errors(what, advice, ValueError):
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or _PORT
        if not parts.scheme.startswith("rerun") or not host:
            raise ValueError("it lacks a part")
    with reported_errors(f"no viewer answers at {address}", advice):
        socket.create_connection((host, port), _ANSWER_S).close()


def _viewer_gone(reason: str) -> ToftrackError:
    return ToftrackError(
        f"the viewer is gone ({reason}): what it had not received is missing there, the result "
        "files are whole; start it again, or leave out view.connect and view.spawn"
    )


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


class _Entities:
    """Logs frame after frame to a stream; one thread at a time."""

    def __init__(self, stream: rr.RecordingStream, likelihood: Likelihood) -> None:
        self._stream, self._log, self._likelihood = stream, stream.log, likelihood
        self._pinholes: dict[str, tuple[bytes, int, int]] = {}
        self._reported: dict[int, tuple[str, ...]] = {}
        self._named: set[str] = set()
        """Plots whose lines have names."""
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        classes = [(n, name, CLASS_RGB[n]) for n, name in enumerate(CLASSES)]
        for entity, labels in (("segmentation", _SEGMENTS), ("classified", classes)):
            self._log(f"world/tracker/{entity}", rr.AnnotationContext(labels), static=True)
        self._log("plots/time", rr.SeriesLines(names=["ms"], colors=[(0, 158, 115)]), static=True)

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
        self._log("plots/time", rr.Scalars([1e3 * estimate.compute_s]))

    def _clear(self, *entities: str) -> None:
        for entity in entities:
            self._log(entity, rr.Clear(recursive=False))

    def _log_slot(self, hand: TrackedHand, slot: int) -> None:
        of_hand, of_tracker = _of_slot("world/hand", slot), _of_slot("world/tracker", slot)
        if hand.insight is None:
            of_image = f"{of_tracker}/segmentation", f"{of_tracker}/classified"
            self._clear(*of_image, f"{of_hand}/particles")
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
            self._clear(entity)
            return
        words, colour = side_words(estimate) or "?", SLOT_RGB[slot]
        wrist = estimate.joints_m[:1]
        self._log(entity, rr.Points3D(wrist, labels=[words], colors=[colour], radii=2 * _JOINT_M))

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
        self._log(entity, pinhole)

    def _log_images(self, tracked: TrackedFrame) -> None:
        depth, camera = tracked.depth_m, tracked.camera
        self._log_pinhole("world/camera", camera.K, *depth.shape)
        steps = _STEPS_A_METRE * depth
        image = rr.DepthImage(
            np.where(steps < 2**16, steps, 0).round().astype(np.uint16),
            meter=_STEPS_A_METRE,
            depth_range=[_STEPS_A_METRE * limit for limit in _SHOWN_M],
            colormap="viridis",
            point_fill_ratio=0.4,
        )
        self._log("world/camera/depth", image)
        amplitude = camera.undistort_amplitude(tracked.frame.amplitude)
        if amplitude is not None:
            self._log("world/camera/amplitude", rr.Image(amplitude))

    def _log_observation(self, entity: str, tracked: TrackedHand, observation: Observation) -> None:
        """How each pixel of the tracker's own image counts."""
        hand, occluder = observation.hand.numpy(), observation.occluder.numpy()
        self._log_pinhole(entity, observation.k.numpy(), *hand.shape)
        segments = hand.astype(np.uint8)
        segments[occluder] = 2
        self._log(f"{entity}/segmentation", rr.SegmentationImage(segments))
        _, labels = classify(tracked.estimate.state, tracked.shape, observation, self._likelihood)
        self._log(f"{entity}/classified", rr.SegmentationImage(labels))

    def _log_particles(self, entity: str, insight: StepInfo) -> None:
        """The middles of the hands that the particles stand for, brighter with their weight."""
        particles = insight.particles.detach().cpu()
        middles = particles[:, :3] + rotated_pivot(particles[:, 3:6])
        weights = insight.weights.detach().cpu().numpy()
        shades = np.round(255 * weights / max(float(weights.max()), 1e-12)).astype(np.uint8)
        colours = cv2.applyColorMap(shades[:, None], cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
        points = rr.Points3D(middles.numpy(), colors=colours, radii=_PARTICLE_M)
        self._log(f"{entity}/particles", points)

    def _log_hand(self, entity: str, tracked: TrackedHand) -> None:
        estimate = tracked.estimate
        if is_vacant(estimate):
            self._clear(*(f"{entity}/{part}" for part in ("ellipsoids", "skeleton", "joints")))
            return
        self._log(f"{entity}/ellipsoids", _ellipsoids(estimate, tracked.shape))
        joints = estimate.joints_m
        strips, colours = _bone_strips(joints, estimate.joint_ok | estimate.lost)
        lines = rr.LineStrips3D(strips, colors=colours, radii=_BONE_M / 2)
        self._log(f"{entity}/skeleton", lines)
        colours = [_PALM_RGB, *(rgb for rgb in FINGER_RGB for _ in range(4))]
        self._log(f"{entity}/joints", rr.Points3D(joints, colors=colours, radii=_JOINT_M))

    def _log_plots(self, estimate: Estimate, slot: int) -> None:
        latent = estimate.latent.tolist()
        coordinates = [f"coordinate {n}" for n in range(1, len(latent) + 1)]
        scores = [estimate.score, estimate.confidence, float(estimate.lost)]
        which, below = (f", hand {slot + 1}", f"/hand_{slot + 1}") if slot else ("", "")
        for plot, names, values, colours in (
            ("score", ["score", "confidence", "lost"], scores, _SCORE_RGB),
            ("latent", coordinates, latent, [FINGER_RGB[n % 5] for n in range(len(latent))]),
            ("pinch", ["pinch"], [estimate.pinch], [FINGER_RGB[1]]),
        ):
            entity = f"plots/{plot}{below}"
            if entity not in self._named:
                self._named.add(entity)
                # Paler, so that the first hand's lines are told from the others'.
                shown = [tuple((c + 255) // 2 for c in rgb) if slot else rgb for rgb in colours]
                lines = rr.SeriesLines(names=[f"{name}{which}" for name in names], colors=shown)
                self._log(entity, lines, static=True)
            self._log(entity, rr.Scalars(values))

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
        self._log("log", rr.TextLog(text, level=level))


def _of_slot(entity: str, slot: int) -> str:
    return entity if slot == 0 else f"{entity}_{slot + 1}"


def _bone_strips(
    joints_m: np.ndarray, ok: np.ndarray
) -> tuple[list[np.ndarray], list[tuple[int, int, int]]]:
    """Lines (n, 3), m, and their colours: a bone each, in dashes where its joint is not ok.

    joints_m: (21, 3).  ok: (21,) bool.
    """
    strips, colours = [], []
    for joint, parent in enumerate(JOINT_PARENTS[1:], 1):
        begin, way = joints_m[parent], joints_m[joint] - joints_m[parent]
        parts = ((0.0, 1.0),) if ok[joint] else _DASHES
        strips += [np.stack((begin + low * way, begin + high * way)) for low, high in parts]
        colours += [FINGER_RGB[(joint - 1) // 4]] * len(parts)
    return strips, colours


def _ellipsoids(estimate: Estimate, shape: HandShape) -> rr.Ellipsoids3D:
    """The posed hand without its wrist, in the fingers' colours; all in one when it is lost."""
    hand, _ = posed_hand(estimate.state, shape)
    axes = hand.axes_m[0]
    sizes = axes.norm(dim=-2)
    rotations = axes / sizes[:, None]
    # A left hand's frames are mirrored. An ellipsoid does not mind turning an axis around.
    rotations[..., 0] *= torch.linalg.det(rotations).sign()[:, None]
    bones = hand_surface(shape).frame_index[:-1]
    palette = torch.tensor((_PALM_RGB, *FINGER_RGB))
    colours = palette[torch.where(bones > 0, 1 + (bones - 1) // 3, 0)].numpy()
    return rr.Ellipsoids3D(
        centers=hand.centres_m[0].numpy(),
        half_sizes=sizes.numpy(),
        quaternions=Rotation.from_matrix(rotations.numpy()).as_quat(),
        colors=[_LOST_RGB] if estimate.lost else colours,
        fill_mode="majorwireframe",
    )


def _blueprint() -> rrb.Blueprint:
    """How the viewer opens: the scene in 3-D, the images beside it, and the plots below."""
    scene = rrb.Spatial3DView(
        origin="world",
        contents=[
            "+ world/**",
            "- world/camera/amplitude",
            "- world/tracker/**",
            *(f"- world/tracker_{slot}/**" for slot in range(2, MOST_HANDS + 1)),
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
