# SPDX-License-Identifier: MIT
"""What a run shows: predictions, templates, overlays."""
