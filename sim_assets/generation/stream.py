# SPDX-License-Identifier: MIT
"""Samples made on the fly, in this process, without touching the disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from itertools import cycle
from typing import Any

import torch
from torch import Tensor

from scapo.categories import Category
from scapo.store.schema import UNLABELLED
from scapo.types import Joints, Labels, Observation, Sample, SampleKey
from sim_assets.generation.assets import Asset
from sim_assets.generation.plan import Request, samples_per_instance
from sim_assets.generation.request import make_request
from sim_assets.options import DataOptions
from sim_assets.rendering.backends import make_renderer
from sim_assets.sampling.samples import Row, SampleMaker


def stream(category: str | Category, **options: Any) -> Iterator[Sample]:  # noqa: ANN401
    """See `sim_assets.generate_samples`."""
    request, assets = make_request(category, DataOptions(**options))
    return _samples(request, assets[: request.instances])


def _samples(request: Request, assets: Sequence[Asset]) -> Iterator[Sample]:
    settings = request.settings
    each = samples_per_instance(request, len(assets))
    runs = range(0, request.count, each)
    backend = settings.backend
    opened = nullcontext() if backend is None else make_renderer(backend, color=settings.color)
    with opened as renderer:
        for first, asset in zip(runs, cycle(assets), strict=False):
            last = min(first + each, request.count)
            states = settings.states_per_view
            maker = SampleMaker(renderer, asset.load(), settings)
            keys = [request.key(view) for view in range(first // states, last // states)]
            rows = (row for view in maker.render_views(keys) for row in view.rows)
            for index, row in enumerate(rows, first):
                yield _sample(request, row, index, maker.thing.instance)


def _sample(request: Request, row: Row, index: int, instance: str) -> Sample:
    tensors: dict[str, Tensor] = {name: torch.from_numpy(array) for name, array in row.items()}
    part = tensors["part"].long()
    color = tensors.get("color")
    return Sample(
        key=SampleKey(
            category=request.category, split=request.split, index=index, instance=instance
        ),
        observation=Observation(
            points=tensors["points"], color=None if color is None else color.float() / 255
        ),
        labels=Labels(
            part=torch.where(part == UNLABELLED, -1, part),
            camera_T_part=tensors["camera_T_part"],
            joints=Joints(
                pivot=tensors["joint_pivot"],
                axis=tensors["joint_axis"],
                state=tensors["joint_state"],
            ),
        ),
        visible=tensors["visible"],
        camera=tensors["camera"],
    )
