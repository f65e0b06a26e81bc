# SPDX-License-Identifier: MIT
"""The records: frozen, slotted, checked for shape in tests; labels hidden unless declared."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, is_dataclass
from itertools import combinations
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from jaxtyping import TypeCheckError

from scapo import categories, types
from scapo.types import Joints, Labels, Observation, Prediction, Sample, SampleKey, Supervision
from tests.helpers.strategies import batch_shapes, joints, normal, rigid_motions, seeds

RECORDS = [
    value
    for module in (types, categories)
    for value in vars(module).values()
    if isinstance(value, type) and is_dataclass(value) and value.__module__ == module.__name__
]


def make_joints(seed: int, *shape: int) -> Joints:
    pivot, axis, state = joints(seed, *shape)
    return Joints(pivot=pivot, axis=axis, state=state)


def make_labels(seed: int, *shape: int) -> Labels:
    """Of 7 points, 3 parts, 2 joints."""
    return Labels(
        part=torch.zeros(*shape, 7, dtype=torch.long),
        camera_T_part=rigid_motions(seed, *shape, 3),
        joints=make_joints(seed, *shape, 2),
        instance=torch.zeros(shape, dtype=torch.long),
    )


@pytest.mark.parametrize("record", RECORDS)
def test_records_are_frozen_slotted_and_made_by_keyword(record: Any) -> None:
    assert record.__dataclass_params__.frozen
    assert "__slots__" in vars(record)
    assert all(field.kw_only for field in fields(record))
    assert record.__doc__


def test_there_are_records() -> None:
    names = {record.__name__ for record in RECORDS}
    assert {"Category", "Joints", "Labels", "Observation", "Prediction", "Sample"} <= names


def test_a_field_cannot_be_set() -> None:
    observation = Observation(points=torch.zeros(5, 3))
    with pytest.raises(FrozenInstanceError):
        observation.points = torch.zeros(4, 3)  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises((AttributeError, TypeError)):
        observation.extra = 1  # pyright: ignore[reportAttributeAccessIssue]


FIELD_OF: dict[Supervision, str] = {
    "segmentation": "part",
    "pose": "camera_T_part",
    "joint": "joints",
    "instance": "instance",
}
SUBSETS = [frozenset(some) for n in range(5) for some in combinations(FIELD_OF, n)]


@pytest.mark.parametrize("supervision", SUBSETS, ids=sorted)
def test_keep_hides_all_that_is_not_declared(supervision: frozenset[Supervision]) -> None:
    labels = make_labels(0, 2)
    kept = labels.keep(supervision)
    shown = {FIELD_OF[name] for name in supervision}
    assert {field.name for field in fields(Labels)} == set(FIELD_OF.values())
    for field in fields(Labels):
        value = getattr(kept, field.name)
        assert value is (getattr(labels, field.name) if field.name in shown else None)


def test_keep_of_withheld_labels_stays_withheld() -> None:
    everything: frozenset[Supervision] = frozenset(FIELD_OF)
    assert Labels().keep(everything) == Labels()


@settings(max_examples=10, deadline=None)
@given(seed=seeds, shape=batch_shapes)
def test_every_batch_shape_fits(seed: int, shape: tuple[int, ...]) -> None:
    points = normal(seed, *shape, 7, 3)
    assert Observation(points=points, color=points.abs()).points is points
    labels = make_labels(seed, *shape)
    weight = normal(seed, *shape, 7, 3).softmax(-1)
    found = Prediction(
        part_weight=weight,
        camera_T_part=labels.camera_T_part,
        joints=labels.joints,
        canonical_points=normal(seed, *shape, 20, 3),
        confidence=normal(seed, *shape),
    )
    assert found.part_weight is weight


BAD: dict[str, tuple[type, dict[str, torch.Tensor]]] = {
    "rows of two": (Observation, {"points": torch.zeros(5, 2)}),
    "columns": (Observation, {"points": torch.zeros(3, 5)}),
    "a vector": (Observation, {"points": torch.zeros(3)}),
    "integers": (Observation, {"points": torch.zeros(5, 3, dtype=torch.long)}),
    "fewer colours": (Observation, {"points": torch.zeros(5, 3), "color": torch.zeros(4, 3)}),
    "other batch": (Observation, {"points": torch.zeros(2, 5, 3), "color": torch.zeros(5, 3)}),
    "fewer states": (
        Joints,
        {"pivot": torch.zeros(2, 3), "axis": torch.zeros(2, 3), "state": torch.zeros(1)},
    ),
    "fewer axes": (
        Joints,
        {"pivot": torch.zeros(2, 3), "axis": torch.zeros(1, 3), "state": torch.zeros(2)},
    ),
    "part as float": (Labels, {"part": torch.zeros(5)}),
    "3x4 poses": (Labels, {"camera_T_part": torch.zeros(2, 3, 4)}),
    "labels of other batches": (
        Labels,
        {"part": torch.zeros(2, 5, dtype=torch.long), "camera_T_part": torch.zeros(3, 2, 4, 4)},
    ),
    "weights of other parts": (
        Prediction,
        {"part_weight": torch.zeros(5, 3), "camera_T_part": torch.zeros(2, 4, 4)},
    ),
    "no points": (Observation, {}),
}


@pytest.mark.usefixtures("shapes_checked")
@pytest.mark.parametrize("kind", BAD)
def test_wrong_shapes_and_types_raise_in_tests(kind: str) -> None:
    record, values = BAD[kind]
    with pytest.raises((TypeCheckError, TypeError)) as caught:
        record(**values)
    assert isinstance(caught.value, TypeCheckError) or kind == "no points"


@pytest.mark.usefixtures("shapes_checked")
@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_sample_joins_the_records(count: int) -> None:
    sample = Sample(
        key=SampleKey(category="oven", split="train", index=count, instance="a"),
        observation=Observation(points=torch.zeros(7, 3)),
        labels=make_labels(count),
        visible=torch.ones(3),
        camera=torch.ones(6),
    )
    assert sample.key.index == count
    with pytest.raises(TypeCheckError):
        Sample(
            key=sample.key,
            observation=sample.observation,
            labels=sample.labels,
            visible=torch.ones(1, 3),
            camera=torch.ones(6),
        )


def test_records_of_equal_values_are_equal_and_hashable() -> None:
    first, second = (SampleKey(category="a", split="b", index=1, instance="c") for _ in range(2))
    assert first == second
    assert len({first, second}) == 1
