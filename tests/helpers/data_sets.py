"""Tiny folders in the formats of public data sets, made from the sample recording."""

from pathlib import Path

import cv2
import numpy as np
from helpers.tracking import Scene, sample
from scipy.io import savemat

from toftrack.evaluation.datasets import INTEL_CREATIVE, NYU_CAMERA
from toftrack.frames.camera import Camera

THUMB_LAST = [0, *range(5, 21), *range(1, 5)]
"""toftrack's rows in MSRA's order."""


def scene(camera: Camera, frames: int) -> Scene:
    """The first frames of the sample as another camera at the same place would have seen them."""
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    ours, theirs = sample().k, camera.K
    u = (columns - theirs[0, 2]) / theirs[0, 0] * ours[0, 0] + ours[0, 2]
    v = (rows - theirs[1, 2]) / theirs[1, 1] * ours[1, 1] + ours[1, 2]
    u, v = u.astype(np.float32), v.astype(np.float32)
    depth = [
        cv2.remap(seen, u, v, cv2.INTER_NEAREST, borderValue=0)
        for seen in sample().depth_m[:frames]
    ]
    return Scene(np.array(depth), theirs, sample().joints_m[:frames])


PARTS = {"MSRA14": "Subject1", "MSRA15": "P0/TIP", "ICVL": "Testing", "NYU": "test"}
"""Where the only sequence of a data set lies, and its name, but for ICVL."""


def write(name: str, folder: Path, frames: int) -> Scene:
    """A data set of one sequence; what it shows."""
    seen = scene(NYU_CAMERA if name == "NYU" else INTEL_CREATIVE, frames)
    if name.startswith("MSRA"):
        write_msra(folder / PARTS[name], seen, boxed=name == "MSRA15")
    else:
        {"ICVL": write_icvl, "NYU": write_nyu}[name](folder / PARTS[name], seen)
    return seen


def write_msra(folder: Path, seen: Scene, boxed: bool) -> None:
    """A sequence of MSRA15 (boxed) or MSRA14."""
    folder.mkdir(parents=True)
    count = len(seen.depth_m)
    rows = 1e3 * seen.joints_m[:, THUMB_LAST] * (1, -1, -1)
    lines = [" ".join(f"{value:.3f}" for value in row.ravel()) for row in rows]
    (folder / "joint.txt").write_text("\n".join([str(count), *lines]) + "\n")
    for index, depth in enumerate(1e3 * seen.depth_m):
        path = folder / f"{index:06d}_depth.bin"
        if not boxed:
            path.write_bytes(depth.astype("<f4").tobytes())
            continue
        rows_there, columns_there = np.nonzero(depth)
        top, bottom = int(rows_there.min()), int(rows_there.max()) + 1
        left, right = int(columns_there.min()), int(columns_there.max()) + 1
        header = np.array([depth.shape[1], depth.shape[0], left, top, right, bottom], "<i4")
        box = depth[top:bottom, left:right].astype("<f4")
        path.write_bytes(header.tobytes() + box.tobytes())


def write_icvl(folder: Path, seen: Scene, name: str = "test_seq_1") -> None:
    """A sequence of ICVL and its file of labels; the palm's middle is made up."""
    images = folder / "Depth" / name
    images.mkdir(parents=True)
    rows = [2, 3, 4, 5, 6, 8, 9, 10, 12, 13, 14, 16, 17, 18, 20]
    lines = []
    for index, (depth, joints) in enumerate(zip(seen.depth_m, seen.joints_m, strict=True)):
        points = np.concatenate([joints[[0, 9]].mean(0, keepdims=True), joints[rows]])
        uv = points[:, :2] / points[:, 2:] * np.diag(seen.k)[:2] + seen.k[:2, 2]
        labels = np.concatenate([uv, 1e3 * points[:, 2:]], axis=1).ravel()
        lines.append(f"{name}/image_{index:04d}.png " + " ".join(f"{v:.3f}" for v in labels))
        words = np.round(1e3 * depth).astype(np.uint16)
        assert cv2.imwrite(str(images / f"image_{index:04d}.png"), words)
    with open(folder / f"{name}.txt", "a", encoding="ascii") as stream:
        stream.write(" \n".join(lines) + " \n")


def write_nyu(folder: Path, seen: Scene) -> None:
    """The images and labels of NYU; points that are not compared lie far away."""
    folder.mkdir(parents=True)
    points = np.full((3, len(seen.joints_m), 36, 3), -999.0)
    ours = {20: 0, 18: 3, 16: 6, 14: 9, 12: 12, 10: 15, 8: 18, 6: 21, 4: 24, 3: 25, 2: 27}
    millimetres = 1e3 * seen.joints_m * (1, -1, 1)
    for row, point in ours.items():
        points[0, :, point] = millimetres[:, row]
    points[0, :, 30] = millimetres[:, 0] + (20, 5, 0)
    points[0, :, 31] = millimetres[:, 0] - (20, 5, 0)
    content = {"joint_names": "unused", "joint_uvd": points + 1, "joint_xyz": points}
    savemat(folder / "joint_data.mat", content, do_compression=True)
    for index, depth in enumerate(seen.depth_m):
        words = np.round(1e3 * depth).astype(np.uint16)
        image = np.stack([words & 255, words >> 8, np.zeros_like(words)], axis=-1)
        path = folder / f"depth_1_{index + 1:07d}.png"
        assert cv2.imwrite(str(path), image.astype(np.uint8))
