# SPDX-License-Identifier: MIT
"""HOI4D's articulated models as the published loaders read them: `<root>/HOI4D/<category>/<id>/`.

- `result.json`: a list of trees; a node with "objs" (mesh names) is a leaf part with an integer
  "id", any other has "children"; parts are counted in the order of traversal;
- `objs/<name>.obj`: the meshes (the sampled points `<name>_down_pts.npy` are not needed);
- `mobility_v2.json`: a list; of its entries with "joint" only hinges count, which are named in
  Chinese; "jointData" has axis.origin, axis.direction and limit {a, b} in degrees, in either order;
  "parts" lists the {"id"} of the leaves that turn.

All other parts are the base, and every hinge hangs on it. The published loaders leave 14 safes
out; so does `find`. Units are not metres; z is taken as up, as in Shape2Motion.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from sim_assets.importers.models import Body, Folder, Hinge, Model, find_folders, joined, safe_word
from sim_assets.importers.records import Mesh, direction, member, read_json, read_obj, vector
from sim_assets.models.validate import read_number, refuse

SET = "hoi4d"
TREE = "result.json"
MOTION = "mobility_v2.json"
MESHES = "objs"
HINGE = "\u94f0\u94fe\uff08\u65cb\u8f6c\uff09"
"""The word for "hinge (rotation)", with full-width parentheses."""
LEFT_OUT = frozenset(f"{k:03d}" for k in (*range(34, 43), 44, 45, 46, 48, 50))
"""Safes that the published loaders skip."""
MAX_PARTS = 1000


def find(path: Path) -> list[Folder]:
    """Model folders below a path, without the safes that nobody uses.

    Raises:
        AssetError: None there.
    """
    folders = find_folders(path, (TREE, MOTION, MESHES))
    return [f for f in folders if f.category != "safe" or f.id not in LEFT_OUT]


def read(folder: Folder) -> Model:
    """One model, in the coordinates of its files.

    Raises:
        AssetError: A file is missing or damaged, or nothing turns.
    """
    leaves = read_leaves(folder.path / TREE)
    turning = _turning(folder.path / MOTION, leaves)
    order = list(leaves)
    turned = {part for parts, _ in turning for part in parts}
    still = [part for part in order if part not in turned]
    if not still:
        raise refuse(folder.path / MOTION, "a part that stands still", "none")
    groups = [still, *(parts for parts, _ in turning)]
    bodies = [
        Body(name=_name(number, group, order, leaves), meshes=_meshes(folder.path, group, leaves))
        for number, group in enumerate(groups)
    ]
    hinges = [
        _hinge(folder.path / MOTION, entry, number + 1) for number, (_, entry) in enumerate(turning)
    ]
    links, joints = joined(bodies, hinges, folder.category)
    return Model(name=f"{SET}_{folder.category}_{folder.id}", links=links, joints=joints)


def _name(number: int, group: list[int], order: list[int], leaves: dict[int, Any]) -> str:
    """`base` or `part_` and its index; with the words that the tree has for it, if any."""
    words = [leaves[part].get("name") for part in group]
    word = next((safe_word(w) for w in words if isinstance(w, str) and safe_word(w) != "x"), "")
    start = "base" if number == 0 else f"part_{order.index(group[0])}"
    return f"{start}_{word}" if word else start


def _meshes(folder: Path, group: list[int], leaves: dict[int, Any]) -> tuple[Mesh, ...]:
    names = [name for part in group for name in leaves[part]["objs"]]
    for name in names:
        if not isinstance(name, str) or not name or Path(name).name != name:
            raise refuse(folder / TREE, "mesh names without folders in 'objs'", f"{name!r:.80}")
    return tuple(read_obj(folder / MESHES / f"{name}.obj") for name in names)


def read_leaves(path: Path) -> dict[int, Any]:
    """The leaf records of the tree by id, in the order of traversal.

    Raises:
        AssetError: Unreadable, a node that is neither leaf nor branch, an id twice.
    """
    frames = read_json(path)
    if not isinstance(frames, list):
        raise refuse(path, "a list", f"{frames!r:.80}")
    leaves: dict[int, Any] = {}
    waiting: list[object] = frames[::-1]
    while waiting:
        node = waiting.pop()
        if not (isinstance(node, dict) and "objs" in node):
            waiting += member(path, node, "children", list)[::-1]
            continue
        number = _integer(path, node, "id")
        if number in leaves or not member(path, node, "objs", list):
            raise refuse(path, f"one part {number} with meshes", "several, or no mesh")
        leaves[number] = node
        if len(leaves) > MAX_PARTS:
            raise refuse(path, f"at most {MAX_PARTS} parts", "more")
    if not leaves:
        raise refuse(path, "parts with 'objs'", "none")
    return leaves


def _integer(path: Path, record: object, key: str) -> int:
    """An integer, which may be written as text."""
    value = member(path, record, key, (int, str))
    try:
        found = read_number(value)
    except ValueError:
        found = math.nan
    if not found.is_integer():
        raise refuse(path, f"{key!r} as an integer", repr(value))
    return int(found)


def _turning(path: Path, leaves: dict[int, Any]) -> list[tuple[list[int], object]]:
    """The parts of each hinge, and its entry."""
    entries = read_json(path)
    if not isinstance(entries, list):
        raise refuse(path, "a list", f"{entries!r:.80}")
    result: list[tuple[list[int], object]] = []
    seen: set[int] = set()
    for entry in entries:
        if not isinstance(entry, dict) or entry.get("joint") != HINGE or not entry.get("parts"):
            continue
        parts = [_integer(path, part, "id") for part in member(path, entry, "parts", list)]
        for part in parts:
            if part not in leaves or part in seen:
                known = f"parts of {TREE}, each on one hinge"
                raise refuse(path, known, f"part {part}")
            seen.add(part)
        result.append((parts, entry))
    if not result:
        raise refuse(path, f"an entry with 'joint' {HINGE!r} and 'parts'", "none")
    return result


def _hinge(path: Path, entry: object, child: int) -> Hinge:
    data = member(path, entry, "jointData", dict)
    axis = member(path, data, "axis", dict)
    return Hinge(
        parent=0,
        child=child,
        pivot=vector(path, axis, "origin"),
        axis=direction(path, axis, "direction"),
        limits=_limits(path, data.get("limit")),
    )


def _limits(path: Path, limit: object) -> tuple[float, float] | None:
    """Lower and upper in rad; None where they are missing, switched off or equal.

    Degrees, as every file of this format has them; a travel of less than 2 pi can only be meant in
    rad, as no hinge stops after six degrees.
    """
    if not isinstance(limit, dict) or limit.get("noLimit") is True:
        return None
    try:
        ends = sorted(read_number(limit[key]) for key in ("a", "b"))
    except (KeyError, ValueError) as error:
        raise refuse(path, "'limit' with numbers a and b", f"{limit!r:.80}") from error
    if not all(math.isfinite(end) for end in ends):
        raise refuse(path, "finite limits", f"{limit!r:.80}")
    if ends[0] == ends[1]:
        return None
    unit = 1.0 if ends[1] - ends[0] <= 2 * math.pi else math.pi / 180
    return ends[0] * unit, ends[1] * unit
