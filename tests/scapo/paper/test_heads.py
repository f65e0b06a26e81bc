# SPDX-License-Identifier: MIT
"""Theta_J, Theta_K, Theta_Delta and the template."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

from scapo.categories import CATEGORIES
from scapo.first_weights import initialise
from scapo.paper import heads as art
from tests.helpers.strategies import generator, normal

CONFIG = art.JointConfig(width=8, blocks=3, head=(8, 6))


def network(category: str = "eyeglasses", config: art.JointConfig = CONFIG) -> art.JointNetwork:
    made = art.JointNetwork(config, CATEGORIES[category])
    initialise(made, generator(0))
    return made


def test_joints_have_unit_axes_and_states_within_range() -> None:
    joints = network()(10 * normal(1, 6, 20, 3, dtype=torch.float32))
    assert joints.pivot.shape == (6, 2, 3)
    assert_close(joints.axis.norm(dim=-1), torch.ones(6, 2))
    assert joints.state.shape == (6, 2, 2)
    assert joints.state.abs().max() <= math.radians(60)
    assert_close(joints.relative(), joints.state[..., 1] - joints.state[..., 0])


@pytest.mark.parametrize(("category", "half"), [("laptop", math.radians(60)), ("drawer", 0.5)])
def test_the_range_depends_on_the_kind(category: str, half: float) -> None:
    made = network(category)
    with torch.no_grad():
        last = made.head[-1]
        assert isinstance(last, torch.nn.Linear)
        last.bias.fill_(100.0)
    joints = made(normal(1, 2, 20, 3, dtype=torch.float32))
    assert_close(joints.state[..., 1], torch.full((2, 1), half), atol=1e-3, rtol=0)


def test_the_base_is_fixed_unless_asked() -> None:
    points = normal(1, 4, 20, 3, dtype=torch.float32)
    assert network()(points).state[..., 0].abs().max() == 0
    free = network(config=art.JointConfig(width=8, blocks=3, head=(8, 6), base_fixed=False))
    assert free(points).state[..., 0].abs().max() > 0


def test_joints_do_not_depend_on_the_order_of_points() -> None:
    made = network().eval()
    points = normal(1, 2, 20, 3, dtype=torch.float32)
    assert_close(made(points).pivot, made(points.flip(1)).pivot)


def test_a_pair_is_both_shapes_in_one_batch() -> None:
    made = network().eval()
    first, second = (normal(k, 3, 20, 3, dtype=torch.float32) for k in (1, 2))
    x, y = made.pair(first, second)
    assert_close(x.pivot, made(first).pivot)
    assert_close(y.axis, made(second).axis)


def test_thin_takes_evenly() -> None:
    points = torch.arange(10.0)[None, :, None].expand(1, 10, 3)
    assert art.thin(points, 5)[0, :, 0].tolist() == [0, 2, 4, 6, 8]
    assert art.thin(points, 50) is points


def test_keypoints_begin_where_they_are_put() -> None:
    made = art.KeypointNetwork(art.HeadConfig(keypoint=(8, 8, 8)), 5, 2)
    initialise(made, generator(0))
    code = normal(1, 4, 5, dtype=torch.float32)
    assert made(code).std(0).min() > 0
    wanted = normal(2, 2, 3, dtype=torch.float32)
    made.start_at(wanted)
    assert_close(made(code), wanted.expand(4, 2, 3))


def test_the_residual_begins_at_zero_and_can_leave_it() -> None:
    made = art.ResidualNetwork(art.HeadConfig(residual=(8, 6)), 5)
    initialise(made, generator(0))
    features = normal(1, 2, 7, 5, dtype=torch.float32)
    out = made(features)
    assert out.shape == (2, 7, 3)
    assert out.abs().max() == 0
    (out - 1).square().sum().backward()
    gradient = made.out.weight.grad
    assert gradient is not None
    assert gradient.abs().max() > 0


def test_the_template_starts_at_random_and_takes_a_shape() -> None:
    template = art.Template(100, 2)
    initialise(template, generator(0))
    bound = math.sqrt(6 / 103)
    assert 0.9 * bound < template.points.abs().max() <= bound
    points, keypoints = (normal(k, n, 3, dtype=torch.float32) for k, n in ((1, 100), (2, 2)))
    template.set_to(points, keypoints)
    assert_close(template.points.detach(), points)
    assert_close(template.keypoints.detach(), keypoints)


def test_of_a_template_from_before_nobody_said_parts() -> None:
    template = art.Template(5, 2)
    state = {name: value for name, value in template.state_dict().items() if name != "part"}
    template.part.fill_(1)
    template.load_state_dict(state)
    assert template.part.tolist() == [1] * 5  # As it was: nothing else was there
    fresh = art.Template(5, 2)
    fresh.load_state_dict(state)
    assert fresh.part.tolist() == [0] * 5


def test_part_centroids_find_separate_clusters() -> None:
    centres = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    points = (centres[:, None] + 0.1 * normal(1, 3, 50, 3, dtype=torch.float32)).flatten(0, 1)
    found = art.part_centroids(points, 3)
    wanted = points.unflatten(0, (3, 50)).mean(1)
    assert_close(found[torch.cdist(wanted, found).argmin(1)], wanted, atol=1e-5, rtol=0)
