# SPDX-License-Identifier: MIT
"""Labels of points, how they overlap, and the order of parts chosen from them (PROTOCOL 1.2)."""

from __future__ import annotations

from itertools import permutations
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num

LabelOrder = Literal["sample", "dataset", "hungarian"]


def part_orders(parts: int) -> np.ndarray:
    """The orders tried by rule, (O, P), identity first: `order[p]` is the true part of slot p.

    Two parts: identity and swap. More: the base stays, so three parts have identity and the swap
    of parts 1 and 2 (PROTOCOL 1.2).
    """
    if parts == 2:
        return np.array([[0, 1], [1, 0]])
    return np.array([(0, *rest) for rest in permutations(range(1, parts))])


def hard_labels(part: Num[np.ndarray, "B N *P"]) -> Int[np.ndarray, "B N"]:
    """Labels of weights (B, N, P) by argmax, ties to the lower index; labels (B, N) unchanged.

    A point whose weights are not all numbers is -1: it has no answer.
    """
    if part.ndim == 2:
        return part.astype(np.int64, copy=False)
    part = part.astype(np.float32, copy=False) if part.dtype == np.float16 else part
    best = part[..., 0]
    label = np.zeros(best.shape, np.int64)
    undefined = np.isnan(best)
    for index in range(1, part.shape[-1]):  # argmax over a short last axis is slow in numpy
        larger = part[..., index] > best
        label[larger] = index
        best = np.where(larger, part[..., index], best)
        undefined |= np.isnan(part[..., index])
    label[undefined] = -1
    return label


def confusion(
    part_true: Int[np.ndarray, "B N"], label: Int[np.ndarray, "B N"], parts: int
) -> Int[np.ndarray, "B P P"]:
    """Points of true part t in predicted slot q, (B, P, P), and answers outside 0..P-1 dropped.

    Points with a negative true label are ignored.
    """
    batch = np.arange(len(part_true))[:, None] * parts
    inside = (part_true >= 0) & (part_true < parts) & (label >= 0) & (label < parts)
    index = ((batch + part_true) * parts + label)[inside]
    counts = np.bincount(index, minlength=len(part_true) * parts * parts)
    return counts.reshape(-1, parts, parts)


def soft_confusion(
    part_true: Int[np.ndarray, "B N"], weight: Num[np.ndarray, "B N P"]
) -> Float[np.ndarray, "B P P"]:
    """Predicted weight of slot q on the points of true part t, (B, P, P); NaN counts nothing."""
    slots = weight.shape[-1]
    weight = np.nan_to_num(weight.astype(np.float64))
    rows = [np.einsum("bn,bnq->bq", part_true == part, weight) for part in range(slots)]
    return np.stack(rows, 1)


def as_weights(label: Int[np.ndarray, "B N"], parts: int) -> Float[np.ndarray, "B N P"]:
    """One-hot weights; labels outside 0..P-1 have none."""
    return (label[..., None] == np.arange(parts)).astype(np.float64)


def overlap(
    shared: Num[np.ndarray, "B P P"],
    true_count: Num[np.ndarray, "B P"],
    slot_count: Num[np.ndarray, "B P"],
) -> Float[np.ndarray, "B P P"]:
    """IoU of true part t and slot q from their intersection and sizes; 0/0 is NaN."""
    union = true_count[:, :, None] + slot_count[:, None, :] - shared
    return np.divide(shared, union, out=np.full(shared.shape, np.nan), where=union > 0)


def choose_order(
    counts: Int[np.ndarray, "B P P"], rule: LabelOrder, iou: Float[np.ndarray, "B P P"]
) -> Int[np.ndarray, "B P"]:
    """The true part compared with each slot, (B, P).

    `sample`: the order with the most points labelled right, per sample. `dataset`: the same, one
    order for all of the batch, each sample counting alike. `hungarian`: the one-to-one matching
    with the largest sum of `iou`, per sample, over all orders (EAP). Ties go to the identity.
    """
    parts = counts.shape[1]
    if rule == "hungarian":
        orders = np.array(list(permutations(range(parts))))
        score = np.nan_to_num(iou)[:, orders, np.arange(parts)].sum(-1)
        # Equal sums in another order of addition differ in the last digit.
        return orders[(score > score.max(1, keepdims=True) - 1e-9).argmax(1)]
    orders = part_orders(parts)
    if rule == "sample":
        return orders[order_scores(counts, orders).argmax(1)]
    best = accuracies(counts, orders).sum(0).argmax()
    return np.broadcast_to(orders[best], (len(counts), parts)).copy()


def order_scores(
    counts: Int[np.ndarray, "B P P"], orders: Int[np.ndarray, "O P"]
) -> Int[np.ndarray, "B O"]:
    """Points labelled right under each order."""
    return counts[:, orders, np.arange(orders.shape[1])].sum(-1)


def accuracies(
    counts: Int[np.ndarray, "B P P"], orders: Int[np.ndarray, "O P"]
) -> Float[np.ndarray, "B O"]:
    """Share of the answered points labelled right under each order; 0 without an answer."""
    return order_scores(counts, orders) / np.maximum(counts.sum((1, 2)), 1)[:, None]


def joint_order(order: Int[np.ndarray, "B P"]) -> Int[np.ndarray, "B J"]:
    """The true joint compared with predicted joint j, (B, J); -1 where none links those parts.

    Predicted joint j links slots 0 and j+1; a true joint exists between two parts if one of them
    is the base.
    """
    base, child = order[:, :1], order[:, 1:]
    return np.where((base == 0) | (child == 0), np.maximum(base, child) - 1, -1)


def is_swapped(order: Int[np.ndarray, "B P"]) -> Bool[np.ndarray, " B"]:
    """Where the order is the exchange that a category's symmetry rotation belongs to."""
    parts = order.shape[1]
    if parts not in (2, 3):
        return np.zeros(len(order), bool)
    return (order == part_orders(parts)[1]).all(1)
