# SPDX-License-Identifier: MIT
"""Self-supervised pose estimation of articulated objects from one point cloud.

The symbols of the paper (SCAPO, CVPR 2026) and their names here:

| paper | here | shape, frame |
|---|---|---|
| X | `Observation.points` | (N, 3), camera, m; normalised to mean radius 0.25 inside the method |
| R_g, t_g | `Encoding.rotation`, `.translation` | R is the transpose of the row-vector R_g |
| S_obj | aligned points | (N, 3), aligned frame: X with the global pose undone |
| S* | canonical points | (N, 3), aligned frame at the canonical states |
| Y_base, Delta S_X, Y_X | template, residual, their sum | (M, 3), template frame |
| w_i, W | `Prediction.part_weight` | (N, P), rows on the simplex |
| c, d, a | `Joints.pivot`, `.axis`, `.state` | state = child minus parent (paper: one per part) |
| T^[p] | `joint_motion` | 4x4, t = (I - R) c for a revolute joint (corrected) |
| K, O | keypoints, bone centres | (P, 3) |
| Theta_E, Theta_D | encoder, decoder | stage 1 |
| Theta_J, Theta_K, Theta_Delta | joint, keypoint and residual networks | stage 2 |

Frames: `camera` is OpenCV (x right, y down, z forward); `object` has z up, the front towards -x and
its origin at the centre of the bounding box at rest; a part's frame is the object frame at rest,
carried along by the part. `a_T_b` maps coordinates in b to a; points are rows.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scapo.categories import CATEGORIES, Category, JointSpec, category
    from scapo.predictor import load
    from scapo.types import Joints, Labels, Observation, Prediction, Sample, SampleKey

__all__ = [
    "CATEGORIES",
    "Category",
    "JointSpec",
    "Joints",
    "Labels",
    "Observation",
    "Prediction",
    "Sample",
    "SampleKey",
    "category",
    "load",
]

_HOMES = {
    "CATEGORIES": "categories",
    "Category": "categories",
    "JointSpec": "categories",
    "category": "categories",
    "load": "predictor",
}
"""Where a name comes from; the others from `types`."""


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """A name when it is asked for: torch takes a second to import, and help texts need none."""
    if name in __all__:
        return getattr(import_module(f"scapo.{_HOMES.get(name, 'types')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
