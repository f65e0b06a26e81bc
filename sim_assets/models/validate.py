# SPDX-License-Identifier: MIT
"""Every check an asset must pass before a renderer sees it, and the record of what was put right.

SAPIEN crashes, hangs on or silently misdraws much of what URDF files in the wild contain. What has
one meaning is repaired and said; all else is refused with an `AssetError` that names the file,
what was expected and what was found.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float

from scapo.store.regular import read_regular
from scapo.text import one_line
from sim_assets.models.robot import MOVABLE, Joint, Robot
from sim_assets.models.sides import used_vertices
from sim_assets.objects import ArticulatedObject

MAX_URDF_BYTES = 32 << 20
MAX_MESH_BYTES = 512 << 20
MAX_LINKS = 5000
MAX_SHAPES = 20000
MAX_CHAIN = 64
"""Joints that mimic one another in a row."""
MAX_WORDS = 300
"""Characters of what was expected, and of what was found."""
MAX_FACES = 2_500_000
"""Triangles of a whole asset, both sides of open surfaces counted: about twice as many as can be
read in the memory that `limits` allows."""
MAX_COORDINATE = 1e5
"""Asset units; beyond it float32 pictures lose the millimetre even for models in millimetres."""


class AssetError(ValueError):
    """The asset cannot be used: `path: expected, found`."""

    def __init__(self, path: Path, words: str) -> None:
        """The file, and what was expected and found: one line, however long a value is."""
        self.path, self.words = path, words
        super().__init__(f"{one_line(path, 2 * MAX_WORDS)}: {words}")

    def below(self, root: Path) -> AssetError:
        """The same error, which names the file as seen from the source folder, wherever that is."""
        words = self.words
        for top in dict.fromkeys((root.absolute(), root.resolve(), root)):
            words = words.replace(f"{one_line(top)}/", "")
        for path, top in ((self.path.absolute(), root.absolute()), (self.path, root.resolve())):
            with suppress(ValueError):
                return AssetError(path.relative_to(top), words)
        return AssetError(self.path, words)


def refuse(path: Path, expected: str, found: str) -> AssetError:
    """The error to raise, worded alike everywhere."""
    words = (one_line(text, MAX_WORDS) for text in (expected, found))
    return AssetError(path, "expected {}, found {}".format(*words))


def read_file(path: Path, limit: int) -> bytes:
    """The bytes of a regular file of at most `limit` bytes.

    Raises:
        AssetError: No such file, another kind of file, or a larger one.
    """
    try:
        return read_regular(path, limit)
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise refuse(path, f"at most {limit >> 20} MiB", "more") from error
        raise refuse(path, "a readable file", str(error.strerror)) from error
    except ValueError as error:
        raise refuse(path, "the name of a file", str(error)) from error


def read_number(word: object) -> float:
    """A number as files have it: ASCII digits, without the underscores that Python takes.

    Raises:
        ValueError: It is none, or larger than a float can be.
    """
    if isinstance(word, str) and (not word.isascii() or "_" in word):
        raise ValueError(f"could not read {word!r:.40} as a number")
    if isinstance(word, bool) or not isinstance(word, str | int | float | np.number):
        raise ValueError(f"expected a number, found {type(word).__name__}")
    try:
        return float(word)
    except OverflowError as error:
        raise ValueError("a number of too many digits") from error


@dataclass(slots=True)
class Repairs:
    """What was put right while reading one asset; equal repairs in many places are one sentence."""

    places: dict[str, list[str]] = field(default_factory=dict)

    def add(self, sentence: str, place: str = "") -> None:
        """Record a repair, and where."""
        self.places.setdefault(sentence, []).append(place)

    def sentences(self) -> tuple[str, ...]:
        """One sentence for each kind of repair, with its first place and the count of others."""
        return tuple(_sentence(text, places) for text, places in self.places.items())


def _sentence(text: str, places: list[str]) -> str:
    named = [place for place in dict.fromkeys(places) if place]
    if not named:
        return text
    more = f" and {len(named) - 1} more" if len(named) > 1 else ""
    return f"{text} ({named[0]}{more})"


def check_tree(path: Path, links: Iterable[str], joints: Iterable[Joint]) -> None:
    """Every joint hangs a known link on a known link, each link on one at most, with no cycle.

    Raises:
        AssetError: A dangling link, a second parent, a cycle.
    """
    names = set(links)
    parent: dict[str, str] = {}
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in names:
                raise refuse(
                    path, f"a link {name!r} ({role} of joint {joint.name!r})", "no such link"
                )
        if joint.child in parent:
            raise refuse(path, "one parent for each link", f"two for link {joint.child!r}")
        parent[joint.child] = joint.parent
    for start in parent:
        seen = {start}
        name = start
        while name in parent:
            name = parent[name]
            if name in seen:
                raise refuse(path, "a tree of links", f"a cycle through link {name!r}")
            seen.add(name)


def check_mimics(path: Path, joints: dict[str, Joint]) -> None:
    """Each mimicked joint exists, moves, and no chain of mimics comes back to itself.

    Raises:
        AssetError: It does not.
    """
    for joint in joints.values():
        seen = {joint.name}
        current = joint
        while current.mimic is not None:
            master = joints.get(current.mimic.joint)
            if master is None or master.kind not in MOVABLE:
                raise refuse(
                    path,
                    f"a movable joint {current.mimic.joint!r} for {current.name!r} to mimic",
                    "none",
                )
            if master.name in seen:
                raise refuse(
                    path, "a mimicked joint that leads", f"a cycle of mimics at {master.name!r}"
                )
            if len(seen) > MAX_CHAIN:
                found = f"more at {joint.name!r}"
                raise refuse(path, f"at most {MAX_CHAIN} mimics in a row", found)
            seen.add(master.name)
            current = master


def check_poses(path: Path, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> None:
    """Links lie where float64 can still tell millimetres.

    Raises:
        AssetError: Naming the first link that is far away or nowhere.
    """
    for name, pose in poses.items():
        if not (np.abs(pose) < MAX_COORDINATE).all():
            found = f"link {name!r} at {pose[:3, 3].tolist()}"
            raise refuse(path, f"links at coordinates below {MAX_COORDINATE:g}", found)


def check_movable(path: Path, joint: Joint, sizes: Float[np.ndarray, " 2"]) -> None:
    """A joint that a category relies on has limits that mean something.

    Args:
        path: Named in the error.
        joint: Revolute, continuous or prismatic.
        sizes: Largest travel that makes sense for it, and smallest: rad or asset units.

    Raises:
        AssetError: No limit, limits that are not finite, next to no travel, or absurdly much.
    """
    if joint.kind == "continuous":
        return
    if joint.lower is None or joint.upper is None:
        raise refuse(path, f"limits of the {joint.kind} joint {joint.name!r}", joint.unlimited)
    span = joint.upper - joint.lower
    where = f"joint {joint.name!r} from {joint.lower:g} to {joint.upper:g}"
    if not np.isfinite(span):
        raise refuse(path, "finite limits", where)
    largest, smallest = sizes
    if span < smallest:
        raise refuse(path, f"a travel of at least {smallest:.3g}", where)
    if span > largest:
        unit = " (degrees where radians belong?)" if joint.kind == "revolute" else ""
        raise refuse(path, f"a travel of at most {largest:.3g}", where + unit)


def check_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """A mesh has triangles, indices within range, finite and sane coordinates, some area.

    Raises:
        AssetError: It does not.
    """
    if len(mesh.faces) == 0 or len(mesh.vertices) == 0:
        raise refuse(path, "a mesh with triangles", "none")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise refuse(
            path,
            f"vertex indices below {len(mesh.vertices)}",
            f"{mesh.faces.min()} to {mesh.faces.max()}",
        )
    chosen = used_vertices(mesh.faces)
    used = mesh.vertices[chosen]
    if not np.isfinite(used).all():
        row = int(np.flatnonzero(~np.isfinite(used).all(1))[0])
        raise refuse(path, "finite vertices", f"vertex {chosen[row]} at {used[row].tolist()}")
    if np.abs(used).max() > MAX_COORDINATE:
        raise refuse(path, f"coordinates below {MAX_COORDINATE:g}", f"{np.abs(used).max():.3g}")
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if not np.abs(normals).max() > 0:
        raise refuse(path, "triangles with an area", "only degenerate ones")


def check_robot(path: Path, robot: Robot, remark: str = "") -> None:
    """Something to see and something that moves.

    Args:
        path: Named in the error.
        robot: The model.
        remark: What else is known of its joints.

    Raises:
        AssetError: No visual shapes, or no joint that moves.
    """
    if not any(link.shapes for link in robot.links.values()):
        raise refuse(path, "visual shapes", "none in any link")
    if not any(joint.kind in MOVABLE for joint in robot.joints.values()):
        found = kinds(robot.joints.values()) + remark
        raise refuse(path, "a revolute, continuous or prismatic joint", found)


def kinds(joints: Iterable[Joint]) -> str:
    """How many joints of each kind there are, in words."""
    found = [joint.kind for joint in joints]
    counts = [f"{found.count(kind)} {kind}" for kind in sorted(set(found))]
    return f"{', '.join(counts)} joint{'s' * (len(found) > 1)}" if counts else "no joint"


def check_object(path: Path, asset: ArticulatedObject) -> None:
    """Refuse an object without surfaces, unit axes, travel or a centred box.

    Raises:
        AssetError: It does not; no input should get this far.
    """
    for name, visuals in zip(asset.category.parts, asset.visuals, strict=True):
        if not visuals:
            raise refuse(path, f"a surface for part {name!r}", "none")
    if not np.isfinite(asset.pivot).all() or not np.isfinite(asset.axis).all():
        raise refuse(path, "finite pivots and axes", f"{asset.pivot}, {asset.axis}")
    if np.abs(np.linalg.norm(asset.axis, axis=1) - 1).max() > 1e-9:
        raise refuse(path, "unit axes", f"{asset.axis}")
    least = [joint.lower for joint in asset.category.joints]
    if not (asset.upper > least).all():
        raise refuse(path, f"travel beyond {least}", f"{asset.upper.tolist()}")
    bounds = np.concatenate([visual.mesh.bounds for part in asset.visuals for visual in part])
    centre = (bounds.min(0) + bounds.max(0)) / 2
    if np.abs(centre).max() > 1e-6 * max(1.0, np.abs(bounds).max()):
        raise refuse(path, "a box at rest centred on the origin", f"its centre at {centre}")
