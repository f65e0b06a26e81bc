# SPDX-License-Identifier: MIT
"""Hinges of objects from how their parts lie in many views, and what a network is told."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.rigid import point_line_distance, random_rotations
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import cat, take
from scapo.registered.hinges import as_placed_by, hinges_of_objects
from scapo.registered.learning import hinged_as
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_network import ViewNetwork, ViewVotes
from tests.helpers.strategies import generator

VIEWS = 30
AXIS = torch.tensor([0.0, 1, 0])


def template(joints: int = 1) -> ArticulatedTemplate:
    """A part left of the base and, for two joints, one right of it."""
    made = ArticulatedTemplate(("revolute",) * joints, 60)
    side = torch.arange(60) % (joints + 1)
    points = 0.1 * torch.randn(60, 3, generator=generator(0))
    points[:, 0] += torch.tensor([0.0, 0.3, -0.3])[side]
    made.assign(points, points, 20.0 * torch.nn.functional.one_hot(side, joints + 1))
    with torch.no_grad():
        made.axis.copy_(AXIS.expand(joints, 3))
        made.pivot.copy_(torch.tensor([[0.2, 0, 0], [-0.2, 0, 0]])[:joints])
    return made


def seen(
    shape: ArticulatedTemplate, hinge: Tensor, part: Tensor, *, seed: int
) -> tuple[Placement, Tensor]:
    """An object in many views, as a search places it whose hinge sits where the template's does.

    Args:
        shape: The template.
        hinge: Where the object's own sits, template frame, metres.
        part: How far its part lies from the template's, both with state 0.
        seed: Of rotations, states and sizes.

    Returns:
        Placements, and how many normalised lengths are a metre in each.
    """
    g = generator(seed)
    size = 0.8 + 0.4 * torch.rand(VIEWS, generator=g)
    state = 1.5 * torch.rand(VIEWS, 1, generator=g)
    turn = rotvec_to_rotmat(AXIS * state)
    pivot = shape.pivot.detach()[0] * size[:, None]
    # turn (x + part - hinge) + hinge, which the search calls turn (x - pivot) + pivot + shift
    true = (turn @ ((part - hinge) * size[:, None])[..., None])[..., 0] + hinge * size[:, None]
    shift = true - pivot + (turn @ pivot[..., None])[..., 0]
    placement = Placement.at(random_rotations(VIEWS, g), torch.randn(VIEWS, 3, generator=g), state)
    log_scale = size.log()[:, None].expand(-1, 3)
    return replace(placement, log_scale=log_scale, shift=shift[:, None]), size


def test_a_hinge_is_where_the_part_has_turned_about() -> None:
    """Of two objects, in views some of which were placed at random."""
    shape = template()
    hinges = torch.tensor([[0.27, 0, 0.06], [0.18, 0, -0.05]])
    parts = torch.tensor([[0.03, 0, 0], [0.0, 0, 0.04]])
    objects = [seen(shape, hinges[k], parts[k], seed=k) for k in (0, 1)]
    placement, size = cat([one for one, _ in objects]), torch.cat([size for _, size in objects])
    wrong = torch.tensor([3, 8, 20, 40, 59])
    placement.shift[wrong] += 0.3 * torch.randn(5, 1, 3, generator=generator(9))
    rows = [torch.arange(VIEWS), VIEWS + torch.arange(VIEWS)]
    found = hinges_of_objects(shape, placement, size, rows)
    true = hinges.repeat_interleave(VIEWS, 0) * size[:, None]
    off = point_line_distance(found.pivot[:, 0], true, AXIS.expand_as(true))
    before = point_line_distance(shape.pivots(placement)[:, 0], true, AXIS.expand_as(true))
    assert off.max() < 0.01
    assert before.median() > 0.03
    assert found.trust[wrong].max() < 0.1
    right = torch.ones(2 * VIEWS, dtype=torch.bool)
    right[wrong] = False
    assert found.trust[right].min() > 0.8


def test_a_slide_has_no_hinge_and_a_door_that_never_moves_keeps_the_templates() -> None:
    shape = template()
    shape.kinds = ("prismatic",)
    placement, size = seen(shape, torch.tensor([0.3, 0, 0]), torch.zeros(3), seed=2)
    found = hinges_of_objects(shape, placement, size, [torch.arange(VIEWS)])
    assert found.trust.max() == 0
    shape.kinds = ("revolute",)
    still = replace(placement, state=torch.full_like(placement.state, 0.4))
    still = replace(still, shift=torch.zeros_like(still.shift))
    kept = hinges_of_objects(shape, still, size, [torch.arange(VIEWS)])
    assert_close(kept.pivot, shape.pivots(still), atol=1e-2, rtol=0)


@pytest.mark.parametrize("joints", [1, 2])
@torch.no_grad()
def test_each_candidate_has_the_hinges_on_its_own_base(joints: int) -> None:
    """The second of two takes the object half turned, and so its parts for each other."""
    shape = template(joints)
    g = generator(3)
    one = Placement.at(
        random_rotations(4, g), torch.randn(4, 3, generator=g), torch.zeros(4, joints)
    )
    half = torch.diag(torch.tensor([-1.0, 1, -1]))
    both = take(
        cat([one, replace(one, rotation=one.rotation @ half)]),
        torch.arange(8).view(2, 4).T.flatten(),
    )
    hinges = hinges_of_objects(shape, one, torch.ones(4), [])
    own = replace(hinges, pivot=hinges.pivot + torch.tensor([0.02, 0, 0.01]))
    found = as_placed_by(both, torch.zeros(4, dtype=torch.long), own, shape)
    assert_close(found[:, 0], own.pivot, atol=1e-5, rtol=0)
    turned = own.pivot @ half
    expected = turned if joints == 1 else turned.flip(1)
    assert_close(found[:, 1], expected, atol=1e-5, rtol=0)


def test_what_is_learned_of_hinges_changes_nothing_else() -> None:
    network = ViewNetwork(2, 1, channels=4)
    g = generator(4)
    points, normals = (0.2 * torch.randn(2, 80, 3, generator=g) for _ in range(2))
    votes: ViewVotes = network(points, normals, 20)
    along = replace(votes, hinge=votes.hinge + 0.4 * AXIS)
    assert_close(along.pivot(template()), votes.pivot(template()))
    off = votes.pivot(template()).square().sum()
    off.backward()
    learned = {name for name, value in network.named_parameters() if value.grad is not None}
    assert learned == {"hinge.weight", "hinge.bias"}


def test_hinges_are_the_networks_where_both_mean_the_same_frame() -> None:
    shape = template()
    said, _ = seen(shape, torch.tensor([0.3, 0, 0]), torch.zeros(3), seed=5)
    found = replace(said, pivot=None)
    turned = found.rotation.clone()
    turned[1] = turned[1] @ torch.diag(torch.tensor([-1.0, 1, -1]))
    found = replace(found, rotation=turned)
    assert hinged_as(shape, found, found) is found
    pivot = torch.full_like(said.shift, 0.25)
    made = hinged_as(shape, replace(said, pivot=pivot), found).pivot
    assert made is not None
    assert_close(made[0], pivot[0])
    assert_close(made[1], shape.pivots(found)[1])
    larger = replace(found, log_scale=found.log_scale + torch.tensor([0.2, 0.0, -0.1]))
    grown = hinged_as(shape, replace(said, pivot=pivot), larger).pivot  # they sit on the base
    assert grown is not None
    assert_close(grown[0], pivot[0] * torch.tensor([0.2, 0.0, -0.1]).exp())
