# SPDX-License-Identifier: MIT
"""The data card, `card.md` beside every manifest: what the data is, how made, how to read it.

A function of manifest and shards alone: no date, no machine's paths; the same bytes each time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from scapo.geometry.camera import Intrinsics
from scapo.store import Split, write_bytes
from scapo.store.definitions import DEFINITION
from scapo.store.manifest import Manifest
from scapo.text import as_markdown
from sim_assets.describe.croissant import CROISSANT, croissant_text
from sim_assets.describe.info import histograms
from sim_assets.describe.terms import citation, licence, terms
from sim_assets.sampling.presets import camera

CARD = "card.md"
_READ = """```python
from scapo.store import dataset

samples = dataset("{folder}")  # a torch.utils.data.Dataset
samples[0]["points"]  # ({points}, 3), camera frame, metres
```"""


def write_card(folder: Path) -> None:
    """Write the card of the split in this folder, and its Croissant file.

    Raises:
        StoreError: There is no split, or a shard is broken.
        OSError: It cannot be written.
    """
    split = Split(folder)
    for name, text in ((CROISSANT, croissant_text(split)), (CARD, card(split))):
        path, data = folder / name, text.encode()
        if not path.exists() or path.read_bytes() != data:
            write_bytes(path, data)


def card(split: Split) -> str:
    """The card as Markdown."""
    manifest = split.manifest
    sections = [
        as_markdown(f"# {manifest.category}, {manifest.split}"),
        _summary(split),
        "## Source and terms",
        terms(manifest),
        "## How to cite",
        f"```bibtex\n{citation(manifest)}\n```",
        "## How it was made",
        _made(manifest),
        "## Parts and joints",
        _joints(manifest),
        "## States, views and points",
        "Least value, distribution, greatest value and mean over the samples. Azimuth and "
        "elevation are those of the camera about the object's front.",
        "```\n" + "\n".join(line.replace("`", "'") for line in histograms(split)) + "\n```",
        "## How to read it",
        "Points and labels are in the camera frame (x right, y down, z forward), metres and "
        "radians; `part` 255 is background. `manifest.json` has frames, sources and digests.",
        _READ.format(folder=f"{manifest.category}/{manifest.split}", points=manifest.points),
    ]
    return "\n\n".join(sections) + "\n"


def _summary(split: Split) -> str:
    manifest = split.manifest
    size = sum((split.folder / shard.file).stat().st_size for shard in manifest.shards)
    rows = [
        ("licence", licence(manifest)),
        ("size", f"{size / 1e6:.1f} MB"),
        ("samples", f"{manifest.count}"),
        ("points per sample", f"{manifest.points}"),
        ("objects", f"{len(manifest.instances)}"),
        ("shards", f"{len(manifest.shards)}"),
        ("seed", f"{manifest.seed}"),
        ("digest", f"`{manifest.digest}`"),
        ("plan digest", f"`{manifest.plan_digest}`"),
    ]
    facts = manifest.statistics
    if "redrawn_share" in facts:
        rows.append(("views drawn again", f"{100 * facts['redrawn_share']:.2f} %"))
    for name, label in (
        ("objects_refused", "objects refused"),
        ("objects_failed", "objects that failed"),
        ("samples_lost", "samples lost with them"),
        ("files_refused", "files refused"),
    ):
        if facts.get(name):
            rows.append((label, f"{facts[name]:.0f}"))
    return _table(("", ""), rows)


def _made(manifest: Manifest) -> str:
    told = {
        n: value for n, value in sorted(manifest.options.items()) if not isinstance(value, dict)
    }
    rows = [(name.replace("_", " "), f"{value}") for name, value in told.items()]
    seen = manifest.options.get("camera")
    if isinstance(seen, dict):
        size = f"{seen['width']} x {seen['height']}"
        rows.append(("camera", f"{size}, fx {seen['fx']:.6g}, fy {seen['fy']:.6g}"))
    alike = manifest.options.get("ambiguity")
    if isinstance(alike, dict):
        rows.append(("ambiguity", ", ".join(f"{k} {v:g}" for k, v in sorted(alike.items()))))
    rows += [(f"version of {name}", text) for name, text in sorted(manifest.versions.items())]
    table = _table(("option", "value"), rows)
    command = remake(manifest)
    return f"{table}\n\nThe same again:\n\n```\n{command}\n```" if command else table


def remake(manifest: Manifest) -> str | None:
    """The command that makes this data, where `scapo-data generate` made it."""
    options = manifest.options
    if options.get("source") not in ("procedural", "urdf") or "camera" not in options:
        return None
    if "chosen_by" in options:
        return f"scapo-data {options['chosen_by']} FOLDER --only real/{manifest.category} --out OUT"
    source = "FOLDER" if options["source"] == "urdf" else "procedural"
    flags = {"source": source, "split": manifest.split, "count": manifest.count}
    if manifest.statistics.get("samples_lost"):
        flags["count"] += int(manifest.statistics["samples_lost"])
    names = ("up", "front", "scale", "instances", "points", "protocol", "preset", "noise", "mask")
    names += ("backend", "sampling", "states_per_view")
    flags |= {"seed": manifest.seed, **{name: options[name] for name in names if options.get(name)}}
    usual = camera(options.get("preset", "sim-art"), None)
    if Intrinsics(**options["camera"]) != usual:
        flags["image_size"] = options["camera"]["width"]
    words = [f"--{name.replace('_', '-')} {value}" for name, value in flags.items()]
    switches = ("color", "ambiguity", "any_model")
    words += [f"--{name.replace('_', '-')}" for name in switches if options.get(name)]
    words += ["--categories FILE"] if DEFINITION in options else []
    return f"scapo-data generate {manifest.category} --out OUT {' '.join(words)}"


def _joints(manifest: Manifest) -> str:
    rows = []
    for number, joint in enumerate(manifest.joints):
        factor, unit = (180 / math.pi, "deg") if joint.kind == "revolute" else (100.0, "cm")
        travel = f"{joint.lower * factor:.4g} to {joint.upper * factor:.4g} {unit}"
        ends = f"{manifest.parts[joint.parent]} to {manifest.parts[joint.child]}"
        rows.append((f"{number}", joint.kind, ends, travel))
    parts = ", ".join(f"{number} {as_markdown(p)}" for number, p in enumerate(manifest.parts))
    return f"Parts: {parts}.\n\n" + _table(("joint", "kind", "links", "travel"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(as_markdown, line))} |" for line in lines)
