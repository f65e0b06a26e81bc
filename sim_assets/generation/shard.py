# SPDX-License-Identifier: MIT
"""The jobs that workers do: describe an object, and render a shard to its file.

A shard's objects are shown one after the other, or several at once where the renderer can.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from socket import gethostname
from typing import Any

import numpy as np

from scapo.parallel.pool import Report, describe_error
from scapo.store import SAMPLES, read_header, write
from scapo.store.json_records import from_json
from sim_assets.generation.assets import Asset
from sim_assets.generation.images import write_images
from sim_assets.generation.plan import Entry, Piece, Request, ShardPlan, instance_record
from sim_assets.generation.request import versions
from sim_assets.objects import ArticulatedObject
from sim_assets.rendering.backends import make_renderer
from sim_assets.rendering.base import AbstractParallelRenderer, AbstractRenderer, Backend
from sim_assets.sampling.samples import (
    RenderedView,
    Row,
    SampleMaker,
    ViewBatch,
    geometry_digest,
    render_together,
    split_batches,
)

REPORT_EVERY = 8
"""Views between two signs of life: each crosses to the parent process."""
TOGETHER = "several objects at once"
"""What a worker reports that shows them."""


def render_piece(
    request: Request, piece: Piece, renderer: AbstractRenderer | None, report: Report
) -> list[RenderedView]:
    """Views of one object.

    Raises:
        ValueError: The object is no longer the one that was planned.
        ViewError: It cannot be shown as asked.
        RenderError: The renderer failed.
    """
    settings = request.settings
    name = piece.entry.instance.id
    maker = SampleMaker(renderer, load(piece, report), settings)
    rendered, reported = [], 0
    for view in maker.render_views(_keys(request, piece)):
        rendered.append(view)
        if len(rendered) - reported >= REPORT_EVERY or len(rendered) == piece.views:
            report(name, (len(rendered) - reported) * settings.states_per_view)
            reported = len(rendered)
    return rendered


def render_pieces(
    request: Request, pieces: Sequence[Piece], renderer: AbstractParallelRenderer, report: Report
) -> dict[int, list[RenderedView] | Exception]:
    """Views of several objects at once, by the piece's first view.

    Those that are not in the answer were not shown because the renderer failed: they may be tried
    one by one.
    """
    made: dict[int, list[RenderedView] | Exception] = {}
    shown: list[tuple[Piece, SampleMaker]] = []
    for piece in pieces:
        thing = _try_load(piece, report)
        if isinstance(thing, Exception):
            made[piece.first] = thing
        else:
            shown.append((piece, SampleMaker(None, thing, request.settings)))
    if not shown:
        return made
    label = TOGETHER if len(shown) > 1 else shown[0][0].entry.instance.id
    reported = 0

    def on_progress(batch: ViewBatch) -> None:
        nonlocal reported
        amount = len(batch.rendered) * request.settings.states_per_view
        reported += amount
        report(label, amount)

    report(label, 0)
    groups = split_batches([(maker, _keys(request, p)) for p, maker in shown], renderer.capacity)
    try:
        render_together(renderer, [batch for group in groups for batch in group], on_progress)
    except Exception:
        if len(shown) == 1:
            raise
        report(label, -reported)
        return made
    for (piece, _), group in zip(shown, groups, strict=True):
        errors = [batch.error for batch in group if batch.error is not None]
        made[piece.first] = (
            errors[0] if errors else [view for batch in group for view in batch.rendered]
        )
    return made


def _try_load(piece: Piece, report: Report) -> ArticulatedObject | Exception:
    try:
        return load(piece, report)
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this object only
        return error


def load(piece: Piece, report: Report) -> ArticulatedObject:
    """The object of a piece.

    Raises:
        ValueError: It is no longer the one that was planned.
    """
    name = piece.entry.instance.id
    report(name, 0)
    thing = piece.entry.asset.load()
    if thing.origin.sha256 != piece.entry.instance.sha256:
        raise ValueError(
            f"{name}: expected files with sha256 {piece.entry.instance.sha256}, found "
            f"{thing.origin.sha256}: they have changed since this data set was begun"
        )
    return thing


def _keys(request: Request, piece: Piece) -> list[tuple[object, ...]]:
    return [request.key(view) for view in range(piece.first, piece.first + piece.views)]


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardJob:
    """Render one shard into a folder."""

    folder: Path
    request: Request
    plan: ShardPlan
    options: dict[str, Any]
    versions: dict[str, str]
    strict: bool
    """Fail at the first object that fails."""
    skip: Mapping[str, str] = field(default_factory=dict)
    """Instance -> reason: objects that killed or hung a worker before."""
    apart: bool = False
    """One object at a time, where the renderer shows several: one of them killed a worker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardDone:
    """What became of a shard; all but `sha256` is in its header too."""

    file: str
    count: int
    sha256: str
    plan: str
    """SHA-256 of the views' first-drawn states and cameras."""
    views: int
    draws: int
    failed: dict[str, str]
    """Instance -> reason, of objects that gave no samples."""


