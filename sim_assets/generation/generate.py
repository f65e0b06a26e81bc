# SPDX-License-Identifier: MIT
"""A split of labelled clouds on disk: plan, workers, shards, manifest; resumable at any moment.

Every shard is a function of the plan, and appears under its name only when complete; the manifest
comes last. So a run that was killed and started again leaves the same bytes as one that was not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from scapo.categories import Category
from scapo.parallel.pool import AbstractPool, Outcome
from scapo.parallel.ray import Engine, open_pool
from scapo.store import SAMPLES, read_header
from scapo.store.manifest import Manifest, Shard, shards_digest
from sim_assets.describe.card import CARD, write_card
from sim_assets.generation.assets import Asset
from sim_assets.generation.images import has_images
from sim_assets.generation.ledger import GenerateError, Ledger
from sim_assets.generation.plan import (
    Entry,
    Request,
    plan_digest,
    plan_shards,
    samples_per_instance,
    used_instances,
)
from sim_assets.generation.request import make_request, versions
from sim_assets.generation.shard import (
    TOGETHER,
    ShardDone,
    ShardJob,
    describe,
    render_shard,
    render_shard_alike,
)
from sim_assets.generation.workers import planned_workers
from sim_assets.models.limits import CLOCK_SECONDS
from sim_assets.options import DataOptions

Progress = Callable[[str, int, int], None]


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total


@dataclass(frozen=True, slots=True, kw_only=True)
class Running:
    """How a split is made: nothing here changes its bytes."""

    workers: int | None = 1
    """None: as many as pay on this machine (`planned_workers`); of a cluster one per core."""
    engine: Engine = "local"
    timeout: float = 300.0
    """Seconds without a sign of life after which an object counts as hanging."""
    strict: bool = False
    """Stop at the first object that fails."""
    progress: Progress = _silent
    """progress(what, done, total), called as objects are read and samples are made."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What became of a request."""

    folder: Path
    manifest: Manifest
    failed: Mapping[str, str] = field(default_factory=dict)
    """Object -> reason, of those that gave no samples or not all of them."""
    kept: int = 0
    """Shards that were there already."""


def open_workers(running: Running, *requests: Request) -> AbstractPool[Any, Any]:
    """The workers that make these requests, as a context manager.

    Raises:
        ValueError: Their number is out of range.
    """
    workers = running.workers
    if workers is None and running.engine == "local":
        workers = planned_workers(*requests)
    return open_pool(running.engine, workers, timeout=running.timeout)


def make_split(
    category: str | Category, options: DataOptions, out: Path, running: Running | None = None
) -> Made:
    """Make OUT/CATEGORY/SPLIT, or finish one that was begun: `scapo-data generate`.

    Raises:
        ValueError: An option is out of range, the category is unknown, or has no such objects.
        RenderError: The backend does not work here.
        GenerateError: See `generate`.
    """
    if options.source != "procedural":  # workers elsewhere stand in another folder
        options = replace(options, source=str(Path(options.source).absolute()))
    request, assets = make_request(category, options)
    found = versions(request.settings.backend)
    return generate(request, assets, out / request.category / options.split, found, running)


def generate(
    request: Request,
    assets: Sequence[Asset],
    folder: Path,
    versions: Mapping[str, str],
    running: Running | None = None,
    pool: AbstractPool[Any, Any] | None = None,
) -> Made:
    """Make a split, or finish one that was begun.

    Args:
        request: What is asked for.
        assets: Objects to show, in order; those that cannot be read are left out.
        folder: Of the split.
        versions: Of what makes the pixels, for the manifest.
        running: How.
        pool: Of `open_workers`, to use the same workers for several splits; it stays open.

    Raises:
        GenerateError: The folder holds something else, is in use or cannot be written; no object
            can be read; an object failed and `strict`.
    """
    running = running or Running()
    identity = {
        "category": request.category,
        "split": request.split,
        "seed": request.seed,
        "count": request.count,
        "options": request.options(),
    }
    with (
        Ledger(folder, identity, versions) as ledger,
        open_workers(running, request) if pool is None else nullcontext(pool) as workers,
    ):
        finished = _finished(ledger, request)
        complete = _complete(ledger, finished)
        if complete is not None:
            if not (folder / CARD).exists():  # killed just before, or made by an older version
                write_card(folder)
            return complete
        entries, refused = ledger.entries(assets) or _describe(
            workers, assets, request.instances, (running, ledger.refused())
        )
        if not entries:
            why = "; ".join(refused.values())
            raise GenerateError(f"{folder}: expected objects that can be read, found none: {why}")
        if ledger.plan is None:
            ledger.begin(entries, refused)
        return _make(ledger, workers, _Work(request, entries, refused, finished), running)


