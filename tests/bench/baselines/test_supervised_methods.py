# SPDX-License-Identifier: MIT
"""The supervised baselines as methods: what they learn, need, ignore and repeat."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from bench.__main__ import main
from bench.baselines import gcn3d, pointnet2
from bench.baselines.supervised import (
    GROW,
    LearningConfig,
)
from bench.scoring.score_files import read_scores
from bench.scoring.scores import to_arrays
from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.records import take
from scapo.store.files import read
from scapo.training.fit import FitConfig, fit
from scapo.training.precision import Arithmetic, applied
from scapo.types import Observation
from tests.helpers.hinged import plates
from tests.helpers.small import FLAGS, hinged_data
from tests.helpers.strategies import generator
from tests.helpers.supervised import MAKERS, NAMES, a_step, errors_of, lean
from tests.helpers.tiny import tiny_data


@pytest.mark.parametrize("name", NAMES)
def test_a_prediction_goes_over_all_points_in_thin_clouds(name: str) -> None:
    observation, _ = plates(2, 50)
    method = lean(name, points=20, either_order=False).eval()
    points = normalise(observation.points)[0] * GROW
    whole = method.answer_all(points)
    for hand in range(3):
        alone = method.answer(points[:, hand::3], None)
        assert_close(whole.part[:, hand::3], alone.part)
        assert whole.votes is not None
        assert alone.votes is not None
        assert_close(whole.votes[:, hand::3], alone.votes)


@pytest.mark.parametrize(
    ("name", "pose", "steps"),
    [
        ("pointnet2", "votes", 100),
        ("pointnet2", "pooled", 100),
        pytest.param("gcn3d", "votes", 150, marks=pytest.mark.slow),
    ],
)
def test_one_batch_is_learned_by_heart(name: str, pose: str, steps: int) -> None:
    """From its own objective to the benchmark's errors of the same clouds."""
    data = tiny_data(4, points=48)
    method = lean(name, pose=pose)
    optimizer = torch.optim.Adam(method.parameters())
    totals = []
    for number in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 1e-2 * (1 - number / steps)
        optimizer.zero_grad()
        terms = method.losses(data.observation, data.labels, a_step(number))
        total = torch.stack(list(terms.values())).sum()
        totals.append(total.item())
        total.backward()
        optimizer.step()
    assert totals[-1] < totals[0] / 5
    errors = errors_of(method.eval(), data.observation, data.labels)
    assert errors["iou"].mean() > 0.95
    assert errors["part_rotation"].mean() < 7
    assert errors["joint_direction"].mean() < 7
    assert errors["part_translation"].mean() < 0.07
    assert errors["joint_pivot"].mean() < 0.05


@pytest.mark.parametrize("name", NAMES)
def test_points_without_a_label_count_nowhere(name: str) -> None:
    observation, labels = plates(4, 60)
    assert labels.part is not None
    method = lean(name, either_order=False).eval()
    none = replace(labels, part=torch.full_like(labels.part, -1))
    terms = method.losses(observation, none, a_step())
    assert terms["segmentation"].item() == 0
    assert terms["votes"].item() == 0
    with torch.no_grad():
        logits = method.answer(normalise(observation.points)[0] * GROW, None).part
    right = logits.argmax(-1) == labels.part
    only = replace(labels, part=torch.where(right, labels.part, -1))
    cost = method.losses(observation, only, a_step())["segmentation"]
    assert cost.item() <= np.log(2)


@pytest.mark.parametrize("name", NAMES)
def test_labels_are_declared_and_needed(name: str) -> None:
    observation, labels = plates(4, 40)
    method = lean(name)
    assert method.supervision == {"pose", "segmentation", "joint"}
    for label in method.supervision:
        some = labels.keep(method.supervision - {label})
        with pytest.raises(ValueError, match="expected parts, poses and joints, found some"):
            method.losses(observation, some, a_step())


@pytest.mark.parametrize("name", NAMES)
def test_withheld_labels_change_no_training(name: str) -> None:
    """Instances are no label of theirs, states a part of one that is never looked at."""
    observation, labels = plates(6, 50)
    assert labels.joints is not None
    other = replace(
        labels,
        joints=replace(labels.joints, state=torch.full((6, 1), torch.nan)),
        instance=torch.arange(6),
    )
    supervision = lean(name).supervision
    one, two = (
        lean(name).losses(observation, some.keep(supervision), a_step()) for some in (labels, other)
    )
    assert all(torch.equal(one[key], two[key]) for key in one)


def command(*words: object) -> None:
    main([str(word) for word in words])


