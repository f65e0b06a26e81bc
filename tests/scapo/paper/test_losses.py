# SPDX-License-Identifier: MIT
"""Every term of the loss against a value worked out by hand, and where its gradient goes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from scapo.categories import CATEGORIES
from scapo.paper import losses
from scapo.types import Joints, Labels
from tests.helpers.strategies import normal, rotations, unit_vectors


def t(*rows: object) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


SQUARE = t([0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0])[None]
HARD = t([1, 0], [0, 1], [1, 0], [0, 1])[None]


def test_reconstruction_adds_both_ways() -> None:
    a, b = t([0, 0, 0])[None], t([0.3, 0, 0], [0, 0.4, 0])[None]
    assert losses.reconstruction(a, b).item() == pytest.approx(0.09 + (0.09 + 0.16) / 2)


@pytest.mark.parametrize("form", ["partial", "robust"])
def test_partial_forms_agree_with_the_squared_one_when_near(form: losses.ReconForm) -> None:
    a, b = t([0, 0, 0])[None], t([1e-3, 0, 0])[None]
    assert losses.reconstruction(a, b, form).item() == pytest.approx(2e-6, rel=1e-3)


def test_partial_forms_bound_what_is_not_seen() -> None:
    seen, shape = t([0, 0, 0])[None], t([0, 0, 0], [9, 0, 0])[None]
    assert losses.reconstruction(seen, shape, "partial").item() == pytest.approx(0.5 / 120)
    assert losses.reconstruction(seen, shape, "robust").item() == pytest.approx(0.5 / 120)
    assert losses.reconstruction(shape, seen, "partial").item() == pytest.approx(81 / 2)
    assert losses.reconstruction(shape, seen, "robust").item() == pytest.approx(0.5 / 30)


def test_orthonormality() -> None:
    assert losses.orthonormality(rotations(0, 3)).item() == pytest.approx(0, abs=1e-12)
    doubled = 2 * rotations(0, 3)
    assert losses.orthonormality(doubled).item() == pytest.approx(3 * 9 / 9)


def test_pose_agreement_is_zero_for_equal_poses_and_counts_columns() -> None:
    turn, shift = rotations(1, 2), normal(1, 2, 3)
    assert losses.pose_agreement(turn, shift, turn, shift).item() == pytest.approx(0, abs=1e-7)
    flipped = turn * t(-1, -1, 1)  # two aligned axes reversed
    found = losses.pose_agreement(flipped, shift + 0.3, turn, shift)
    assert found.item() == pytest.approx((2 + 2 + 0) / 3 + 0.09)


def test_cycle_is_the_mean_absolute_error() -> None:
    assert losses.cycle(SQUARE + 0.25, SQUARE).item() == pytest.approx(0.25)


def test_soft_centroids_and_keypoints() -> None:
    centroids, support = losses.soft_centroids(SQUARE, HARD)
    assert centroids.tolist() == [[[0, 0.5, 0], [1, 0.5, 0]]]
    assert support.tolist() == [[2, 2]]
    keypoints = t([0, 0.5, 0], [1, 0.5, 0.2])[None]
    assert losses.keypoint_segmentation(keypoints, SQUARE, HARD, 1.0).item() == pytest.approx(0.02)
    assert losses.keypoint_segmentation(keypoints, SQUARE, HARD, 2.0).item() == 0
    uneven = t([1, 0], [1, 0], [1, 0], [0, 1])[None]  # three points of one part, one of the other
    off = losses.soft_centroids(SQUARE, uneven)[0] + t([0, 0, 0.2])
    assert losses.keypoint_segmentation(off, SQUARE, uneven, 2.0).item() == pytest.approx(0.02)
    found = losses.keypoint_segmentation(off, SQUARE, uneven, 2.0, "supported")
    assert found.item() == pytest.approx(0.04)


def test_segmentation_by_the_nearest_keypoint() -> None:
    targets = losses.nearest_keypoint(SQUARE, t([0, 0, 0], [1, 0.1, 0])[None])
    assert targets.tolist() == HARD.tolist()
    half = torch.full_like(HARD, 0.5)
    assert losses.segmentation(half, targets).item() == pytest.approx(0.5)


def test_nearest_keypoint_has_no_gradient() -> None:
    keypoints = t([0, 0, 0], [1, 0, 0])[None].requires_grad_()
    assert not losses.nearest_keypoint(SQUARE, keypoints).requires_grad


def test_shape_variance_per_point_and_whole() -> None:
    residual = t([0.1, 0, 0], [0, 0, 0])[None]
    assert losses.shape_variance(residual).item() == pytest.approx((1 - math.exp(-0.6)) / 2)
    whole = losses.shape_variance(residual.expand(3, 2, 3), form="whole")
    assert whole.item() == pytest.approx(1 - math.exp(-1.8))


def test_entropy_of_even_and_of_hard_weights() -> None:
    even = torch.full((1, 1, 3), 1 / 3, dtype=torch.float64)
    assert losses.entropy(even).item() == pytest.approx(math.log(3))
    assert losses.entropy(HARD).abs().max().item() == pytest.approx(0)


def edge_of_two_plates() -> tuple[Tensor, Tensor]:
    """Points on two plates that meet along x at y = 0, weights by the side of y."""
    points = normal(0, 1, 400, 3) * t(1.0, 0.5, 0.01)
    inside = torch.sigmoid(40 * points[..., 1])
    return points, torch.stack([1 - inside, inside], -1)


def test_the_boundary_of_two_plates_runs_along_their_edge() -> None:
    points, weights = edge_of_two_plates()
    direction, known = losses.boundary_direction(points, weights, 1)
    assert known.tolist() == [True]
    assert abs(direction[0, 0].item()) > 0.99
    assert losses.joint_direction(t([[1, 0, 0]]), points, weights).item() < 0.01
    assert losses.joint_direction(t([[-1, 0, 0]]), points, weights).item() < 0.01
    assert losses.joint_direction(t([[0, 0, 1]]), points, weights).item() > 0.9


def test_a_boundary_with_several_joints_is_that_of_the_joint() -> None:
    points, weights = edge_of_two_plates()
    three = torch.cat([weights, torch.zeros_like(weights[..., :1])], -1)
    assert losses.boundary_of_joint(three, 1).all()
    assert not losses.boundary_of_joint(three, 2).any()
    _, known = losses.boundary_direction(points, three, 2)
    assert known.tolist() == [False]
    axes = torch.stack([t(1, 0, 0), t(0, 0, 1)])[None]
    alone = losses.joint_direction(axes[:, :1], points, weights)
    assert losses.joint_direction(axes, points, three).item() == pytest.approx(alone.item() / 2)


def test_proximity_is_zero_on_the_shape_and_saturates_away_from_it() -> None:
    assert losses.joint_proximity(SQUARE[:, :1], SQUARE).item() == pytest.approx(0)
    near = losses.joint_proximity(t([[0, 0, 0.1]]), SQUARE)
    assert near.item() == pytest.approx(1 - math.exp(-0.3))
    assert losses.joint_proximity(t([[0, 0, 5]]), SQUARE).item() == pytest.approx(1)
    four = losses.joint_proximity(t([[0.5, 0.5, 0]]), SQUARE, neighbours=4)
    assert four.item() == pytest.approx(1 - math.exp(-30 * 0.5))
    more = losses.joint_proximity(t([[0.5, 0.5, 0]]), SQUARE, neighbours=40)
    assert more.item() == four.item()  # as many as there are, at the end of a long first stage
    both = losses.joint_proximity(t([[0, 0, 0.1], [0, 0, 0]]), SQUARE)
    assert both.item() == pytest.approx(1 - math.exp(-0.15))


def test_proximity_moves_the_pivot_alone() -> None:
    points, pivot = SQUARE.clone().requires_grad_(), t([[0, 0, 0.1]]).requires_grad_()
    losses.joint_proximity(pivot, points).backward()
    assert points.grad is None
    assert pivot.grad is not None
    assert pivot.grad[0, 0, 2] > 0


def test_boundary_attraction_by_hand() -> None:
    points = t([0, 0, 0], [1, 0, 0])[None]
    weights = t([0.5, 0.5], [1, 0])[None]
    pivot = t([[0, 0, 0]])
    share = 1 / (1 + math.exp(-1))
    found = losses.joint_boundary(pivot, points, weights)
    assert found.item() == pytest.approx(-share * math.log(2), rel=1e-5)
    sharp = losses.joint_boundary(pivot, points, weights, 0.05)
    assert sharp.item() == pytest.approx(-math.log(2), rel=1e-5)


@pytest.mark.parametrize("detach", [True, False])
def test_boundary_attraction_leaves_the_weights_alone_unless_asked(detach: bool) -> None:
    weights = t([0.4, 0.6], [0.9, 0.1])[None].requires_grad_()
    pivot = t([[0.5, 0.1, 0]]).requires_grad_()
    points = t([0, 0, 0], [1, 0, 0])[None]
    losses.joint_boundary(pivot, points, weights, detach=detach).backward()
    assert pivot.grad is not None
    assert pivot.grad[0, 0, 0] > 0  # a step against it goes to the uncertain point
    assert (weights.grad is None) == detach


def test_gauge_and_mass() -> None:
    state, axis = t([[0, 0.2]], [[0, 0.2]]), t([[0, 0, 1]], [[0, 1, 0]])
    assert losses.state_gauge(state, axis).item() == pytest.approx(0.02 + 0.5)
    assert losses.part_mass(HARD).item() == 0
    empty = t([1, 0], [0.98, 0.02])[None]
    assert losses.part_mass(empty).item() == pytest.approx(0.04)


def supervised(
    weights: Tensor, joints: tuple[Tensor, Tensor], labels: Labels, category: str = "oven"
) -> list[float]:
    found = losses.labelled(weights, joints, labels, CATEGORIES[category], (1.0, 2.0))
    return [term.item() for term in found.values()]


def true_joint(pivot: Tensor, axis: Tensor) -> Joints:
    return Joints(pivot=pivot, axis=axis, state=torch.zeros(axis.shape[:-1]))


def test_supervised_terms() -> None:
    weights = t([0.25, 0.75], [0.5, 0.5])[None]
    part, upright = torch.tensor([[1, -1]]), true_joint(t([[0, 0, 0]]), t([[0, 0, 1]]))
    found = t([[0, 0.3, 7]]), t([[0, 0, -1]])
    assert supervised(weights, found, Labels()) == []
    assert supervised(weights, found, Labels(part=-torch.ones_like(part))) == [0]
    entropy, off = supervised(weights, found, Labels(part=part, joints=upright))
    assert (entropy, off) == pytest.approx((-math.log(0.75), 2 * 0.09))
    turned = found[0], t([[1, 0, 0]])
    assert supervised(weights, turned, Labels(joints=upright)) == pytest.approx([2 * 1.09])


def test_supervised_terms_take_one_order_for_both_of_a_cloud() -> None:
    """Of a laptop's two names for its halves; the cheaper in sum, here by the parts alone."""
    weights, found = t([0.25, 0.75])[None], (t([[0, 0, 0]]), t([[0, 0, 1]]))
    labels = Labels(part=torch.tensor([[0]]), joints=true_joint(*found))
    assert supervised(weights, found, labels) == pytest.approx([-math.log(0.25), 0])
    assert supervised(weights, found, labels, "laptop") == pytest.approx([-math.log(0.75), 0])


def test_all_terms_have_finite_gradients_at_a_perfect_fit() -> None:
    points = (0.25 * unit_vectors(1, 2, 40)).requires_grad_()
    weights = torch.softmax(normal(2, 2, 40, 2), -1).requires_grad_()
    pivot, axis = points[:, :1], unit_vectors(3, 2, 1).requires_grad_()
    total = (
        losses.reconstruction(points, points.detach(), "partial")
        + losses.cycle(points, points.detach())
        + losses.keypoint_segmentation(losses.soft_centroids(points, weights)[0], points, weights)
        + losses.joint_proximity(pivot, points, neighbours=8)
        + losses.joint_boundary(pivot, points, weights, detach=False)
        + losses.joint_direction(axis, points, weights)
        + losses.labelled(
            weights,
            (pivot, axis),
            Labels(joints=true_joint(pivot.detach(), axis.detach())),
            CATEGORIES["laptop"],
            (1.0, 1.0),
        )["labelled_joints"]
        + losses.shape_variance(points - points.detach())
    )
    total.backward()
    for leaf in (points, weights, axis):
        assert leaf.grad is not None
        assert bool(leaf.grad.isfinite().all())
