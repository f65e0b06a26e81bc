# SPDX-License-Identifier: MIT
"""What a data set says of itself: `info` as text, `card` beside its manifest."""