@dataclass(frozen=True, slots=True)
class _Work:
    request: Request
    entries: tuple[Entry, ...]
    refused: Mapping[str, str]
    finished: Mapping[str, ShardDone]


def _finished(ledger: Ledger, request: Request) -> dict[str, ShardDone]:
    """The shards that are there whole, with the pictures that are asked for."""
    done = ledger.finished()
    if not request.settings.images:
        return done
    return {name: s for name, s in done.items() if has_images(ledger.folder / name, s.count)}


def _complete(ledger: Ledger, finished: Mapping[str, ShardDone]) -> Made | None:
    """The data set, if it is there whole."""
    manifest = ledger.manifest
    if manifest is None or ledger.plan is not None or manifest.statistics.get("samples_lost"):
        return None
    if any(shard.file not in finished for shard in manifest.shards):
        return None
    return Made(
        folder=ledger.folder, manifest=manifest, failed=manifest.left_out, kept=len(finished)
    )


def _make(ledger: Ledger, pool: AbstractPool[Any, Any], work: _Work, running: Running) -> Made:
    request, instances = work.request, len(work.entries)
    used = work.entries[: used_instances(request, instances)]
    options = {
        **ledger.identity["options"],
        "samples_per_instance": samples_per_instance(request, instances),
    }
    jobs = [
        ShardJob(
            folder=ledger.folder.absolute(),
            request=request,
            plan=plan,
            options=options,
            versions=ledger.versions,
            strict=running.strict,
        )
        for plan in plan_shards(request, used, instances)
    ]
    kept = {
        job.plan.file: work.finished[job.plan.file]
        for job in jobs
        if job.plan.file in work.finished and _cut_alike(job)
    }
    made = _render(ledger, pool, [job for job in jobs if job.plan.file not in kept], running)
    shards = [{**kept, **made}[job.plan.file] for job in jobs]
    failed = {name: why for shard in shards for name, why in shard.failed.items()}
    manifest = replace(
        _manifest(ledger, options, request, used, shards, len(work.refused)),
        left_out={**work.refused, **failed},
    )
    ledger.finish(manifest, [shard.file for shard in shards if not shard.count])
    write_card(ledger.folder)
    return Made(folder=ledger.folder, manifest=manifest, failed=manifest.left_out, kept=len(kept))


def _cut_alike(job: ShardJob) -> bool:
    """Whether the shard that is there was planned as this one; older versions rounded otherwise."""
    name = "samples_per_instance"
    made = read_header(job.folder / job.plan.file, SAMPLES).get("options", {})
    return made.get(name) == job.options[name]


def _describe(
    pool: AbstractPool[Any, Any],
    assets: Sequence[Asset],
    wanted: int,
    how: tuple[Running, Mapping[str, str]],
) -> tuple[tuple[Entry, ...], dict[str, str]]:
    """Read objects until there are enough; those that cannot be read come with the reason.

    Those that an earlier run refused stay refused: others have taken their place.
    """
    running, before = how
    found: dict[str, Entry] = {}
    refused: dict[str, str] = dict(before)
    waiting = [asset for asset in assets if asset.name not in refused]
    running.progress("objects", 0, wanted)
    while waiting and len(found) < wanted:
        batch, waiting = waiting[: wanted - len(found)], waiting[wanted - len(found) :]
        for outcome in pool.run(describe, batch, within=CLOCK_SECONDS):
            name = outcome.job.name
            if outcome.result is not None:
                found[name] = outcome.result
            elif running.strict:
                raise GenerateError(_reason(name, outcome))
            else:
                refused[name] = outcome.reason
            running.progress("objects", len(found), wanted)
    order = [asset.name for asset in assets]
    return (
        tuple(found[name] for name in order if name in found),
        {name: refused[name] for name in order if name in refused},
    )


