# SPDX-License-Identifier: MIT
"""Data sets and models to look at: contact sheet, browser, check."""
