# SPDX-License-Identifier: MIT
"""What tells how an object stands, and that objects can teach it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from scapo.geometry.rigid import random_rotations, rotation_angle
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import evenly
from scapo.records import take
from scapo.registered import objects as room
from scapo.registered.object_frames import taught_by_objects
from scapo.registered.objects import OneObject, owned_views
from scapo.registered.orientation import (
    CHARGE,
    MOST,
    OrientationScorer,
    quarter_turns,
    surface_in_cells,
)
from scapo.registered.orientation import _turned_index as turned_index
from scapo.registered.pose_search import Hypotheses, SearchSpace, best_of
from scapo.registered.template import Placement
from scapo.registered.view_bank import ViewBank
from scapo.registered.views import PartialViews, observe
from tests.helpers.strategies import generator
from tests.scapo.registered.test_objects import known


def test_quarter_turns_are_the_rotations_of_a_cube() -> None:
    turns = quarter_turns()
    assert torch.equal(turns @ turns.mT, torch.eye(3).expand(24, 3, 3))
    assert torch.equal(torch.det(turns), torch.ones(24))
    assert len({tuple(turn.flatten().tolist()) for turn in turns}) == 24
    assert torch.equal(turns[0], torch.eye(3))


def test_cells_hold_where_surface_is_and_which_way_it_faces() -> None:
    """A plate above another, turned up and down; the cube's middle is between them."""
    flat = torch.rand(200, 3, generator=generator(0)) - 0.5
    points = torch.cat([flat * torch.tensor([0.8, 0.8, 0.0]) + torch.tensor([0, 0, z])
                        for z in (0.1, 0.5)])[None]  # fmt: skip
    normals = torch.tensor([0, 0, 1.0]).expand(400, 3).clone()
    normals[:200] *= -1
    cells = surface_in_cells(points, normals[None]).square().view(8, 8, 8, 6)
    up, down = cells[..., 2].sum((0, 1)), cells[..., 5].sum((0, 1))
    assert float(cells.sum()) == pytest.approx(64, rel=1e-4)
    assert float(up.sum()) == pytest.approx(float(down.sum()), rel=1e-4)
    assert int(up.argmax()) > 3.5 > int(down.argmax())
    assert float(cells[..., [0, 1, 3, 4]].sum()) == 0.0
    assert torch.allclose(surface_in_cells(points + 3.0, normals[None]), cells.sqrt().view(1, -1),
                          atol=2e-2)  # fmt: skip


def test_turned_cells_are_those_of_the_turned_points() -> None:
    """Squares are compared: a root is steep at nothing."""
    points = 0.2 * torch.randn(3, 150, 3, generator=generator(1))
    normals = F.normalize(torch.randn(3, 150, 3, generator=generator(2)), dim=-1)
    cells = surface_in_cells(points, normals)
    for turn, index in zip(quarter_turns(), turned_index(), strict=True):
        direct = surface_in_cells(points @ turn, normals @ turn)
        assert torch.allclose(direct.square(), cells[:, index].square(), atol=2e-3)


def standing(count: int, seed: int) -> tuple[PartialViews, Tensor]:
    """Chairs of different proportions from all sides and above, and their turns."""
    g = generator(seed)
    rotation = random_rotations(count, g)
    size = 0.7 + 0.6 * torch.rand(count, 1, 3, generator=g)
    seat = torch.rand(count, 150, 3, generator=g) - 0.5
    seat = seat * torch.tensor([0.6, 0.6, 0.1])
    back = torch.rand(count, 100, 3, generator=g) - 0.5
    back = back * torch.tensor([0.1, 0.6, 0.5]) + torch.tensor([0.25, 0, 0.3])
    points = torch.cat([seat, back], 1) * size
    above = torch.randn(count, 3, generator=g)
    camera = 3 * F.normalize(torch.cat([above[:, :2], above[:, 2:].abs() + 0.5], 1), dim=-1)
    turned = (rotation @ camera[..., None])[..., 0]
    return observe(points @ rotation.mT, turned, count=96), rotation


def right(scorer: OrientationScorer, views: PartialViews, rotation: Tensor) -> float:
    """Share of the views whose true turn comes before the other 23."""
    with torch.no_grad():
        score = scorer(views, rotation[:, None] @ quarter_turns())
    return float((score.argmax(1) == 0).float().mean())


