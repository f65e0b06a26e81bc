# SPDX-License-Identifier: MIT
"""Stage 2 networks: joints Theta_J, keypoints Theta_K, residual Theta_Delta, template Y (Sec. 3.2).

Frames: `aligned` is the paper's S_obj, `template` its Y_X. Lengths are in normalised units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from scapo.categories import Category, JointKind
from scapo.first_weights import uniform
from scapo.geometry.numerics import at_least_float32
from scapo.geometry.points import farthest_points, k_means

MOST_BLOCKS = 100  # Of any network: five are published


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPairs:
    """Joints of one shape with a state on either side, the paper's (c, d, a) with a in R^2."""

    pivot: Float[Tensor, "B J 3"]
    axis: Float[Tensor, "B J 3"]
    """Unit vectors."""
    state: Float[Tensor, "B J 2"]
    """Of the parent and of the child; only their difference can be seen from outside."""

    def relative(self) -> Float[Tensor, "B J"]:
        """Child minus parent."""
        return self.state[..., 1] - self.state[..., 0]


def opalign_record(
    rotation: Float[Tensor, "B 3 3"],
    translation: Float[Tensor, "B 3"],
    aligned: JointPairs,
    canonical: JointPairs,
) -> dict[str, Tensor]:
    """What OP-Align's released evaluator asks of a network, under its names.

    Args:
        rotation: input_R_aligned.
        translation: Aligned points are R^T x - t.
        aligned: Joints of the aligned shape (S).
        canonical: Joints of the canonical shape or template (I).
    """
    record = {"R_select": rotation, "T_select": translation}
    for letter, joints in (("S", aligned), ("I", canonical)):
        record |= {
            f"{letter}_joint": joints.pivot,
            f"{letter}_drct": joints.axis,
            f"{letter}_angl": joints.state,
        }
    return record


def joint_pairs(
    numbers: Float[Tensor, "B J 8"],
    kinds: tuple[JointKind, ...],
    revolute: float,
    prismatic: float,
) -> JointPairs:
    """The joints that a network says: pivot, axis, and states within half their range of 0.

    Args:
        numbers: Of each joint.
        kinds: Of the joints.
        revolute: Width of the range of states of hinges, rad.
        prismatic: The same of joints that slide, normalised units.
    """
    pivot, axis, state = numbers.split((3, 3, 2), -1)
    reach = {"revolute": revolute, "prismatic": prismatic}
    scale = state.new_tensor([reach[kind] for kind in kinds])[:, None]
    state = scale * (torch.sigmoid(state) - 0.5)  # (B, J, 2)
    return JointPairs(pivot=pivot, axis=F.normalize(axis, dim=-1), state=state)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointConfig:
    """Sizes of Theta_J; defaults as OP-Align's point network without its segmentation head."""

    width: int = 256
    """Channels of the residual blocks."""
    blocks: int = 5
    """Residual blocks."""
    head: tuple[int, int] = (256, 128)
    """Channels of the layers that find joints."""
    points: int | None = None
    """Points it looks at, evenly taken from the cloud's order; None = all."""
    revolute_range: float = 2.0944
    """Width of the interval of states, rad (120 degrees)."""
    prismatic_range: float = 1.0
    """Width of the interval of ways of prismatic joints, in normalised units."""
    base_fixed: bool = True
    """Hold the parent's state at 0: moving the base is the same as moving the object."""

    def __post_init__(self) -> None:
        """Raise ValueError for more blocks than any network has, as damaged files ask for."""
        if not 1 <= self.blocks <= MOST_BLOCKS:
            raise ValueError(f"blocks: expected 1 to {MOST_BLOCKS}, found {self.blocks}")


