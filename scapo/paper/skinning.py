# SPDX-License-Identifier: MIT
"""Gaussian bones, skinning weights and blend skinning between spaces (Sec. 3.2).

Maps are homogeneous matrices (B, P, 4, 4), one per part, `b_T_a` as everywhere. The printed
equations that cannot be used as they stand are named at the functions that correct them.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from scapo.categories import JointKind
from scapo.geometry.rigid import apply, invert, joint_motion, mean_rotation, rigid, rotation_between
from scapo.geometry.rotations import rotmat_to_unitquat, unitquat_to_rotmat
from scapo.paper.heads import JointPairs


class Bones(nn.Module):
    """One Gaussian per part: orientation V, scale Lambda, shared sharpness gamma.

    The centres O are keypoints and come with each shape. V and Lambda are learned per category
    (BANMo); Q = V^T Lambda V.
    """

    def __init__(self, parts: int, gamma: float) -> None:
        super().__init__()
        self.quaternion = nn.Parameter(torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(parts, 1))
        self.log_scale = nn.Parameter(torch.zeros(parts, 3))
        self.log_gamma = nn.Parameter(torch.tensor(gamma).log())

    def precision(self) -> Float[Tensor, "P 3 3"]:
        """Q of each bone, symmetric positive definite."""
        orientation = unitquat_to_rotmat(torch.nn.functional.normalize(self.quaternion, dim=-1))
        return orientation.mT @ (self.log_scale.exp()[..., None] * orientation)

    def weights(
        self,
        points: Float[Tensor, "B N 3"],
        centres: Float[Tensor, "B P 3"],
        turn: Float[Tensor, "B P 3 3"] | None = None,
    ) -> Float[Tensor, "B N P"]:
        """w_i = softmax_p(-W_i / gamma), W the Mahalanobis distances (paper's W, not its weights).

        Args:
            points: Of a shape.
            centres: O, its keypoints.
            turn: How its parts are turned against the template; bones turn along (BANMo). None:
                every shape has the same V, whatever its state.
        """
        precision = self.precision() / self.log_gamma.exp()
        if turn is not None:
            precision = turn @ precision @ turn.mT
        return gaussian_weights(points, centres, precision)

    def set_to(self, precision: Float[Tensor, "P 3 3"]) -> None:
        """Take orientation and scale from Q / gamma of each bone; gamma stays."""
        with torch.no_grad():
            values, vectors = torch.linalg.eigh(precision * self.log_gamma.exp())
            sign = torch.linalg.det(vectors).sign()[:, None, None]
            self.quaternion.copy_(rotmat_to_unitquat((vectors * sign).mT))
            self.log_scale.copy_(values.clamp(min=1e-6).log())


def gaussian_weights(
    points: Float[Tensor, "B N 3"],
    centres: Float[Tensor, "B P 3"],
    precision: Float[Tensor, "*B P 3 3"],
) -> Float[Tensor, "B N P"]:
    """Softmax over parts of minus the Mahalanobis distances.

    Expanded as s^T Q s - 2 s^T Q o + o^T Q o, which holds no (B, N, P, 3) tensor.

    Args:
        points: Of a shape.
        centres: Of the bones.
        precision: Q / gamma, of each shape or of all.
    """
    points = points - centres.mean(1, keepdim=True)
    centres = centres - centres.mean(1, keepdim=True)
    pairs = (points[..., :, None] * points[..., None, :]).flatten(-2)  # (B, N, 9)
    square = pairs @ precision.flatten(-2).mT  # (B, N, P)
    pulled = (precision @ centres[..., None])[..., 0]
    distance = square - 2 * points @ pulled.mT + (pulled * centres).sum(-1)[:, None]
    return torch.softmax(-distance, -1)


def incident_maps(joints: JointPairs, kinds: tuple[JointKind, ...]) -> Float[Tensor, "B J 2 4 4"]:
    """T of Sec. 3.2 for both sides of each joint, canonical to observed.

    Revolute x -> R (x - c) + c, the three steps of the text; the printed t = c leaves out -R c.
    """
    maps = [
        joint_motion(joints.pivot[:, j, None], joints.axis[:, j, None], joints.state[:, j], kind)
        for j, kind in enumerate(kinds)
    ]
    return torch.stack(maps, 1)


def cross_maps(
    source: JointPairs, target: JointPairs, kinds: tuple[JointKind, ...]
) -> Float[Tensor, "B J 2 4 4"]:
    """T_{X->Y} of Sec. 3.2 for both sides of each joint: source space to target space.

    x -> R_x2y R_r (x - c_x) + c_y + t_x2y, where R_r turns d_x to d_y the short way. The printed
    form lacks -c_x; without it a shape's own pivot would not land on the target's.
    """
    maps = []
    for j, kind in enumerate(kinds):
        turn = rotation_between(source.axis[:, j], target.axis[:, j])  # R_r
        aligned = rigid(turn, target.pivot[:, j] - (turn @ source.pivot[:, j, :, None])[..., 0])
        motion = joint_motion(
            target.pivot[:, j, None],
            target.axis[:, j, None],
            target.state[:, j] - source.state[:, j],
            kind,
        )
        maps.append(motion @ aligned[:, None])
    return torch.stack(maps, 1)


def part_maps(incident: Float[Tensor, "B J 2 4 4"]) -> Float[Tensor, "B P 4 4"]:
    """One map per part: the child's side of joint j for part j + 1, the base from all its joints.

    With two joints the base has two maps; their mean is used, translations averaged, rotations by
    the chordal mean (docs/method.md). `base_gap` says how far they disagree.
    """
    base = incident[:, :, 0]  # (B, J, 4, 4)
    if base.shape[1] == 1:
        return torch.cat([base, incident[:, :, 1]], 1)
    mean = rigid(mean_rotation(base[..., :3, :3]), base[..., :3, 3].mean(1))
    return torch.cat([mean[:, None], incident[:, :, 1]], 1)


def base_gap(
    incident: Float[Tensor, "B J 2 4 4"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N P"],
) -> Float[Tensor, ""]:
    """Mean squared distance between the base mapped by one joint and by the other; 0 for J = 1."""
    if incident.shape[1] == 1:
        return points.new_zeros(())
    first, second = (apply(incident[:, j, 0], points) for j in (0, 1))
    return (weights[..., 0] * (first - second).square().sum(-1)).mean()


def deform(
    maps: Float[Tensor, "B P 4 4"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N P"],
) -> Float[Tensor, "B N 3"]:
    """Blend skinning: (sum_p w_i^p T^p) [s_i; 1], evaluated as sum_p w_i^p (T^p s_i)."""
    moved = apply(maps, points[:, None])  # (B, P, N, 3)
    return (weights.mT[..., None] * moved).sum(1)


def to_canonical(
    maps: Float[Tensor, "B P 4 4"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N P"],
) -> Float[Tensor, "B N 3"]:
    """D^{o->c}: the blend of the inverses, sum_p w_i^p (T^p)^{-1}.

    That is not the inverse of the blend in `deform`: with weights w reused on the way back the
    cycle closes exactly only where w is one-hot.
    """
    return deform(invert(maps), points, weights)
