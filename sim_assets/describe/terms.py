# SPDX-License-Identifier: MIT
"""What a data set may be used for and how it is cited, for its card and its Croissant file."""

from __future__ import annotations

import re

from scapo.store.manifest import Manifest
from scapo.text import as_markdown

LICENCE = "MIT"
LICENCE_URL = "https://spdx.org/licenses/MIT.html"
CREATOR = "The scapo authors"
OWN = (
    "The objects are made by this project's own generators and show nobody's design; the data may "
    "be used under the project's licence (MIT)."
)
MODELS = (
    "Rendered from models in a folder of URDF files. The terms of those models apply to this data "
    "as well; the manifest names the file and the SHA-256 of each."
)
FOREIGN = (
    "Converted from other authors' set `{source}`. Their terms apply to this data, and their work "
    "is to be cited; the manifest names the files and the SHA-256 of each recording."
)


def is_own(manifest: Manifest) -> bool:
    """Whether the objects are this project's own."""
    return manifest.options.get("source") == "procedural"


def terms(manifest: Manifest) -> str:
    """Under which terms the data may be used."""
    source = manifest.options.get("source")
    if is_own(manifest):
        return OWN
    return MODELS if source == "urdf" else FOREIGN.format(source=as_markdown(f"{source}"))


def licence(manifest: Manifest) -> str:
    """The licence in one line."""
    return LICENCE if is_own(manifest) else "that of the models or recordings; nothing is added"


def citation(manifest: Manifest) -> str:
    """BibTeX of the data, by its digest: the year is that of what made it."""
    version = manifest.versions.get("scapo", "")
    note = f"version {version}, " if version else ""
    name = re.sub(r"[^\w .,-]", "_", f"{manifest.category}, {manifest.split}")
    return (
        "@misc{scapo_data,\n"
        f"  title = {{scapo: {name}}},\n"
        f"  author = {{{{{CREATOR}}}}},\n"
        "  year = {2026},\n"
        f"  note = {{{note}digest {manifest.digest[:16]}}}\n"
        "}"
    )
