# SPDX-License-Identifier: MIT
"""The record's pose is the network's, in OP-Align's convention."""

from __future__ import annotations

import torch

from scapo.geometry.points import normalise
from tests.helpers.tiny import tiny, tiny_data


def test_its_pose_aligns_the_cloud_as_the_network_does() -> None:
    model, observation = tiny().eval(), tiny_data(4).observation
    points, _ = normalise(observation.points)
    with torch.no_grad():
        explanation = model.explain(points)
    record = model.predict(observation).record
    assert record is not None
    # Rows: R^T x - T of every point.
    aligned = points @ record["R_select"] - record["T_select"][:, None]
    assert torch.allclose(aligned, explanation.aligned, atol=1e-5)
    assert torch.equal(record["S_joint"], explanation.joints.pivot)
    assert torch.equal(record["I_angl"], explanation.template_joints.state)
