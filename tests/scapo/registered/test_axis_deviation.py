# SPDX-License-Identifier: MIT
"""Rotations of a flap are observed; a template of flaps whose axes deviate is found, no other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import roma
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.records import take
from scapo.registered import axis_deviation
from scapo.registered.axis_deviation import (
    LEAST_GAIN,
    LEAST_GAIN_PARALLEL,
    REACHES,
    _parallel,
    _rests,
    _senses,
    deviating_templates,
    observe_part_rotations,
    refine_deviations,
    rotated_poses,
    spread_across,
    square_axes,
    with_axis_deviation,
)
from scapo.registered.bundle_adjustment import Candidate, FitOptions, Inliers
from scapo.registered.config import DiscoveryConfig
from scapo.registered.deviation_model import DeviationModel
from scapo.registered.joint_limits import limits_of
from scapo.registered.pose_search import SearchResult
from scapo.registered.template import ArticulatedTemplate, Placement, across_axis
from tests.helpers.sighted import sighted, template
from tests.helpers.strategies import generator

ASIDE = 0.15


@pytest.mark.parametrize("beside", [0.0, 0.05])
@torch.no_grad()
def test_the_rotation_of_a_flap_whose_axis_deviates_is_observed(beside: float) -> None:
    """Also where the objects' hinges lie beside the template's."""
    views, truth = sighted(16, seed=5, deviation=ASIDE)
    made = template()
    straight = replace(truth, deviation=torch.zeros_like(truth.deviation))
    off = torch.tensor([0.0, 0.0, beside])
    shift = (made.turns(straight)[:, 0] - torch.eye(3)) @ off
    straight = replace(straight, shift=shift[:, None])
    truth = replace(truth, shift=((made.turns(truth)[:, 0] - torch.eye(3)) @ off)[:, None])
    made.pivot.add_(off)
    observed = observe_part_rotations(made, views, straight, REACHES)
    base = truth.rotation.mT
    aside, upright = (base @ made.part_poses(at).rotation[:, 1] for at in (truth, straight))
    turn = roma.rotmat_to_rotvec(upright.mT @ aside)
    got = spread_across(observed.turn, made)[:, 0]
    off = (got - turn)[observed.seen[:, 0], 0]  # out of the flap's plane, which its points tell
    assert observed.seen.float().mean() > 0.8
    assert off.abs().max() < 0.012
    assert turn[:, 0].abs().max() > 0.05


def test_parts_are_posed_as_rotated_about_their_pivot() -> None:
    views, truth = sighted(6, seed=5)
    made = template()
    observed = observe_part_rotations(made, views, truth, REACHES)
    observed.turn[:, 0] = torch.tensor(
        [[0.1, 0.0], [-0.1, 0.0], [0.0, 0.2], [0, -0.2], [2, 0], [-2, 0]]
    )
    observed.seen[:4] = True
    observed.seen[4:] = False
    poses, straight = rotated_poses(made, truth, observed), made.part_poses(truth)
    turn = roma.rotmat_to_rotvec(straight.rotation[:, 1].mT @ poses.rotation[:, 1])
    assert_close(turn.norm(dim=-1), torch.tensor([0.1, 0.1, 0.2, 0.2, 0, 0]), atol=1e-4, rtol=1e-3)
    for one in (poses, straight):
        spot = one.rotation[:, 1] @ made.pivot[0].detach() + one.translation[:, 1]
        assert_close(spot, made.joints_in_view(truth)[0][:, 0].detach(), atol=1e-5, rtol=1e-5)
    assert_close(poses.rotation[:, 0], straight.rotation[:, 0])


@pytest.mark.parametrize("deviation", [0.3, 0.0])
def test_a_deviating_template_is_taken_where_held_out_views_deviate_and_tells_how(
    deviation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The judging alone: one that deviates is at hand, and the judges' placements are known.

    Templates that were fitted explain far more than these, so that less gain is asked for here.
    """
    views, truth = sighted(8, seed=5, deviation=deviation)
    straight = replace(truth, deviation=torch.zeros_like(truth.deviation))
    inliers = Inliers(views=views, placement=straight)
    start, other = Candidate(template=template(count=1500), inliers=inliers), template(count=1500)
    other.load.copy_(torch.tensor([0.0, 0.3]))  # as of the true one, which rests at state 0
    other.noise.copy_(1e-4 * torch.eye(2))
    placed = SearchResult(placement=straight, loss=torch.zeros(8), margin=torch.zeros(8))
    monkeypatch.setattr(
        axis_deviation, "deviating_templates", lambda *_: [replace(start, template=other)]
    )
    monkeypatch.setattr(axis_deviation, "search_views", lambda *_: placed)
    monkeypatch.setattr(axis_deviation, "LEAST_GAIN", 0.04)
    found = with_axis_deviation(start, views, DiscoveryConfig(), generator(0)).template
    assert found is (other if deviation else start.template)
    at, _ = refine_deviations(found, views, straight)
    got, true = (one.rotation @ found.own_directions(one).mT for one in (at, truth))
    angle = torch.rad2deg((got * true).sum(1).clamp(max=1).arccos())
    assert angle.mean() < 2 / 3 * torch.rad2deg(torch.tensor(0.3))