@pytest.mark.parametrize("name", NAMES)
def test_labels_of_the_split_change_no_prediction(name: str, tmp_path: Path) -> None:
    """And the whole way: train, predict, evaluate, with all errors there."""
    data = hinged_data(tmp_path / "data")
    run = tmp_path / "run"
    command("train", name, "--category", "laptop", "--data", data, "--out", run, "--device", "cpu",
            "--no-pictures", *FLAGS[name])  # fmt: skip
    assert json.loads((run / "config.json").read_text())["config"]["preset"] == "cpu"
    other = hinged_data(tmp_path / "other", wrong=True)
    for folder, out in ((data, "right"), (other, "wrong")):
        command("predict", run, "--data", folder, "--out", tmp_path / f"{out}.safetensors",
                "--device", "cpu")  # fmt: skip
    right, wrong = (read(tmp_path / f"{out}.safetensors")[0] for out in ("right", "wrong"))
    assert all((right[key] == wrong[key]).all() for key in right)
    command("evaluate", "--predictions", tmp_path / "right.safetensors", "--data", data, "--out",
            tmp_path / "scores.csv.gz")  # fmt: skip
    (scores,) = read_scores(tmp_path / "scores.csv.gz")
    assert all(np.isfinite(values).all() for values in scores.errors.values())


@pytest.mark.parametrize("name", NAMES)
def test_a_training_is_repeated_bit_for_bit(name: str, tmp_path: Path) -> None:
    """Dropout, augmentation and random pools draw from the generator of the step alone."""
    still = {"points": 48, "rotated": 0.5, "noisy": 0.5, "dropout": 0.5, "epochs": 1, "batch": 8}
    files = []
    for number in range(2):
        method = lean(name, **still)
        torch.rand(number + 1)
        folder = tmp_path / str(number)
        fit(method, tiny_data(16), folder, FitConfig(pictures_every=None))
        files.append(read(folder / "checkpoint.safetensors")[0])
    assert all((files[0][key] == files[1][key]).all() for key in files[0])


@pytest.mark.parametrize("name", NAMES)
def test_predictions_are_the_same_each_time(name: str) -> None:
    observation, _ = plates(3, 60)
    method = lean(name, dropout=0.5, noisy=1.0, rotated=1.0, points=30).eval()
    one, two = method.predict(observation), method.predict(observation)
    one, two = (to_arrays(prediction) for prediction in (one, two))
    assert len(one) == 5
    assert all((one[key] == two[key]).all() for key in one)
    alone = method.predict(take(observation, torch.tensor([1])))
    whole = torch.from_numpy(one["part_weight"])
    assert_close(alone.part_weight[0], whole[1], atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_size_and_place_of_the_cloud_do_not_matter(name: str) -> None:
    observation, _ = plates(3, 60)
    method = lean(name).eval()
    shift = torch.tensor([0.3, -0.2, 1.0])
    one = method.predict(observation)
    two = method.predict(Observation(points=2 * observation.points + shift))
    assert_close(two.part_weight, one.part_weight, atol=1e-3, rtol=0)
    assert one.camera_T_part is not None
    assert two.camera_T_part is not None
    expected = one.camera_T_part.clone()
    expected[..., :3, 3] = 2 * expected[..., :3, 3] + shift
    assert_close(two.camera_T_part, expected, atol=1e-2, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_variants_name_what_differs(name: str) -> None:
    maker = {"pointnet2": pointnet2.PointNet2Config, "gcn3d": gcn3d.Gcn3dConfig}[name]
    small = {"pointnet2": pointnet2.cpu_config, "gcn3d": gcn3d.cpu_config}[name]()
    laptop = CATEGORIES["laptop"]
    assert MAKERS[name](small, laptop, generator(0)).variant == "cpu"
    paper = maker(learning=LearningConfig(epochs=3, lr=1.0))
    assert changes_of(paper) == changes_of(maker()) | {"epochs": 3, "lr": 1.0}
    other = replace(small, learning=replace(small.learning, pose="pooled", rotated=1.0, epochs=9))
    found = MAKERS[name](other, laptop, generator(0)).variant
    assert found == "cpu-learning.pose=pooled-learning.rotated=1.0"


def changes_of(config: Any) -> dict[str, Any]:
    return asdict(config.learning)


@pytest.mark.parametrize("name", NAMES)
def test_the_body_runs_in_reduced_precision(name: str) -> None:
    observation, labels = plates(4, 50)
    method = lean(name, points=30)
    full = method.losses(observation, labels, a_step())
    with applied(method, Arithmetic(precision="bfloat16"), "cpu"):
        terms = method.losses(observation, labels, a_step())
        torch.stack(list(terms.values())).sum().backward()
    for key, value in terms.items():
        assert value.dtype == torch.float32
        assert_close(value, full[key], atol=0.2, rtol=0.1)
    assert all(torch.isfinite(p.grad).all() for p in method.parameters() if p.grad is not None)
