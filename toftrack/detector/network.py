"""The detector's two networks: a finder of hands in the whole image, and poses of a crop.

Free hypotheses collapse onto one another, so every hypothesis is anchored to one of the 24
rotations of the cube: it answers for hands that are turned about as its anchor. Beside them the
joints are regressed from every cell of a feature map, each cell saying where each joint is and
how surely (as Xiong et al., "A2J: Anchor-to-joint regression network", ICCV 2019), which is more
exact at what is seen. Hands are right hands; a left one is shown mirrored.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from toftrack.compute.rotations import special_gramschmidt
from toftrack.compute.transfer import on_device, on_host, table
from toftrack.detector.crops import CROP_CHANNELS, CROP_M
from toftrack.hand.skeleton import ANGLE_LIMITS

SEGMENTS = 5
"""Classes of pixels: background, the hand, its forearm, another hand or forearm, things."""
PARTS = 32
"""Side of the map of classes that the pose network also predicts for a crop."""
STRIDE = 4
"""Pixels of the finder's image to a cell of its map."""
ANGLES = 21
JOINTS = 21
ANCHORS = 24
EACH = 6 + ANGLES + 1 + 3 + 2
"""Numbers of a hypothesis: rotation, angles, size, pivot, chance, error."""
REPORTED = ANCHORS * EACH + 2
"""Numbers of the heads: those of all hypotheses, present, right."""
CELLS = 16
"""Side of the map of keypoints."""
OFFSET_M = 0.15
LOG_SIZE = 0.3
JOINT_M = 0.05
"""The scales in which places, sizes and offsets of joints are predicted. Weights are of these, of
the deviations' below and of ANGLE_LIMITS: another value needs another training, and then
`fit-confidence`."""
SIGMA_M, LEAST_SIGMA_M = 0.01, 0.001
ERROR_M, LEAST_ERROR_M = 0.02, 0.003


def cube_rotations() -> Tensor:
    """(24, 3, 3) the rotations that take a cube to itself."""
    found = []
    for order in itertools.permutations(range(3)):
        for signum in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3)
            for row, (column, sign) in enumerate(zip(order, signum, strict=True)):
                matrix[row, column] = sign
            if torch.linalg.det(matrix) > 0:
                found.append(matrix)
    return torch.stack(found)


class Proposed(NamedTuple):
    """What the pose network says of N crops, in the crop's frame about its centre.

    rotation: (N, 24, 3, 3).  angles: (N, 24, 21).  log_size: (N, 24).  pivot_m: (N, 24, 3).
    log_probability: (N, 24).  error_m: (N, 24) expected mean error of the joints.
    joints_m: (N, 21, 3) and sigma_m: (N, 21), by the keypoints of the cells.
    right: (N,) logit of a right hand.  present: (N,) logit of a hand near the centre.
    parts: (N, SEGMENTS, PARTS, PARTS) logits.
    """

    rotation: Tensor
    angles: Tensor
    log_size: Tensor
    pivot_m: Tensor
    log_probability: Tensor
    error_m: Tensor
    joints_m: Tensor
    sigma_m: Tensor
    right: Tensor
    present: Tensor
    parts: Tensor


def _layer(inputs: int, outputs: int, size: int, stride: int) -> tuple[nn.Module, ...]:
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return convolution, nn.BatchNorm2d(outputs), nn.ReLU()


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False)
        self.norm_1 = nn.BatchNorm2d(outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, 1, dilation, dilation, bias=False)
        self.norm_2 = nn.BatchNorm2d(outputs)
        self.shortcut: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.shortcut = nn.Sequential(*_layer(inputs, outputs, 1, stride)[:2])

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        y = F.relu(self.norm_1(self.first(x)))
        return F.relu(self.shortcut(x) + self.norm_2(self.second(y)))


