# SPDX-License-Identifier: MIT
"""OP-Align from the command line: the variant with labels, and the released evaluator's reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.__main__ import main
from bench.scoring.score_files import read_scores
from scapo.store.files import read
from tests.helpers.small import FLAGS, hinged_data


def command(*words: object) -> None:
    main([str(word) for word in words])


def test_the_labelled_variant_is_scored_as_the_released_evaluator_does(tmp_path: Path) -> None:
    data, run = hinged_data(tmp_path / "data"), tmp_path / "run"
    command("train", "op-align", "--category", "laptop", "--data", data, "--out", run, "--device",
            "cpu", "--no-pictures", *FLAGS["op-align"], "--supervision", "segmentation",
            "joint")  # fmt: skip
    for split in ("train", "test"):
        command("predict", run, "--data", data, "--split", split, "--out",
                tmp_path / f"{split}.safetensors", "--device", "cpu")  # fmt: skip
    tensors, header = read(tmp_path / "test.safetensors")
    assert header["supervision"] == ["joint", "segmentation"]
    assert header["variant"].startswith("cpu-SJ")
    assert tensors["record_R_select"].shape == (5, 3, 3)
    assert tensors["record_S_angl"].shape == (5, 1, 2)
    out = tmp_path / "scores" / "compat.csv.gz"
    command("evaluate", "--predictions", tmp_path / "test.safetensors", "--calibration",
            tmp_path / "train.safetensors", "--data", data, "--geometry", "opalign-compat",
            "--out", out)  # fmt: skip
    (scores,) = read_scores(out)
    assert scores.run.method == "op-align"
    for metric, unit in (("part_rotation", "deg"), ("joint_pivot", "r4")):
        assert np.isfinite(scores.errors[metric, unit]).all()
