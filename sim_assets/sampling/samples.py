# SPDX-License-Identifier: MIT
"""Labelled samples: views are drawn, rendered, checked, and drawn again if they show too little.

A `SampleMaker` makes those of one object. `render_together` does several of them at once, with a
renderer that shows many objects in one pass: each `ViewBatch` has a sub-scene of its own; in every
round each says which picture it needs next, all are rendered together, and each goes on with its
own. The samples are those that the object gives alone.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import TypeVar

import numpy as np

from scapo.geometry.camera import Intrinsics
from sim_assets.objects import ArticulatedObject
from sim_assets.options import Mask, Noise, PresetName, Protocol, Sampling
from sim_assets.rendering.base import (
    AbstractParallelRenderer,
    AbstractRenderer,
    Backend,
    Frame,
    RenderError,
    RenderRequest,
)
from sim_assets.sampling.ambiguity import Ambiguity
from sim_assets.sampling.cloud import (
    FPS_POOL,
    Cloud,
    SurfaceSamples,
    Truth,
    sample_frames,
    truth,
    visible_pixels,
)
from sim_assets.sampling.images import image_rows
from sim_assets.sampling.presets import find_preset, least_points
from sim_assets.sampling.viewpoints import (
    Outline,
    View,
    ViewOptions,
    draw_preset_views,
    generator,
    rotation,
)
from sim_assets.sensors.depth_camera import Sensor, measure_some

Row = dict[str, np.ndarray]
"""One sample: the tensors of docs/data-format.md without their first dimension; its pictures."""

Key = tuple[object, ...]
"""Of a view: seeds its random numbers."""

Result = TypeVar("Result")
Steps = Generator[list[RenderRequest], list[Frame], Result]
"""Yields the pictures that it needs next and is sent them; so that whoever has a renderer may
render those of several objects at once."""

LEAST_PIXELS = 200
"""Visible pixels below which a view is drawn again (docs/data-format.md)."""
LEAST_POINTS = 16
"""Points of each part below which a view is drawn again (docs/benchmark.md)."""
SENSED = 3
"""Pixels for which the sensor is simulated, for each point: some measure nothing."""
MAX_DRAWS = 100
"""Draws of one view after which an object counts as impossible to show."""
BATCH = 64
"""Views that are framed together."""


class ViewError(ValueError):
    """An object cannot be shown as asked: `instance: expected, found`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How objects are turned into samples: all that changes pixels but the objects."""

    protocol: Protocol
    """joint: the whole object in one picture. isolated: a picture of each part alone, merged.
    full: points of the whole surface."""
    backend: Backend | None
    """None where no pictures are needed, as for `full`."""
    camera: Intrinsics
    points: int
    sampling: Sampling
    color: bool
    states_per_view: int
    preset: PresetName = "sim-art"
    """Of states and views."""
    held_out: bool = False
    """A test split: eyeglasses then have a published grid of their own."""
    noise: Noise = "none"
    mask: Mask = "exact"
    ambiguity: bool = False
    """Say which turns look alike."""
    images: bool = False
    """Keep each sample's picture; its other tensors stay as they are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedView:
    """The samples of one view."""

    rows: list[Row]
    """One per state."""
    draws: int
    """1 if the first draw was good."""
    plan: bytes
    """States and camera of the first draw in whole 1e-6: the same on every machine."""


