# SPDX-License-Identifier: MIT
"""What the reader decided about a model: which joint it took, what it put right, which size it set.

A reader that takes any model makes an oven of a cart as soon as the cart has a hinge. So a model
must speak of the category, in its links' or joints' names or in its semantics, or be taken on the
user's word.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from scapo.categories import Category
from sim_assets.models.joints import Reduction, words
from sim_assets.models.robot import Robot
from sim_assets.models.sources import Traits
from sim_assets.models.validate import AssetError, refuse
from sim_assets.objects import Account, ArticulatedObject

SHOWN = 6
"""Names that a message lists."""


def account(
    robot: Robot,
    known: Traits,
    reduction: Reduction,
    category: Category,
    sides: Float[np.ndarray, " 3"],
    ratio: float,
) -> Account:
    """Of a model that was read.

    Args:
        robot: The model.
        known: What its set says of it.
        reduction: Which joints were taken.
        category: Of which it is an object now.
        sides: Of the box at rest, m.
        ratio: Metres per unit of the model.
    """
    return Account(
        joints=tuple(
            f"{joint.name} ({_called(known, joint.parent if flipped else joint.child)})"
            for joint, flipped in zip(reduction.joints, reduction.inverted, strict=True)
        ),
        size=_size(category, sides, ratio),
        names=tuple(dict.fromkeys(_called(known, name) for name in robot.links)),
        speaks=bool(spoken(robot, known) & own_words(category)),
    )


def own_words(category: Category) -> set[str]:
    """Words that speak of a category: its name, and what its moving parts are called."""
    return set(category.words) | words(category.name)


def spoken(robot: Robot, known: Traits) -> set[str]:
    """All words of a model: of its own name, its links, joints and semantics."""
    return words(robot.name, *robot.links, *robot.joints, *known.labels.values())


def check_speaks(path: Path, thing: ArticulatedObject) -> None:
    """Refuse a model none of whose names speaks of its category.

    Args:
        path: Named in the error.
        thing: The object that was read from it.

    Raises:
        AssetError: It does not.
    """
    told = thing.origin.account
    if told is None or told.speaks:
        return
    wanted = ", ".join(sorted(own_words(thing.category)))
    found = ", ".join(told.names[:SHOWN])
    expected = f"a link, joint or semantics that speaks of the category {thing.category.name!r}"
    error = refuse(path, f"{expected} ({wanted})", found)
    raise AssetError(path, f"{error.words} (--any-model takes it all the same)")


def sentences(thing: ArticulatedObject) -> tuple[str, ...]:
    """The account in words, with the repairs; none of an object that was not read."""
    told = thing.origin.account
    if told is None:
        return ()
    plural = "s" if len(told.joints) > 1 else ""
    taken = f"joint{plural} {', '.join(told.joints)}"
    return (taken, f"size {told.size}", *(f"repaired: {text}" for text in thing.origin.repairs))


def _called(known: Traits, link: str) -> str:
    """What a link is: its name, and what the semantics call it."""
    meaning = known.labels.get(link, link)
    return link if meaning == link else f"{link}: {meaning}"


def _size(category: Category, sides: Float[np.ndarray, " 3"], ratio: float) -> str:
    box = " x ".join(f"{side:.3g}" for side in sides)
    if ratio == 1:
        return f"{box} m, as given"
    nominal = np.isclose(np.linalg.norm(sides), category.diagonal, rtol=1e-6)
    why = f", the category's nominal diagonal of {category.diagonal:g} m" if nominal else ""
    return f"{box} m, {ratio:.4g} m a unit{why}"
