# SPDX-License-Identifier: MIT
"""Methods to compare with: one final class and its configuration per file."""
