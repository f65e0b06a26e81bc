# SPDX-License-Identifier: MIT
"""Heads, targets and losses of the supervised baselines, against the evaluator and plain loops."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from bench.__main__ import main
from bench.baselines import gcn3d, pointnet2
from bench.baselines.supervised import (
    GROW,
    Answer,
    LearningConfig,
    SupervisedMethod,
    Target,
    augmented,
    best_order,
    exchanged,
    gram_schmidt,
    interpolate,
    interpolation,
    mean_pose,
    penalties,
    poses_by_vote,
    states,
)
from bench.matching import joint_order, part_orders, reorder_poses
from bench.metrics import sample_errors
from bench.runs.predict import to_arrays
from bench.scoring.score_files import read_scores
from scapo.categories import CATEGORIES
from scapo.geometry.points import normalise
from scapo.geometry.rigid import apply, invert, rigid
from scapo.geometry.rotations import rotvec_to_rotmat
from scapo.method import Step
from scapo.records import take
from scapo.store.files import read
from scapo.training.fit import FitConfig, fit
from scapo.training.precision import Arithmetic, applied
from scapo.types import Labels, Observation
from tests.helpers import made
from tests.helpers.hinged import plates
from tests.helpers.small import FLAGS, hinged_data
from tests.helpers.strategies import generator, is_rotation, normal, rigid_motions, rotations
from tests.helpers.tiny import tiny_data

LEAN: dict[str, Any] = {
    "pointnet2": replace(
        pointnet2.cpu_config(),
        centres=(32, 8),
        near_samples=(4, 6, 8),
        near_widths=((8, 16), (16, 16), (16, 32)),
        far_samples=(4, 8),
        far_widths=((32, 32), (32, 64)),
        whole_widths=(64, 128),
        back_widths=((64,), (64,), (64,)),
    ),
    "gcn3d": replace(gcn3d.cpu_config(), neighbours=8, widths=(16, 16, 32, 32, 64), fuse=(64, 64)),
}
MAKERS: dict[str, Any] = {"pointnet2": pointnet2.PointNet2, "gcn3d": gcn3d.Gcn3d}
NAMES = tuple(MAKERS)


def lean(name: str, category: str = "laptop", **learning: Any) -> SupervisedMethod:
    """A network of some 50,000 parameters that sees its clouds as they are."""
    config = LEAN[name]
    still = {"points": None, "rotated": 0.0, "noisy": 0.0, "dropout": 0.0} | learning
    config = replace(config, learning=replace(config.learning, **still))
    return MAKERS[name](config, CATEGORIES[category], generator(0))


def a_step(seed: int = 0, count: int = 8) -> Step:
    return Step(
        stage="learn", progress=0.0, generator=generator(seed), index=torch.arange(count), total=8
    )


def truth(count: int = 3, points: int = 40, parts: int = 2, seed: int = 0) -> tuple[Tensor, Target]:
    """Normal clouds with any labels."""
    joints = parts - 1
    axis = F.normalize(normal(seed + 3, count, joints, 3), dim=-1)
    return normal(seed, count, points, 3), Target(
        part=torch.randint(-1, parts, (count, points), generator=generator(seed)),
        pose=rigid_motions(seed + 1, count, parts),
        pivot=normal(seed + 2, count, joints, 3),
        axis=axis,
    )


def perfect(points: Tensor, target: Target, *, pooled: bool = False) -> Answer:
    """The answer that the truth asks for."""
    parts = target.pose.shape[1]
    base = invert(target.pose[:, 0])
    axis = target.axis @ base[:, :3, :3].mT
    pivot = apply(base, target.pivot)
    votes = torch.stack([apply(invert(target.pose[:, p]), points) for p in range(parts)], 2)
    return Answer(
        part=50.0 * F.one_hot(target.part.clamp(min=0), parts).to(points.dtype),
        votes=None if pooled else votes,
        pose=target.pose if pooled else None,
        pivot=pivot - (pivot * axis).sum(-1, keepdim=True) * axis,
        axis=3 * axis,
    )


@pytest.mark.parametrize("pooled", [False, True])
def test_the_truth_costs_nothing_and_what_is_off_costs(pooled: bool) -> None:
    points, target = truth()
    config, answer = LearningConfig(), perfect(points, target, pooled=pooled)
    right = penalties(points, answer, target, config)
    # Distances of votes are smooth within a hundredth.
    assert all(0 <= float(term.max()) < (0.051 if name == "votes" else 1e-6)
               for name, term in right.items())  # fmt: skip
    turn = rigid(rotations(7), torch.full((3,), 0.3, dtype=torch.float64))
    off = replace(
        answer,
        part=answer.part.flip(-1),
        votes=None if answer.votes is None else answer.votes + 0.3,
        pose=None if answer.pose is None else answer.pose @ turn,
        pivot=answer.pivot + 0.3,
        axis=-answer.axis,
    )
    wrong = penalties(points, off, target, config)
    assert set(wrong) == set(right)
    assert all(float((wrong[name] - right[name]).min()) > 0.1 for name in right)
    assert_close(wrong["axis"], torch.full((3,), 2.0, dtype=torch.float64))


def test_the_segmentation_and_vote_terms_are_means_over_known_points() -> None:
    points, target = truth(count=2)
    config = LearningConfig(segmentation_weight=2.0, pose_weight=3.0)
    answer = replace(
        perfect(points, target), part=normal(4, 2, 40, 2), votes=normal(5, 2, 40, 2, 3)
    )
    assert answer.votes is not None
    terms = penalties(points, answer, target, config)
    for b in range(2):
        entropies, offs = [], []
        for n in range(40):
            label = int(target.part[b, n])
            if label < 0:
                continue
            entropies.append(-float(answer.part[b, n].log_softmax(0)[label]))
            for p in range(2):
                pose = target.pose[b, p]
                own = pose[:3, :3].T @ (points[b, n] - pose[:3, 3])
                offs.append(float(((own - answer.votes[b, n, p]).square().sum() + 1e-4).sqrt()))
        assert 0 < len(entropies) < 40
        assert float(terms["segmentation"][b]) == pytest.approx(2 * np.mean(entropies))
        assert float(terms["votes"][b]) == pytest.approx(3 * np.mean(offs))


@pytest.mark.parametrize("category", ["laptop", "eyeglasses", "basket", "scissors"])
def test_exchanged_truth_is_what_the_evaluator_accepts(category: str) -> None:
    symmetry = CATEGORIES[category].symmetry
    parts = len(CATEGORIES[category].parts)
    _, target = truth(parts=parts)
    other = exchanged(target, torch.tensor(symmetry, dtype=torch.float64))
    order = np.repeat(part_orders(parts)[1:2], 3, 0)
    assert_close(
        other.pose.numpy(),
        reorder_poses(target.pose.numpy(), order, np.array(symmetry)),
    )
    joint = joint_order(order)
    assert_close(
        other.pivot, target.pivot.gather(1, torch.tensor(joint)[..., None].expand(-1, -1, 3))
    )
    for slot in range(parts):
        assert torch.equal(other.part == slot, target.part == int(order[0, slot]))
    assert torch.equal(other.part < 0, target.part < 0)


def test_the_exchanged_joint_opens_the_same_way() -> None:
    """A laptop that stands on its screen is open by as much, and in no direction of its own."""
    observation, labels = plates(6, 50)
    target, _ = target_of(observation, labels)
    symmetry = torch.tensor(CATEGORIES["laptop"].symmetry, dtype=torch.float32)
    other = exchanged(target, symmetry)
    for one in (target, other):
        axis = one.axis @ invert(one.pose[:, 0])[:, :3, :3].mT
        assert labels.joints is not None
        found = states(one.pose, axis, CATEGORIES["laptop"])
        assert_close(found, labels.joints.state, atol=1e-4, rtol=0)


def target_of(observation: Observation, labels: Labels) -> tuple[Target, Tensor]:
    assert labels.part is not None
    assert labels.camera_T_part is not None
    assert labels.joints is not None
    target = Target(
        part=labels.part,
        pose=labels.camera_T_part,
        pivot=labels.joints.pivot,
        axis=labels.joints.axis,
    )
    return target, observation.points


def test_each_cloud_takes_the_cheaper_order() -> None:
    points, target = truth(count=4)
    symmetry = torch.tensor(CATEGORIES["laptop"].symmetry, dtype=torch.float64)
    other = exchanged(target, symmetry)
    one, two = perfect(points, target), perfect(points, other)
    mixed = Answer(
        **{
            name: torch.cat([getattr(one, name)[:2], getattr(two, name)[2:]])
            for name in ("part", "votes", "pivot", "axis")
        },
        pose=None,
    )
    config = LearningConfig()
    cost = best_order(points, mixed, [target, other], config)
    assert float(torch.stack(list(cost.values())).sum()) < 0.06
    alone = best_order(points, mixed, [target], config)
    both = [penalties(points, mixed, some, config) for some in (target, other)]
    totals = [sum(float(term[b]) for term in both[0].values()) for b in range(4)]
    assert float(torch.stack(list(alone.values())).sum()) == pytest.approx(np.mean(totals))


def test_votes_make_poses_that_bad_votes_do_not_spoil() -> None:
    points, target = truth(count=3, points=200)
    votes = perfect(points, target).votes
    assert votes is not None
    weight = torch.ones(3, 200, 2, dtype=torch.float64)
    assert_close(poses_by_vote(points, votes, weight), target.pose, atol=1e-6, rtol=0)
    votes[:, :40] += 2.0
    found = poses_by_vote(points, votes, weight)
    assert (found - target.pose).abs().max() < 0.02
    weight[:, :40] = 0
    assert_close(poses_by_vote(points, votes, weight), target.pose, atol=1e-6, rtol=0)


def test_gram_schmidt_gives_rotations_that_keep_the_first_axis() -> None:
    a, b = normal(0, 5, 3), normal(1, 5, 3)
    rotation = gram_schmidt(a, b)
    assert is_rotation(rotation, 1e-9).all()
    assert_close(rotation[..., 0], F.normalize(a, dim=-1))
    exact = rotations(3, 4)
    assert_close(gram_schmidt(exact[..., 0], exact[..., 1]), exact)


def test_the_mean_of_poses_about_one_is_that_one() -> None:
    pose = rigid_motions(0, 3)
    turn = rotvec_to_rotmat(0.3 * normal(5, 3))
    sides = [rigid(pose[:, :3, :3] @ t, pose[:, :3, 3]) for t in (turn, turn.mT)]
    assert_close(mean_pose(torch.stack(sides)), pose)


@pytest.mark.parametrize("there", [1, 2, 30])
def test_interpolation_against_loops(there: int) -> None:
    here, points = normal(0, 2, 20, 3).float(), normal(1, 2, there, 3).float()
    values = normal(2, 2, there, 5).float()
    found = interpolate(values, *interpolation(here, points))
    for b in range(2):
        for n in range(20):
            square = (points[b] - here[b, n]).square().sum(1)
            near = square.sort().indices[:3]
            weight = 1 / (square[near] + 1e-9)
            expected = (weight[:, None] * values[b, near]).sum(0) / weight.sum()
            assert_close(found[b, n], expected, atol=1e-4, rtol=1e-3)
    there_itself = interpolate(values, *interpolation(points, points))
    assert_close(there_itself, values, atol=1e-4, rtol=0)


@pytest.mark.parametrize("category", ["laptop", "drawer", "eyeglasses"])
def test_states_are_those_of_the_data(category: str) -> None:
    arrays = made.sample_arrays(category, 6, 20)
    pose = torch.from_numpy(arrays["camera_T_part"])
    base = invert(pose[:, 0])[:, :3, :3]
    axis = torch.from_numpy(arrays["joint_axis"]) @ base.mT
    found = states(pose, axis, CATEGORIES[category])
    assert_close(found, torch.from_numpy(arrays["joint_state"]), atol=1e-4, rtol=0)


def test_augmentation_moves_truth_and_cloud_alike() -> None:
    observation, labels = plates(6, 60)
    target, points = target_of(observation, labels)
    config = LearningConfig(rotated=1.0, noisy=0.0, points=40)
    moved, other = augmented(points, target, config, generator(0))
    assert moved.shape == (6, 40, 3)
    for p in range(2):
        before = apply(invert(target.pose[:, p]), points)
        after = apply(invert(other.pose[:, p]), moved)
        gap = torch.cdist(after, before)  # each is one of the points, with its label
        assert gap.amin(-1).max() < 1e-3
        assert torch.equal(target.part.gather(1, gap.argmin(-1)), other.part)
    base = invert(target.pose[:, 0]), invert(other.pose[:, 0])
    assert_close(apply(base[1], other.pivot), apply(base[0], target.pivot), atol=1e-4, rtol=0)
    assert_close(other.axis @ base[1][:, :3, :3].mT, target.axis @ base[0][:, :3, :3].mT)
    turned = [augmented(points, target, replace(config, rotated=share, noisy=share, noise=0.1,
                                                points=None), generator(0))[0]
              for share in (0.0, 0.5)]  # fmt: skip
    assert torch.equal(turned[0], points)
    same = (turned[1] == points).all(-1).all(-1)
    assert 0 < int(same.sum()) < 6


@pytest.mark.parametrize("category", ["laptop", "drawer", "eyeglasses"])
def test_a_perfect_network_predicts_the_truth_in_metres(
    category: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = {name: torch.from_numpy(array) for name, array in
              made.sample_arrays(category, 4, 90, background=9).items()}  # fmt: skip
    method = lean("gcn3d", category).eval()
    normalised, similarity = normalise(arrays["points"])
    pose = arrays["camera_T_part"].clone()
    pose[..., :3, 3] = GROW * similarity.forward(pose[..., :3, 3])
    part = arrays["part"].long()
    target = Target(
        part=torch.where(part == 255, -1, part),
        pose=pose,
        pivot=GROW * similarity.forward(arrays["joint_pivot"]),
        axis=arrays["joint_axis"],
    )
    answer = perfect(GROW * normalised, target)
    monkeypatch.setattr(method, "answer_all", lambda points: answer)
    prediction = method.predict(Observation(points=arrays["points"]))
    assert prediction.camera_T_part is not None
    assert prediction.joints is not None
    errors = sample_errors(
        part_true=target.part.numpy(),
        camera_T_part_true=arrays["camera_T_part"].numpy(),
        pivot_true=arrays["joint_pivot"].numpy(),
        axis_true=arrays["joint_axis"].numpy(),
        part_pred=prediction.part_weight.numpy(),
        camera_T_part_pred=prediction.camera_T_part.numpy(),
        pivot_pred=prediction.joints.pivot.numpy(),
        axis_pred=prediction.joints.axis.numpy(),
    )
    assert errors.pop("iou").min() == 1
    errors.pop("order")
    assert max(value.max() for value in errors.values()) < 1e-2  # degrees and metres
    assert_close(prediction.joints.state, arrays["joint_state"], atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_a_prediction_goes_over_all_points_in_thin_clouds(name: str) -> None:
    observation, _ = plates(2, 50)
    method = lean(name, points=20).eval()
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
    [("pointnet2", "votes", 100), ("pointnet2", "pooled", 100), ("gcn3d", "votes", 150)],
)
def test_one_batch_is_learned_by_heart(name: str, pose: str, steps: int) -> None:
    """From its own objective to the benchmark's errors of the same clouds."""
    data = tiny_data(4, points=48)
    method = lean(name, pose=pose)
    optimizer = torch.optim.Adam(method.parameters())
    first = None
    for number in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 1e-2 * (1 - number / steps)
        optimizer.zero_grad()
        terms = method.losses(data.observation, data.labels, a_step(number))
        total = torch.stack(list(terms.values())).sum()
        first = total.item() if first is None else first
        total.backward()
        optimizer.step()
    assert first is not None
    assert total.item() < first / 5
    errors = errors_of(method.eval(), data.observation, data.labels)
    assert errors["iou"].mean() > 0.95
    assert errors["part_rotation"].mean() < 7
    assert errors["joint_direction"].mean() < 7
    assert errors["part_translation"].mean() < 0.07
    assert errors["joint_pivot"].mean() < 0.05


def errors_of(
    method: SupervisedMethod, observation: Observation, labels: Labels
) -> dict[str, np.ndarray]:
    target, _ = target_of(observation, labels)
    prediction = method.predict(observation)
    assert prediction.camera_T_part is not None
    assert prediction.joints is not None
    return sample_errors(
        part_true=target.part.numpy(),
        camera_T_part_true=target.pose.numpy(),
        pivot_true=target.pivot.numpy(),
        axis_true=target.axis.numpy(),
        part_pred=prediction.part_weight.numpy(),
        camera_T_part_pred=prediction.camera_T_part.numpy(),
        pivot_pred=prediction.joints.pivot.numpy(),
        axis_pred=prediction.joints.axis.numpy(),
        symmetry=np.array(method.category.symmetry),
    )


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
def test_states_are_never_looked_at(name: str) -> None:
    """The one label that no supervision names apart: training is the same without it."""
    observation, labels = plates(6, 50)
    assert labels.joints is not None
    unknown = replace(labels, joints=replace(labels.joints, state=torch.full((6, 1), torch.nan)))
    one, two = (lean(name).losses(observation, some, a_step()) for some in (labels, unknown))
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
