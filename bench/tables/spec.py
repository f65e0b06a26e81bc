# SPDX-License-Identifier: MIT
"""The paper's three tables as data: rows, columns, units, decimals, names."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One metric of a table: where it comes from in the scores and how it is printed."""

    key: str
    """In `paper.csv`."""
    symbol: str
    heading: str
    metric: str
    unit: str
    factor: float
    """Score to printed unit."""
    decimals: int
    higher: bool
    """Larger is better."""
    printed: bool = True
    """Whether the paper has it."""


TABLE_1 = (
    Measure(key="seg_iou", symbol="S", heading="segmentation IoU, %", metric="iou", unit="1",
            factor=100, decimals=2, higher=True),
    Measure(key="joint_dir", symbol="D", heading="joint direction, deg", metric="joint_direction",
            unit="deg", factor=1, decimals=2, higher=False),
    Measure(key="joint_pivot", symbol="C", heading="joint pivot, 4 x mean radius",
            metric="joint_pivot", unit="r4", factor=1, decimals=3, higher=False),
    Measure(key="part_rot", symbol="R", heading="part rotation, deg", metric="part_rotation",
            unit="deg", factor=1, decimals=2, higher=False),
    Measure(key="part_trans", symbol="t", heading="part translation, 4 x mean radius",
            metric="part_translation", unit="r4", factor=1, decimals=3, higher=False),
    Measure(key="joint_state", symbol="q", heading="joint state, deg", metric="joint_state",
            unit="deg", factor=1, decimals=2, higher=False, printed=False),
    Measure(key="reconstruction", symbol="E", heading="reconstruction, 4 x mean radius",
            metric="reconstruction", unit="r4", factor=1, decimals=3, higher=False,
            printed=False),
)  # fmt: skip
"""The last two are ours alone."""
SWAPPED = Measure(key="swapped", symbol="O", heading="samples whose parts were taken in another "
                  "order, %", metric="order", unit="1", factor=100, decimals=1, higher=False,
                  printed=False)  # fmt: skip
"""How often the order of the parts was chosen for the sample: neither end is better."""
SECONDS = "Seconds per cloud"
DATASET_ORDER, AMBIGUITY = "label-order=dataset", "ambiguity=on"
"""Readings that `evaluate` writes beside its own, as a variant's brackets name them."""
READINGS = {DATASET_ORDER: "one part order", AMBIGUITY: "ambiguity-aware"}
"""What tables call them."""

TABLE_1_CATEGORIES = ("laptop", "safe", "eyeglasses", "oven", "washer")
TABLE_1_GROUPS = (("HOI4D", 2), ("Shape2Motion", 3))
"""Where the paper's data come from, over its columns."""

TABLE_2_CATEGORIES = ("basket", "drawer", "laptop", "scissors", "suitcase")
PRECISION_KEYS = (
    "seg_75", "seg_50", "joint_5", "joint_10", "joint_15", "part_5", "part_10", "part_15",
)  # fmt: skip
PRECISION_HEADINGS = ("75%", "50%", *("5°5cm", "10°10cm", "15°15cm") * 2)
PRECISION_GROUPS = (("Segmentation", 2), ("Joint", 3), ("Part", 3))

TABLE_3 = TABLE_1[:3]
ABLATIONS = ("full", "wo_shape_var", "wo_dir_align", "wo_joint_prox", "wo_joint_boundary")
"""Methods of Table 3 in `paper.csv`; a run's variant ends in one of the last four."""
ABLATION_NAMES = {
    "full": "Full",
    "wo_shape_var": "w/o L_shape-var",
    "wo_dir_align": "w/o L_dir-align",
    "wo_joint_prox": "w/o L_joint-prox",
    "wo_joint_boundary": "w/o L_joint-boundary",
}

PUBLISHED = {
    "3dgcn": ("3DGCN", 10),
    "gcn3d": ("3DGCN", 10),
    "pointnet2": ("PointNet++", 20),
}
"""Methods that are not trained here: name in a predictions file -> what a table calls it, and its
rank among the methods of `bench.methods`, which say the same of themselves."""

PAPER_METHODS = {"Ours": "SCAPO", "OP-Align(SJ)": "OP-Align"}
"""Names of `paper.csv` that differ from ours."""

REFERENCE = {"constant": "Constant prediction", "oracle-pose": "Oracle pose"}
"""Rows that are no method: what a constant answer scores, and what true poses would. Not ranked;
`evaluate` scores them with every method."""
