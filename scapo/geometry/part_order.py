# SPDX-License-Identifier: MIT
"""Which true part a predicted slot stands for: the orders tried by rule, and what labels say.

No method knows in which order a data set lists its parts, so scores and simulations ask the labels.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from jaxtyping import Int, Num


def part_orders(parts: int) -> np.ndarray:
    """The orders tried by rule, (O, P), identity first: `order[p]` is the true part of slot p.

    Two parts: identity and swap. More: the base stays, so three parts have identity and the swap
    of parts 1 and 2 (docs/protocol.md).
    """
    if parts == 2:
        return np.array([[0, 1], [1, 0]])
    return np.array([(0, *rest) for rest in permutations(range(1, parts))])


def order_scores(
    counts: Int[np.ndarray, "B P P"], orders: Int[np.ndarray, "O P"]
) -> Int[np.ndarray, "B O"]:
    """Points labelled right under each order."""
    return counts[:, orders, np.arange(orders.shape[1])].sum(-1)


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


def joint_order(order: Int[np.ndarray, "B P"]) -> Int[np.ndarray, "B J"]:
    """The true joint compared with predicted joint j, (B, J); -1 where none links those parts.

    Predicted joint j links slots 0 and j+1; a true joint exists between two parts if one of them
    is the base.
    """
    base, child = order[:, :1], order[:, 1:]
    return np.where((base == 0) | (child == 0), np.maximum(base, child) - 1, -1)
