# SPDX-License-Identifier: MIT
"""The shape that all steps share: an articulated template and its placements.

One template per category: oriented points, part weights, joint axes and pivots, all in a template
frame at state 0. A placement says where one cloud has it: pose of the base, joint states, three
scales along the template's axes, and where on the body each joint sits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from scapo.categories import JointKind
from scapo.geometry.points import ends, farthest_points
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take

NORMAL_LENGTH = 0.06
"""Normalised length that a unit of normal difference counts as when points are told apart; the
normals of a plate's two faces differ by 2."""
PART_LENGTH = 0.1
"""That of a unit of part weights, so that small parts are sampled along their borders too."""
BUFFERS = ("rest", "load", "noise", "alike")
"""What is known of the axes and parts beside the shape."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Where B views have the template; normalised units and frames of the views."""

    rotation: Float[Tensor, "B 3 3"]
    """view_R_template of the base."""
    translation: Float[Tensor, "B 3"]
    log_scale: Float[Tensor, "B 3"]
    """Along the template's axes, before everything else."""
    state: Float[Tensor, "B J"]
    """Relative to the template's own state: rad or normalised length."""
    shift: Float[Tensor, "B J 3"]
    """Of a joint and its part on the base, across its axis; template frame, after scaling."""
    deviation: Float[Tensor, "B J 3"]
    """Of a hinge's axis from the category's (rotation vector, template frame)."""
    pivot: Float[Tensor, "B J 3"] | None = None
    """Where the object's own joints sit on the base, template frame, after scaling. What is placed
    does not depend on it; None: where the template's are."""

    @staticmethod
    def at(
        rotation: Float[Tensor, "B 3 3"],
        translation: Float[Tensor, "B 3"],
        state: Float[Tensor, "B J"],
    ) -> Placement:
        """A placement without scaling or shift."""
        return Placement(
            rotation=rotation,
            translation=translation,
            log_scale=torch.zeros_like(translation),
            state=state,
            shift=translation.new_zeros(*state.shape, 3),
            deviation=translation.new_zeros(*state.shape, 3),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PartPoses:
    """view_T_part of B views and P parts, acting on scaled template points."""

    rotation: Float[Tensor, "B P 3 3"]
    translation: Float[Tensor, "B P 3"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mirror:
    """A reflection of the template's frame that takes each hinge to itself or to the other one."""

    flip: Float[Tensor, "3 3"]
    middle: Float[Tensor, " 3"]
    """Of the plane, unscaled; along its normal."""
    order: Int[Tensor, " J"]
    """Hinge j is the image of hinge order[j]."""
    sense: Float[Tensor, " J"]
    """Its state is so many times that one's."""

    def placement(self, placement: Placement) -> Placement:
        """Of the mirror images of views, their frames reflected alike; axes do not deviate."""
        rotation = self.flip @ placement.rotation @ self.flip
        beyond = 2 * self.middle * placement.log_scale.exp()
        return replace(
            placement,
            rotation=rotation,
            translation=placement.translation @ self.flip - (rotation @ beyond[..., None])[..., 0],
            state=placement.state[:, self.order] * self.sense,
            shift=placement.shift[:, self.order] @ self.flip,
        )


class ArticulatedTemplate(nn.Module):
    """Oriented points with part weights, and the joints that move them."""

    points: nn.Parameter
    """(M, 3)"""
    logit: nn.Parameter
    """(M, P) part weights before the softmax."""
    axis: nn.Parameter
    """(J, 3), any length."""
    pivot: nn.Parameter
    """(J, 3)"""
    sliding: Tensor
    """(J, 1) 1 for each prismatic joint, 0 for the others; a buffer, as what follows."""
    normals: Tensor
    """(M, 3)"""
    rest: Tensor
    """(J,) state at which a deviating axis leaves the part where it is; see `axis_deviation`."""
    load: Tensor
    """(2 J,) what axes deviate by, along the two directions across each; 0: they do not."""
    noise: Tensor
    """(2 J, 2 J) covariance of observed part rotations that no deviation explains."""
    alike: Tensor
    """() 1 where the parts are two like halves, of which neither is favoured as the base."""
    mirrored: bool
    """Whether cameras are known to stand to either side of the object alike (`mirror`)."""

    def __init__(self, kinds: tuple[JointKind, ...], count: int = 400) -> None:
        """A template of `count` points at the origin, to be filled by `assign`."""
        super().__init__()
        self.kinds, self.mirrored = kinds, False
        self.points = nn.Parameter(torch.zeros(count, 3))
        self.logit = nn.Parameter(torch.zeros(count, len(kinds) + 1))
        self.axis = nn.Parameter(torch.ones(len(kinds), 3))
        self.pivot = nn.Parameter(torch.zeros(len(kinds), 3))
        sliding = [[float(kind == "prismatic")] for kind in kinds]
        self.register_buffer("sliding", torch.tensor(sliding).view(-1, 1), persistent=False)
        self.register_buffer("normals", torch.zeros(count, 3))
        self.register_buffer("rest", torch.zeros(len(kinds)))
        self.register_buffer("load", torch.zeros(2 * len(kinds)))
        self.register_buffer("noise", torch.eye(2 * len(kinds)))
        self.register_buffer("alike", torch.zeros(()))

    @torch.no_grad()
    def assign(
        self,
        points: Float[Tensor, "M 3"],
        normals: Float[Tensor, "M 3"],
        logit: Float[Tensor, "M P"],
    ) -> None:
        """Replace the shape and its parts, keep the joints. Fewer points are repeated."""
        index = torch.arange(len(self.points)) % len(points)
        self.points.copy_(points[index])
        self.normals.copy_(normals[index])
        self.logit.copy_(logit[index])

    @torch.no_grad()
    def with_points(self, count: int) -> ArticulatedTemplate:
        """Another with the same joints and so many points.

        They are the first of this one's, which `motion_segmentation.rebuild` leaves spread out;
        where there are fewer, all of them, repeated.
        """
        made = ArticulatedTemplate(self.kinds, count).to(self.points)
        made.assign(self.points[:count], self.normals[:count], self.logit[:count])
        for name in ("axis", "pivot", *BUFFERS):
            getattr(made, name).copy_(getattr(self, name))
        made.mirrored = self.mirrored
        return made

    def directions(self) -> Float[Tensor, "J 3"]:
        """Unit axes."""
        return F.normalize(self.axis, dim=-1)

    def deviates(self) -> bool:
        """Whether hinges of this category have axes that differ from object to object."""
        return bool(self.load.any())

    def own_directions(self, placement: Placement) -> Float[Tensor, "B J 3"]:
        """Unit axes of each view's own object, template frame."""
        axis = self.directions()
        if not bool(placement.deviation.any()):
            return axis.expand(len(placement.state), -1, -1)
        return (rotvec_to_rotmat(placement.deviation) @ axis[:, :, None])[..., 0]

    def turns(self, placement: Placement) -> Float[Tensor, "B J 3 3"]:
        """How joints turn their parts: not at all what slides, hinges about their own axes.

        A hinge whose axis deviates turns from its rest (`axis_deviation`).
        """
        axis, state = self.directions(), placement.state * (1 - self.sliding[:, 0])
        if not bool(placement.deviation.any()):
            return rotvec_to_rotmat(axis * state[..., None])
        onward = self.own_directions(placement) * (state - self.rest)[..., None]
        return rotvec_to_rotmat(onward) @ rotvec_to_rotmat(axis * self.rest[:, None])

    def part_poses(self, placement: Placement) -> PartPoses:
        """view_T_part of every part at the placement's states (corrected bone map of Sec. 3.2)."""
        own, turn = placement.rotation[:, None], self.turns(placement)
        pivot = (self.pivot * placement.log_scale.exp()[:, None])[..., None]
        slid = self.directions() * placement.state[..., None] * self.sliding
        move = (pivot - turn @ pivot)[..., 0] + slid + placement.shift
        translation = (own @ move[..., None])[..., 0] + placement.translation[:, None]
        return PartPoses(
            rotation=torch.cat([own, own @ turn], 1),
            translation=torch.cat([placement.translation[:, None], translation], 1),
        )

    def place(
        self, placement: Placement, poses: PartPoses | None = None
    ) -> tuple[Float[Tensor, "B M 3"], Float[Tensor, "B M 3"]]:
        """Points and unit normals of the template in every view, parts blended by weight.

        Args:
            placement: Of B views.
            poses: Of the parts, if they are not as placed.
        """
        poses = self.part_poses(placement) if poses is None else poses
        weight = self.logit.softmax(-1)
        scaled = self.points * placement.log_scale.exp()[:, None]
        points, normals = torch.zeros_like(scaled), torch.zeros_like(scaled)
        for p in range(weight.shape[1]):
            turn = poses.rotation[:, p].mT
            share = weight[:, p : p + 1]
            points = points + share * (scaled @ turn + poses.translation[:, p, None])
            normals = normals + share * (self.normals @ turn)
        return points, F.normalize(normals, dim=-1)

    @torch.no_grad()
    def mirror(self) -> Mirror:
        """What takes the left side of such objects to their right one, found by the joints.

        One hinge lies across the plane, of two one lies to either side of it.
        """
        axis, count = self.directions(), len(self.kinds)
        normal = axis[0] if count == 1 else F.normalize(self.pivot[0] - self.pivot[1], dim=0)
        if count > 1:  # objects are scaled along the template's axes
            normal = F.one_hot(normal.abs().argmax(), 3).to(normal)
        flip = torch.eye(3).to(normal) - 2 * normal[:, None] * normal
        order = torch.arange(count, device=normal.device).flip(0)
        turned = -axis[order] @ flip  # an axis is no vector: mirror images turn the other way
        return Mirror(
            flip=flip,
            middle=ends(self.points @ normal).mean() * normal,
            order=order,
            sense=(axis * turned).sum(-1).sign(),
        )

    @torch.no_grad()
    def part_centres(self) -> Float[Tensor, "P 3"]:
        """Middle of the box (`ends`) of each part's points, unscaled; of all if it has none."""
        part = self.logit.argmax(-1)
        own = [self.points[part == p] for p in range(self.logit.shape[1])]
        filled = [points if len(points) else self.points for points in own]
        return torch.stack([ends(points).mean(0) for points in filled])

    def pivots(self, placement: Placement) -> Float[Tensor, "B J 3"]:
        """Of the template's joints on the base of every view, template frame, after scaling.

        A sliding joint has no pivot of its own: the middle of its part stands for it.
        """
        pivot: Tensor = self.pivot
        if "prismatic" in self.kinds:
            pivot = torch.where(self.sliding > 0, self.part_centres()[1:], pivot)
        return pivot * placement.log_scale.exp()[:, None] + placement.shift

    def joints_in_view(
        self, placement: Placement
    ) -> tuple[Float[Tensor, "B J 3"], Float[Tensor, "B J 3"]]:
        """Pivots and axes in the frame of every view, the object's own where they are known."""
        pivot = self.pivots(placement)
        if placement.pivot is not None:
            pivot = torch.where(self.sliding > 0, pivot, placement.pivot)
        pivot = pivot @ placement.rotation.mT + placement.translation[:, None]
        return pivot, self.own_directions(placement) @ placement.rotation.mT


def across_axis(axis: Float[Tensor, " 3"]) -> Float[Tensor, "2 3"]:
    """Two unit directions at right angles to an axis and each other, by the template's frame."""
    least = F.one_hot(axis.abs().argmin(), 3).to(axis)
    first = F.normalize(torch.linalg.cross(axis, least), dim=0)
    return torch.stack([first, torch.linalg.cross(axis, first)])


def oriented(points: Float[Tensor, "*B M 3"], normals: Float[Tensor, "*B M 3"]) -> Tensor:
    """(*B, M, 6) features whose distance tells points apart by place and normal."""
    return torch.cat([points, NORMAL_LENGTH * normals], -1)


def surface_features(
    points: Float[Tensor, "M 3"], normals: Float[Tensor, "M 3"], part: Float[Tensor, "M P"]
) -> Float[Tensor, "M D"]:
    """Features whose distance tells points apart by place, normal and part."""
    return torch.cat([oriented(points, normals), PART_LENGTH * part], -1)


def spread_out(feature: Float[Tensor, "M D"], count: int) -> Int[Tensor, " {count}"]:
    """Indices of points that are far apart; where there are too few the first one fills up."""
    index = farthest_points(feature, min(count, len(feature)))
    return F.pad(index, (0, count - len(index)))


def turn_placement(placement: Placement, turn: Float[Tensor, "B 3 3"]) -> Placement:
    """The placements after every view's frame is turned, x -> turn x."""
    return replace(
        placement,
        rotation=turn @ placement.rotation,
        translation=(turn @ placement.translation[..., None])[..., 0],
    )


def interleave(sources: list[Placement], count: int) -> Placement:
    """Hypotheses of `count` views from several sources, those of a view one after the other."""
    sizes = [len(source.state) // count for source in sources]
    starts = [sum(sizes[:k]) * count for k in range(len(sizes))]
    view = torch.arange(count)[:, None]
    columns = [
        begin + view * size + torch.arange(size) for begin, size in zip(starts, sizes, strict=True)
    ]
    return take(cat(sources), torch.cat(columns, 1).flatten())
