# SPDX-License-Identifier: MIT
"""`infer`: parts, poses and joints of the object in each of somebody's files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path

from bench.infer.answer import agreement, ask
from bench.infer.calibration import JOINT_DEGREES, with_confidence
from bench.infer.cloud import Cloud, InputError
from bench.infer.files import Choice, Result, write_result
from bench.infer.model import Model, load_models
from bench.infer.readers import ReadOptions, find_inputs, read_input
from bench.requests import InferRequest, Mode, require_some
from bench.runs.train import pick_device
from scapo.text import UsageError, is_word, one_line, words_of

CLOSE = 0.05
"""Difference of residuals from which on one category explains a view clearly better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """What became of one input."""

    source: Path
    folder: Path | None = None
    """Where the results are; None: it failed."""
    result: Result | None = None
    error: str = ""


def infer(request: InferRequest, tell: Callable[[Done], None]) -> list[Done]:
    """Answer every input, each in isolation.

    Args:
        request: Inputs, models and where the results go.
        tell: Called after each.

    Raises:
        StoreError: No model.
        UsageError: No inputs, or an up that no model can use.
        InputError: None that can be read, two of one name, or a scale or place that cannot be.
    """
    require_some("INPUT", request.inputs)
    options = ReadOptions(
        scale=request.scale, intrinsics=request.intrinsics, mask=request.mask,
        sensor=request.sensor, up=request.up,
    )  # fmt: skip
    inputs = find_inputs(request.inputs)
    folders = [request.out / name for name in distinct_names(inputs)]
    device = pick_device(request.device)
    models = load_models(request.checkpoint, request.category, device, request.mode)
    if request.up is not None and not any(model.predictor.knows_up for model in models):
        names = ", ".join(model.name for model in models)
        raise UsageError(f"--up: expected a model that can use it, found {names}")
    done = []
    for path, folder in zip(inputs, folders, strict=True):
        done.append(_one(path, folder, models, options, request))
        tell(done[-1])
    return done


def distinct_names(inputs: Sequence[Path]) -> list[str]:
    """Names of the inputs' folders: without suffix, or with it where two would be the same.

    Raises:
        InputError: Two inputs of one name, or one that cannot be a folder's.
    """
    stems = [path.stem for path in inputs]
    names = [path.stem if stems.count(path.stem) == 1 else path.name for path in inputs]
    for path, name in zip(inputs, names, strict=True):
        if names.count(name) > 1 or not is_word(name):
            raise InputError(
                f"{path}: expected inputs of distinct, plain names, as each gets a folder of its "
                f"own; found {name!r}"
            )
    return names


def _one(
    path: Path,
    folder: Path,
    models: Sequence[Model],
    options: ReadOptions,
    request: InferRequest,
) -> Done:
    """One input's results, or what was wrong with it."""
    try:
        cloud = read_input(path, options)
        given = "run" if request.checkpoint is not None else "category"
        result = answer(path.stem, cloud, models, request.mode, given)
        write_result(result, folder)
    except (ValueError, OSError, ArithmeticError, RuntimeError, MemoryError) as error:
        words = one_line(words_of(error)) or type(error).__name__
        return Done(source=path, error=words if str(path) in words else f"{path}: {words}")
    return Done(source=path, folder=folder, result=result)


def answer(name: str, cloud: Cloud, models: Sequence[Model], mode: Mode, given: str) -> Result:
    """The answer of the model that explains the cloud best, with confidences.

    Args:
        name: Of the input.
        cloud: The object.
        models: Of different categories, or one.
        mode: Of prediction.
        given: What named the only model: run or category.

    Raises:
        InputError: No model says how well it explains the cloud.
    """
    twins = [ask(name, cloud, model, mode) for model in models]
    residuals = {twin.category.name: twin.evidence["residual"]
                 for twin in twins if "residual" in twin.evidence}  # fmt: skip
    best = 0
    if len(models) > 1:
        if not residuals:
            raise InputError(f"{name}: expected --category, as no model can tell how well it fits")
        least = min(residuals, key=residuals.__getitem__)
        best = [model.category.name for model in models].index(least)
    choice = Choice(by=given if len(models) == 1 else "residual", residuals=residuals)
    twin = agreement(cloud, twins[best], models[best], mode)
    if choice.margin is not None and choice.margin < CLOSE:
        rival = sorted(residuals, key=residuals.__getitem__)[1]
        words = f"the category is doubtful: {rival} explains the view almost as well; --category"
        twin = replace(twin, warnings=(*twin.warnings, words))
    twin, reason = with_confidence(twin, models[best].calibration)
    return Result(
        twin=twin,
        choice=choice,
        mode=mode,
        uncalibrated=reason,
        aligned=models[best].predictor.in_object_frame,
    )


def summary(done: Done) -> str:
    """An answer in a line, or why there is none."""
    if done.result is None:
        return done.error
    twin, choice = done.result.twin, done.result.choice
    category = twin.category.name
    if choice.margin is not None:
        category += f" by {choice.margin:.2f}"
    joints = []
    for j, spec in enumerate(twin.category.joints):
        known, state = twin.joint_confidence, _state(spec.kind, twin.state[j])
        # Of the axis alone: nobody calibrated how true states are.
        sure = "" if known is None else (
            f" (axis {100 * float(known[j]):.0f} % sure within {JOINT_DEGREES:g} degrees)"
        )  # fmt: skip
        # A model with zeros of its own knows no closed state.
        how = "open " if done.result.aligned else ""
        joints.append(f"{twin.category.parts[spec.child]} {how}{state}{sure}")
    more = f"; {len(twin.warnings)} warning(s) in joints.json" if twin.warnings else ""
    return f"{done.source}: {category}, {', '.join(joints)}: {done.folder}{more}"


def _state(kind: str, state: float) -> str:
    return f"{degrees(state):.1f} degrees" if kind == "revolute" else f"{100 * state:.1f} cm"