def test_hinges_along_one_direction_are_parallel_whatever_their_sense() -> None:
    assert not _parallel(template())
    made = ArticulatedTemplate(("revolute", "revolute"), 8)
    made.axis.data = torch.tensor([[0.1, 0.0, 2.0], [0.0, -0.1, -1.0]])
    assert _parallel(made)
    made.axis.data = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    assert not _parallel(made)
    assert not _parallel(ArticulatedTemplate(("revolute", "prismatic"), 8))


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_parallel_hinges_rest_as_mirror_images_do(sense: float) -> None:
    """A part and its mirror image turn in opposite senses: about one axis or about two."""
    made = ArticulatedTemplate(("revolute", "revolute"), 8)
    made.axis.data = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, sense]])
    limits = limits_of(torch.tensor([[-0.5, 0.2], [0.5, 1.2]]), made.kinds)
    rests = _rests(limits, _senses(made))
    ends = [(one[:, 0] > limits.low + 0.5).tolist() for one in rests]
    assert ends == ([[False, True], [True, False]] if sense > 0 else [[False] * 2, [True] * 2])
    assert len(_rests(limits)) == 4


def test_parallel_hinges_stay_so_when_a_fit_has_turned_their_axes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of axes along the frame a hair's breadth tells which direction across them comes first."""
    axes = [[[1.0, 1e-3, 2e-3], [-1.0, 2e-3, 1e-3]], [[1.0, 2e-3, 1e-3], [-1.0, 1e-3, 2e-3]],
            [[1.0, 1e-3, 2e-3], [-1.0, 1e-3, 2e-3]]]  # fmt: skip
    views, truth = sighted(8, seed=5)
    made = ArticulatedTemplate(("revolute", "revolute"), 8)
    found = Candidate(template=made, inliers=Inliers(views=views, placement=truth))
    apart: list[Tensor] = []

    def fit(
        fitted: ArticulatedTemplate, *inputs: object, **named: object
    ) -> tuple[Placement, None]:
        fitted.axis.data = torch.tensor(axes[len(apart)])
        return truth, None

    def learn(*inputs: Tensor) -> DeviationModel:
        turn = spread_across((inputs[-1] @ torch.tensor([0.2, -0.1])).view(1, 2, 2), made)[0]
        apart.append(turn[0] - turn[1])
        return DeviationModel(rest=torch.zeros(2), load=torch.zeros(4), noise=torch.eye(4))

    stays: dict[str, object] = dict.fromkeys(["with_deviations", "settle_hinges"], truth)
    stays |= dict.fromkeys(["rebuild", "observe_part_rotations", "square_axes"])
    stays["refine_deviations"] = truth, None
    for name, answer in stays.items():
        monkeypatch.setattr(axis_deviation, name, lambda *_, answer=answer, **named: answer)
    monkeypatch.setattr(axis_deviation, "bundle_adjust", fit)
    monkeypatch.setattr(axis_deviation, "learn_deviations", learn)
    rests = torch.zeros(2, 1)
    axis_deviation._fitted(found, rests, True, FitOptions(), generator(0))
    assert_close(torch.stack(apart), torch.zeros(3, 3), atol=2e-3, rtol=0)


