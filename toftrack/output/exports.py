"""The hands of a run as skeletons that move, and as binary glTF, each with a skin.

Metres; x right, y up, z backward. In glTF a node for each of the 26 joints of OpenXR has a key in
every frame for its place and its turn; in frames without the hand its skeleton is scaled to
nothing, which is how glTF hides what is animated, and its pose is held.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.metadata import version
from types import ModuleType
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from toftrack.errors import ToftrackError, module_of_extra
from toftrack.frames.frame import LEAP_S
from toftrack.hand.openxr import (
    JOINT_OF_FRAME,
    OPENXR_JOINT_NAMES,
    OPENXR_PARENTS,
    openxr_hand,
    openxr_rig,
)
from toftrack.hand.shape import SIDES, HandShape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import hand_surface
from toftrack.output.run_folder import Run

_WRIST = OPENXR_JOINT_NAMES.index("wrist")


@dataclass(frozen=True, eq=False)
class HandMotion:
    """One hand over T frames: the 26 joints of OpenXR, each relative to the one it hangs on."""

    slot: int
    time_s: np.ndarray
    """(T,) from 0 on, increasing."""
    tracked: np.ndarray
    """(T,) bool; elsewhere the pose is held from the frame before, or the first tracked one."""
    offset_m: np.ndarray
    """(T, 26, 3) in the axes of the joint that each hangs on; of the wrist in the world."""
    turn: np.ndarray
    """(T, 26, 4) unit quaternions x y z w likewise, without jumps of sign."""
    rest_offset_m: np.ndarray
    """(26, 3) of the straight hand at the origin."""
    shape: HandShape
    """Of the side that the hand had in most of its frames."""
    suffix: str = ""
    """Of its joints' names, where another hand has the same side."""

    def name(self, joint: str) -> str:
        """As the specification of OpenXR advises: "Index_Metacarpal_R"."""
        return f"{joint.title()}_{self.shape.side[0].upper()}{self.suffix}"


def motions_of(run: Run) -> list[HandMotion]:
    """The hands of a run that were tracked at all.

    In a frame that was dropped a hand stays as the row has it, which is as it was before. Raises
    ToftrackError when no slot had a hand that was tracked.
    """
    time_s = _times(run.timestamp_s)
    found: list[HandMotion] = []
    for slot in range(len(run.shapes)):
        motion = _motion(slot, run.slot(slot), time_s)
        if motion is None:
            continue
        # What animates a hand finds its joints by their names.
        if any(motion.shape.side == other.shape.side for other in found):
            motion = replace(motion, suffix=f"_{slot + 1}")
        found.append(motion)
    if not found:
        raise ToftrackError(
            "no frame of this run has a hand that is not lost, so there is nothing to export"
        )
    return found


