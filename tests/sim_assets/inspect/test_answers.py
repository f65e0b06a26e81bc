# SPDX-License-Identifier: MIT
"""Predictions beside their data: of the right split, on unit axes, with no answer as such."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from scapo.store import StoreError
from scapo.store.predictions import Header, write_predictions
from sim_assets.inspect.answers import read_answers
from tests.helpers import made


@pytest.fixture
def split(tmp_path):
    return made.make_data(tmp_path / "data", "oven", count=3, points=16)


@pytest.fixture
def file(split, tmp_path):
    """The truth with parts exchanged and axes twice as long; none of the last sample."""
    arrays = split.arrays("part", "joint_pivot", "joint_axis")
    arrays = {**arrays, "part": 1 - arrays["part"], "joint_axis": 2 * arrays["joint_axis"]}
    arrays["joint_axis"][2] = np.nan
    header = Header(
        method="mine", variant="v", category="oven", split=split.manifest.split, seed=1,
        data_digest=split.manifest.digest, supervision=(),
    )  # fmt: skip
    write_predictions(tmp_path / "p.safetensors", header, arrays)
    return tmp_path / "p.safetensors"


def test_they_belong_to_the_split_with_their_digest(split, file):
    other = made.make_data(file.parent / "other", "oven", count=2, points=16)
    name, answers = read_answers(file, {"other": other, "own": split})
    truth = split.arrays("part", "joint_axis", "joint_pivot")
    assert name == "own"
    assert answers.title == "mine v"
    assert np.array_equal(answers.part, 1 - truth["part"])
    assert np.allclose(answers.axis[:2], truth["joint_axis"][:2])
    assert np.isnan(answers.axis[2]).all()
    assert np.allclose(answers.pivot, truth["joint_pivot"])
    with pytest.raises(StoreError, match="expected predictions of one of other, found those of"):
        read_answers(file, {"other": other})


@pytest.mark.skipif(find_spec("viser") is None, reason="viser (extra [view]) is not installed")
@pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets")
def test_the_viewer_shows_them(split, file):
    from sim_assets.inspect.view import ANSWERED, PAINTS, PREDICTED, Viewer

    viewer = Viewer(split.folder, port=18080, predictions=file)
    try:
        assert "Predicted by mine v: orange" in viewer.text.content
        (arrow,) = viewer.scene.answers
        assert tuple(arrow.colors) == PREDICTED
        before = np.array(viewer.scene.cloud[0].colors)
        assert not viewer.paint_box.disabled
        viewer.paint_box.value = ANSWERED
        assert not np.array_equal(before, viewer.scene.cloud[0].colors)
        viewer.paint_box.value = PAINTS[0]
        assert np.array_equal(before, viewer.scene.cloud[0].colors)
        viewer.answer_box.value = False
        assert not viewer.scene.answers[0].visible
        viewer.show(2)
        assert viewer.scene.answers == []
    finally:
        viewer.close()
