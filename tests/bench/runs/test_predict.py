# SPDX-License-Identifier: MIT
"""`scapo-bench predict --up`: who can use it is told, its row says so, others refuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from bench.__main__ import main
from scapo.store.predictions import read_prediction_header
from tests.helpers.made import make_data


def test_released_models_stand_as_they_are_told(tmp_path: Path, capsys):
    split = make_data(tmp_path / "data", "oven", count=3, train=2, points=200)
    out = tmp_path / "p.safetensors"
    words = ["--data", str(tmp_path / "data"), "--out", str(out), "--up", "--row", "released"]
    main(["predict", "oven", *words, "--mode", "quick"])
    arrays = load_file(out)
    assert read_prediction_header(out).variant == "released-quick-up"
    up = split.arrays("camera_T_part")["camera_T_part"][:, 0, :3, 2]
    np.testing.assert_allclose(arrays["camera_T_part"][:, 0, :3, 2], up, atol=2e-3)
    capsys.readouterr()


def test_a_network_that_cannot_use_it_says_so(tmp_path: Path, capsys):
    make_data(tmp_path / "data", "laptop", count=3, train=2, points=200)
    words = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "p.safetensors")]
    with pytest.raises(SystemExit, match="1"):
        main(["predict", "laptop/scapo", *words, "--up"])
    assert "--up: expected a model that can use it, found scapo" in capsys.readouterr().err
    assert not (tmp_path / "p.safetensors").exists()
