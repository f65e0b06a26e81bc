# SPDX-License-Identifier: MIT
"""Every metric by what was seen: visibility, state, viewing direction and size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from bench.scoring.scores import Errors
from bench.scoring.truth import Truth
from bench.statistics import Interval, interval
from scapo.store.manifest import Manifest

QUANTILES = 5
STATE_EDGES = np.linspace(0, 1, 6)
AMBIGUOUS_EDGES = np.array([0.0, 0.5, 1.0])
AZIMUTH_EDGES = np.arange(-180, 181, 45.0)
ELEVATION_EDGES = np.arange(-90, 91, 30.0)

FACTORS = {
    "visible": "visible share of the moving parts",
    "state": "state, share of the travel",
    "azimuth": "camera azimuth, deg, 0 = front",
    "elevation": "camera elevation, deg",
    "size": "size, m (4 x mean radius)",
    "ambiguous": "0 one pose explains it, 1 several",
}
"""Factor -> what it is; with several moving parts the mean over them. `ambiguous` is there where
the data say so."""


def factors(truth: Truth, manifest: Manifest) -> dict[str, Float[np.ndarray, " B"]]:
    """The value of every factor for some samples, NaN where the data do not say it.

    Azimuth and elevation are those of the camera about the object's origin (`categories.Window`).
    """
    lower = np.array([joint.lower for joint in manifest.joints])
    travel = np.array([max(joint.upper - joint.lower, 1e-12) for joint in manifest.joints])
    pose = truth.camera_T_part[:, 0]
    camera = -np.einsum("bij,bi->bj", pose[:, :3, :3], pose[:, :3, 3])  # in the object frame
    x, y, z = camera.T
    values = {
        "visible": truth.visible[:, 1:].mean(1),
        "state": ((truth.joint_state - lower) / travel).mean(1),
        "azimuth": np.degrees(np.arctan2(-y, -x)),
        "elevation": np.degrees(np.arctan2(z, np.hypot(x, y))),
        "size": truth.scale,
    }
    if truth.alike is not None:
        values["ambiguous"] = truth.alike.turns[:, 1:].any(1).astype(np.float64)
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class Stratum:
    """One metric on the samples of one bin."""

    factor: str
    lower: float
    upper: float
    metric: str
    unit: str
    samples: int
    value: Interval


def edges(factor: str, values: Float[np.ndarray, " B"]) -> Float[np.ndarray, " E"]:
    """Limits of the bins: fixed for angles and states, five equal counts for the others."""
    fixed = {
        "state": STATE_EDGES,
        "azimuth": AZIMUTH_EDGES,
        "elevation": ELEVATION_EDGES,
        "ambiguous": AMBIGUOUS_EDGES,
    }
    if factor in fixed:
        return fixed[factor]
    return np.unique(np.quantile(values, np.linspace(0, 1, QUANTILES + 1)))


def stratify(
    errors: Errors, values: dict[str, np.ndarray], instance: Int[np.ndarray, " B"]
) -> Iterator[Stratum]:
    """Means and intervals of every metric in every bin that has samples.

    Values beyond the outer limits (a state past the category's travel) belong to the outer bins,
    those that are not known to none.
    """
    for factor, value in values.items():
        known = ~np.isnan(value)
        if not known.any():
            continue
        limits = edges(factor, value[known])
        if len(limits) < 2:
            limits = np.repeat(limits, 2)
        bins = np.clip(np.searchsorted(limits, value, "right") - 1, 0, len(limits) - 2)
        for number, (lower, upper) in enumerate(pairwise(limits)):
            members = known & (bins == number)
            if not members.any():
                continue
            for (metric, unit), table in errors.items():
                yield Stratum(
                    factor=factor, lower=float(lower), upper=float(upper), metric=metric,
                    unit=unit, samples=int(members.sum()),
                    value=interval(table[members], instance[members], resamples=500),
                )  # fmt: skip
