# SPDX-License-Identifier: MIT
"""Hook of mkdocs: links from docs/ to other files of the checkout are no pages of the site."""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./([^)#]+)[^)]*\)")


def on_page_markdown(markdown: str, **_: Any) -> str:  # noqa: ANN401
    """Name the file instead of linking to it, as it lies outside the site."""
    return OUTSIDE.sub(r"\1 (`\2` of the checkout)", markdown)
