# SPDX-License-Identifier: MIT
"""Methods without labels: true, wrong and withheld ones leave the same weights and answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bench.methods import METHODS
from scapo.categories import CATEGORIES
from scapo.method import AbstractMethod, Step
from scapo.store.samples import TrainingData
from scapo.training.fit import FitConfig, fit
from scapo.training.precision import Arithmetic, applied
from scapo.types import Labels
from tests.bench.baselines.eap.test_method import TINY as EAP
from tests.bench.baselines.op_align.test_method import TINY as OP_ALIGN
from tests.helpers.hinged import plates
from tests.helpers.small import settle
from tests.helpers.strategies import generator, is_rotation

CONFIGS = {"op-align": replace(OP_ALIGN, epochs=1), "eap": replace(EAP, epochs=(1, 1))}


def trained(name: str, labels: Labels, folder: Path) -> AbstractMethod:
    method = METHODS[name].build(CONFIGS[name], CATEGORIES["laptop"], generator(0))
    observation, _ = plates(8, 48)
    data = TrainingData(observation=observation, labels=labels, digest="plates")
    fit(method, data, folder, FitConfig(pictures_every=None))
    return method.eval()


@pytest.mark.parametrize("name", CONFIGS)
def test_labels_change_neither_training_nor_prediction(name: str, tmp_path: Path) -> None:
    observation, true = plates(8, 48)
    _, wrong = plates(8, 48, seed=5)
    runs = [
        trained(name, labels, tmp_path / str(k)) for k, labels in enumerate((true, wrong, Labels()))
    ]
    first, *others = (run.state_dict() for run in runs)
    for other in others:
        assert all(torch.equal(first[key], other[key]) for key in first)
    one, *more = (run.predict(observation) for run in runs)
    assert one.camera_T_part is not None
    for answer in more:
        assert answer.camera_T_part is not None
        assert torch.equal(answer.part_weight, one.part_weight)
        assert torch.equal(answer.camera_T_part, one.camera_T_part)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize(("batch", "clouds"), [(1, 4), (8, 1)])
def test_steps_of_one_cloud_are_refused_in_words(
    name: str, batch: int, clouds: int, tmp_path: Path
) -> None:
    config = replace(CONFIGS[name], batch=batch)
    method = METHODS[name].build(config, CATEGORIES["laptop"], generator(0))
    observation, labels = plates(clouds, 48)
    data = TrainingData(observation=observation, labels=labels, digest="plates")
    with pytest.raises(ValueError, match=f"at least 2 clouds in a step of {name} .* found 1"):
        fit(method, data, tmp_path, FitConfig(pictures_every=None))


@pytest.mark.parametrize("name", CONFIGS)
def test_networks_in_half_precision_leave_poses_whole(name: str) -> None:
    method = settle(METHODS[name].build(CONFIGS[name], CATEGORIES["laptop"], generator(0)))
    observation, _ = plates(6, 48)
    with torch.no_grad(), applied(method, Arithmetic(precision="bfloat16"), "cpu"):
        for stage in method.stages():
            step = Step(stage=stage.name, progress=0.0, generator=generator(1),
                        index=torch.arange(6), total=6)  # fmt: skip
            terms = method.losses(observation, Labels(), step)
            assert all(bool(torch.isfinite(term)) for term in terms.values())
        answer = method.eval().predict(observation)
    assert answer.camera_T_part is not None
    assert answer.camera_T_part.dtype == torch.float32
    assert is_rotation(answer.camera_T_part[..., :3, :3], 1e-5).all()