class PoseNet(nn.Module):
    """Crops (N, CROP_CHANNELS, 64, 64) to Proposed."""

    anchors: Tensor
    limits: Tensor
    cells: Tensor
    name = "pose"

    def __init__(self, width: int = 24) -> None:
        super().__init__()
        self.width = width
        w1, w2, w3, w4 = width, 2 * width, 4 * width, 6 * width
        self.stem = nn.Sequential(*_layer(CROP_CHANNELS, w1, 5, 2))
        self.fine = Residual(w1, w2, 2)  # 16 x 16
        self.middle = nn.Sequential(Residual(w2, w3, 2), Residual(w3, w3))  # 8 x 8
        self.coarse = Residual(w3, w4, 2)  # 4 x 4
        self.dense = nn.Sequential(
            nn.Flatten(), nn.Linear(16 * w4, 384), nn.ReLU(), nn.Linear(384, 384), nn.ReLU()
        )
        self.register_buffer("anchors", cube_rotations())
        self.register_buffer("limits", torch.tensor(ANGLE_LIMITS))
        self.heads = nn.Linear(384, REPORTED)
        self.context = nn.Linear(384, 2 * width)
        self.lateral_16 = nn.Conv2d(w2, 2 * width, 1)
        self.lateral_8 = nn.Conv2d(w3, 2 * width, 1)
        self.smooth = nn.Sequential(*_layer(2 * width, 2 * width, 3, 1))
        self.keypoints = nn.Conv2d(2 * width, 5 * JOINTS, 1)
        self.painted = nn.Conv2d(2 * width, 4 * SEGMENTS, 1)
        steps = (torch.arange(CELLS) + 0.5) / CELLS - 0.5
        cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy")) * CROP_M
        self.register_buffer("cells", cells)  # (2, 16, 16) metres across, x then y

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return self.anchors.device

    @property
    def ends(self) -> tuple[Tensor, ...]:
        """Weights of the first layer and of the last ones."""
        ends = (self.stem[0], self.heads, self.keypoints, self.painted)
        return tuple(one.get_parameter("weight") for one in ends)

    def forward(self, image: Tensor) -> Proposed:
        """See the class."""
        return self.decode(image, *self.features(image))

    def features(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The last layers' outputs: heads (N, ...), keypoints and parts (N, ..., 16, 16)."""
        fine = self.fine(self.stem(image))
        middle = self.middle(fine)
        dense = self.dense(self.coarse(middle))
        merged = self.lateral_16(fine) + self.context(dense)[:, :, None, None]
        merged = merged + _twice_as_fine(self.lateral_8(middle))
        merged = self.smooth(F.relu(merged))
        return self.heads(dense), self.keypoints(merged), self.painted(merged)

    @torch.inference_mode()
    def outputs(self, crops: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`features` of crops, as arrays on the CPU."""
        image = torch.from_numpy(crops).to(memory_format=torch.channels_last)
        found = on_host(*self.features(on_device(image, self.device)))
        heads, keypoints, parts = (one.contiguous().numpy() for one in found)
        return heads, keypoints, parts

    def decode(self, image: Tensor, heads: Tensor, keypoints: Tensor, painted: Tensor) -> Proposed:
        """What the outputs of `features` mean; in full precision."""
        heads = heads.float()
        joints, sigma = self._joints(keypoints.float(), image[:, :1])
        present, right = heads[:, -2], heads[:, -1]
        each = heads[:, :-2].unflatten(1, (len(self.anchors), -1))
        turn, angles, size, pivot, chance, error = each.split((6, ANGLES, 1, 3, 1, 1), 2)
        unit = table((1.0, 0.0, 0.0, 0.0, 1.0, 0.0), turn.dtype, turn.device)
        turned = special_gramschmidt((0.5 * turn + unit).unflatten(2, (2, 3)).mT)
        low, high = self.limits.unbind(1)
        return Proposed(
            rotation=turned @ self.anchors,
            angles=low + (high - low) * torch.sigmoid(angles),
            log_size=LOG_SIZE * size[..., 0],
            pivot_m=OFFSET_M * pivot,
            log_probability=chance[..., 0].log_softmax(1),
            error_m=ERROR_M * F.softplus(error[..., 0]) + LEAST_ERROR_M,
            joints_m=joints,
            sigma_m=sigma,
            right=right,
            present=present,
            parts=F.pixel_shuffle(painted.float(), PARTS // 16),
        )

    def _joints(self, keypoints: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted means of the cells' keypoints, (N, 21, 3), and their deviations (N, 21)."""
        weight, x, y, z, spread = keypoints.unflatten(1, (5, JOINTS)).flatten(3).unbind(1)
        weight = weight.softmax(2)
        across, down = self.cells.flatten(1)
        # Depth is voted for about the surface that the cell sees.
        seen = F.avg_pool2d(depth, depth.shape[-1] // 16).flatten(2) * (CROP_M / 2)
        at = torch.stack((across + JOINT_M * x, down + JOINT_M * y, seen + JOINT_M * z), 3)
        joints = (weight[..., None] * at).sum(2)
        sigma = SIGMA_M * F.softplus((weight * spread).sum(2)) + LEAST_SIGMA_M
        return joints, sigma


class Found(NamedTuple):
    """What the finder says of N images of h x w cells: each (N, h, w).

    heat: logit that a hand's middle lies in the cell.  column, row: offsets from the cell's middle,
    in cells.  log_depth: of the middle of the palm, Z in metres.
    """

    heat: Tensor
    column: Tensor
    row: Tensor
    log_depth: Tensor


class Finder(nn.Module):
    """Whole images (N, 2, H, W), H and W multiples of WIDE_MULTIPLE, to Found, a cell to 4 x 4
    pixels.

    What is coarse is added to what is fine, as in feature pyramids (Lin et al., "Feature pyramid
    networks for object detection", CVPR 2017).
    """

    name = "finder"

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.width = width
        w1, w2 = width, 2 * width
        self.fine = nn.Sequential(*_layer(2, 16, 5, 2), *_layer(16, w1, 3, 2), Residual(w1, w1))
        self.middle = nn.Sequential(Residual(w1, w2, 2), Residual(w2, w2))
        self.coarse = nn.Sequential(
            Residual(w2, w2, 2), Residual(w2, w2), Residual(w2, w2, dilation=2)
        )
        self.lateral_coarse = nn.Conv2d(w2, w2, 1)
        self.merged_middle = Residual(w2, w2)
        self.lateral_middle = nn.Conv2d(w2, w1, 1)
        self.merged = Residual(w1, w1)
        self.heads = nn.Conv2d(w1, 4, 1)
        assert self.heads.bias is not None
        self.heads.bias.data[0] = -5.0  # at first there are no hands anywhere

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return self.heads.weight.device

    @property
    def ends(self) -> tuple[Tensor, ...]:
        """Weights of the first layer and of the last one."""
        return self.fine[0].get_parameter("weight"), self.heads.weight

    def forward(self, image: Tensor) -> Found:
        """See the class."""
        fine = self.fine(image)
        middle = self.middle(fine)
        coarse = self.lateral_coarse(self.coarse(middle))
        middle = self.merged_middle(F.relu(middle + _twice_as_fine(coarse)))
        merged = self.merged(F.relu(fine + _twice_as_fine(self.lateral_middle(middle))))
        heat, column, row, depth = self.heads(merged).float().unbind(1)
        return Found(heat, column, row, depth - 0.7)


def _twice_as_fine(features: Tensor) -> Tensor:
    return F.interpolate(features, scale_factor=2.0, mode="nearest")
