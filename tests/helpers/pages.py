# SPDX-License-Identifier: MIT
"""Code on Markdown pages."""

from __future__ import annotations

from markdown_it import MarkdownIt


def code_blocks(page: str, language: str = "") -> list[str]:
    """The fenced blocks of a language; those of none by default."""
    blocks = (token for token in MarkdownIt().parse(page) if token.type == "fence")
    return [block.content for block in blocks if block.info == language]
