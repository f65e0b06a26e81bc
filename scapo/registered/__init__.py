# SPDX-License-Identifier: MIT
"""The registration method for partial views: `method` is what others take."""
