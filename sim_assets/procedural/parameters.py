# SPDX-License-Identifier: MIT
"""Free parameters of procedural shapes: declared as dataclass fields, drawn from a generator.

A category's shape is a frozen dataclass whose fields are made by `span` (a length), `ratio` (a
proportion), `chance`
(a detail that is there or not), `choice` (one of several styles) and `tint` (a colour). `draw`
fills it. Outside the training distribution (`test-ood`) proportions leave their training range, up
to the outer range, and the details take one of the combinations that training never shows; or all
is drawn as for training and the field `trait` names a rearrangement that the recipe then builds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

Shape = TypeVar("Shape")
HeldOut = tuple[Mapping[str, object], ...]
"""Detail combinations kept for `test-ood`: a shape is held out if it agrees with one of them."""
Color = tuple[float, float, float]

PROPORTIONS = "proportions"
OTHER_SIDE = "hinge on the other side"
OTHER_WAY = "opens the other way"
SET_BACK = "hinge set back"


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """Training range [low, high] inside the outer range [least, most]."""

    low: float
    high: float
    least: float
    most: float
    ratio: bool = False
    """Uniform in its logarithm: a half is as likely as a double."""

    def _even(self, value: float) -> float:
        return math.log(value) if self.ratio else value

    def inside(self, rng: np.random.Generator) -> float:
        """From the training range."""
        low, high = self._even(self.low), self._even(self.high)
        value = float(rng.uniform(low, high))
        return math.exp(value) if self.ratio else value

    def outside(self, rng: np.random.Generator) -> float:
        """From the outer range less the training range and a tenth of the way beyond it."""
        least, low, high, most = map(self._even, (self.least, self.low, self.high, self.most))
        below, above = 0.9 * (low - least), 0.9 * (most - high)
        offset = float(rng.uniform(0.0, below + above))
        value = least + offset if offset < below else most - (below + above - offset)
        return math.exp(value) if self.ratio else value


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


def ratio(low: float, high: float, least: float, most: float) -> Any:  # noqa: ANN401
    """As `span`, uniform in the logarithm: of one length over another."""
    if not 0 < least <= low < high <= most:
        raise ValueError(
            f"ratio: expected 0 < least <= low < high <= most, {least, low, high, most}"
        )
    return field(metadata={"draw": Span(low=low, high=high, least=least, most=most, ratio=True)})


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


def _leaving(
    spans: Mapping[str, Span], rng: np.random.Generator, main: Sequence[str]
) -> frozenset[str]:
    """Half of the proportions that can leave their range, the main ones among them."""
    wide = [n for n, s in spans.items() if s.least < s.low or s.high < s.most]
    first = list(main)
    order = rng.permutation(np.asarray(wide)).tolist()
    return frozenset(first + [name for name in order if name not in first][: len(wide) // 2])


def draw(
    shape: type[Shape],
    rng: np.random.Generator,
    *,
    held_out: HeldOut = (),
    unseen: bool = False,
    main: Sequence[str] = (),
) -> Shape:
    """A random shape of this type.

    Args:
        shape: A dataclass whose fields come from `span`, `chance`, `choice` and `tint`.
        rng: The only source of randomness.
        held_out: Detail combinations that training never shows.
        unseen: Draw for `test-ood`: a held-out combination, and half of the proportions outside
            their training range.
        main: Proportions that leave their range in any case.
    """
    entries: tuple[Field[Any], ...] = fields(shape)  # pyright: ignore[reportArgumentType]
    options = {
        e.name: e.metadata["draw"] for e in entries if isinstance(e.metadata.get("draw"), Options)
    }
    spans = {
        e.name: e.metadata["draw"] for e in entries if isinstance(e.metadata.get("draw"), Span)
    }
    values = _draw_options(options, rng, held_out, unseen)
    leaving = _leaving(spans, rng, main) if unseen else frozenset()
    for name, kind in spans.items():
        values[name] = kind.outside(rng) if name in leaving else kind.inside(rng)
    for entry in entries:
        if "palette" in entry.metadata:
            values[entry.name] = _draw_color(entry.metadata["palette"], rng)
    return shape(**values)
