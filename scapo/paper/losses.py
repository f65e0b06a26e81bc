# SPDX-License-Identifier: MIT
"""The terms of the loss, one pure function each, named as in the paper; weights are the model's.

Sec. 3.1 has the four of stage 1, Sec. 3.2 the cycle and the reconstruction, Sec. 3.3 the
regularisers. Where two readings exist, the function takes the choice (docs/method.md has the
reasons). All return a scalar mean over the batch; lengths are in normalised units.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from scapo.categories import Category
from scapo.geometry.part_order import joint_order, part_orders
from scapo.geometry.points import chamfer, gather, k_nearest, robust_chamfer, squared_distances
from scapo.geometry.rigid import point_line_distance
from scapo.types import Labels

ReconForm = Literal["squared", "partial", "robust"]
VarianceForm = Literal["per-point", "whole"]
KeypointMean = Literal["parts", "supported"]

Scalar = Float[Tensor, ""]


def reconstruction(
    observed: Float[Tensor, "B N 3"], shape: Float[Tensor, "B M 3"], form: ReconForm = "squared"
) -> Scalar:
    """L_rec of stage 1, L_recon and L_recon^Y of stage 2: Chamfer distance CD.

    `squared`: mean squared distance, both ways, as printed. `partial`: observed to shape as
    before, and back (1 - exp(-120 D)) / 120, which near 0 is D but lets the shape's unseen points
    be far from every observed one. `robust`: OP-Align's form with 30 and 120, divided by 30 so
    that near 0 it is the same again.
    """
    if form == "squared":
        return chamfer(observed, shape).mean()
    if form == "robust":
        return robust_chamfer(observed, shape, forward=30.0, backward=120.0).mean() / 30
    back = 1 - torch.exp(-120 * squared_distances(shape, observed))
    return squared_distances(observed, shape).mean() + back.mean() / 120


def orthonormality(frame: Float[Tensor, "B 3 3"]) -> Scalar:
    """L_ortho (Sec. 3.1): mean squared entry of R R^T - I for the raw frame."""
    eye = torch.eye(3, dtype=frame.dtype, device=frame.device)
    return (frame @ frame.mT - eye).square().mean()


def pose_agreement(
    rotation: Float[Tensor, "B 3 3"],
    translation: Float[Tensor, "B 3"],
    expected_rotation: Float[Tensor, "B 3 3"],
    expected_translation: Float[Tensor, "B 3"],
) -> Scalar:
    """L_aug_consist and L_can_consist (Sec. 3.1): 1 - cos per aligned axis, and MSE of t.

    The rows of the paper's R_g are the columns of ours.
    """
    cosine = F.cosine_similarity(rotation, expected_rotation, dim=-2)  # (B, 3)
    return (1 - cosine).mean() + F.mse_loss(translation, expected_translation)


def cycle(returned: Float[Tensor, "B N 3"], points: Float[Tensor, "B N 3"]) -> Scalar:
    """L_cycle (Sec. 3.2): mean absolute error after D^{o->c} and D^{c->o}."""
    return (returned - points).abs().mean()


def soft_centroids(
    points: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N P"]
) -> tuple[Float[Tensor, "B P 3"], Float[Tensor, "B P"]]:
    """m^[p] and N_p of Sec. 3.3."""
    support = weights.sum(1)
    return weights.mT @ points / support.clamp(min=1e-6)[..., None], support


def keypoint_segmentation(
    keypoints: Float[Tensor, "B P 3"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N P"],
    support: float = 20.0,
    mean: KeypointMean = "parts",
) -> Scalar:
    """L_kp-seg (Sec. 3.3): squared distance of keypoint and soft centroid where N_p > tau.

    `parts` divides by P as printed, `supported` by the parts with N_p > tau (ShapeMaker).
    """
    centroids, count = soft_centroids(points, weights)
    distance = (keypoints - centroids).square().sum(-1)
    supported = (count.detach() > support).to(distance)
    if mean == "supported":
        return (supported * distance).sum() / supported.sum().clamp_min(1)
    return (supported * distance).mean()


def nearest_keypoint(
    points: Float[Tensor, "B N 3"], keypoints: Float[Tensor, "B P 3"]
) -> Float[Tensor, "B N P"]:
    """y_i of Sec. 3.3: one-hot of the closest keypoint, without gradient."""
    with torch.no_grad():
        distance = (points[:, :, None] - keypoints[:, None]).square().sum(-1)
        return F.one_hot(distance.argmin(-1), keypoints.shape[1]).to(points.dtype)


def segmentation(weights: Float[Tensor, "B N P"], targets: Float[Tensor, "B N P"]) -> Scalar:
    """L_seg (Sec. 3.3): mean over points of |w_i - y_i|^2."""
    return (weights - targets).square().sum(-1).mean()


def shape_variance(
    residual: Float[Tensor, "B N 3"], scale: float = 60.0, form: VarianceForm = "per-point"
) -> Scalar:
    """L_shape-var (Sec. 3.3): 1 - exp(-lambda_var |V|^2).

    Printed over the whole tensor (`whole`), where it saturates at once; OP-Align's is per point,
    averaged.
    """
    square = residual.square().sum(-1)
    return 1 - torch.exp(-scale * (square if form == "per-point" else square.sum())).mean()


def entropy(weights: Float[Tensor, "B N P"]) -> Float[Tensor, "B N"]:
    """H_i of Sec. 3.3 in nats, w clamped at 1e-8 under the logarithm."""
    return -(weights * weights.clamp(min=1e-8).log()).sum(-1)


def boundary_of_joint(weights: Float[Tensor, "B N P"], child: int) -> Bool[Tensor, "B N"]:
    """Points whose two largest weights are those of the base and of `child`; all for P = 2."""
    if weights.shape[-1] == 2:
        return torch.ones_like(weights[..., 0], dtype=torch.bool)
    top = weights.topk(2, dim=-1).indices
    return (top.sum(-1) == child) & (top.amin(-1) == 0)


@torch.no_grad()
def boundary_direction(
    points: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N P"], child: int
) -> tuple[Float[Tensor, "B 3"], Bool[Tensor, " B"]]:
    """d~ of Sec. 3.3: principal direction of the points with the highest entropy.

    The paper gives no threshold: the tenth of the points with the highest entropy, at least 16;
    with several joints only points between the base and `child`, and a sample with fewer than 16
    of them has no direction (second result False).
    """
    count = min(max(16, points.shape[1] // 10), points.shape[1])
    between = boundary_of_joint(weights, child)
    order = torch.where(between, entropy(weights), -1.0).topk(count, dim=1).indices
    chosen = gather(points, order)
    member = between.gather(1, order).to(points.dtype)[..., None]
    number = member.sum(1, keepdim=True)
    centred = (chosen - (member * chosen).sum(1, keepdim=True) / number.clamp(min=1)) * member
    return torch.linalg.eigh(centred.mT @ centred).eigenvectors[..., -1], number[:, 0, 0] >= 16


def joint_direction(
    axis: Float[Tensor, "B J 3"], points: Float[Tensor, "B N 3"], weights: Float[Tensor, "B N P"]
) -> Scalar:
    """L_dir-align (Sec. 3.3): 1 - |cos| between each axis and the line of its boundary points.

    Right for hinges along an edge; a hinge at a point (scissors) or a slide has no such line.
    """
    terms = []
    for j in range(axis.shape[1]):
        direction, known = boundary_direction(points, weights, j + 1)
        terms.append(known * (1 - (axis[:, j] * direction).sum(-1).abs()))
    return torch.stack(terms).mean()


def joint_proximity(
    pivot: Float[Tensor, "B J 3"],
    points: Float[Tensor, "B N 3"],
    scale: float = 30.0,
    neighbours: int = 1,
    *,
    detach: bool = True,
) -> Scalar:
    """L_joint-prox (Sec. 3.3): 1 - exp(-lambda_prox E_j[min_i |c_j - s_i|^2]).

    `neighbours` = 8 gives OP-Align's form, the squared mean distance of the 8 nearest points, of
    all where there are fewer. The printed expectation is over p of a term in j; joints are meant.
    `detach`: points are constants.
    """
    points = points.detach() if detach else points
    most = min(neighbours, points.shape[1])
    near = k_nearest(pivot.detach(), points.detach(), most)  # (B, J, k)
    chosen = gather(points, near.flatten(1)).unflatten(1, near.shape[1:])
    square = (pivot[:, :, None] - chosen).square().sum(-1)
    if neighbours > 1:
        square = (square + 1e-12).sqrt().mean(-1, keepdim=True).square()
    return (1 - torch.exp(-scale * square.mean((1, 2)))).mean()


def joint_boundary(
    pivot: Float[Tensor, "B J 3"],
    points: Float[Tensor, "B N 3"],
    weights: Float[Tensor, "B N P"],
    temperature: float = 1.0,
    *,
    detach: bool = True,
) -> Scalar:
    """L_joint-boundary (Sec. 3.3): - mean_j sum_i alpha_ji H_i, alpha a softmax of -|c_j - s_i|.

    `detach`: H and the points are constants. As printed, the term would also be lowered by raising
    the entropy everywhere, against L_seg. Distances below 1 leave alpha almost uniform at the
    printed temperature 1.
    """
    uncertainty = entropy(weights)
    if detach:
        uncertainty, points = uncertainty.detach(), points.detach()
    square = (pivot[:, :, None] - points[:, None]).square().sum(-1)  # (B, J, N)
    attention = torch.softmax(-(square + 1e-12).sqrt() / temperature, -1)
    return -(attention * uncertainty[:, None]).sum(-1).mean()


def state_gauge(state: Float[Tensor, "B J 2"], axis: Float[Tensor, "B J 3"]) -> Scalar:
    """Mean squared template state and variance over the batch of the template's axes (OP-Align).

    Not in the paper, whose terms leave the template's state free.
    """
    return state.square().mean() + axis.var(0, unbiased=False).sum(-1).mean()


def part_mass(weights: Float[Tensor, "B N P"], least: float = 0.05) -> Scalar:
    """Hinge on the mean weight of a part over the batch's points (OP-Align): no part is empty.

    Not in the paper, where one bone may take all points at no cost.
    """
    return F.relu(least - weights.mean((0, 1))).sum()


def labelled(
    weights: Float[Tensor, "B N P"],
    joints: tuple[Float[Tensor, "B J 3"], Float[Tensor, "B J 3"]],
    labels: Labels,
    category: Category,
    scales: tuple[float, float],
) -> dict[str, Tensor]:
    """The terms of the labels that there are: cross entropy of the parts, errors of the joints.

    Where a symmetry of the category exchanges parts, the evaluation takes either order, and so does
    this: of each cloud the one that costs less, in both terms together.

    Args:
        weights: Of the parts, they sum to 1.
        joints: Pivots and axes as found.
        labels: Parts, -1 ignored, and joints in the frame of those found; what is None costs 0.
        category: Says whether parts exchange.
        scales: Of the two terms.
    """
    orders = part_orders(len(category.parts))[: None if category.symmetry is not None else 1]
    found: list[dict[str, Tensor]] = []
    for order, joint in zip(orders, joint_order(orders), strict=True):
        terms: dict[str, Tensor] = {}
        if labels.part is not None:
            slot = torch.tensor(order.argsort()).to(labels.part)
            part = torch.where(labels.part < 0, -1, slot[labels.part.clamp_min(0)])
            terms["labelled_segmentation"] = scales[0] * _entropy(weights, part)
        if labels.joints is not None:
            pivot, axis = labels.joints.pivot[:, joint], labels.joints.axis[:, joint]
            terms["labelled_joints"] = scales[1] * _joint_error(*joints, pivot, axis)
        found.append(terms)
    return least_costly(found)


def least_costly(readings: Sequence[Mapping[str, Float[Tensor, " B"]]]) -> dict[str, Scalar]:
    """Means of the terms, each cloud by the reading of its labels that costs it least in all.

    Args:
        readings: Terms of each cloud, by every order of the parts that is right.
    """
    if not readings[0]:
        return {}
    totals = torch.stack([torch.stack(list(terms.values())).sum(0) for terms in readings])
    best = totals.argmin(0, keepdim=True)  # (1, B)
    return {
        name: torch.stack([terms[name] for terms in readings]).gather(0, best).mean()
        for name in readings[0]
    }


def _entropy(weights: Float[Tensor, "B N P"], part: Int[Tensor, "B N"]) -> Float[Tensor, " B"]:
    """Cross entropy of each cloud with true parts, -1 ignored (Table 2, supervised variant)."""
    logs = weights.clamp(min=1e-8).log().mT
    error = F.nll_loss(logs, part, ignore_index=-1, reduction="none")
    return error.sum(-1) / (part != -1).sum(-1).clamp_min(1)


def _joint_error(
    pivot: Float[Tensor, "B J 3"],
    axis: Float[Tensor, "B J 3"],
    true_pivot: Float[Tensor, "B J 3"],
    true_axis: Float[Tensor, "B J 3"],
) -> Float[Tensor, " B"]:
    """Of each cloud: 1 - |cos| of the axes and squared distance of the pivot from the true axis."""
    off = point_line_distance(pivot, true_pivot, true_axis).square()
    return (1 - (axis * true_axis).sum(-1).abs() + off).mean(-1)
