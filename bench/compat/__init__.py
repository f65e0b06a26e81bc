# SPDX-License-Identifier: MIT
"""The published evaluators' readings, for comparison with printed numbers only."""

from bench.compat.eap import eap_calibration, eap_iou, eap_rotation
from bench.compat.readings import opalign

__all__ = [
    "eap_calibration",
    "eap_iou",
    "eap_rotation",
    "opalign",
]
