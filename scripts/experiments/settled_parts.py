#!/usr/bin/env python
# SPDX-License-Identifier: MIT
"""What parts near a hinge are worth: a trained template is built and fitted anew in two rounds.

    python scripts/experiments/settled_parts.py MODEL DATA/clean oven OUT.safetensors [usual]
    scapo-bench predict OUT.safetensors --data DATA/clean --split val --mode quick --limit 200 ...

400 training clouds are placed by `quick`; 144 of the 320 that are placed most surely tell the
template, as of settled placements or, with `usual`, as while it is sought. The network, the frame
and all else are MODEL's.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch

from scapo import store
from scapo.method import evenly
from scapo.records import take
from scapo.registered.bundle_adjustment import bundle_adjust, late_options, settle_hinges
from scapo.registered.method import TemplateRegistration
from scapo.registered.motion_segmentation import rebuild
from scapo.registry import load_method
from scapo.released import find
from scapo.store.checkpoint import write_checkpoint
from scapo.types import Observation

PLACED, SURE, FITTED, ROUNDS = 400, 320, 144, 2


def main(run: Path, data: str, category: str, out: Path, settled: bool) -> None:
    """Place, fit, keep."""
    method, header = load_method(run)
    if not isinstance(method, TemplateRegistration):
        raise SystemExit(f"{run}: expected a run of registered, found {method.name}")
    split = store.dataset(data, category, "train")
    some = [split[int(k)] for k in evenly(len(split), PLACED)]
    cloud = torch.stack([torch.as_tensor(one["points"]) for one in some]).float()
    with torch.no_grad():
        seen = method._seen(Observation(points=cloud))
        placement, agreed = method._searched(seen, "quick").placement, method._voted(seen).sure
    rows = agreed.argsort(descending=True)[:SURE][evenly(SURE, FITTED)]
    views, placement = take(seen.views, rows), replace(take(placement, rows), pivot=None)
    template, config = method.template, method.config.discovery
    generator = torch.Generator().manual_seed(1)
    for _ in range(ROUNDS):
        rebuild(template, views, placement, settled=settled, generator=generator)
        options = late_options(template, config)
        placement, _ = bundle_adjust(template, views, placement, options, generator=generator)
    settle_hinges(template, placement, touching=True)
    write_checkpoint(out, method, header)


if __name__ == "__main__":
    name, data, category, out, *usual = sys.argv[1:]
    main(find(name), data, category, Path(out), settled=not usual)
