# SPDX-License-Identifier: MIT
"""Free parameters of procedural shapes: declared as dataclass fields, drawn from a generator.

A category's shape is a frozen dataclass whose fields are made by `span` (a proportion), `chance`
(a detail that is there or not), `choice` (one of several styles) and `tint` (a colour). `draw`
fills it. Outside the training distribution (`test-ood`) proportions leave their training range, up
to the outer range, and the details take one of the combinations that training never shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

Shape = TypeVar("Shape")
HeldOut = tuple[Mapping[str, object], ...]
"""Detail combinations kept for `test-ood`: a shape is held out if it agrees with one of them."""
Color = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Training range [low, high] inside the outer range [least, most]."""

    low: float
    high: float
    least: float
    most: float

    def inside(self, rng: np.random.Generator) -> float:
        """Uniform in the training range."""
        return float(rng.uniform(self.low, self.high))

    def outside(self, rng: np.random.Generator) -> float:
        """Uniform in the outer range less the training range."""
        below, above = self.low - self.least, self.most - self.high
        offset = float(rng.uniform(0.0, below + above))
        return self.least + offset if offset < below else self.high + offset - below


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """One of several values, equally likely unless weighted."""

    values: tuple[Any, ...]
    weights: tuple[float, ...]


def span(low: float, high: float, least: float, most: float) -> Any:  # noqa: ANN401
    """A proportion or length: training range [low, high], outer range [least, most]."""
    if not least <= low < high <= most:
        raise ValueError(f"span: expected least <= low < high <= most, {least, low, high, most}")
    return field(metadata={"draw": Span(low=low, high=high, least=least, most=most)})


def chance(probability: float) -> Any:  # noqa: ANN401
    """A detail that is there with this probability."""
    return field(
        metadata={"draw": Options(values=(True, False), weights=(probability, 1 - probability))}
    )


def choice(*values: object) -> Any:  # noqa: ANN401
    """One of several styles or counts, equally likely."""
    weights = (1 / len(values),) * len(values)
    return field(metadata={"draw": Options(values=values, weights=weights)})


def tint(*palette: Color) -> Any:  # noqa: ANN401
    """A colour of the palette, each channel varied by up to 0.05."""
    return field(metadata={"palette": palette})


def _draw_color(palette: Sequence[Color], rng: np.random.Generator) -> Color:
    base = np.asarray(palette[int(rng.integers(len(palette)))])
    red, green, blue = np.clip(base + rng.uniform(-0.05, 0.05, 3), 0.0, 1.0).tolist()
    return (red, green, blue)


def _draw_options(
    options: Mapping[str, Options], rng: np.random.Generator, held_out: HeldOut, unseen: bool
) -> dict[str, Any]:
    """Details: for `unseen` with one held-out combination forced, else with none of them."""
    forced = held_out[int(rng.integers(len(held_out)))] if unseen and held_out else {}
    while True:
        drawn = {
            name: entry.values[int(rng.choice(len(entry.values), p=entry.weights))]
            for name, entry in options.items()
        }
        if unseen:
            return drawn | dict(forced)
        if not any(agrees(drawn, combination) for combination in held_out):
            return drawn


def agrees(drawn: Mapping[str, Any], combination: Mapping[str, object]) -> bool:
    """Whether all details named by the combination have its values."""
    return all(drawn[name] == value for name, value in combination.items())


def draw(
    shape: type[Shape], rng: np.random.Generator, *, held_out: HeldOut = (), unseen: bool = False
) -> Shape:
    """A random shape of this type.

    Args:
        shape: A dataclass whose fields come from `span`, `chance`, `choice` and `tint`.
        rng: The only source of randomness.
        held_out: Detail combinations that training never shows.
        unseen: Draw for `test-ood`: a held-out combination, and half of the proportions outside
            their training range.
    """
    entries: tuple[Field[Any], ...] = fields(shape)  # pyright: ignore[reportArgumentType]
    options = {
        e.name: e.metadata["draw"] for e in entries if isinstance(e.metadata.get("draw"), Options)
    }
    spans = [e for e in entries if isinstance(e.metadata.get("draw"), Span)]
    values = _draw_options(options, rng, held_out, unseen)
    wide = [
        e.name
        for e in spans
        if e.metadata["draw"].least < e.metadata["draw"].low
        or e.metadata["draw"].high < e.metadata["draw"].most
    ]
    chosen = set(rng.permutation(np.asarray(wide))[: (len(wide) + 1) // 2].tolist())
    for entry in spans:
        leaves = unseen and entry.name in chosen
        kind = entry.metadata["draw"]
        values[entry.name] = kind.outside(rng) if leaves else kind.inside(rng)
    for entry in entries:
        if "palette" in entry.metadata:
            values[entry.name] = _draw_color(entry.metadata["palette"], rng)
    return shape(**values)
