# SPDX-License-Identifier: MIT
from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from bench.twin.record import Twin
from scapo.categories import CATEGORIES


@pytest.mark.usefixtures("shapes_checked")
def test_a_record_refuses_shapes_that_do_not_fit():
    pose = np.eye(4)[None].repeat(2, 0)
    known = {
        "name": "one",
        "category": CATEGORIES["oven"],
        "part": np.zeros(5, int),
        "camera_T_part": pose,
        "pivot": np.zeros((1, 3)),
        "axis": np.eye(3)[:1],
        "state": np.zeros(1),
        "limits": np.array([[0.0, 1.0]]),
    }
    assert Twin(points=np.zeros((5, 3)), **known).shape is None
    with pytest.raises(TypeCheckError, match="points"):
        Twin(points=np.zeros((6, 3)), **known)
