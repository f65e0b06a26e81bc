# SPDX-License-Identifier: MIT
"""The template of true placements is the shape that the objects share, in their own frames."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from scapo.categories import CATEGORIES, JointKind
from scapo.geometry.points import normalise, squared_distances
from scapo.geometry.rigid import axis_angle, point_line_distance, rotation_angle
from scapo.method import Step
from scapo.records import take
from scapo.registered.config import DiscoveryConfig, RegisteredConfig, TemplateConfig
from scapo.registered.labelled import LabelledConfig, LabelledRegistered
from scapo.registered.method import TemplateRegistration
from scapo.registered.pose_refinement import RANKED, backward_weight
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.registered.view_loss import view_loss
from scapo.registered.views import PartialViews, observe
from scapo.types import Labels, Observation
from tests.helpers.objects import Objects, objects
from tests.helpers.sighted import AXIS, PIVOT
from tests.helpers.sliding import OUT
from tests.helpers.strategies import generator

CONFIG = LabelledConfig(
    discovery=TemplateConfig(rotations=200, final_points=300),
    points=128, channels=4, placed=30, grid_hypotheses=32, epochs=1,
)  # fmt: skip
CATEGORY: dict[JointKind, str] = {"revolute": "oven", "prismatic": "drawer"}


def started(seen: Objects, kind: JointKind = "revolute") -> LabelledRegistered:
    method = LabelledRegistered(CONFIG, CATEGORIES[CATEGORY[kind]], generator(0))
    labels = seen.labels.keep(method.supervision)
    method.start("votes", seen.observation, labels, generator(1))
    return method.eval()


SEEN = objects(6, 5, seed=1)


@pytest.fixture(scope="module")
def made() -> LabelledRegistered:
    return started(SEEN)


def unit_boxes(method: LabelledRegistered, seen: Objects) -> Tensor:
    """Along which factor (3,) the shape that all objects share is the template."""
    rest, _ = seen.surfaces[0]
    ends = torch.tensor((0.02, 0.98))
    own = (rest / seen.stretch[0]).quantile(ends, 0)
    found = method.template.points.quantile(ends, 0)
    return (found[1] - found[0]) / (own[1] - own[0])


def test_its_points_and_parts_are_those_of_the_shape(made: LabelledRegistered) -> None:
    rest, part = SEEN.surfaces[0]
    shape = rest / SEEN.stretch[0] * unit_boxes(made, SEEN)
    template = made.template
    label = template.logit.argmax(-1)
    for p in (0, 1):
        mine = template.points[label == p]
        assert len(mine) > 30
        assert squared_distances(mine, shape[part == p]).sqrt().quantile(0.95) < 0.04
    flap = shape[part == 1]
    assert squared_distances(flap, template.points[label == 1]).sqrt().quantile(0.9) < 0.1


def test_its_joint_is_the_labelled_one(made: LabelledRegistered) -> None:
    template = made.template
    assert axis_angle(template.directions(), AXIS[None]).max() < 1e-3
    pivot = PIVOT * unit_boxes(made, SEEN)
    assert point_line_distance(template.pivot, pivot[None], AXIS[None]).max() < 0.03
    assert not template.deviates()


def test_pseudo_labels_are_the_true_placements(made: LabelledRegistered) -> None:
    pose, joints = SEEN.labels.camera_T_part, SEEN.labels.joints
    assert pose is not None
    assert joints is not None
    found = made.pseudo.placement()
    assert_close(found.rotation, pose[:, 0, :3, :3])
    assert_close(found.state, joints.state)
    _, similarity = normalise(SEEN.observation.points)
    assert_close(found.translation, similarity.forward(pose[:, None, 0, :3, 3])[:, 0])
    assert bool((made.pseudo.trust == 1).all())
    size = (SEEN.stretch.repeat_interleave(5, 0) * similarity.scale[:, None]).log()
    off = found.log_scale - (size - size.mean(0))
    assert off.abs().max() < 0.15  # boxes are told from points that views show
    assert (found.log_scale.mean(0)).abs().max() < 1e-5


def loss_of(template: ArticulatedTemplate, views: PartialViews, placement: Placement) -> float:
    with torch.no_grad():
        return float(
            view_loss(views, template.place(placement), RANKED, backward_weight(template)).mean()
        )


def views_of(seen: Objects) -> PartialViews:
    points, similarity = normalise(seen.observation.points)
    return observe(points, -similarity.centre * similarity.scale[:, None], count=128)


def test_true_placements_explain_the_views_better_than_others(made: LabelledRegistered) -> None:
    views, true = views_of(SEEN), made.pseudo.placement()
    at = loss_of(made.template, views, true)
    for other in (
        replace(true, state=true.state + 0.3),
        replace(true, translation=true.translation + 0.05),
        replace(true, log_scale=true.log_scale.roll(5, 0)),
    ):
        assert at < 0.9 * loss_of(made.template, views, other)


def test_drawers_sit_where_they_sit_on_each_body() -> None:
    seen = objects(6, 5, kind="prismatic", seed=2)
    method = started(seen, "prismatic")
    assert axis_angle(method.template.directions(), OUT[None]).max() < 1e-3
    found = method.pseudo.placement()
    assert_close(found.shift @ OUT, torch.zeros(30, 1), atol=1e-5, rtol=0)
    _, similarity = normalise(seen.observation.points)
    height = (seen.height * seen.stretch[:, 2]).repeat_interleave(5) * similarity.scale
    stretch = found.log_scale[:, 2].exp()
    expected = height - stretch * (height / stretch).mean()
    assert (found.shift[:, 0, 2] - expected).abs().max() < 0.05
    joints = seen.labels.joints
    assert joints is not None
    assert_close(found.state, joints.state * similarity.scale[:, None])
    views = views_of(seen)
    centred = replace(found, shift=torch.zeros_like(found.shift))
    assert loss_of(method.template, views, found) < 0.9 * loss_of(method.template, views, centred)


@pytest.mark.parametrize("kind", ["revolute", pytest.param("prismatic", marks=pytest.mark.slow)])
def test_refinement_answers_in_the_true_frames(kind: JointKind) -> None:
    seen = SEEN if kind == "revolute" else objects(6, 5, kind="prismatic", seed=2)
    method = started(seen, kind)
    some, labels = take((seen.observation, seen.labels), torch.tensor([0, 7, 14, 21]))
    found, pose = method.predict(some, "refine"), labels.camera_T_part
    assert pose is not None
    assert labels.part is not None
    assert found.camera_T_part is not None
    assert found.joints is not None
    assert labels.joints is not None
    turns = found.camera_T_part[..., :3, :3], pose[..., :3, :3]
    assert rotation_angle(*turns).rad2deg().median() < 10
    gap = (found.camera_T_part[..., :3, 3] - pose[..., :3, 3]).norm(dim=-1)
    assert gap.median() < 0.08
    assert axis_angle(found.joints.axis, labels.joints.axis).rad2deg().median() < 10
    assert (found.part_weight.argmax(-1) == labels.part).float().mean() > 0.85


@pytest.mark.parametrize("name", ["part", "camera_T_part", "joints", "instance"])
def test_all_labels_are_needed(name: str) -> None:
    method = LabelledRegistered(CONFIG, CATEGORIES["oven"], generator(0))
    labels = replace(SEEN.labels, **{name: None})
    with pytest.raises(ValueError, match="registered-labelled: expected parts, poses, joints and"):
        method.start("votes", SEEN.observation, labels, generator(1))


def test_labels_change_nothing_where_they_are_not_declared() -> None:
    """The network's losses, and all of `registered`, see none."""
    method = started(SEEN)
    step = Step(
        stage="votes", progress=0.5, generator=generator(2), index=torch.arange(4), total=30
    )
    some, labels = take((SEEN.observation, SEEN.labels), torch.arange(4))
    with torch.no_grad():
        one = method.losses(some, labels, step)
        other = method.losses(some, Labels(), replace(step, generator=generator(2)))
    assert {k: float(v) for k, v in one.items()} == {k: float(v) for k, v in other.items()}
    bare = TemplateRegistration(RegisteredConfig(), CATEGORIES["oven"], generator(0))
    assert bare.supervision == frozenset()
    assert SEEN.labels.keep(bare.supervision) == Labels()
    config = RegisteredConfig(supervision=("instance",))
    told = TemplateRegistration(config, CATEGORIES["oven"], generator(0))
    kept = SEEN.labels.keep(told.supervision)
    assert kept.instance is SEEN.labels.instance
    assert replace(kept, instance=None) == Labels()
    assert told.variant == "objects known"
    assert not bare.variant


def test_a_stored_one_answers_alike(made: LabelledRegistered) -> None:
    other = LabelledRegistered(CONFIG, CATEGORIES["oven"], generator(5))
    other.load_state_dict(made.state_dict())
    some = Observation(points=SEEN.observation.points[:2])
    assert_close(other.eval().predict(some).camera_T_part, made.predict(some).camera_T_part)


@pytest.mark.slow
def test_the_bound_explains_the_views_at_least_as_well_as_what_is_discovered() -> None:
    seen = objects(6, 4, seed=6)
    discovery = DiscoveryConfig(
        seeds=10, rotations=200, searched=12, trusted=(0.9,), starts=1, draws=1, heats=(),
        judged=4, template_points=120, final_points=300, mirror=False, halves=False,
        leans=False,
    )  # fmt: skip
    config = RegisteredConfig(discovery=discovery, points=128, width=8, epochs=1)
    found = TemplateRegistration(config, CATEGORIES["oven"], generator(0))
    found.start("votes", seen.observation, Labels(), generator(1))
    views = views_of(seen)
    bound = started(seen)
    best = loss_of(bound.template, views, bound.pseudo.placement())
    assert best <= loss_of(found.template, views, found.pseudo.placement())
