# SPDX-License-Identifier: MIT
"""Template registration, the method for partial views: `method` is what others take."""
