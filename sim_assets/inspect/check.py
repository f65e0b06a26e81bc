# SPDX-License-Identifier: MIT
"""`scapo-data check`: every model of a folder read in a worker process, and what came of it.

A model that crashes, hangs or eats the memory costs itself alone. The command ends 1 when any
model is refused, 0 when all are accepted or repaired.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from scapo.categories import Category, JointKind, JointSpec
from scapo.parallel.pool import Outcome, Pool, Report
from scapo.store.files import write_bytes
from scapo.text import one_line
from sim_assets.generation.request import make_settings
from sim_assets.models.account import check_speaks, sentences
from sim_assets.models.frames import check_wanted
from sim_assets.models.joints import Candidate, candidates
from sim_assets.models.library import find, source_root
from sim_assets.models.limits import CLOCK_SECONDS, bounded, limited_memory
from sim_assets.models.reader import Model, load, read
from sim_assets.models.resolver import SourceFiles
from sim_assets.models.validate import AssetError, Repairs, refuse
from sim_assets.objects import ArticulatedObject
from sim_assets.options import DataOptions
from sim_assets.rendering.backends import make_renderer
from sim_assets.sampling.samples import SampleMaker, ViewError

FORMAT = "scapo-check/1"
Status = Literal["accepted", "repaired", "refused"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """How to read the models; None: as the source says."""

    category: str | Category | None = None
    """Check as objects of this category; else that some joint can be used at all."""
    up: str | None = None
    front: str | None = None
    scale: float | None = None
    any_model: bool = False
    """Whether a model none of whose names speaks of the category is accepted."""
    timeout: float = 120.0
    """Seconds for one model."""
    memory: int = 4 << 30
    """Bytes for one model, to read it and to show it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came of one model."""

    path: str
    """Relative to the folder checked."""
    status: Status
    reason: str = ""
    """Why it is refused: what was expected, what was found, where."""
    repairs: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    """Joints that a category can use; with a category given, those chosen."""
    account: tuple[str, ...] = ()
    """With a category given: which joints were taken, what the size is, and the repairs."""
    triangles: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Model:
    """A job for a worker."""

    urdf: Path
    given: Path
    """Folder that names are relative to."""
    root: Path
    """Folder below which files are found: of a package's own folder of URDFs, the package."""
    options: Options


def check(
    path: Path,
    options: Options | None = None,
    *,
    workers: int = 1,
    on_result: Callable[[Result], None] | None = None,
) -> list[Result]:
    """Check all models of a folder.

    Args:
        path: A folder, searched recursively, or one `.urdf` file.
        options: Category and limits.
        workers: Processes.
        on_result: Called with each result as it comes.

    Returns:
        A result for each model, in the order of `library.find`.

    Raises:
        AssetError: No such folder, or no model in it.
        ValueError: Options by which no model can be read.
    """
    options = options or Options()
    check_wanted(options.up, options.front, options.scale)
    given, root = path if path.is_dir() else path.parent, source_root(path)
    models = [_Model(urdf=urdf, given=given, root=root, options=options) for urdf in find(path)]
    results: dict[Path, Result] = {}
    pool: Pool[_Model, Result] = Pool(min(workers, len(models)), timeout=options.timeout)
    with pool:
        for outcome in pool.run(_job, models, within=CLOCK_SECONDS):
            result = _result(outcome)
            results[outcome.job.urdf] = result
            if on_result is not None:
                on_result(result)
    return [results[model.urdf] for model in models]


def report(results: Iterable[Result]) -> dict[str, Any]:
    """What the JSON file holds."""
    rows = [asdict(result) for result in results]
    counts = Counter(row["status"] for row in rows)
    return {
        "format": FORMAT,
        "counts": {status: counts[status] for status in get_args(Status)},
        "assets": rows,
    }


def write_report(results: Iterable[Result], path: Path) -> None:
    """Write `report` as sorted JSON, atomically."""
    text = json.dumps(report(results), sort_keys=True, indent=1, ensure_ascii=False)
    write_bytes(path, (text + "\n").encode())


