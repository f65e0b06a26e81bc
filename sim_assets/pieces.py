# SPDX-License-Identifier: MIT
"""The views of the objects of a shard: one object after the other, or several at once."""

from __future__ import annotations

from collections.abc import Sequence

from scapo.jobs import Report
from sim_assets.articulated import ArticulatedObject
from sim_assets.plan import Piece, Request
from sim_assets.renderer import AbstractParallelRenderer, AbstractRenderer
from sim_assets.samples import Shooter, Shot
from sim_assets.together import Take, divide, shoot_together

REPORT_EVERY = 8
"""Shots between two signs of life: each crosses to the parent process."""
TOGETHER = "several objects at once"
"""What a worker reports that shows them."""


def shoot_piece(
    request: Request, piece: Piece, renderer: AbstractRenderer | None, report: Report
) -> list[Shot]:
    """Views of one object.

    Raises:
        ValueError: The object is no longer the one that was planned.
        ViewError: It cannot be shown as asked.
        RenderError: The renderer failed.
    """
    settings = request.settings
    name = piece.entry.instance.id
    shooter = Shooter(renderer, load(piece, report), settings)
    shots, told = [], 0
    for shot in shooter.shots(_keys(request, piece)):
        shots.append(shot)
        if len(shots) - told >= REPORT_EVERY or len(shots) == piece.views:
            report(name, (len(shots) - told) * settings.states_per_view)
            told = len(shots)
    return shots


def shoot_pieces(
    request: Request, pieces: Sequence[Piece], renderer: AbstractParallelRenderer, report: Report
) -> dict[int, list[Shot] | Exception]:
    """Views of several objects at once, by the piece's index.

    Those that are not in the answer were not shown because the renderer failed: they may be tried
    one by one.
    """
    made: dict[int, list[Shot] | Exception] = {}
    shown: list[tuple[Piece, Shooter]] = []
    for piece in pieces:
        thing = _try_load(piece, report)
        if isinstance(thing, Exception):
            made[piece.index] = thing
        else:
            shown.append((piece, Shooter(None, thing, request.settings)))
    if not shown:
        return made
    label = TOGETHER if len(shown) > 1 else shown[0][0].entry.instance.id
    told = 0

    def heard(take: Take) -> None:
        nonlocal told
        amount = len(take.shots) * request.settings.states_per_view
        told += amount
        report(label, amount)

    report(label, 0)
    groups = divide([(shooter, _keys(request, p)) for p, shooter in shown], renderer.places)
    try:
        shoot_together(renderer, [take for group in groups for take in group], heard)
    except Exception:
        if len(shown) == 1:
            raise
        report(label, -told)
        return made
    for (piece, _), group in zip(shown, groups, strict=True):
        errors = [take.error for take in group if take.error is not None]
        made[piece.index] = errors[0] if errors else [shot for take in group for shot in take.shots]
    return made


def _try_load(piece: Piece, report: Report) -> ArticulatedObject | Exception:
    try:
        return load(piece, report)
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this object only
        return error


def load(piece: Piece, report: Report) -> ArticulatedObject:
    """The object of a piece.

    Raises:
        ValueError: It is no longer the one that was planned.
    """
    name = piece.entry.instance.id
    report(name, 0)
    thing = piece.entry.asset.load()
    if thing.origin.sha256 != piece.entry.instance.sha256:
        raise ValueError(
            f"{name}: expected files with sha256 {piece.entry.instance.sha256}, found "
            f"{thing.origin.sha256}: they have changed since this data set was begun"
        )
    return thing


def _keys(request: Request, piece: Piece) -> list[tuple[object, ...]]:
    return [request.key(view) for view in range(piece.first, piece.first + piece.views)]