def test_turns_of_unseen_objects_are_told_after_learning() -> None:
    views, rotation = standing(240, 0)
    others, truth = standing(60, 1)
    untaught = OrientationScorer()
    assert torch.equal(untaught.charge(others, truth[:, None]), torch.zeros(60, 1))
    scorer = OrientationScorer().learn(views, rotation, generator(2), epochs=8)
    assert right(untaught, others, truth) < 0.3
    assert right(scorer, others, truth) > 0.9
    again = OrientationScorer().learn(views, rotation, generator(2), epochs=8)
    for name, value in scorer.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_a_hypothesis_is_charged_for_how_unlikely_it_is() -> None:
    views, rotation = standing(64, 3)
    scorer = OrientationScorer().learn(views, rotation, generator(0), epochs=8)
    turns = rotation[:, None] @ quarter_turns()[:6]
    charge = scorer.charge(views, turns)
    with torch.no_grad():
        nats = -scorer(views, turns).log_softmax(-1)
    assert torch.allclose(charge, CHARGE * nats.clamp_max(MOST))
    assert float(charge.max()) == pytest.approx(CHARGE * MOST)
    bank = ViewBank.__new__(ViewBank)
    space = SearchSpace(rendered=bank, placed=None, states=torch.zeros(1, 1), scorer=scorer)
    assert torch.equal(space.unlikeness(views, turns), charge)
    assert torch.equal(replace(space, scorer=None).unlikeness(views, turns), 0 * charge)
    still = Placement.at(turns.flatten(0, 1), torch.zeros(384, 3), torch.zeros(384, 1))
    chosen = best_of(still, torch.zeros(64, 6), charge).placement.rotation
    assert float((rotation_angle(chosen, rotation) < 0.01).float().mean()) > 0.9


def an_object(views: PartialViews, rotation: Tensor, turn: Tensor) -> OneObject:
    """Views with true poses in a frame that is turned."""
    posed = known(turn, 0, (0.2, 0.1, 0.1))
    inner = replace(posed.posed, views=views, rotation=rotation @ turn.mT,
                    translation=torch.zeros(len(rotation), 3))  # fmt: skip
    return replace(posed, posed=inner)


COUNT, EACH = 24, 8  # Objects, and views of each


def objects_of_chairs(turns: Tensor) -> tuple[list[OneObject], Tensor]:
    """Objects that are read right, and the true turns of all views."""
    views, rotation = standing(COUNT * EACH, 6)
    rows = torch.arange(COUNT * EACH).split(EACH)
    some = [an_object(take(views, own), rotation[own], turns[k]) for k, own in enumerate(rows)]
    return some, rotation


def placed_so(frames: Tensor) -> Hypotheses:
    """Two hypotheses of each view (B, 3, 3), the second of which is wrong and costs more."""
    both = torch.stack([frames, frames @ quarter_turns()[7]], 1).flatten(0, 1)
    loss = torch.tensor([0.30, 0.31]).expand(len(frames), 2)
    placement = Placement.at(both, torch.zeros(len(both), 3), torch.zeros(len(both), 1))
    return Hypotheses(placement=placement, loss=loss, unlike=torch.zeros_like(loss))


ASKED = 4  # Views of each object that tell how the template is turned


def taught(
    objects: list[OneObject], turns: Tensor, placed: Tensor, patch: pytest.MonkeyPatch
) -> OrientationScorer | None:
    """By objects that are read with these turns, whose views are placed so."""

    def readings(some: list[OneObject], kinds: object) -> list[object]:
        del kinds
        return [type("Reading", (), {"turn": turns[k].mT})() for k in range(len(some))]

    patch.setattr(room, "agreeing", readings)
    shown = owned_views(objects, ("revolute",))
    placed = placed[evenly(len(placed), ASKED * COUNT)]
    return taught_by_objects(shown, shown.some(ASKED * COUNT), placed_so(placed), generator(8))


@pytest.mark.slow
def test_objects_teach_what_the_loss_mistakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss takes a wrong turn of two objects in five, the same; objects are read right.

    The frame in which they are read together is another than the template's.
    """
    turns = random_rotations(COUNT, generator(7))
    objects, rotation = objects_of_chairs(turns)
    wrong = torch.isin(torch.arange(COUNT) % 5, torch.tensor([0, 2]))
    mistaken = rotation.clone()
    mistaken[wrong.repeat_interleave(EACH)] @= quarter_turns()[5]
    other = rotvec_to_rotmat(torch.tensor([[0.7, -0.2, 0.4]]))[0]
    scorer = taught(objects, turns @ other, mistaken, monkeypatch)
    assert scorer is not None
    views, _ = standing(COUNT * EACH, 6)
    others, truth = standing(60, 9)
    by_loss = OrientationScorer().learn(views, mistaken, generator(8))
    assert right(scorer, others, truth) > 0.85 > right(by_loss, others, truth) + 0.1


@pytest.mark.parametrize("cameras", ["right", "gathered", "scattered"])
def test_objects_whose_cameras_gather_or_scatter_do_not_teach(
    cameras: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views of all sides were registered as if they showed one, or one for the other."""
    turns = random_rotations(COUNT, generator(7))
    objects, rotation = objects_of_chairs(turns)
    posed = {"right": lambda one: one.posed.rotation, "gathered": facing,
             "scattered": lambda _: random_rotations(EACH, generator(9))}[cameras]  # fmt: skip
    objects = [replace(one, posed=replace(one.posed, rotation=posed(one))) for one in objects]
    told = taught(objects, turns, rotation, monkeypatch)
    assert (told is None) == (cameras != "right")


def facing(one: OneObject) -> Tensor:
    """view_R_object with which all cameras lie along the object's z axis."""
    toward = F.normalize(one.posed.views.direction(), dim=-1)
    aside = F.normalize(torch.linalg.cross(toward, torch.tensor([[0.6, 0.0, 0.8]])), dim=-1)
    return torch.stack([aside, torch.linalg.cross(toward, aside), toward], -1)