def _relative(position: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints in the world (T, 26, 3) and (T, 26, 4), each in the axes of the one it hangs on."""
    offset, turn = position.copy(), turned.copy()
    for joint, parent in enumerate(OPENXR_PARENTS):
        if parent >= 0:
            back = Rotation.from_quat(turned[:, parent]).inv()
            offset[:, joint] = back.apply(position[:, joint] - position[:, parent])
            turn[:, joint] = (back * Rotation.from_quat(turned[:, joint])).as_quat()
    return offset, turn


def _rest_joints(shape: HandShape) -> tuple[np.ndarray, np.ndarray]:
    """(26, 3) and (26, 4) of the straight hand with the wrist at the origin, in the world."""
    rest = torch.zeros(1, 27, dtype=torch.float64)
    joints = forward_kinematics(rest, shape.to("cpu", torch.float64)).joints_m.numpy()
    hand = openxr_hand(joints[0], rest[0].numpy(), openxr_rig(shape))
    return hand.position_m, hand.orientation


def _motion(slot: int, run: Run, time_s: np.ndarray) -> HandMotion | None:
    """The motion of the hand of a run with one slot, None where it never had one."""
    hand, shape = run.results, run.shape
    # As they are: those of one shape would not be where the hand was before that was fitted.
    position, turned = hand["openxr_position_m"], hand["openxr_orientation"].astype(np.float64)
    tracked = ~hand["lost"].astype(bool) & np.isfinite(position).all((1, 2))
    if not tracked.any():
        return None
    reported = list(hand["side"][tracked])
    shape = shape.of_side(max(SIDES, key=reported.count) if any(reported) else shape.side)
    held = np.maximum.accumulate(np.where(tracked, np.arange(len(tracked)), -1))
    held = np.where(held < 0, tracked.argmax(), held)
    offset, turn = _relative(position[held], turned[held])
    position, turned = _rest_joints(shape)
    rest_offset, _ = _relative(position[None], turned[None])
    return HandMotion(slot, time_s, tracked, offset, _smooth_signum(turn), rest_offset[0], shape)


def _smooth_signum(turn: np.ndarray) -> np.ndarray:
    """(T, 26, 4) quaternions, each with the sign that lies nearer to the one before."""
    agree = np.einsum("tjq,tjq->tj", turn[1:], turn[:-1]) >= 0
    signum = np.cumprod(np.where(agree, 1.0, -1.0), axis=0)
    return np.concatenate((turn[:1], turn[1:] * signum[..., None]))


def _times(timestamp_s: np.ndarray) -> np.ndarray:
    """(T,) from 0 on; where time stands still, goes back or leaps, frames of even length."""
    steps = np.diff(timestamp_s)
    if not ((steps > 0) & (steps < LEAP_S)).all():
        usual = steps[(steps >= 0) & (steps < LEAP_S)]
        later = usual[usual > 0]
        # No mean: all frames would last longer because of one pause.
        step = float(np.median(later)) * later.size / usual.size if later.size else 1 / 25
        return step * np.arange(len(timestamp_s))
    return timestamp_s - timestamp_s[:1]


_SKIN = [0.85, 0.6, 0.46, 1.0]


def glb_of(motions: list[HandMotion]) -> bytes:
    """The content of a .glb file. Raises ToftrackError when pygltflib is not installed."""
    file = _File(module_of_extra("pygltflib", "glb needs pygltflib", "export"))
    for motion in motions:
        _add_hand(file, motion)
    return file.content()


def _add_hand(file: _File, motion: HandMotion) -> None:
    """Nodes, skin, mesh and animation of one hand."""
    gltf, nodes = file.gltf, file.document.nodes
    first = len(nodes) + 1  # of the joints, behind the node that holds them
    nodes.append(gltf.Node(name=motion.name("hand"), children=[first + _WRIST]))
    for joint, name in enumerate(OPENXR_JOINT_NAMES):
        node = gltf.Node(
            name=motion.name(name),
            translation=motion.offset_m[0, joint].tolist(),
            rotation=motion.turn[0, joint].tolist(),
            children=[first + child for child, at in enumerate(OPENXR_PARENTS) if at == joint],
        )
        nodes.append(node)
    mesh, skin = _mesh(file, motion), _skin(file, motion, first)
    skinned = _added(nodes, gltf.Node(name=motion.name("skin"), mesh=mesh, skin=skin))
    file.document.scenes[0].nodes += [first - 1, skinned]
    _animate(file, motion, first)


def _added(items: list[Any], one: Any) -> int:
    """Append to a list of the document; returns the number there."""
    items.append(one)
    return len(items) - 1


def _mesh(file: _File, motion: HandMotion) -> int:
    """The number of the mesh."""
    gltf = file.gltf
    points_m, normals, joint, triangles = hand_mesh(motion.shape)
    joints = np.zeros((len(joint), 4), np.uint8)
    joints[:, 0] = joint
    weights = np.zeros((len(joint), 4), np.float32)
    weights[:, 0] = 1
    attributes = gltf.Attributes(
        POSITION=file.array(points_m, gltf.VEC3, gltf.ARRAY_BUFFER, limits=True),
        NORMAL=file.array(normals, gltf.VEC3, gltf.ARRAY_BUFFER),
        JOINTS_0=file.array(joints, gltf.VEC4, gltf.ARRAY_BUFFER),
        WEIGHTS_0=file.array(weights, gltf.VEC4, gltf.ARRAY_BUFFER),
    )
    corners = triangles.ravel().astype(np.uint32)
    indices = file.array(corners, gltf.SCALAR, gltf.ELEMENT_ARRAY_BUFFER)
    primitive = gltf.Primitive(attributes=attributes, indices=indices, material=0)
    mesh = gltf.Mesh(name=motion.name("skin"), primitives=[primitive])
    return _added(file.document.meshes, mesh)


def _skin(file: _File, motion: HandMotion, first: int) -> int:
    """The number of the skin; its joints are the nodes from `first` on."""
    gltf = file.gltf
    position, turned = _rest_joints(motion.shape)
    back = Rotation.from_quat(turned).inv()
    inverse = np.zeros((26, 4, 4))
    inverse[:, :3, :3] = back.as_matrix()
    inverse[:, :3, 3] = -back.apply(position)
    inverse[:, 3, 3] = 1
    columns = inverse.swapaxes(1, 2).reshape(26, 16)
    skin = gltf.Skin(
        name=motion.name("skin"),
        inverseBindMatrices=file.array(columns, gltf.MAT4),
        skeleton=first + _WRIST,
        joints=list(range(first, first + 26)),
    )
    return _added(file.document.skins, skin)


def _animate(file: _File, motion: HandMotion, first: int) -> None:
    gltf, animation = file.gltf, file.animation
    keys_s = motion.time_s.astype(np.float32)
    for row in range(1, len(keys_s)):  # each later than the one before, even where 32 bits are few
        keys_s[row] = max(keys_s[row], np.nextafter(keys_s[row - 1], np.float32(np.inf)))
    time = file.array(keys_s, gltf.SCALAR, limits=True)

    def add(node: int, path: str, values: np.ndarray, kind: str, steps: str) -> None:
        sampler = gltf.AnimationSampler(
            input=time, output=file.array(values, kind), interpolation=steps
        )
        number = _added(animation.samplers, sampler)
        target = gltf.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(gltf.AnimationChannel(sampler=number, target=target))

    shown = np.repeat(motion.tracked[:, None].astype(np.float32), 3, 1)
    add(first - 1, "scale", shown, gltf.VEC3, "STEP")
    for joint in range(26):
        add(first + joint, "translation", motion.offset_m[:, joint], gltf.VEC3, "LINEAR")
        add(first + joint, "rotation", motion.turn[:, joint], gltf.VEC4, "LINEAR")


class _File:
    """A document that grows, with all its arrays in one buffer; gltf: the module pygltflib."""

    def __init__(self, gltf: ModuleType) -> None:
        self.gltf: Any = gltf
        self.animation = self.gltf.Animation(name="track", samplers=[], channels=[])
        skin = self.gltf.PbrMetallicRoughness(
            baseColorFactor=_SKIN, metallicFactor=0.0, roughnessFactor=0.7
        )
        self.document = self.gltf.GLTF2(
            asset=self.gltf.Asset(version="2.0", generator=f"toftrack {version('toftrack')}"),
            scene=0,
            scenes=[self.gltf.Scene(nodes=[])],
            materials=[self.gltf.Material(name="skin", pbrMetallicRoughness=skin)],
            animations=[self.animation],
        )
        self._data = bytearray()

    def array(
        self, values: np.ndarray, kind: str, target: int | None = None, limits: bool = False
    ) -> int:
        """Append an array, floating ones as float32, with the least and the largest of each column
        where asked; returns the number of its accessor.
        """
        types = {"u1": self.gltf.UNSIGNED_BYTE, "u4": self.gltf.UNSIGNED_INT}
        if values.dtype.kind == "f":
            values = values.astype(np.float32)
        component = types.get(values.dtype.str[1:], self.gltf.FLOAT)
        data = np.ascontiguousarray(values).tobytes()
        rows = values.reshape(len(values), -1)
        view = self.gltf.BufferView(
            buffer=0, byteOffset=len(self._data), byteLength=len(data), target=target
        )
        self._data += data + bytes(-len(data) % 4)
        accessor = self.gltf.Accessor(
            bufferView=_added(self.document.bufferViews, view),
            componentType=component,
            count=len(values),
            type=kind,
            min=rows.min(0).tolist() if limits else None,
            max=rows.max(0).tolist() if limits else None,
        )
        return _added(self.document.accessors, accessor)

    def content(self) -> bytes:
        """The whole file."""
        self.document.buffers = [self.gltf.Buffer(byteLength=len(self._data))]
        self.document.set_binary_blob(bytes(self._data))
        return b"".join(self.document.save_to_bytes())


_POINTS = 146
"""Of an ellipsoid."""
_WORLD = np.array([1.0, -1.0, -1.0])


def hand_mesh(shape: HandShape) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The mesh of a straight hand with its wrist at the origin, in the world of OpenXR; an
    ellipsoid is a ball of its own, which moves with one joint.

    Returns points, m, and normals, (V, 3) each; the joint of OpenXR that each point moves with,
    (V,); and triangles (F, 3) of points, anticlockwise seen from outside.
    """
    shape = shape.to("cpu", torch.float64)
    surface = hand_surface(shape)
    rest = forward_kinematics(torch.zeros(1, 27, dtype=torch.float64), shape)
    flesh = surface.pose(rest)
    centres = _WORLD * flesh.centres_m[0, :-1].numpy()
    axes = _WORLD[:, None] * flesh.axes_m[0, :-1].numpy()  # (E, 3, 3)
    ball, faces = _ball()
    points = centres[:, None] + ball @ axes.swapaxes(1, 2)
    normals = ball @ np.linalg.inv(axes)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # Mirrored axes turn a ball inside out.
    turned = np.where((np.linalg.det(axes) < 0)[:, None, None], faces[:, ::-1], faces)
    triangles = turned + len(ball) * np.arange(len(axes))[:, None, None]
    frames = surface.frame_index[:-1].numpy()
    joint = np.repeat(np.array(JOINT_OF_FRAME)[frames], len(ball))
    return points.reshape(-1, 3), normals.reshape(-1, 3), joint, triangles.reshape(-1, 3)


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """A unit ball's points (P, 3), evenly spread on a spiral, and triangles (F, 3)."""
    z = np.linspace(1, -1, _POINTS)
    turn = np.pi * (3 - 5**0.5) * np.arange(_POINTS)
    radius = np.sqrt(1 - z**2)
    points = np.stack((radius * np.cos(turn), radius * np.sin(turn), z), -1)
    faces = ConvexHull(points).simplices
    inwards = np.linalg.det(points[faces]) < 0
    return points, np.where(inwards[:, None], faces[:, ::-1], faces)
