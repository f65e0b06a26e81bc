# SPDX-License-Identifier: MIT
"""Clouds per second of `--backend maniskill` by objects at once: `many.py CATEGORY [OBJECTS ...]`.

One line of JSON per number of objects at once, with the device: labelled clouds per second of one
process (objects loaded before; scenes made, views drawn, rendered, sampled, labelled), and the
pictures per second of the renderer alone. Seconds are wall time, since a GPU is waited for.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator

from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions
from sim_assets.rendering.base import RenderRequest
from sim_assets.rendering.maniskill import ManiSkillRenderer
from sim_assets.sampling.samples import SampleMaker, render_together, split_batches
from sim_assets.sampling.viewpoints import draw_views, generator

OBJECTS = 16
"""Different objects at most; more sub-scenes show them several times."""
EACH = {True: 32, False: 8}
"""Views per sub-scene on CUDA, elsewhere."""
CAPACITIES = {True: (1, 4, 16, 64, 256, 1024), False: (1, 2, 4)}


def sweep(category: str, capacities: tuple[int, ...] = ()) -> Iterator[dict[str, float | str]]:
    """Rates for each number of objects at once."""
    cuda = ManiSkillRenderer().cuda
    options = DataOptions(count=10**6, instances=OBJECTS, backend="maniskill")
    request, assets = make_request(category, options)
    makers = [SampleMaker(None, asset.load(), request.settings) for asset in assets]
    device = versions("maniskill")["device"]
    _rates(makers[:1], 1, 1, request.key)  # shaders are compiled
    for number in capacities or CAPACITIES[cuda]:
        used = makers[: min(OBJECTS, number)]
        yield {"device": device, "at once": number, **_rates(used, number, EACH[cuda], request.key)}


def _rates(
    makers: list[SampleMaker], capacity: int, each: int, key: Callable[[int], tuple[object, ...]]
) -> dict[str, float]:
    total = capacity * each
    amount = -(-total // len(makers))
    groups = [
        (maker, [key(view) for view in range(i * amount, (i + 1) * amount)])
        for i, maker in enumerate(makers)
    ]
    renderer = ManiSkillRenderer(capacity=capacity)
    batches = [batch for group in split_batches(groups, capacity) for batch in group]
    started = time.perf_counter()
    render_together(renderer, batches, lambda batch: None)
    seconds = time.perf_counter() - started
    made = sum(len(batch.rendered) for batch in batches)
    alone = _pictures(renderer, makers, capacity, each)
    renderer.close()
    return {"clouds": round(made / seconds, 2), "pictures": round(alone, 2)}


def _pictures(
    renderer: ManiSkillRenderer, makers: list[SampleMaker], capacity: int, each: int
) -> float:
    """Of the renderer alone, scenes made before."""
    shown = [makers[number % len(makers)] for number in range(capacity)]
    camera = shown[0].settings.camera
    requests = []
    for number, maker in enumerate(shown):
        (view,) = draw_views(maker.outline, [generator(number)], camera)
        request = RenderRequest(
            state=view.states[0], camera_T_object=view.camera_T_object, camera=camera
        )
        requests.append(request)
    renderer.open_all([maker.thing for maker in shown])
    renderer.render_all(requests)
    started = time.perf_counter()
    for _ in range(each):
        renderer.render_all(requests)
    return capacity * each / (time.perf_counter() - started)


if __name__ == "__main__":
    for line in sweep(sys.argv[1], tuple(int(word) for word in sys.argv[2:])):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
