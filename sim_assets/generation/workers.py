# SPDX-License-Identifier: MIT
"""How many worker processes a request is worth.

Processor seconds below were measured on one core of a 2.1 GHz Xeon; only their proportions matter.
"""

from __future__ import annotations

import os

from sim_assets.generation.plan import Request

WORKER_SECONDS = 1.4
"""What a worker costs before its first sample: its imports, the renderer, the first pictures."""
WORTH = 2.0
"""How many times its cost a worker is to save."""
SAMPLE_SECONDS = {None: 0.0015, "sapien": 0.0035, "raycast": 0.012, "maniskill": 0.012}
"""One sample of 1,024 points, by backend at 256 x 256 pixels; None: without a picture."""
SENSOR_SECONDS = 0.01
"""More for a sample with noise or an imperfect mask."""
FARTHEST_SECONDS = 0.4
"""More for a sample of 1,024 farthest points."""
MODEL_SECONDS = 0.3
"""Reading a model of a folder; an object of our own is made in a hundredth of that."""


def planned_workers(*requests: Request, cores: int | None = None) -> int:
    """Workers that these requests are worth, 0 for none: this process does the work.

    One worker alone saves nothing. It is started all the same where models are read from a folder,
    since one that crashes or hangs must not take this process with it.

    Args:
        requests: All that the same workers do.
        cores: Most workers; by default one for each core.
    """
    seconds = sum(work_seconds(request) for request in requests)
    workers = min(cores or os.cpu_count() or 1, int(seconds / (WORTH * WORKER_SECONDS)))
    foreign = any(request.source != "procedural" for request in requests)
    return max(workers, 1) if foreign else workers if workers > 1 else 0


def work_seconds(request: Request) -> float:
    """Processor time that a request takes, roughly."""
    settings = request.settings
    each = SAMPLE_SECONDS[settings.backend]
    if (settings.noise, settings.mask) != ("none", "exact"):
        each += SENSOR_SECONDS
    if settings.sampling == "fps":
        each += FARTHEST_SECONDS * (settings.points / 1024) ** 2
    models = 0 if request.source == "procedural" else request.instances
    return request.count * each + models * MODEL_SECONDS
