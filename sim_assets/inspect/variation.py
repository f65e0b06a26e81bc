# SPDX-License-Identifier: MIT
"""How much the objects of a data set differ: coefficients of variation of their proportions.

The objects themselves are measured (`sim_assets.procedural.variation`), so they are made or read
again: procedural ones always, models where their folder is at hand.
"""

from __future__ import annotations

from pathlib import Path

from scapo.store import Split
from sim_assets.generation.assets import RecoverError, recover
from sim_assets.procedural.variation import Statistic, statistics


class Variation:
    """Measures splits, and remembers objects that several share, as parts of a benchmark do."""

    def __init__(self, source: Path | None = None) -> None:
        """See `lines`.

        Args:
            source: Folder of the models that data sets were made from.
        """
        self.source = source
        self._known: dict[tuple[str, ...], list[Statistic]] = {}

    def lines(self, split: Split) -> list[str]:
        """One line for the proportions, one for the tilt of the axes; none where nothing is known.

        What cannot be made again is said in one line.
        """
        manifest = split.manifest
        made = manifest.options.get("source")
        if made != "procedural" and (made != "urdf" or self.source is None):
            return []
        if len(manifest.instances) < 2:
            return []
        try:
            rows = self.measured(split)
        except RecoverError as error:
            return [f"  variation  unknown: {error}"]
        main = ", ".join(f"{row.name} {row.variation:.2f}" for row in rows if row.main)
        tilts = [row for row in rows if row.name.endswith("tilt (deg)")]
        tilted = ", ".join(f"{row.mean:.1f} +- {row.variation:.1f}" for row in tilts)
        return [
            f"  variation  {main} (coefficient, of {rows[0].count} objects)",
            f"  axes       {tilted} deg from the nearest side of the box",
        ]

    def measured(self, split: Split) -> list[Statistic]:
        """The proportions, pivots and tilts of a split's objects.

        Raises:
            RecoverError: One of them cannot be had again.
        """
        manifest = split.manifest
        key = (manifest.category, *(row.id + row.sha256 for row in manifest.instances))
        if key not in self._known:
            count = len(manifest.instances)
            things = (recover(manifest, index, self.source) for index in range(count))
            self._known[key] = statistics(things)
        return self._known[key]
