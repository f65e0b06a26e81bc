# SPDX-License-Identifier: MIT
"""What labelled clouds taught about a model's answers, as a JSON file beside its checkpoint.

`alignment` brings its frames to the category's where the checkpoint does not; `joint` and `part`
turn what speaks for an answer into the probability that it is right: a logistic map of three
numbers whose weights cannot have the wrong sign. `reliability` says how true such probabilities
were of objects not fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import exp, log, log1p
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bench.requests import Mode
from bench.twin.record import Twin
from scapo.alignment import Alignment
from scapo.store.files import canonical_json, write_bytes
from scapo.store.json_records import from_json, read_json
from scapo.store.schema import StoreError

FORMAT, OF_BEFORE = "scapo-calibration/2", "scapo-calibration/1"
SIGNS = (-1.0, 1.0, -1.0)
"""Of the weights of residual, margin and spread: a larger residual or spread cannot speak for an
answer."""
LEAST_RESIDUAL = 1e-3
RIDGE = 1e-2
"""Weight of the squared weights, so that a method that is never wrong has finite ones."""
BINS = 10
"""Of probabilities, in a reliability diagram."""
JOINT_DEGREES, PART_DEGREES = 5.0, 10.0
"""An axis' direction and a part's rotation are right within these."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogisticMap:
    """p = 1 / (1 + exp(-(bias + weight . feature)))."""

    bias: float
    weight: tuple[float, ...]
    """Of `FEATURES`, as `feature` has them."""

    def probability(self, feature: Sequence[float]) -> float:
        """That an answer is right."""
        score = self.bias + sum(w * x for w, x in zip(self.weight, feature, strict=True))
        return 1 / (1 + exp(-min(max(score, -50.0), 50.0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Reliability:
    """Probabilities of objects that were not fitted to, beside how often answers were right."""

    count: tuple[int, ...]
    """Answers in each of `BINS` equal bins of probability."""
    predicted: tuple[float, ...]
    """Mean probability in each; 0 in an empty one."""
    right: tuple[float, ...]
    """Share that was right; 0 in an empty one."""
    error: float
    """Expected calibration error: mean gap of the two, each bin by its count."""
    brier: float
    """Mean squared difference of probability and outcome."""
    base_rate: float
    """Share of all answers that was right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Of one model in one mode."""

    model: str
    """SHA-256 of the checkpoint."""
    mode: Mode
    category: str
    split: str
    data: str
    """Digest of the labelled data."""
    samples: int
    alignment: Alignment | None
    """None: the checkpoint has one, or learned poses from labels."""
    joint: tuple[LogisticMap, ...]
    """That the direction of each joint's axis is within 5 degrees."""
    part: tuple[LogisticMap, ...]
    """That each part's rotation is within 10 degrees."""
    reliability: Mapping[str, Reliability]
    """`joint` and `part`."""


def calibration_file(checkpoint: Path, mode: Mode) -> Path:
    """Where the calibration of a checkpoint lies."""
    return checkpoint.with_name(f"{checkpoint.stem}.calibration-{mode}.json")


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write the JSON file, whole or not at all."""
    record = {"format": FORMAT, **asdict(calibration)}
    write_bytes(path, (canonical_json(record) + "\n").encode())


def read_calibration(path: Path, digest: str) -> Calibration:
    """The calibration of the checkpoint with this digest.

    Raises:
        StoreError: Of another checkpoint, or no calibration.
    """
    record = read_json(path)
    if not isinstance(record, dict) or record.get("format") not in (FORMAT, OF_BEFORE):
        raise StoreError(
            f"{path}: expected {FORMAT}, found something else: scapo-bench calibrate makes it anew"
        )
    if record["format"] == OF_BEFORE:
        record = {**record, "alignment": _of_before(record)}
    found: Calibration = from_json(
        Calibration, {k: v for k, v in record.items() if k != "format"}, str(path)
    )
    if found.model != digest:
        raise StoreError(
            f"{path}: expected the calibration of the checkpoint beside it, {digest[:12]}, found "
            f"that of {found.model[:12]}: scapo-bench calibrate makes it anew"
        )
    return found


def _of_before(record: dict[str, Any]) -> object:
    """The alignment of a file of before: one offset, of the base, from which joints move the rest.

    Here children follow the base too (`bench.infer.parts`), so that it may stand for every part.
    """
    known = record.get("alignment")
    if not isinstance(known, dict) or not isinstance(known.get("order"), list):
        return known
    clouds = {"split": record.get("split"), "data_digest": record.get("data"),
              "samples": record.get("samples"), "mode": record.get("mode")}  # fmt: skip
    return {**known, "own_T_part": [known.get("base")] * len(known["order"]), "clouds": clouds}


def feature(evidence: Mapping[str, float], kind: str, index: int) -> tuple[float, ...] | None:
    """What speaks for the answer of a joint or part; None where something is not known."""
    names = ("residual", "margin", f"{kind}_{index}_spread")
    if any(name not in evidence for name in names):
        return None
    residual, margin, spread = (evidence[name] for name in names)
    return log(max(residual, LEAST_RESIDUAL)), margin, log1p(spread)


def with_confidence(twin: Twin, calibration: Calibration | None) -> tuple[Twin, str | None]:
    """The twin with probabilities, or without and the reason why."""
    if calibration is None:
        return twin, "the model was not calibrated for this mode: scapo-bench calibrate RUN"
    made: dict[str, np.ndarray] = {}
    for kind, maps in (("joint", calibration.joint), ("part", calibration.part)):
        values = [feature(twin.evidence, kind, index) for index in range(len(maps))]
        if any(value is None for value in values):
            return twin, "the method has no shape to compare with the view"
        pairs = zip(maps, values, strict=True)
        made[kind] = np.array([one.probability(value) for one, value in pairs if value is not None])
    return replace(twin, joint_confidence=made["joint"], part_confidence=made["part"]), None


def fit_map(x: Float[np.ndarray, "S 3"], right: Bool[np.ndarray, " S"]) -> LogisticMap:
    """Logistic regression with weights of known signs and a small ridge on them."""
    from scipy.optimize import minimize

    spread = np.maximum(x.std(0), 1e-6)
    unit = (x - x.mean(0)) / spread
    sign = np.where(right, 1.0, -1.0)

    def loss(p: np.ndarray) -> tuple[float, np.ndarray]:
        score = sign * (p[0] + unit @ p[1:])
        slope = -sign / (1 + np.exp(np.clip(score, -50, 50))) / len(unit)
        ridge = RIDGE * p
        gradient = np.concatenate([[slope.sum()], slope @ unit]) + ridge
        return float(np.logaddexp(0, -score).mean() + RIDGE / 2 * p @ p), gradient

    free = (None, None)
    bounds = [free, *((0, None) if s > 0 else (None, 0) for s in SIGNS)]
    p = minimize(loss, np.zeros(4), jac=True, bounds=bounds, method="L-BFGS-B").x
    weight = p[1:] / spread
    bias = float(p[0] - weight @ x.mean(0))
    return LogisticMap(bias=bias, weight=tuple(float(w) for w in weight))


def reliability(probability: Float[np.ndarray, " S"], right: Bool[np.ndarray, " S"]) -> Reliability:
    """Of probabilities and what came of them."""
    place = np.minimum((probability * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    some = np.maximum(count, 1)
    predicted = np.bincount(place, probability, BINS) / some
    share = np.bincount(place, right.astype(float), BINS) / some
    total = max(len(right), 1)
    return Reliability(
        count=tuple(int(n) for n in count),
        predicted=tuple(float(v) for v in predicted),
        right=tuple(float(v) for v in share),
        error=float((count * np.abs(predicted - share)).sum() / total),
        brier=float(np.square(probability - right).mean()),
        base_rate=float(right.mean()),
    )
