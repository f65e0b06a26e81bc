# SPDX-License-Identifier: MIT
"""Procedural articulated objects: one module per category, one function to make an instance.

`generate` is a pure function of its arguments. Training, validation and test shapes come from one
distribution and never coincide. Of the `test-ood` shapes those with an even index have a
combination of details that training never shows and half of their proportions, the main ones among
them, outside the training ranges; those with an odd index are drawn as for training and
rearranged, in turn by each of the recipe's traits. `ArticulatedObject.trait` says which.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from typing import Any

import numpy as np

from scapo.text import did_you_mean
from sim_assets.objects import ArticulatedObject
from sim_assets.procedural import (
    basket,
    drawer,
    eyeglasses,
    laptop,
    oven,
    safe,
    scissors,
    suitcase,
    washer,
)
from sim_assets.procedural.assembly import VERSION, Recipe, assemble, digest
from sim_assets.procedural.parameters import PROPORTIONS, draw

SPLITS = ("train", "val", "test", "test-ood")


RECIPES: dict[str, Recipe] = {
    "laptop": laptop.RECIPE,
    "safe": safe.RECIPE,
    "oven": oven.RECIPE,
    "washer": washer.RECIPE,
    "drawer": drawer.RECIPE,
    "suitcase": suitcase.RECIPE,
    "scissors": scissors.RECIPE,
    "eyeglasses": eyeglasses.RECIPE,
    "basket": basket.RECIPE,
}


def recipe(category: str) -> Recipe:
    """The recipe of a category.

    Raises:
        ValueError: There is none; the message lists those that are.
    """
    if category not in RECIPES:
        raise ValueError(
            f"category {category!r}: expected one of {', '.join(RECIPES)}, which have a generator, "
            f"or models of it (generate --source FOLDER){did_you_mean(category, RECIPES)}"
        )
    return RECIPES[category]


def _generator(*key: object) -> np.random.Generator:
    """A generator seeded by a SHA-256 of the key: equal keys, equal numbers, on every machine."""
    text = json.dumps([VERSION, *key])
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest(), "little")
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))


def draw_shape(category: str, split: str, seed: int, index: int) -> Any:  # noqa: ANN401
    """The parameters of an instance, a dataclass of the category's own."""
    made = recipe(category)
    if split not in SPLITS:
        raise ValueError(f"split {split!r}: expected one of {', '.join(SPLITS)}")
    rng = _generator(category, split, int(seed), int(index))
    trait = trait_of(category, split, index)
    drawn = draw(
        made.shape, rng, held_out=made.held_out, unseen=trait == PROPORTIONS, main=made.main
    )
    return replace(drawn, trait=trait)


def trait_of(category: str, split: str, index: int) -> str:
    """What sets an instance apart from the training shapes: in `test-ood` by turns."""
    if split != "test-ood":
        return ""
    others = recipe(category).rearranged
    return others[index // 2 % len(others)] if index % 2 else PROPORTIONS


def generate(category: str, split: str, seed: int, index: int) -> ArticulatedObject:
    """One instance, `<category>-<split>-<seed>-<index>`, a pure function of the arguments.

    Args:
        category: One of `RECIPES`.
        split: train, val, test or test-ood.
        seed: Of the data set, >= 0.
        index: Within the split, >= 0.

    Raises:
        ValueError: Unknown category or split, or a negative number.
    """
    if seed < 0 or index < 0:
        raise ValueError(f"seed and index: expected numbers >= 0, found {seed} and {index}")
    shape = draw_shape(category, split, seed, index)
    return assemble(
        category,
        f"{category}-{split}-{seed}-{index:05d}",
        recipe(category).build(shape),
        f"procedural/{category}/{split}/{seed}/{index}",
        digest(shape),
        shape.trait,
    )