@pytest.mark.parametrize("gains", [(0.8,), (0.93,), (0.97, 0.8), (0.97, 0.93)])
def test_the_first_kind_of_loads_that_explains_enough_is_taken(
    gains: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    views, truth = sighted(8, seed=5)
    start = Candidate(template=template(), inliers=Inliers(views=views, placement=truth))
    made = [Candidate(template=template(), inliers=start.inliers) for _ in gains]
    loss = {id(one.template): gain for one, gain in zip(made, gains, strict=True)}
    found = SearchResult(placement=truth, loss=torch.zeros(8), margin=torch.zeros(8))
    monkeypatch.setattr(axis_deviation, "_parallel", lambda _: True)
    monkeypatch.setattr(axis_deviation, "search_views", lambda *_: found)
    asked: list[object] = []

    def tried(*inputs: object) -> list[Candidate]:
        asked.append(inputs[-1])
        return [made[len(asked) - 1]]

    def judged(one: ArticulatedTemplate, *_: object) -> tuple[Placement, Tensor]:
        return truth, torch.full((8,), loss.get(id(one), 1.0))

    monkeypatch.setattr(axis_deviation, "deviating_templates", tried)
    monkeypatch.setattr(axis_deviation, "refine_deviations", judged)
    taken = with_axis_deviation(start, views, DiscoveryConfig(), generator(0))
    enough = 1 - {1: LEAST_GAIN_PARALLEL, 2: LEAST_GAIN}[len(gains)]
    assert taken is (made[-1] if gains[-1] < enough else start)
    assert asked == [True, False][: len(gains)]


@pytest.mark.slow
def test_axes_that_deviate_are_found_and_told() -> None:
    views, truth = sighted(48, seed=8, deviation=ASIDE)
    straight = replace(truth, deviation=torch.zeros_like(truth.deviation))
    index = torch.arange(48)
    held, rest = index[::3], index[index % 3 > 0]
    config = DiscoveryConfig(rotations=300)
    inliers = Inliers(views=take(views, rest), placement=take(straight, rest))
    start = Candidate(template=template(), inliers=inliers)
    found = with_axis_deviation(start, take(views, held), config, generator(0)).template
    assert found.deviates()
    placed, loss = refine_deviations(found, take(views, held), take(straight, held))
    got, true = (at.rotation @ found.own_directions(at).mT for at in (placed, take(truth, held)))
    angle = torch.rad2deg((got * true).sum(1).clamp(max=1).arccos())
    # which of 16 held-out axes are found hangs on rounding: means of 3 to 5 degrees were seen
    assert angle.mean() < 2 / 3 * torch.rad2deg(torch.tensor(ASIDE))
    _, before = refine_deviations(template(), take(views, held), take(straight, held))
    assert loss.mean() < before.mean()


def test_templates_deviate_where_a_few_views_do_and_there_alone() -> None:
    for deviation in (0.0, ASIDE):
        views, truth = sighted(8, seed=9, deviation=deviation)
        straight = replace(truth, deviation=torch.zeros_like(truth.deviation))
        start = Candidate(template=template(), inliers=Inliers(views=views, placement=straight))
        made = deviating_templates(start, FitOptions(steps=1), generator(0))
        assert bool(made) == (deviation > 0)
        assert all(one.template.deviates() for one in made)


@pytest.mark.slow
def test_axes_that_do_not_deviate_make_no_template() -> None:
    views, truth = sighted(24, seed=9)
    start = Candidate(template=template(), inliers=Inliers(views=views, placement=truth))
    assert not deviating_templates(start, FitOptions(steps=5), generator(0))


@torch.no_grad()
def test_axes_are_put_along_the_frame_and_parts_stay_as_they_were_at_rest() -> None:
    made, rest = template(), torch.tensor([0.4])
    lean = rotvec_to_rotmat(torch.tensor([0.0, 0.0, 0.15]))
    made.axis.copy_((lean @ made.axis.T).T)
    made.rest.copy_(rest)
    aside = torch.tensor([[[0.0, 0.0, 0.2]]])  # across both axes
    made.load.copy_((across_axis(made.directions()[0]) @ aside[0, 0]).flatten())
    made.logit.mul_(10)  # parts without a seam
    placement = replace(
        sighted(1, seed=2)[1],
        state=rest[None],
        shift=torch.zeros(1, 1, 3),
        log_scale=torch.zeros(1, 3),
    )
    before = made.place(placement)
    square_axes(made)
    assert torch.equal(made.axis, torch.eye(3)[1:2])
    after = made.place(placement)
    for old, new in zip(before, after, strict=True):
        assert_close(new, old, atol=1e-5, rtol=0)
    assert_close(spread_across(made.load[None, None], made), aside, atol=1e-5, rtol=0)
    flap = template()
    assert (made.points - flap.points).norm(dim=-1).max() > 0.01  # at state 0 the flap is elsewhere
    made.axis.copy_(torch.tensor([[0.0, 0.8, 0.6]]))  # between two directions: which one?
    square_axes(made)
    assert_close(made.axis, torch.tensor([[0.0, 0.8, 0.6]]))