class SampleMaker:
    """Makes the samples of one object with a renderer."""

    def __init__(
        self, renderer: AbstractRenderer | None, thing: ArticulatedObject, settings: Settings
    ) -> None:
        """Open the object in the renderer, if there is one; `steps` does without."""
        self.renderer, self.thing, self.settings = renderer, thing, settings
        self.outline = Outline(thing)
        self.surface = SurfaceSamples(thing, color=settings.color)
        parts = len(thing.visuals)
        self.least = min(LEAST_POINTS, max(1, settings.points // (4 * parts)))
        self.preset_least = least_points(settings.preset, settings.protocol, parts, settings.points)
        self.paired = find_preset(settings.preset).paired
        self.sensor = Sensor(noise=settings.noise, mask=settings.mask)
        pool = FPS_POOL if settings.sampling == "fps" else SENSED
        self.enough = pool * max(settings.points, LEAST_PIXELS)
        names = [field.name for field in fields(ViewOptions)]
        self.view_options = ViewOptions(**{name: getattr(settings, name) for name in names})
        self.ambiguity = None
        if settings.ambiguity:
            self.ambiguity = Ambiguity(thing, settings.camera, settings.noise, settings.protocol)
        if renderer is not None:
            renderer.open(thing)

    def render_views(self, keys: Sequence[Key]) -> Iterator[RenderedView]:
        """One view per key, in order; a view is a function of object, settings and its key.

        Raises:
            ViewError: No draw of a view was good.
        """
        for start in range(0, len(keys), BATCH):
            yield from self._follow(self.steps(keys[start : start + BATCH]))

    def _follow(self, steps: Steps[list[RenderedView]]) -> list[RenderedView]:
        """Do the steps with the renderer."""
        try:
            requests = next(steps)
            while True:
                requests = steps.send([self._render(request) for request in requests])
        except StopIteration as end:
            return end.value

    def _render(self, request: RenderRequest) -> Frame:
        if self.renderer is None:
            raise RenderError("expected a renderer, found none")
        return self.renderer.render(
            request.state, request.camera_T_object, request.camera, request.only
        )

    def steps(self, keys: Sequence[Key]) -> Steps[list[RenderedView]]:
        """As `render_views`, for at most BATCH keys: draw all, then again those that are poor.

        Raises:
            ViewError: No draw of a view was good.
        """
        rendered: dict[int, RenderedView] = {}
        plans: list[bytes] = []
        for draws in range(1, MAX_DRAWS + 1):
            poor = [k for k in range(len(keys)) if k not in rendered]
            rngs = [generator(*keys[k], draws - 1) for k in poor]
            views = draw_preset_views(self.outline, rngs, self.view_options)
            plans = plans or [_plan_bytes(view) for view in views]
            for k, rng, view in zip(poor, rngs, views, strict=True):
                rows = yield from self._rows(view, rng)
                if rows is not None:
                    rendered[k] = RenderedView(rows=rows, draws=draws, plan=plans[k])
            if len(rendered) == len(keys):
                return [rendered[k] for k in range(len(keys))]
        raise ViewError(
            f"{self.thing.instance}: expected a view with {LEAST_PIXELS} visible pixels and "
            f"{self.least} of {self.settings.points} points on each part, found none in "
            f"{MAX_DRAWS} draws"
        )

    def _rows(self, view: View, rng: np.random.Generator) -> Steps[list[Row] | None]:
        """Samples of all states, or None if one of them shows too little."""
        rows = []
        for state in view.states:
            row = yield from self._row(state, view, rng)
            if row is None:
                return None
            rows.append(row)
        return rows

    def _row(self, state: np.ndarray, view: View, rng: np.random.Generator) -> Steps[Row | None]:
        settings, images = self.settings, {}
        known = truth(self.thing, state, view.camera_T_object)
        if settings.protocol == "full" and not self.paired:
            visible = np.ones(len(known.camera_T_part))
            cloud = self.surface.sample(
                known.camera_T_part, settings.points, self.least, rng, settings.sampling
            )
        else:
            frames = yield self._requests(state, view)
            sensed = measure_some(frames, settings.camera, rng, self.sensor, self.enough)
            seen = visible_pixels(sensed)
            if sum(len(pixels) for pixels in seen) < LEAST_PIXELS:
                return None
            cloud = sample_frames(
                sensed, seen, settings.camera, settings.points, rng, settings.sampling
            )
            visible = self.surface.visible(frames, settings.camera, known.camera_T_part)
            if settings.images:
                images = image_rows(frames[0], settings.camera, rng, self.sensor)
        if not self._enough(cloud):
            return None
        if self.paired:
            known, cloud, visible = self._whole(state, view, rng)
        return {
            **_cloud_row(cloud, settings.color),
            "camera_T_part": known.camera_T_part.astype(np.float32),
            "joint_pivot": known.pivot.astype(np.float32),
            "joint_axis": known.axis.astype(np.float32),
            "joint_state": known.state.astype(np.float32),
            "visible": visible.astype(np.float32),
            "camera": np.array(settings.camera.row(), np.float32),
            **self._alike(state, known.camera_T_part[0]),
            **images,
        }

    def _whole(
        self, state: np.ndarray, view: View, rng: np.random.Generator
    ) -> tuple[Truth, Cloud, np.ndarray]:
        """The whole surface where a good view shows it, turned about the object's origin.

        From a generator of its own, which leaves the view's as it would be without: what is redrawn
        is what `sim-art` redraws.
        """
        (own,) = rng.spawn(1)
        pose = view.camera_T_object.copy()
        pose[:3, :3] = rotation(None, own)
        known = truth(self.thing, state, pose)
        count, sampling = self.settings.points, self.settings.sampling
        cloud = self.surface.sample(known.camera_T_part, count, self.least, own, sampling)
        return known, cloud, np.ones(len(known.camera_T_part))

    def _alike(self, state: np.ndarray, camera_T_object: np.ndarray) -> Row:
        """The tensors of `ambiguity`, if they are asked for."""
        if self.ambiguity is None:
            return {}
        return self.ambiguity.find(state, camera_T_object).row()

    def _enough(self, cloud: Cloud) -> bool:
        """Whether each part has the points it needs."""
        parts = len(self.thing.visuals)
        per_part = np.bincount(cloud.part, minlength=parts)[:parts]
        return bool((per_part >= np.maximum(self.least, self.preset_least)).all())

    def _requests(self, state: np.ndarray, view: View) -> list[RenderRequest]:
        """The pictures of a sample: of the whole object, or of each part alone."""
        parts = range(len(self.thing.visuals))
        return [
            RenderRequest(
                state=state,
                camera_T_object=view.camera_T_object,
                camera=self.settings.camera,
                only=only,
            )
            for only in (parts if self.settings.protocol == "isolated" else (None,))
        ]


def _cloud_row(cloud: Cloud, color: bool) -> Row:
    row = {"points": cloud.points, "part": cloud.part}
    if color and cloud.color is not None:
        row["color"] = cloud.color
    return row


def _plan_bytes(view: View) -> bytes:
    numbers = np.concatenate([view.states.ravel(), view.camera_T_object[:3].ravel()])
    return np.rint(numbers * 1e6).astype("<i8").tobytes()


@dataclass(slots=True, kw_only=True, eq=False)
class ViewBatch:
    """Views of one object that are rendered one after the other in a sub-scene."""

    maker: SampleMaker
    """Without a renderer."""
    keys: Sequence[Key]
    rendered: list[RenderedView] = field(default_factory=list)
    """Of the keys, once done."""
    error: Exception | None = None
    """Why it failed."""


def split_batches(
    makers: Sequence[tuple[SampleMaker, Sequence[Key]]], capacity: int
) -> list[list[ViewBatch]]:
    """The views of each object as batches of equal length, about as many as sub-scenes."""
    total = sum(len(keys) for _, keys in makers)
    length = min(BATCH, max(1, math.ceil(total / capacity)))
    return [
        [
            ViewBatch(maker=maker, keys=keys[start : start + length])
            for start in range(0, len(keys), length)
        ]
        for maker, keys in makers
    ]


def render_together(
    renderer: AbstractParallelRenderer,
    batches: Sequence[ViewBatch],
    on_progress: Callable[[ViewBatch], None],
) -> None:
    """Render the batches; each ends with its views or with an error, which costs that batch only.

    Args:
        renderer: Shows the objects of all batches, as many at once as its capacity.
        batches: To be rendered, in place.
        on_progress: Called with each batch that has ended, and with one that has not in each round.

    Raises:
        RenderError: The objects cannot be shown, or the device failed.
    """
    for start in range(0, len(batches), renderer.capacity):
        _render_batches(renderer, batches[start : start + renderer.capacity], on_progress)


def _render_batches(
    renderer: AbstractParallelRenderer,
    batches: Sequence[ViewBatch],
    on_progress: Callable[[ViewBatch], None],
) -> None:
    renderer.open_all([batch.maker.thing for batch in batches])
    steps = [batch.maker.steps(batch.keys) for batch in batches]
    pending = [_advance(batch, step, None) for batch, step in zip(batches, steps, strict=True)]
    while any(requests is not None for requests in pending):
        frames = _render(renderer, pending)
        for k, (batch, step) in enumerate(zip(batches, steps, strict=True)):
            if pending[k] is not None:
                pending[k] = _advance(batch, step, frames[k])
                if pending[k] is None:
                    on_progress(batch)
        unfinished = [
            b for b, requests in zip(batches, pending, strict=True) if requests is not None
        ]
        if unfinished:
            on_progress(unfinished[0])


def _advance(
    batch: ViewBatch, steps: Steps[list[RenderedView]], frames: list[Frame] | None
) -> list[RenderRequest] | None:
    """What the batch needs next; None when it has ended."""
    try:
        return next(steps) if frames is None else steps.send(frames)
    except StopIteration as end:
        batch.rendered = end.value
    except RenderError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this batch only
        batch.error = error
    return None


def _render(
    renderer: AbstractParallelRenderer, pending: Sequence[list[RenderRequest] | None]
) -> list[list[Frame]]:
    """The frames that each batch requested: the first of each together, then the second, ..."""
    frames: list[list[Frame]] = [[] for _ in pending]
    for number in range(max(len(requests) for requests in pending if requests is not None)):
        rendered = renderer.render_all(
            [
                requests[number] if requests is not None and number < len(requests) else None
                for requests in pending
            ]
        )
        for k, frame in enumerate(rendered):
            if frame is not None:
                frames[k].append(frame)
    return frames


def geometry_digest(thing: ArticulatedObject) -> str:
    """SHA-256 of an object's surfaces and joints in whole 1e-6 m and rad."""
    digest = hashlib.sha256()
    for part in range(len(thing.visuals)):
        mesh = thing.part_mesh(part)
        digest.update(np.rint(np.asarray(mesh.vertices) * 1e6).astype("<i8").tobytes())
        digest.update(np.asarray(mesh.faces).astype("<i8").tobytes())
    for numbers in (thing.pivot, thing.axis, thing.upper):
        digest.update(np.rint(numbers * 1e6).astype("<i8").tobytes())
    return digest.hexdigest()