def describe(asset: Asset, report: Report) -> Entry:
    """Load an object once and record what the manifest says of it."""
    report(asset.name, 0)
    thing = asset.load()
    return Entry(asset=asset, instance=instance_record(thing), geometry=geometry_digest(thing))


def render_shard(job: ShardJob, report: Report) -> ShardDone:
    """Render the shard's objects one after the other and write the file.

    An object that fails is left out with its reason, unless `strict`.
    """
    rows: list[Row] = []
    rendered: list[RenderedView] = []
    failed: dict[str, str] = {}
    for piece, result in _results(job, report):
        if isinstance(result, Exception):
            name = piece.entry.instance.id
            if job.strict:
                raise result
            failed[name] = describe_error(result)
            report(name, piece.views * job.request.settings.states_per_view)
            continue
        rendered += result
        index = np.array(piece.index, np.int32)
        rows += [{**row, "instance": index} for view in result for row in view.rows]
    return _write(job, rows, rendered, failed)


def render_shard_alike(job: ShardJob, report: Report) -> ShardDone:
    """The same on another machine, which must make the same pixels.

    Raises:
        ValueError: What makes the pixels here has other versions than where the data set was begun.
    """
    settings = job.request.settings
    found = _versions(settings.backend)
    if found != job.versions:
        names = sorted(n for n in {*found, *job.versions} if found.get(n) != job.versions.get(n))
        expected, there = (
            ", ".join(f"{name} {what.get(name)}" for name in names)
            for what in (job.versions, found)
        )
        raise ValueError(f"machine {gethostname()}: expected {expected}, found {there}")
    return render_shard(job, report)


_versions = lru_cache(maxsize=4)(versions)


def _results(
    job: ShardJob, report: Report
) -> Iterator[tuple[Piece, list[RenderedView] | Exception]]:
    """What became of each object of the shard, in order."""
    settings = job.request.settings
    renderer = _renderer(settings.backend, settings.color)
    made: Mapping[int, list[RenderedView] | Exception] = {}
    if isinstance(renderer, AbstractParallelRenderer) and not job.apart:
        wanted = [p for p in job.plan.pieces if p.entry.instance.id not in job.skip]
        made = render_pieces(job.request, wanted, renderer, report)
    for piece in job.plan.pieces:
        if piece.entry.instance.id in job.skip:
            yield piece, RuntimeError(job.skip[piece.entry.instance.id])
        elif piece.first in made:
            yield piece, made[piece.first]
        else:
            yield piece, _try_piece(job.request, piece, renderer, report)


def _try_piece(
    request: Request, piece: Piece, renderer: AbstractRenderer | None, report: Report
) -> list[RenderedView] | Exception:
    try:
        if isinstance(renderer, AbstractParallelRenderer):
            return render_pieces(request, [piece], renderer, report)[piece.first]
        return render_piece(request, piece, renderer, report)
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this object only
        return error


@lru_cache(maxsize=1)
def _renderer(backend: Backend | None, color: bool) -> AbstractRenderer | None:
    return None if backend is None else make_renderer(backend, color=color)


def _write(
    job: ShardJob, rows: list[Row], rendered: list[RenderedView], failed: dict[str, str]
) -> ShardDone:
    digest = hashlib.sha256(b"".join(view.plan for view in rendered)).hexdigest()
    done = {
        "count": len(rows),
        "plan": digest,
        "views": len(rendered),
        "draws": sum(view.draws for view in rendered),
        "failed": failed,
    }
    header = {
        "format": SAMPLES,
        "category": job.request.category,
        "split": job.request.split,
        "seed": job.request.seed,
        "first": job.plan.first,
        "options": job.options,
        "versions": job.versions,
        **done,
    }
    path = job.folder / job.plan.file
    rows = write_images(path, rows, job.request.settings.camera)
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]} if rows else {}
    try:
        sha256 = write(path, arrays, header)
    except OSError as error:
        raise OSError(f"{path}: expected to be written, found: {error.strerror}") from error
    return ShardDone(file=job.plan.file, sha256=sha256, **done)


def read_done(path: Path, sha256: str) -> ShardDone:
    """What a finished shard says of itself; `sha256` is that of its bytes.

    Raises:
        StoreError: It is none of ours.
    """
    known = {"file": path.name, "sha256": sha256}
    return from_json(ShardDone, {**read_header(path, SAMPLES), **known}, str(path))
