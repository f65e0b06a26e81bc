# SPDX-License-Identifier: MIT
"""Other people's array files, read without running what they hold."""