def thin(points: Float[Tensor, "B N 3"], count: int) -> Float[Tensor, "B K 3"]:
    """`count` of the points, evenly taken from their order; all where there are fewer."""
    if count >= points.shape[1]:
        return points
    return points[:, torch.arange(count, device=points.device) * points.shape[1] // count]


class ResidualBlock(nn.Module):
    """Two pointwise layers beside a linear shortcut, then batch norm (ResNet-PointNet)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, outputs)
        self.second = nn.Linear(outputs, outputs)
        self.shortcut = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "B N I"]) -> Float[Tensor, "B N O"]:
        """Pointwise."""
        x = self.shortcut(x) + self.second(F.relu(self.first(F.relu(x))))
        return self.norm(x.flatten(0, 1)).view_as(x)


class JointNetwork(nn.Module):
    """Theta_J, shared by S_obj and Y_X: points -> pivots, axes and states of all joints."""

    def __init__(self, config: JointConfig, category: Category) -> None:
        super().__init__()
        self.config = config
        self.kinds: tuple[JointKind, ...] = tuple(joint.kind for joint in category.joints)
        width, (wide, narrow) = config.width, config.head
        self.lift = nn.Linear(3, 2 * width)
        self.blocks = nn.ModuleList([ResidualBlock(2 * width, width) for _ in range(config.blocks)])
        self.head = nn.Sequential(
            nn.Linear(width, wide),
            nn.ReLU(),
            nn.Linear(wide, narrow),
            nn.ReLU(),
            nn.Linear(narrow, 8 * len(self.kinds)),
        )

    def pair(
        self, aligned: Float[Tensor, "B N 3"], template: Float[Tensor, "B M 3"]
    ) -> tuple[JointPairs, JointPairs]:
        """Joints of both shapes, as one batch so that they share its statistics (OP-Align)."""
        count = min(aligned.shape[1], template.shape[1], self.config.points or 1 << 30)
        both = torch.cat([thin(aligned, count), thin(template, count)])
        joints = self(both)
        first, second = (
            JointPairs(pivot=pivot, axis=axis, state=state)
            for pivot, axis, state in zip(
                joints.pivot.chunk(2), joints.axis.chunk(2), joints.state.chunk(2), strict=True
            )
        )
        return first, second

    def forward(self, points: Float[Tensor, "B N 3"]) -> JointPairs:
        """Joints in the frame of the points; states within half the range of 0 by a sigmoid."""
        x = self.lift(points)
        for block in self.blocks[:-1]:
            x = block(x)
            x = torch.cat([x, x.amax(1, keepdim=True).expand_as(x)], -1)
        pooled = self.blocks[-1](x).amax(1)
        numbers = at_least_float32(self.head(pooled)).unflatten(1, (len(self.kinds), 8))
        config = self.config
        joints = joint_pairs(numbers, self.kinds, config.revolute_range, config.prismatic_range)
        if not config.base_fixed:
            return joints
        return replace(joints, state=joints.state * numbers.new_tensor([0.0, 1.0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadConfig:
    """Sizes of Theta_K (as ShapeMaker's) and Theta_Delta."""

    keypoint: tuple[int, int, int] = (512, 512, 256)
    """Channels of Theta_K's layers."""
    residual: tuple[int, int] = (256, 128)
    """Channels of Theta_Delta's layers."""


class KeypointNetwork(nn.Module):
    """Theta_K: code Z_x -> one keypoint per part, K in R^{P x 3}, aligned frame."""

    def __init__(self, config: HeadConfig, code: int, parts: int) -> None:
        super().__init__()
        sizes = (code, *config.keypoint)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.out = nn.Linear(sizes[-1], 3 * parts)

    def start_at(self, keypoints: Float[Tensor, "P 3"]) -> None:
        """Predict these for every shape until training moves away from them."""
        with torch.no_grad():
            self.out.weight.zero_()
            self.out.bias.copy_(keypoints.flatten())

    def forward(self, code: Float[Tensor, "B Z"]) -> Float[Tensor, "B P 3"]:
        """One point per part."""
        return self.out(self.layers(code)).unflatten(1, (-1, 3))


class ResidualNetwork(nn.Module):
    """Theta_Delta: decoder features F_x -> residual shape Delta S_X, pointwise, zero at first."""

    def __init__(self, config: HeadConfig, features: int) -> None:
        super().__init__()
        wide, narrow = config.residual
        self.layers = nn.Sequential(
            nn.Linear(features, wide), nn.ReLU(), nn.Linear(wide, narrow), nn.ReLU()
        )
        self.out = ZeroLinear(narrow, 3)

    def forward(self, features: Float[Tensor, "B N C"]) -> Float[Tensor, "B N 3"]:
        """One displacement per template point."""
        return self.out(self.layers(features))


class ZeroLinear(nn.Module):
    """A linear layer that starts at 0."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(outputs, inputs))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Float[Tensor, "*B I"]) -> Float[Tensor, "*B O"]:
        """Over the last axis."""
        return F.linear(x, self.weight, self.bias)


class Template(nn.Module):
    """Y_base and its keypoints K_Y, learned per category.

    The paper says where neither starts. Points: Xavier uniform (OP-Align) until `set_to` puts
    the decoded training medoid in their place. Keypoints: one K per shape is our reading
    (docs/method.md), so the template has its own.
    """

    part: Tensor
    """(N,) which part each point was of where stage 2 began; 0 where nobody said."""

    def __init__(self, points: int, parts: int) -> None:
        super().__init__()
        self.points = nn.Parameter(torch.zeros(points, 3))
        self.keypoints = nn.Parameter(torch.zeros(parts, 3))
        self.register_buffer("part", torch.zeros(points, dtype=torch.uint8))

    def _load_from_state_dict(
        self,
        state_dict: dict[str, Any],
        prefix: str,
        *rest: Any,  # noqa: ANN401 - as torch calls it
        **named: Any,  # noqa: ANN401
    ) -> None:
        """Of a template that was saved without them nobody said parts."""
        state_dict.setdefault(prefix + "part", self.part)
        super()._load_from_state_dict(state_dict, prefix, *rest, **named)

    def reset(self, generator: torch.Generator) -> None:
        """Xavier uniform points, small random keypoints."""
        uniform(self.points, (6 / (self.points.shape[0] + 3)) ** 0.5, generator)
        uniform(self.keypoints, 0.1, generator)

    def set_to(self, points: Float[Tensor, "N 3"], keypoints: Float[Tensor, "P 3"]) -> None:
        """Put a shape and its part centroids in place."""
        with torch.no_grad():
            self.points.copy_(points)
            self.keypoints.copy_(keypoints)


@torch.no_grad()
def part_centroids(
    points: Float[Tensor, "N 3"], parts: int, rounds: int = 20
) -> Float[Tensor, "P 3"]:
    """P-means of a shape, started from its farthest points: where bones can begin."""
    first = int((points - points.mean(0)).norm(dim=1).argmax())
    return k_means(points, points[farthest_points(points, parts, start=first)], rounds)