def exit_code(results: Iterable[Result]) -> int:
    """1 when any model is refused, else 0."""
    return int(any(result.status == "refused" for result in results))


def _job(model: _Model, send: Report) -> Result:
    """In the worker."""
    send(one_line(model.urdf), 0)
    with limited_memory(model.options.memory):
        return check_one(model.urdf, model.root, model.options, send)


def _result(outcome: Outcome[_Model, Result]) -> Result:
    model = outcome.job
    folder = model.urdf.parent.resolve()  # the file itself may be a link to anywhere
    name = one_line((folder / model.urdf.name).relative_to(model.given.resolve()).as_posix())
    result = outcome.result
    if result is None:
        reason = f"{name}: expected to be read, found that {outcome.reason}"
        return Result(path=name, status="refused", reason=reason)
    return replace(result, path=name)


def check_one(
    urdf: Path, root: Path, options: Options, send: Report = lambda label, amount: None
) -> Result:
    """Check one model in this process; refusals are results, other errors are raised."""
    repairs = Repairs()
    told: tuple[str, ...] = ()
    try:
        if options.category is None:
            joints, triangles = _general(urdf, root, repairs)
            said = repairs.sentences()
        else:
            thing = read(
                urdf,
                options.category,
                up=options.up,
                front=options.front,
                scale=options.scale,
                root=root,
            )
            if not options.any_model:
                check_speaks(urdf, thing)
            send(one_line(urdf), 0)  # that reading it is over
            show(urdf, thing)
            told = sentences(thing)
            joints, said = thing.origin.joint_names, thing.origin.repairs
            triangles = sum(len(visual.mesh.faces) for part in thing.visuals for visual in part)
    except AssetError as error:
        reason, said = str(error.below(root)), repairs.sentences()
        return Result(path=str(urdf), status="refused", reason=reason, repairs=said)
    status: Status = "repaired" if said else "accepted"
    return Result(
        path=str(urdf),
        status=status,
        repairs=said,
        joints=joints,
        account=told,
        triangles=triangles,
    )


def show(urdf: Path, thing: ArticulatedObject) -> None:
    """Make one sample, as `generate` would; by ray casting, which draws the same everywhere.

    Raises:
        AssetError: No view shows enough of every part.
    """
    settings = make_settings(DataOptions(count=1, backend="raycast"))
    with make_renderer("raycast") as renderer:
        try:
            list(SampleMaker(renderer, thing, settings).render_views([("check",)]))
        except ViewError as error:
            reason = str(error).removeprefix(f"{thing.instance}: expected ")
            raise AssetError(urdf, f"expected {reason}") from error


def _general(urdf: Path, root: Path, repairs: Repairs) -> tuple[tuple[str, ...], int]:
    """Joints that some category could use, and the number of triangles."""
    with bounded(urdf):
        return _found(load(SourceFiles(urdf=urdf, root=root, repairs=repairs)))


def _found(model: Model) -> tuple[tuple[str, ...], int]:
    urdf, surfaces = model.robot.path, model.surfaces
    found, reasons = [], []
    for kind in get_args(JointKind):
        spec = JointSpec(kind=kind, parent=0, child=1, lower=0.0, upper=math.pi)
        try:
            found += _usable(model, spec)
        except AssetError as error:
            reasons.append(error)
    if not found:
        raise reasons[0] if reasons else refuse(urdf, "a joint that moves something", "none")
    triangles = sum(len(v.mesh.faces) for visuals in surfaces.values() for v in visuals)
    return tuple(candidate.joint.name for candidate in found), triangles


def _usable(model: Model, spec: JointSpec) -> list[Candidate]:
    found = candidates(model.robot, model.surfaces, spec, (), model.known)
    return [c for c in found if set(model.surfaces) - model.robot.subtree(c.joint)]
