#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""What each thing that template registration takes for granted is worth, at test time.

    python scripts/experiments/priors.py MODEL DATA [CLOUDS [MODE [NAME ...]]]

Asks a released model of so many clouds of `val`, evenly spread, as it is and without one prior at a
time, and once told which way is up (with names, as it is and those alone); the evaluator's means
are printed, part order per sample, in the object's frame. What a prior is worth in training is
another question.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import torch
from torch import Tensor

from bench.requests import EvaluateRequest, Mode, PredictRequest
from bench.runs import predict as asking
from bench.scoring.evaluate import evaluate
from scapo.registered import base, learning, pose_refinement, view_loss
from scapo.registered.method import TemplateRegistration
from scapo.registered.pose_search import SearchSpace, light, modes_of
from scapo.registered.view_bank import ViewBank
from scapo.registered.views import PartialViews

Change = Callable[[TemplateRegistration], None]
COLUMNS = {
    "iou_1": 100.0,
    "joint_direction_deg": 1.0,
    "joint_pivot_r4": 1.0,
    "part_rotation_deg": 1.0,
    "part_translation_r4": 1.0,
}
"""Of the evaluator's summary, and their factors: S, D, C, R, t."""


def configured(**options: object) -> Change:
    """The method with other options."""

    def change(method: TemplateRegistration) -> None:
        method.config = replace(method.config, **options)

    return change


def in_space(change: Callable[[TemplateRegistration, SearchSpace], SearchSpace]) -> Change:
    """The method with another search space."""

    def change_space(method: TemplateRegistration) -> None:
        usual = method._space
        method._space = lambda: change(method, usual())

    return change_space


def cameras_anywhere(method: TemplateRegistration, space: SearchSpace) -> SearchSpace:
    """Images of the template from all sides, and nothing that was placed to look like."""
    modes = modes_of(method.pseudo.placement(), space.states)
    return replace(space, rendered=ViewBank.rendered(light(method.template), modes, None))


def nothing_seen(views: PartialViews, points: Tensor, normals: Tensor) -> Tensor:
    """As if no camera would have seen any point of the template."""
    del views, normals
    return torch.zeros(points.shape[:-1], dtype=torch.bool)


def without_axes(method: TemplateRegistration) -> None:
    """All hinges along the category's axes."""
    method.template.load.zero_()


def without_hinges(method: TemplateRegistration) -> None:
    """All hinges where the template's are."""
    method.network.get_buffer("hinged").zero_()


def as_states_say(method: TemplateRegistration) -> None:
    """Parts posed as if stretching turned none of them."""
    method._rest = lambda placement: method.template.rest.expand_as(placement.state)


CHANGES: dict[str, Change | None] = {
    "as it is": None,
    "known up": None,
    "no word of the network on states and rotations": configured(dissent=0.0),
    "network asked in one roll": configured(looks=1),
    "outliers kept": configured(strays="kept"),
    "cameras anywhere": in_space(cameras_anywhere),
    "no likeness to placed views": in_space(lambda _, space: replace(space, placed=None)),
    "not how objects stand": in_space(lambda _, space: replace(space, scorer=None)),
    "no free space, nothing unseen": None,
    "axes of the category": without_axes,
    "hinges of the template": without_hinges,
    "parts as their states say": as_states_say,
    "banks better by any loss": None,
    "banks never better": None,
    "points' parts by the template alone": None,
}
PATCHES: dict[str, list[tuple[ModuleType, str, object]]] = {
    "no free space, nothing unseen": [
        (module, "should_be_seen", nothing_seen) for module in (pose_refinement, view_loss)
    ],
    "banks better by any loss": [(base, "BETTER", 0.0)],
    "banks never better": [(base, "BETTER", 100.0)],
    "points' parts by the template alone": [(learning, "WORD", 0.0)],
}
"""What stands in a module in place of what it has."""


def scores(run: Path, data: Path, count: int, mode: Mode, name: str) -> list[float]:
    """The evaluator's means of one variant."""
    usual = asking.load

    def load(path: Path) -> tuple[TemplateRegistration, dict[str, object]]:
        method, header = usual(path)
        if not isinstance(method, TemplateRegistration):
            raise ValueError(f"{run}: expected a run of registered, found {method.name}")
        change = CHANGES[name]
        if change is not None:
            change(method)
        return method, header

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for module, attribute, value in [(asking, "load", load), *PATCHES.get(name, [])]:
            stack.enter_context(patch.object(module, attribute, value))
        asked = PredictRequest(
            checkpoint=run, data=data, out=folder / "p.safetensors", split="val", mode=mode,
            limit=count, up=name == "known up",
        )  # fmt: skip
        asking.predict(asked)
        found = evaluate(
            EvaluateRequest(
                predictions=asked.out, data=data, split="val", out=folder / "s.csv.gz",
                companions=False,
            )
        )  # fmt: skip
    return [factor * found["summary"][key]["mean"] for key, factor in COLUMNS.items()]


def main(run: Path, data: Path, count: int, mode: Mode, names: list[str]) -> None:
    """Print a row for each, or for those that are named."""
    if unknown := [name for name in names if name not in CHANGES]:
        sys.exit(f"names: expected some of {', '.join(CHANGES)}, found {', '.join(unknown)}")
    torch.set_num_threads(1)
    print(f"{run.stem}, {mode}, {count} clouds: S, D, C, R, t")
    for name in ["as it is", *names] if names else CHANGES:
        try:
            found = scores(run, data, count, mode, name)
        except ValueError as error:
            print(f"| {name} | {error} |", flush=True)
            continue
        print(f"| {name} | " + " | ".join(f"{x:.3f}" if x < 1 else f"{x:.1f}" for x in found)
              + " |", flush=True)  # fmt: skip


if __name__ == "__main__":
    words = sys.argv[3:]
    main(
        Path(sys.argv[1]), Path(sys.argv[2]), int(words[0]) if words else 100,
        "quick" if words[1:2] == ["quick"] else "refine", words[2:],
    )  # fmt: skip
