# SPDX-License-Identifier: MIT
"""Clouds per second of `--backend maniskill` by objects at once: `many.py CATEGORY [PLACES ...]`.

One line of JSON per number of places, with the device: labelled clouds per second of one process
(objects loaded before; scenes made, views drawn, rendered, sampled, labelled), and the pictures
per second of the renderer alone. Seconds are those of the clock, since a GPU is waited for.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator

from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions
from sim_assets.rendering.base import Ask
from sim_assets.rendering.maniskill import ManiSkillRenderer
from sim_assets.sampling.samples import Shooter, divide, shoot_together
from sim_assets.sampling.viewpoints import draw_views, generator

OBJECTS = 16
"""Different objects at most; more places show them several times."""
EACH = {True: 32, False: 8}
"""Views per place on CUDA, elsewhere."""
PLACES = {True: (1, 4, 16, 64, 256, 1024), False: (1, 2, 4)}


def sweep(category: str, places: tuple[int, ...] = ()) -> Iterator[dict[str, float | str]]:
    """Rates for each number of places."""
    cuda = ManiSkillRenderer().cuda
    options = DataOptions(count=10**6, instances=OBJECTS, backend="maniskill")
    request, assets = make_request(category, options)
    shooters = [Shooter(None, asset.load(), request.settings) for asset in assets]
    device = versions("maniskill")["device"]
    _rates(shooters[:1], 1, 1, request.key)  # shaders are compiled
    for number in places or PLACES[cuda]:
        used = shooters[: min(OBJECTS, number)]
        yield {"device": device, "places": number, **_rates(used, number, EACH[cuda], request.key)}


def _rates(
    shooters: list[Shooter], places: int, each: int, key: Callable[[int], tuple[object, ...]]
) -> dict[str, float]:
    total = places * each
    amount = -(-total // len(shooters))
    groups = [
        (shooter, [key(view) for view in range(i * amount, (i + 1) * amount)])
        for i, shooter in enumerate(shooters)
    ]
    renderer = ManiSkillRenderer(places=places)
    takes = [take for group in divide(groups, places) for take in group]
    started = time.perf_counter()
    shoot_together(renderer, takes, lambda take: None)
    seconds = time.perf_counter() - started
    made = sum(len(take.shots) for take in takes)
    alone = _pictures(renderer, shooters, places, each)
    renderer.close()
    return {"clouds": round(made / seconds, 2), "pictures": round(alone, 2)}


def _pictures(
    renderer: ManiSkillRenderer, shooters: list[Shooter], places: int, each: int
) -> float:
    """Of the renderer alone, scenes made before."""
    shown = [shooters[place % len(shooters)] for place in range(places)]
    camera = shown[0].settings.camera
    asks = []
    for place, shooter in enumerate(shown):
        (view,) = draw_views(shooter.outline, [generator(place)], camera)
        ask = Ask(state=view.states[0], camera_T_object=view.camera_T_object, camera=camera)
        asks.append(ask)
    renderer.open_all([shooter.thing for shooter in shown])
    renderer.render_all(asks)
    started = time.perf_counter()
    for _ in range(each):
        renderer.render_all(asks)
    return places * each / (time.perf_counter() - started)


if __name__ == "__main__":
    for line in sweep(sys.argv[1], tuple(int(word) for word in sys.argv[2:])):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
