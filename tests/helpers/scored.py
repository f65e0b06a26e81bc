# SPDX-License-Identifier: MIT
"""Scores files with random errors, for tests of what reads them."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from bench.requests import Settings
from bench.scoring.score_files import Run, writing

SAMPLES, OBJECTS = 40, 8


def make_scores(
    folder, method, category, *, seed=1, kind="clean", quality=1.0, supervision=(), variant="",
    samples=SAMPLES, digest="0123456789ab", split="test", budget=None, camera=None, traits=(),
    order=None, calibration=None,
):  # fmt: skip
    """A scores file with random errors; larger `quality` is worse."""
    generator = np.random.default_rng([seed, len(category), len(method)])
    parts = 3 if category in ("eyeglasses", "basket") else 2
    metres = quality * generator.gamma(2, 0.03, size=(samples, parts))
    errors = {
        ("iou", "1"): generator.uniform(0.5, 1, size=(samples, parts)),
        ("joint_direction", "deg"): quality * generator.gamma(2, 3, size=(samples, parts - 1)),
        ("joint_pivot", "r4"): metres[:, 1:] * 3,
        ("joint_pivot", "m"): metres[:, 1:],
        **_states(generator.gamma(2, 3, size=(samples, parts - 1)), category == "drawer"),
        ("part_rotation", "deg"): quality * generator.gamma(2, 4, size=(samples, parts)),
        ("part_translation", "r4"): metres * 3,
        ("part_translation", "m"): metres,
    }
    errors["iou", "1"][0] = np.nan
    if order is not None:
        errors["order", "1"] = order
    run = Run(method=method, variant=variant, seed=seed, data=f"{kind}@{digest}",
              category=category, split=split)  # fmt: skip
    path = folder / f"{kind}-{category}-{split}-{method}-{variant}-{seed}.csv.gz"
    with writing(path) as file:
        file.add(run, 0, {key: value[:15] for key, value in errors.items()})
        file.add(run, 15, {key: value[15:] for key, value in errors.items()})
        own = {
            "camera": camera,
            "trait": list(traits) or None,
            "budget": budget,
            "calibration": calibration,
        }
        known = {name: value for name, value in own.items() if value is not None}
        file.report = report_of(run, supervision, samples) | known
    return errors


def _states(error, slides):
    """In degrees, or in 4 x mean radii and metres."""
    if slides:
        return {("joint_state", "r4"): error * 0.03, ("joint_state", "m"): error * 0.01}
    return {("joint_state", "deg"): error}


def report_of(run, supervision=(), samples=SAMPLES):
    """A whole report, as `evaluate` writes it."""
    return {
        **asdict(run),
        "supervision": list(supervision), "instance": (np.arange(samples) % OBJECTS).tolist(),
        "budget": {"device": "cpu", "seconds": 12.5}, "parts": ["a", "b"], "joints": ["revolute"],
        "settings": asdict(Settings()), "calibration": None, "part_order": None,
        "counts": {"samples": samples, "instances": OBJECTS, "unanswered": {}},
        "seeds": {"training": run.seed, "calibration": None, "bootstrap": 0},
        "digests": {"data": "0" * 64, "predictions": "1" * 64}, "run": {}, "commit": "0abc",
        "machine": {"cpu": "a chip", "cores": 2}, "versions": {"numpy": "2"}, "summary": {},
        "average_precision": {"rule": "mean"},
        "bootstrap": {"resamples": 2000, "seed": 0, "unit": "instance"},
    }  # fmt: skip
