# SPDX-License-Identifier: MIT
"""Labelled samples of one object: views are drawn, rendered, checked, and drawn again if poor.

Samples of several objects at once, with a renderer that shows them all in one picture-taking.

Each take makes some views of one object, in a place of its own. In every round each take says which
picture it needs next, all are drawn together, and each take goes on with its own. Samples are those
that the object gives alone.
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
from sim_assets.options import Mask, Noise, Preset, Protocol, Sampling
from sim_assets.rendering.base import (
    AbstractParallelRenderer,
    AbstractRenderer,
    Ask,
    Backend,
    Frame,
    RenderError,
)
from sim_assets.sampling.cloud import (
    FPS_POOL,
    Cloud,
    Surface,
    Truth,
    sample_frames,
    truth,
    visible_pixels,
)
from sim_assets.sampling.presets import least_points, rules
from sim_assets.sampling.viewpoints import (
    Outline,
    View,
    Wanted,
    draw_preset_views,
    generator,
    rotation,
)
from sim_assets.sensors.depth_camera import Sensor, measure_some

Row = dict[str, np.ndarray]
"""One sample: the tensors of CONTRACT 3 without their first dimension."""

Done = TypeVar("Done")
Steps = Generator[list[Ask], list[Frame], Done]
"""Yields the pictures that it needs next and is sent them; so that whoever has a renderer may take
those of several objects at once."""

LEAST_PIXELS = 200
"""Visible pixels below which a view is drawn again (CONTRACT 3)."""
LEAST_POINTS = 16
"""Points of each part below which a view is drawn again (CONTRACT 4)."""
SENSED = 3
"""Pixels for which the sensor is simulated, for each that is needed: some measure nothing."""
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
    preset: Preset = "sim-art"
    """Of states and views."""
    held_out: bool = False
    """A test split: eyeglasses then have a published grid of their own."""
    noise: Noise = "none"
    mask: Mask = "exact"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """What became of one view."""

    rows: list[Row]
    """One per state."""
    draws: int
    """1 if the first draw was good."""
    plan: bytes
    """States and camera of the first draw in whole 1e-6: the same on every machine."""


class Shooter:
    """Makes samples of one object with an open renderer."""

    def __init__(
        self, renderer: AbstractRenderer | None, thing: ArticulatedObject, settings: Settings
    ) -> None:
        """Open the object in the renderer, if there is one; `steps` does without."""
        self.renderer, self.thing, self.settings = renderer, thing, settings
        self.outline = Outline(thing)
        self.surface = Surface(thing, color=settings.color)
        parts = len(thing.visuals)
        self.least = min(LEAST_POINTS, max(1, settings.points // (4 * parts)))
        self.asked = least_points(settings.preset, settings.protocol, parts, settings.points)
        self.paired = rules(settings.preset).paired
        self.sensor = Sensor(noise=settings.noise, mask=settings.mask)
        pool = FPS_POOL if settings.sampling == "fps" else SENSED
        self.enough = pool * max(settings.points, LEAST_PIXELS)
        shared = {field.name: getattr(settings, field.name) for field in fields(Wanted)}
        self.wanted = Wanted(**shared)
        if renderer is not None:
            renderer.open(thing)

    def shots(self, keys: Sequence[tuple[object, ...]]) -> Iterator[Shot]:
        """One shot per key, in order; a shot is a function of object, settings and its key.

        Raises:
            ViewError: No draw of a view was good.
        """
        for start in range(0, len(keys), BATCH):
            yield from self._follow(self.steps(keys[start : start + BATCH]))

    def _follow(self, steps: Steps[list[Shot]]) -> list[Shot]:
        """Do the steps with the renderer."""
        try:
            asks = next(steps)
            while True:
                asks = steps.send([self._render(ask) for ask in asks])
        except StopIteration as end:
            return end.value

    def _render(self, ask: Ask) -> Frame:
        if self.renderer is None:
            raise RenderError("expected a renderer, found none")
        return self.renderer.render(ask.state, ask.camera_T_object, ask.camera, ask.only)

    def steps(self, keys: Sequence[tuple[object, ...]]) -> Steps[list[Shot]]:
        """As `shots`, for at most BATCH keys: draw all, then again those that are poor.

        Raises:
            ViewError: No draw of a view was good.
        """
        shots: dict[int, Shot] = {}
        plans: list[bytes] = []
        for draws in range(1, MAX_DRAWS + 1):
            poor = [k for k in range(len(keys)) if k not in shots]
            rngs = [generator(*keys[k], draws - 1) for k in poor]
            views = draw_preset_views(self.outline, rngs, self.wanted)
            plans = plans or [_plan_bytes(view) for view in views]
            for k, rng, view in zip(poor, rngs, views, strict=True):
                rows = yield from self._rows(view, rng)
                if rows is not None:
                    shots[k] = Shot(rows=rows, draws=draws, plan=plans[k])
            if len(shots) == len(keys):
                return [shots[k] for k in range(len(keys))]
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
        settings = self.settings
        known = truth(self.thing, state, view.camera_T_object)
        if settings.protocol == "full" and not self.paired:
            visible = np.ones(len(known.camera_T_part))
            cloud = self.surface.sample(
                known.camera_T_part, settings.points, self.least, rng, settings.sampling
            )
        else:
            frames = yield self._asks(state, view)
            sensed = measure_some(frames, settings.camera, rng, self.sensor, self.enough)
            seen = visible_pixels(sensed)
            if sum(len(pixels) for pixels in seen) < LEAST_PIXELS:
                return None
            cloud = sample_frames(
                sensed, seen, settings.camera, settings.points, rng, settings.sampling
            )
            visible = self.surface.visible(frames, settings.camera, known.camera_T_part)
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

    def _enough(self, cloud: Cloud) -> bool:
        """Whether each part has the points it needs."""
        parts = len(self.thing.visuals)
        per_part = np.bincount(cloud.part, minlength=parts)[:parts]
        return bool((per_part >= np.maximum(self.least, self.asked)).all())

    def _asks(self, state: np.ndarray, view: View) -> list[Ask]:
        """The pictures of a sample: of the whole object, or of each part alone."""
        parts = range(len(self.thing.visuals))
        return [
            Ask(
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


Key = tuple[object, ...]


@dataclass(slots=True, kw_only=True, eq=False)
class Take:
    """Views of one object that are made one after the other."""

    shooter: Shooter
    """Without a renderer."""
    keys: Sequence[Key]
    shots: list[Shot] = field(default_factory=list)
    """Of the keys, once done."""
    error: Exception | None = None
    """Why it failed."""


def divide(shooters: Sequence[tuple[Shooter, Sequence[Key]]], places: int) -> list[list[Take]]:
    """The views of each object as takes of equal length, about as many as there are places."""
    total = sum(len(keys) for _, keys in shooters)
    length = min(BATCH, max(1, math.ceil(total / places)))
    return [
        [
            Take(shooter=shooter, keys=keys[start : start + length])
            for start in range(0, len(keys), length)
        ]
        for shooter, keys in shooters
    ]


def shoot_together(
    renderer: AbstractParallelRenderer,
    takes: Sequence[Take],
    heard: Callable[[Take], None],
) -> None:
    """Do the takes; each ends with its shots or with an error, which costs that take only.

    Args:
        renderer: Shows the objects of all takes, as many at once as it has places.
        takes: To be done, in place.
        heard: Called with each take that has ended, and with one that has not in each round.

    Raises:
        RenderError: The objects cannot be shown, or the device failed.
    """
    for start in range(0, len(takes), renderer.places):
        _shoot_all(renderer, takes[start : start + renderer.places], heard)


def _shoot_all(
    renderer: AbstractParallelRenderer, takes: Sequence[Take], heard: Callable[[Take], None]
) -> None:
    renderer.open_all([take.shooter.thing for take in takes])
    steps = [take.shooter.steps(take.keys) for take in takes]
    asked = [_advance(take, step, None) for take, step in zip(takes, steps, strict=True)]
    while any(asks is not None for asks in asked):
        pictures = _render(renderer, asked)
        for k, (take, step) in enumerate(zip(takes, steps, strict=True)):
            if asked[k] is not None:
                asked[k] = _advance(take, step, pictures[k])
                if asked[k] is None:
                    heard(take)
        waiting = [take for take, asks in zip(takes, asked, strict=True) if asks is not None]
        if waiting:
            heard(waiting[0])


def _advance(take: Take, steps: Steps[list[Shot]], frames: list[Frame] | None) -> list[Ask] | None:
    """What the take needs next; None when it has ended."""
    try:
        return next(steps) if frames is None else steps.send(frames)
    except StopIteration as end:
        take.shots = end.value
    except RenderError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever it is, it costs this take only
        take.error = error
    return None


def _render(
    renderer: AbstractParallelRenderer, asked: Sequence[list[Ask] | None]
) -> list[list[Frame]]:
    """The pictures that each take asked for: the first of each together, then the second, ..."""
    pictures: list[list[Frame]] = [[] for _ in asked]
    for number in range(max(len(asks) for asks in asked if asks is not None)):
        frames = renderer.render_all(
            [asks[number] if asks is not None and number < len(asks) else None for asks in asked]
        )
        for k, frame in enumerate(frames):
            if frame is not None:
                pictures[k].append(frame)
    return pictures
