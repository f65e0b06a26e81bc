# SPDX-License-Identifier: MIT
"""Names as a hostile file has them."""

from __future__ import annotations

NAME = "a\n\x1b[2J[/x] [red]$\\frac{$\x07" + "y" * 5000
"""Breaks lines, clears the screen, is markup and a formula, and long."""
PARTS = (
    '<img src=x onerror="document.title=1"><script>document.title=2</script>',
    "{document.title=3} [a](javascript:document.title=4) `$\\frac{$`",
)
"""HTML; an expression of MDX, Markdown and LaTeX."""
