# SPDX-License-Identifier: MIT
"""The method: labels are withheld, a stored run predicts alike, predictions turn with the cloud."""

from __future__ import annotations

import pytest
import torch
from sighted import sighted, template
from strategies import generator
from torch.testing import assert_close

from scapo.categories import CATEGORIES
from scapo.geometry import random_rotations, rotation_angle
from scapo.method import Step
from scapo.registered import RegisteredConfig, RegisteredScapo
from scapo.types import Labels, Observation


def trained(steps: int = 30) -> tuple[RegisteredScapo, Observation]:
    """The method with the true template and placements of 12 clouds, its network taught a bit."""
    views, truth = sighted(12, seed=60)
    cloud = views.points - views.camera[:, None]  # the camera at the origin
    config = RegisteredConfig(points=128, width=16, batch=12)
    method = RegisteredScapo(config, CATEGORIES["oven"], generator(0))
    method.template.load_state_dict(template().state_dict())
    camera = (truth.rotation.mT @ (views.camera - truth.translation)[..., None])[..., 0]
    method.pseudo.set(cloud[:, 0], truth, camera, torch.ones(12))
    observation = Observation(points=cloud)
    optimiser = torch.optim.Adam(method.network.parameters(), 3e-3)
    g = generator(1)
    for step in range(steps):
        terms = method.losses(
            observation, Labels(), Step(stage="votes", progress=step / steps, generator=g)
        )
        optimiser.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        optimiser.step()
    return method.eval(), observation


def test_predictions_turn_and_move_with_the_cloud_and_survive_storage():
    method, observation = trained()
    assert method.supervision == frozenset()
    plain = method.predict(observation)
    turn = random_rotations(1, generator(2))[0]
    move = torch.tensor([0.3, -0.2, 0.5])
    turned = method.predict(Observation(points=observation.points @ turn.T + move))
    assert plain.camera_T_part is not None
    assert turned.camera_T_part is not None
    angles = rotation_angle(
        turned.camera_T_part[:, 0, :3, :3], turn @ plain.camera_T_part[:, 0, :3, :3]
    )
    assert angles.rad2deg().median() < 1
    other = RegisteredScapo(method.config, method.category, generator(5))
    other.load_state_dict(method.state_dict())
    again = other.eval().predict(observation)
    assert_close(again.part_weight, plain.part_weight)


@pytest.mark.slow
def test_refinement_brings_the_template_closer():
    method, observation = trained(150)
    refined = method.predict(observation, "refine")
    views, truth = sighted(12, seed=60)
    del views
    assert refined.camera_T_part is not None
    errors = rotation_angle(refined.camera_T_part[:, 0, :3, :3], truth.rotation).rad2deg()
    fast = method.predict(observation).camera_T_part
    assert fast is not None
    before = rotation_angle(fast[:, 0, :3, :3], truth.rotation).rad2deg()
    assert errors.median() < before.median() + 1
    assert torch.allclose(refined.part_weight.sum(-1), torch.tensor(1.0), atol=1e-4)


def test_stages_follow_the_switch():
    made = RegisteredScapo(RegisteredConfig(epochs=(3, 0)), CATEGORIES["drawer"], generator(0))
    assert [stage.name for stage in made.stages()] == ["votes"]
    assert made.variant == ""
    assert sum(p.numel() for p in made.parameters()) < 1_500_000
