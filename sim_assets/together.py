# SPDX-License-Identifier: MIT
"""Samples of several objects at once, with a renderer that shows them all in one picture-taking.

Each take makes some views of one object, in a place of its own. In every round each take says which
picture it needs next, all are drawn together, and each take goes on with its own. Samples are those
that the object gives alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from sim_assets.renderer import AbstractParallelRenderer, Ask, Frame, RenderError
from sim_assets.samples import BATCH, Shooter, Shot, Steps

Key = tuple[object, ...]


@dataclass(slots=True, kw_only=True, eq=False)
class Take:
    """Views of one object that are made one after the other."""

    shooter: Shooter
    """Without a renderer."""
    keys: Sequence[Key]
    shots: list[Shot] = field(default_factory=list)
    """Of the keys, once done."""
    error: Exception | None = None
    """Why it failed."""


def divide(shooters: Sequence[tuple[Shooter, Sequence[Key]]], places: int) -> list[list[Take]]:
    """The views of each object as takes of equal length, about as many as there are places."""
    total = sum(len(keys) for _, keys in shooters)
    length = min(BATCH, max(1, math.ceil(total / places)))
    return [
        [
            Take(shooter=shooter, keys=keys[start : start + length])
            for start in range(0, len(keys), length)
        ]
        for shooter, keys in shooters
    ]


def shoot_together(
    renderer: AbstractParallelRenderer,
    takes: Sequence[Take],
    heard: Callable[[Take], None],
) -> None:
    """Do the takes; each ends with its shots or with an error, which costs that take only.

    Args:
        renderer: Shows the objects of all takes, as many at once as it has places.
        takes: To be done, in place.
        heard: Called with each take that has ended, and with one that has not in each round.

    Raises:
        RenderError: The objects cannot be shown, or the device failed.
    """
    for start in range(0, len(takes), renderer.places):
        _shoot_all(renderer, takes[start : start + renderer.places], heard)


def _shoot_all(
    renderer: AbstractParallelRenderer, takes: Sequence[Take], heard: Callable[[Take], None]
) -> None:
    renderer.open_all([take.shooter.thing for take in takes])
    steps = [take.shooter.steps(take.keys) for take in takes]
    asked = [_advance(take, step, None) for take, step in zip(takes, steps, strict=True)]
    while any(asks is not None for asks in asked):
        pictures = _render(renderer, asked)
        for k, (take, step) in enumerate(zip(takes, steps, strict=True)):
            if asked[k] is not None:
                asked[k] = _advance(take, step, pictures[k])
                if asked[k] is None:
                    heard(take)
        waiting = [take for take, asks in zip(takes, asked, strict=True) if asks is not None]
        if waiting:
            heard(waiting[0])


def _advance(take: Take, steps: Steps[list[Shot]], frames: list[Frame] | None) -> list[Ask] | None:
    """What the take needs next; None when it has ended."""
    try:
        return next(steps) if frames is None else steps.send(frames)
    except StopIteration as end:
        take.shots = end.value
    except RenderError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this take only
        take.error = error
    return None


def _render(
    renderer: AbstractParallelRenderer, asked: Sequence[list[Ask] | None]
) -> list[list[Frame]]:
    """The pictures that each take asked for: the first of each together, then the second, ..."""
    pictures: list[list[Frame]] = [[] for _ in asked]
    for number in range(max(len(asks) for asks in asked if asks is not None)):
        frames = renderer.render_all(
            [asks[number] if asks is not None and number < len(asks) else None for asks in asked]
        )
        for k, frame in enumerate(frames):
            if frame is not None:
                pictures[k].append(frame)
    return pictures
