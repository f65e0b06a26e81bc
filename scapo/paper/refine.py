# SPDX-License-Identifier: MIT
"""The posed template at test time: labels from its nearest points, and each cloud fitted by it.

Not in the paper. In refinement networks stay as they are; per cloud a small rotation, a translation
and changes of pivot, axis and state are found by Adam on the reconstruction loss of stage 2, and
kept where they lower it. No label is involved.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from scapo.categories import JointKind
from scapo.geometry.points import gather, nearest, robust_chamfer, smoothed
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.paper.heads import JointPairs
from scapo.paper.objectives import Explanation
from scapo.paper.skinning import cross_maps, deform, part_maps

SHARPNESS = (30.0, 120.0)
"""Of the robust distances, cloud to template and back (OP-Align's)."""


def posed_template(e: Explanation, kinds: tuple[JointKind, ...]) -> Float[Tensor, "B M 3"]:
    """D_{Y->X} on Y_X, in the input frame: where the template lies in each cloud."""
    maps = part_maps(cross_maps(e.template_joints, e.joints, kinds))
    return e.encoding.place(deform(maps, e.template, e.template_weights))


def nearest_template_weights(
    points: Float[Tensor, "B N 3"], e: Explanation, kinds: tuple[JointKind, ...]
) -> Float[Tensor, "B N P"]:
    """The weights of the nearest point of the posed template.

    Not in the paper, whose segmentation is w on S_obj. There two Gaussian bones meet in a quadric,
    which two plates that share a hinge do not; w on the template was fitted to all clouds at once.

    Args:
        points: Input frame.
        e: What the networks say of them.
        kinds: Of the joints.
    """
    return gather(e.template_weights, nearest(points, posed_template(e, kinds)))


def smoothed_template_weights(
    points: Float[Tensor, "B N 3"], e: Explanation, kinds: tuple[JointKind, ...]
) -> Float[Tensor, "B N P"]:
    """The same of several nearest points: where parts are hard, one alone is often the wrong one.

    Args:
        points: Input frame.
        e: What the networks say of them.
        kinds: Of the joints.
    """
    clouds = zip(points, posed_template(e, kinds), e.template_weights, strict=True)
    return torch.stack([smoothed(*cloud) for cloud in clouds])


def misfit(
    points: Float[Tensor, "B N 3"], e: Explanation, kinds: tuple[JointKind, ...]
) -> Float[Tensor, " B"]:
    """How badly the posed template explains each cloud; a few outliers cost a bounded amount."""
    there, back = SHARPNESS
    return robust_chamfer(points, posed_template(e, kinds), forward=there, backward=back)


def moved(
    e: Explanation, change: Float[Tensor, "B 6"], joint: Float[Tensor, "B J 7"]
) -> Explanation:
    """The explanation with its pose turned and shifted, and its joints changed."""
    turn = rotvec_to_rotmat(change[:, :3])
    joints = JointPairs(
        pivot=e.joints.pivot + joint[..., :3],
        axis=F.normalize(e.joints.axis + joint[..., 3:6], dim=-1),
        state=e.joints.state + F.pad(joint[..., 6:], (1, 0)),
    )
    encoding = replace(
        e.encoding,
        rotation=e.encoding.rotation @ turn,
        translation=e.encoding.translation + change[:, 3:],
    )
    return replace(e, encoding=encoding, joints=joints)


@torch.enable_grad()
def refine(
    points: Float[Tensor, "B N 3"],
    e: Explanation,
    kinds: tuple[JointKind, ...],
    *,
    steps: int = 40,
    rate: float = 0.02,
) -> Explanation:
    """The explanation at the least misfit met on the way, cloud by cloud.

    Args:
        points: Input frame.
        e: What the networks say, without gradients.
        kinds: Of the joints.
        steps: Of Adam.
        rate: Its learning rate, in radians and normalised units, falling to a tenth.
    """
    batch, joints = e.joints.pivot.shape[:2]
    change = points.new_zeros(batch, 6).requires_grad_()
    joint = points.new_zeros(batch, joints, 7).requires_grad_()
    best = (change.detach().clone(), joint.detach().clone())
    least = points.new_full((batch,), torch.inf)
    optimizer = torch.optim.Adam([change, joint], lr=rate)
    for step in range(steps + 1):
        for group in optimizer.param_groups:
            group["lr"] = rate * 0.1 ** (step / steps)
        cost = misfit(points, moved(e, change, joint), kinds)
        better = cost.detach() < least
        least = torch.where(better, cost.detach(), least)
        best = (
            torch.where(better[:, None], change.detach(), best[0]),
            torch.where(better[:, None, None], joint.detach(), best[1]),
        )
        change.grad, joint.grad = torch.autograd.grad(cost.sum(), (change, joint))
        optimizer.step()
    with torch.no_grad():
        return moved(e, *best)