def _render(
    ledger: Ledger, pool: AbstractPool[Any, Any], jobs: list[ShardJob], running: Running
) -> dict[str, ShardDone]:
    """Render the shards; one whose worker died or hung is tried again without that object."""
    done: dict[str, ShardDone] = {}
    amount: dict[str, int] = {}
    total = sum(job.plan.count for job in jobs)

    def heard(job: ShardJob, label: str, samples: int) -> None:
        del label
        amount[job.plan.file] = amount.get(job.plan.file, 0) + samples
        running.progress("samples", sum(amount.values()), total)

    running.progress("samples", 0, total)
    function = render_shard if running.engine == "local" else render_shard_alike
    while jobs:
        again = []
        for outcome in pool.run(function, jobs, heard):
            if outcome.result is None:
                amount.pop(outcome.job.plan.file, None)
                again.append(_without(outcome, running.strict))
            else:
                done[outcome.result.file] = outcome.result
                ledger.record(outcome.result)
        jobs = again
    return done


def _without(outcome: Outcome[ShardJob, ShardDone], strict: bool) -> ShardJob:
    """The job again, without the object at which its worker died or hung."""
    job = outcome.job
    if outcome.label == TOGETHER and outcome.failure != "error" and not job.apart:
        return replace(job, apart=True)  # to see which of them it is
    if outcome.failure == "error" and not strict:  # of writing: objects are left out in the job
        raise GenerateError(outcome.reason)
    if strict or not outcome.label or outcome.label in job.skip:
        raise GenerateError(_reason(outcome.label or job.plan.file, outcome))
    return replace(job, skip={**job.skip, outcome.label: outcome.reason})


def _reason(name: str, outcome: Outcome[Any, Any]) -> str:
    return outcome.reason if name in outcome.reason else f"{name}: {outcome.reason}"


def _manifest(
    ledger: Ledger,
    options: dict[str, Any],
    request: Request,
    used: Sequence[Entry],
    done: Sequence[ShardDone],
    refused: int,
) -> Manifest:
    category = request.kind
    shards, first = [], 0
    for shard in done:
        if shard.count:
            shards.append(
                Shard(file=shard.file, first=first, count=shard.count, sha256=shard.sha256)
            )
        first += shard.count
    if not first:
        reasons = {why for shard in done for why in shard.failed.values()}
        raise GenerateError(f"{ledger.folder}: expected samples, found none: {'; '.join(reasons)}")
    return Manifest(
        category=request.category,
        split=request.split,
        count=first,
        points=request.settings.points,
        parts=category.parts,
        joints=category.joints,
        options=options,
        seed=request.seed,
        instances=tuple(entry.instance for entry in used),
        shards=tuple(shards),
        versions=ledger.versions,
        plan_digest=plan_digest(used, [shard.plan for shard in done]),
        digest=shards_digest(tuple(shards)),
        statistics=_statistics(request, done, refused),
    )


def _statistics(request: Request, done: Sequence[ShardDone], refused: int) -> dict[str, float]:
    views, draws = sum(shard.views for shard in done), sum(shard.draws for shard in done)
    return {
        "views": views,
        "draws": draws,
        "redrawn_share": round((draws - views) / draws, 6) if draws else 0.0,
        "objects_failed": len({name for shard in done for name in shard.failed}),
        "objects_refused": refused,
        "samples_lost": request.count - sum(shard.count for shard in done),
    }
