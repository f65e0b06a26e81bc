# SPDX-License-Identifier: MIT
"""A contact sheet of a data set: clouds as the camera sees them, coloured by part, with axes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from scapo.drawing import PART_COLORS, draw_axis, draw_cloud
from scapo.store import Split, StoreError, write_bytes
from scapo.store.manifest import Manifest
from scapo.store.schema import UNLABELLED
from scapo.text import one_line
from sim_assets.describe.info import describe_state, find_splits

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 6
TILE = 2.1
"""Inches."""
DPI = 150
PAPER, INK, FAINT = "#ffffff", "#222222", "#777777"
AXIS = "#111111"
LONGEST_NAME = 40
LETTERS = {chr(c) for c in (*range(32, 127), *range(161, 0x250), *range(0x370, 0x530))} | {"–"}
"""Latin, Greek and Cyrillic, which matplotlib's own font draws."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tile:
    """One sample to draw."""

    manifest: Manifest
    number: int
    instance: str
    points: Float[np.ndarray, "N 3"]
    part: UInt8[np.ndarray, " N"]
    pivot: Float[np.ndarray, "J 3"]
    axis: Float[np.ndarray, "J 3"]
    state: Float[np.ndarray, " J"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Samples under one heading."""

    title: str
    tiles: list[Tile]


def draw_preview(
    path: Path,
    out: Path,
    count: int,
    category: str | None = None,
    split: str | None = None,
    *,
    by_ambiguity: bool = False,
) -> int:
    """Draw `count` samples of each split at `path` or below it into one PNG.

    Args:
        path: A data set, or a category or split of one.
        out: File to write, `.png`.
        count: Samples per split, spread evenly.
        category: Only this one.
        split: Only this one.
        by_ambiguity: Half of them such that look alike under other turns, and half that do not,
            apart, as far as there are such.

    Returns:
        How many were drawn.

    Raises:
        StoreError: There is no such data set, or a shard is broken.
        ValueError: `out` is no .png file, or `count` is below 1.
    """
    if out.suffix.lower() != ".png":
        raise ValueError(f"{out}: expected a file name that ends in .png")
    if count < 1:
        raise ValueError(f"count: expected 1 or more, found {count}")
    splits = [Split(folder) for folder in find_splits(path)]
    chosen = [
        data
        for data in splits
        if category in (None, data.manifest.category) and split in (None, data.manifest.split)
    ]
    if not chosen:
        raise StoreError(f"{path}: expected {category or '*'}/{split or '*'}, found none")
    blocks = [block for data in chosen for block in _blocks(data, count, by_ambiguity)]
    write_bytes(out, _picture(blocks))
    return sum(len(block.tiles) for block in blocks)


def _blocks(split: Split, count: int, by_ambiguity: bool) -> Iterator[Block]:
    """The samples of a split, all together or those that look alike under other turns first."""
    every = np.arange(split.manifest.count)
    title = _plain(f"{split.manifest.category}  {split.manifest.split}")
    if not by_ambiguity:
        yield Block(title=title, tiles=list(_tiles(split, _spread(every, count))))
        return
    several = (split.arrays("alike")["alike"] == 1).sum(1) > 1
    for name, members in (("ambiguous", every[several]), ("not ambiguous", every[~several])):
        if len(members):
            heading = f"{title}, {name}: {len(members)} of {len(every)}"
            chosen = _spread(members, max(1, count // 2))
            yield Block(title=heading, tiles=list(_tiles(split, chosen)))


def _spread(numbers: Int[np.ndarray, " S"], count: int) -> Int[np.ndarray, " _"]:
    """`count` of them or all, evenly."""
    places = np.linspace(0, len(numbers) - 1, min(count, len(numbers)))
    return numbers[np.unique(places.round().astype(int))]


def _tiles(split: Split, numbers: Int[np.ndarray, " K"]) -> Iterator[Tile]:
    manifest = split.manifest
    names = ("points", "part", "joint_pivot", "joint_axis", "joint_state", "instance")
    data = split.arrays(*names)
    for i in numbers:
        yield Tile(
            manifest=manifest,
            number=int(i),
            instance=manifest.instances[int(data["instance"][i])].id,
            points=data["points"][i],
            part=data["part"][i],
            pivot=data["joint_pivot"][i],
            axis=data["joint_axis"][i],
            state=data["joint_state"][i],
        )


def _picture(blocks: list[Block]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(COLUMNS, max(len(block.tiles) for block in blocks))
    rows = [math.ceil(len(block.tiles) / columns) for block in blocks]
    heading = 0.5
    height = sum(rows) * TILE + len(blocks) * heading + 0.1
    figure = Figure(figsize=(max(columns, 3) * TILE, height), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    top = 1.0
    for block, count in zip(blocks, rows, strict=True):
        _heading(figure, block.title, block.tiles[0].manifest, top, height)
        top -= heading / height
        for k, tile in enumerate(block.tiles):
            row, column = divmod(k, columns)
            width, tall = 1 / max(columns, 3), TILE / height
            box = (column * width, top - (row + 1) * tall, width, tall)
            _draw(figure.add_axes(box), tile)
        top -= count * TILE / height
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _heading(figure, title: str, manifest: Manifest, top: float, height: float) -> None:  # noqa: ANN001
    x, y = 0.012, top - 0.3 / height
    style = {"color": INK, "fontsize": 11, "weight": "bold"}
    words = [figure.text(x, y, title, parse_math=False, **style)]
    for p, name in enumerate(manifest.parts):
        x += (words[-1].get_window_extent().width + 0.15 * DPI) / figure.bbox.width
        color = PART_COLORS[p % len(PART_COLORS)]
        label = f"● {_plain(name)}"
        words.append(figure.text(x, y, label, parse_math=False, fontsize=9, color=color))


def _plain(name: str) -> str:
    """A name from a file, short and in letters that the font has."""
    return "".join(c if c in LETTERS else "?" for c in one_line(name, LONGEST_NAME))


def _draw(axes: Axes, tile: Tile) -> None:
    part = np.where(tile.part == UNLABELLED, -1, tile.part.astype(int))
    draw_cloud(axes, tile.points, part, size=3.0)
    for pivot, axis in zip(tile.pivot, tile.axis, strict=True):
        draw_axis(axes, tile.points, pivot, axis, color=AXIS)
    states = [
        describe_state(float(state), joint.kind)
        for joint, state in zip(tile.manifest.joints, tile.state, strict=True)
    ]
    axes.text(0.04, 0.03, f"{tile.number}", transform=axes.transAxes, fontsize=6, color=FAINT)
    axes.text(
        0.96, 0.03, "  ".join(states), transform=axes.transAxes, fontsize=6, color=FAINT, ha="right"
    )
