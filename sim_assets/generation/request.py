# SPDX-License-Identifier: MIT
"""From options to a request: the objects to choose from, the renderer, the camera."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from math import ceil

from scapo.categories import Category
from scapo.categories import category as find_category
from scapo.store.manifest import MAX_POINTS
from sim_assets.generation.assets import Asset, folder_assets, procedural_assets
from sim_assets.generation.plan import Request
from sim_assets.models.frames import check_wanted
from sim_assets.options import DataOptions
from sim_assets.rendering.backends import resolve_backend
from sim_assets.rendering.base import Backend
from sim_assets.sampling.presets import camera, find_preset
from sim_assets.sampling.samples import Settings

SAMPLES_PER_INSTANCE = 50
"""By default, as the benchmark's training split (docs/benchmark.md)."""
MIN_IMAGE, MAX_IMAGE = 32, 4096
LEAST_POINTS = 8


def make_request(
    category: str | Category, options: DataOptions, models: Sequence[Asset] | None = None
) -> tuple[Request, list[Asset]]:
    """The request and the objects to choose from.

    Args:
        category: Of the objects.
        options: What data to make.
        models: Of the folder `options.source`, chosen by the caller; by default those of its split.

    Raises:
        ValueError: An option is out of range, the category is unknown, or has no such objects.
        RenderError: The backend does not work here.
    """
    kind = category if isinstance(category, Category) else find_category(category)
    _check(options)
    procedural = options.source == "procedural"
    if procedural:
        instances = options.instances or ceil(options.count / SAMPLES_PER_INSTANCE)
        assets = procedural_assets(kind.name, options.split, options.seed, instances)
    else:
        assets = _models(kind, options) if models is None else list(models)
        views = options.count // options.states_per_view
        instances = options.instances or min(len(assets), views)
    given = {name: getattr(options, name) for name in ("up", "front", "scale")}
    given["any_model"] = options.any_model or None
    request = Request(
        kind=kind,
        split=options.split,
        seed=options.seed,
        count=options.count,
        instances=instances,
        source="procedural" if procedural else "urdf",
        source_options={name: value for name, value in given.items() if value is not None},
        settings=make_settings(options),
    )
    return request, assets


def versions(backend: Backend | None) -> dict[str, str]:
    """Versions of what makes the pixels here; of no renderer where the backend is None."""
    names = ["scapo", "numpy", "trimesh"]
    drawn: dict[str, str] = {}
    if backend == "raycast":
        names.append("embreex")
    elif backend == "sapien":
        from sim_assets.rendering import sapien as scene

        drawn = scene.versions()
    elif backend == "maniskill":
        from sim_assets.rendering import maniskill as parallel_scene

        drawn = parallel_scene.versions()
    return {**{name: metadata.version(name) for name in names}, **drawn}


def make_settings(options: DataOptions) -> Settings:
    """What decides a view's pixels, besides its object.

    Raises:
        ValueError: Options that contradict each other.
        RenderError: The backend does not work here.
    """
    preset = find_preset(options.preset)
    protocol = options.protocol or preset.protocol
    if preset.paired and protocol != "full":
        raise ValueError(f"protocol: expected full with preset {options.preset}, found {protocol}")
    needed = protocol != "full" or preset.paired
    if protocol == "full" and (options.noise, options.mask) != ("none", "exact"):
        raise ValueError(
            f"noise and mask: expected none and exact with protocol full, which has no picture, "
            f"found {options.noise} and {options.mask}"
        )
    if options.images and protocol != "joint":
        raise ValueError(f"images: expected protocol joint, found {protocol}")
    if options.ambiguity:
        if protocol == "isolated":
            raise ValueError("ambiguity: expected protocol joint or full, found isolated")
        if needed:
            resolve_backend("raycast")  # turned objects are rendered by it, whatever the backend
    return Settings(
        protocol=protocol,
        backend=resolve_backend(options.backend) if needed else None,
        camera=camera(options.preset, options.image_size),
        points=options.points,
        sampling=options.sampling or preset.sampling,
        color=options.color,
        states_per_view=options.states_per_view,
        preset=options.preset,
        held_out=options.split in ("test", "test-ood"),
        noise=options.noise,
        mask=options.mask,
        ambiguity=options.ambiguity,
        images=options.images,
    )


def _models(category: Category, options: DataOptions) -> list[Asset]:
    if options.split == "test-ood":
        raise ValueError("split test-ood: expected procedural objects, found --source with a path")
    found = folder_assets(category, options)
    if options.instances is not None and options.instances > len(found):
        raise ValueError(
            f"instances: expected at most {len(found)}, the models of split {options.split!r} in "
            f"{options.source}, found {options.instances}"
        )
    return found


def _check(options: DataOptions) -> None:
    """Refuse values out of range.

    Raises:
        ValueError: `option: expected, found`.
    """
    least: Sequence[tuple[str, int | None, int]] = (
        ("count", options.count, 1),
        ("instances", options.instances, 1),
        ("seed", options.seed, 0),
        ("points", options.points, LEAST_POINTS),
        ("states_per_view", options.states_per_view, 1),
        ("image_size", options.image_size, MIN_IMAGE),
    )
    for name, value, minimum in least:
        if value is not None and value < minimum:
            raise ValueError(f"{name}: expected {minimum} or more, found {value}")
    most: Sequence[tuple[str, int | None, int]] = (
        ("states_per_view", options.states_per_view, MAX_POINTS // LEAST_POINTS),
        ("points", options.points, MAX_POINTS // options.states_per_view),  # whole views a shard
        ("image_size", options.image_size, MAX_IMAGE),
    )
    for name, value, maximum in most:
        if value is not None and value > maximum:
            raise ValueError(f"{name}: expected {maximum} or less, found {value}")
    if options.count % options.states_per_view:
        raise ValueError(
            f"count: expected a multiple of states_per_view, {options.states_per_view}, found "
            f"{options.count}"
        )
    views = options.count // options.states_per_view
    if options.instances is not None and options.instances > views:
        raise ValueError(
            f"instances: expected at most {views}, the views that count gives, found "
            f"{options.instances}"
        )
    wanted = options.up, options.front, options.scale
    asked = options.any_model or any(value is not None for value in wanted)
    if options.source == "procedural" and asked:
        names = "up, front, scale, any_model"
        raise ValueError(f"{names}: expected only with a --source folder of models")
    check_wanted(*wanted)
