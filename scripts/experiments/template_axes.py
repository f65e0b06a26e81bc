# SPDX-License-Identifier: MIT
"""How far the axes of a trained template are from the true ones, and what more fitting does.

Training clouds are placed by `refine`; a placed base takes the labelled axis into the template's
frame, where their median is the truth and their scatter what placing adds. With rounds the 70 % of
the clouds that were placed most surely are fitted again as the dense template is: built anew, then
bundle adjustment.

    python scripts/experiments/template_axes.py RUN DATA/clean laptop CLOUDS ROUNDS [SEED]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
import torch.nn.functional as F

import scapo
from scapo import store
from scapo.geometry.rigid import axis_angle
from scapo.method import evenly
from scapo.records import take
from scapo.registered.bundle_adjustment import bundle_adjust, late_options
from scapo.registered.method import TemplateRegistration
from scapo.registered.motion_segmentation import rebuild
from scapo.registered.template import ArticulatedTemplate, Placement
from scapo.types import Observation

SURE = 0.3  # Quantile of the confidences below which clouds are left out
SAME = 0.9  # Cosine to the template's axis below which a cloud is misplaced and says nothing


def tell(
    what: str, template: ArticulatedTemplate, placement: Placement, axes: torch.Tensor
) -> None:
    """Print, for each joint, the angle to the true axis and the scatter about it, degrees."""
    words = []
    for j, axis in enumerate(template.directions().detach()):
        seen = torch.einsum("bji,bj->bi", placement.rotation, axes[:, j])
        seen = seen * (seen @ axis).sign()[:, None]
        seen = seen[seen @ axis > SAME]
        true = F.normalize(seen.median(0).values, dim=0)
        off = float(axis_angle(axis, true).rad2deg())
        scatter = float(axis_angle(seen, true.expand_as(seen)).rad2deg().median())
        words.append(f"off by {off:.2f}, scatter {scatter:.2f} of {len(seen)}")
    print(f"{what}: " + "; ".join(words), flush=True)


def main(run: Path, data: str, category: str, clouds: int, rounds: int, seed: int) -> None:
    """Place clouds, tell, and tell again after each round."""
    method = scapo.load(run).model
    if not isinstance(method, TemplateRegistration):
        raise SystemExit(f"{run}: expected a run of registered, found {method.name}")
    split = store.dataset(data, category, "train")
    some = [split[int(k)] for k in evenly(len(split), clouds)]
    cloud = torch.stack([torch.as_tensor(one["points"]) for one in some]).float()
    axes = torch.stack([torch.as_tensor(one["joint_axis"]) for one in some]).float()
    with torch.no_grad():
        seen = method._seen(Observation(points=cloud))
        said = method._searched(seen, "refine")
    views, placement, confidence = seen.views, said.placement, said.sure
    axes = axes @ seen.frame.mT  # in the clouds' own frames
    template, config = method.template, method.config.discovery
    tell("as trained", template, placement, axes)
    sure = (confidence > confidence.quantile(SURE)).nonzero()[:, 0]
    views, placement, axes = take(views, sure), take(placement, sure), axes[sure]
    for parameter in template.parameters():
        parameter.requires_grad_(True)
    generator = torch.Generator().manual_seed(seed)
    for number in range(rounds):
        begun = time.process_time()
        rebuild(template, views, placement, generator=generator)
        options = late_options(template, config)
        placement, loss = bundle_adjust(template, views, placement, options, generator=generator)
        took = time.process_time() - begun
        tell(f"round {number + 1}, loss {float(loss.mean()):.4f}, {took:.0f} s", template,
             placement, axes)  # fmt: skip


if __name__ == "__main__":
    run, data, category, clouds, rounds, *seed = sys.argv[1:]
    main(Path(run), data, category, int(clouds), int(rounds), int(seed[0]) if seed else 1)
