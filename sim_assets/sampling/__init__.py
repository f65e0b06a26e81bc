# SPDX-License-Identifier: MIT
"""States, cameras and labelled clouds of one object: `samples`."""
