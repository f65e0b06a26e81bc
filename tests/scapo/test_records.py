# SPDX-License-Identifier: MIT
"""Records are changed, picked and joined tensor by tensor, as if written out by hand."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
import torch
from torch import nn

from scapo.records import cat, map_tensors, pack, take, unpack, without_autograd
from scapo.types import Joints, Labels, Observation, Prediction


def labels(first: int, count: int) -> Labels:
    number = torch.arange(first, first + count, dtype=torch.float32)
    line = number[:, None, None].expand(count, 2, 3)
    joints = Joints(pivot=line + 0.5, axis=line, state=number[:, None].expand(count, 2))
    return Labels(part=torch.arange(count * 4).view(count, 4) + first, joints=joints)


def test_nested_records_are_followed_and_what_is_withheld_stays_so() -> None:
    changed = map_tensors(labels(0, 3), lambda tensor: tensor * 2)
    assert changed.joints is not None
    assert changed.part is not None
    assert torch.equal(changed.part, torch.arange(12).view(3, 4) * 2)
    assert torch.equal(changed.joints.pivot[2], torch.full((2, 3), 5.0))
    assert changed.camera_T_part is None
    assert map_tensors(Labels(), lambda tensor: tensor + 1) == Labels()


def test_autograd_goes_on_with_what_was_made_without_it() -> None:
    weight = torch.ones(2, 5, 3, requires_grad=True)

    @without_autograd
    def doubled(given: torch.Tensor) -> Prediction:
        assert torch.is_inference_mode_enabled()
        return Prediction(part_weight=2 * given)

    made = doubled(weight).part_weight
    assert not made.requires_grad
    assert not made.is_inference()
    (made * weight).sum().backward()  # saved for the backward pass
    assert weight.grad is not None
    assert torch.equal(weight.grad, torch.full_like(weight, 2.0))


def test_mappings_and_tuples_are_followed() -> None:
    weight = torch.ones(2, 5, 3)
    prediction = Prediction(part_weight=weight, record={"S": torch.zeros(2, 1)})
    changed = map_tensors((prediction, "word", 3), lambda tensor: tensor - 1)
    assert changed[1:] == ("word", 3)
    assert torch.equal(changed[0].part_weight, weight * 0)
    assert changed[0].record is not None
    assert torch.equal(changed[0].record["S"], -torch.ones(2, 1))


def test_take_and_cat_are_inverse() -> None:
    whole = labels(0, 5)
    again = cat([take(whole, torch.tensor([0, 1])), take(whole, torch.tensor([2, 3, 4]))])
    assert whole.joints is not None
    assert again.joints is not None
    assert torch.equal(again.joints.state, whole.joints.state)
    assert again.part is not None
    assert whole.part is not None
    assert torch.equal(again.part, whole.part)
    some = take(whole, torch.tensor([True, False, False, False, True]))
    assert some.part is not None
    assert some.part[:, 0].tolist() == [0, 16]


def test_records_that_do_not_fit_are_not_joined() -> None:
    points = torch.zeros(1, 2, 3)
    with pytest.raises(ValueError, match="expected the same fields in all, found NoneType and Ten"):
        cat([Observation(points=points), Observation(points=points, color=points)])
    with pytest.raises(ValueError, match="expected one or more to join, found none"):
        cat([])


MAKERS = {"Labels": Labels, "Joints": Joints, "Linear": lambda **state: linear(state)}


def linear(state: dict[str, torch.Tensor]) -> nn.Linear:
    made = nn.Linear(2, 3)
    made.load_state_dict(state)
    return made


def through_json(record: object) -> Any:
    """The record as it comes back from a file."""
    tree, tensors = pack(record, MAKERS)
    assert all(flat.ndim == 1 for flat in tensors.values())
    return unpack(json.loads(json.dumps(tree)), tensors, MAKERS)


def test_a_packed_record_comes_back() -> None:
    module, some = nn.Linear(2, 3), labels(0, 3)
    found = through_json([(some, module), 0.1, math.inf, 7, True, None, "word", []])
    assert found[1:] == [0.1, math.inf, 7, True, None, "word", []]
    (one, other) = found[0]
    assert type(found[0]) is tuple
    assert torch.equal(other.weight, module.weight)
    assert one.camera_T_part is None
    assert some.part is not None
    assert some.joints is not None
    assert torch.equal(one.part, some.part)
    assert one.part.dtype == torch.int64
    assert torch.equal(one.joints.axis, some.joints.axis)


@pytest.mark.parametrize(
    "tensor",
    [
        torch.arange(12.0).view(3, 4).mT,
        torch.arange(24.0).view(2, 3, 4)[:, 1:, ::2],
        torch.arange(3.0)[:, None].expand(3, 5),
        torch.zeros(0, 3),
        torch.tensor(2.0),
        torch.tensor([True, False]),
        torch.nn.Parameter(torch.ones(2)),
    ],
)
def test_a_packed_tensor_keeps_values_and_strides(tensor: torch.Tensor) -> None:
    found = through_json(tensor)
    assert torch.equal(found, tensor)
    assert found.dtype == tensor.dtype
    assert found.stride() == tensor.stride()
    assert not found.requires_grad


def test_what_cannot_be_made_again_is_not_packed_nor_made() -> None:
    with pytest.raises(TypeError, match="can be made again, found Observation"):
        pack([Observation(points=torch.zeros(1, 3))], MAKERS)
    tree, tensors = pack(labels(0, 3), MAKERS)
    with pytest.raises(LookupError, match="Joints"):
        unpack(tree, tensors, {"Labels": Labels})
    name = tree["fields"]["part"]["tensor"]
    with pytest.raises(LookupError, match=name):
        unpack(tree, {}, MAKERS)
    with pytest.raises(ValueError, match=r"expected a tensor of size \[3, 4\], found \(5,\)"):
        unpack(tree, {**tensors, name: torch.zeros(5)}, MAKERS)
