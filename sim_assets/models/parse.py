# SPDX-License-Identifier: MIT
"""From URDF elements to a `Robot`, repairing what has one meaning and refusing the rest.

`parse` reads the elements; `build_robot` finds the root among the links and orders the joints from
it outwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

import numpy as np
from jaxtyping import Float

from sim_assets.models.robot import (
    MOVABLE,
    Color,
    Joint,
    Kind,
    Link,
    Mimic,
    Robot,
    Shape,
    ShapeKind,
    transform,
)
from sim_assets.models.validate import (
    MAX_LINKS,
    MAX_SHAPES,
    AssetError,
    Repairs,
    check_mimics,
    check_tree,
    read_number,
    refuse,
)
from sim_assets.models.xml import Element, children, local, read_xml


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reader:
    """What all element readers need: the file for messages, and where repairs go."""

    path: Path
    repairs: Repairs
    colors: dict[str, Color]

    def error(self, where: str, expected: str, found: str) -> AssetError:
        return refuse(self.path, f"{where}: {expected}", found)

    def name(self, element: Element, attribute: str, where: str) -> str:
        value = (element.get(attribute) or "").strip()
        if not value:
            raise self.error(where, f"an attribute {attribute!r}", "none")
        return value

    def numbers(self, text: str | None, counts: tuple[int, ...], where: str) -> tuple[float, ...]:
        """Finite numbers separated by spaces; by commas too, which is repaired."""
        text = (text or "").strip()
        words = text.replace(",", " ").replace(";", " ").split()
        try:
            values = tuple(read_number(word) for word in words)
        except ValueError as error:
            raise self.error(where, "numbers", repr(text)) from error
        if len(values) not in counts:
            amount = " or ".join(str(count) for count in counts)
            raise self.error(where, f"{amount} numbers", repr(text))
        if not all(math.isfinite(value) for value in values):
            raise self.error(where, "finite numbers", repr(text))
        if "," in text or ";" in text:
            self.repairs.add("Commas between numbers were read as spaces", where)
        return values

    def one(self, text: str | None, where: str) -> float:
        return self.numbers(text, (1,), where)[0]

    def origin(self, element: Element, where: str) -> Float[np.ndarray, "4 4"]:
        """The pose in `<origin>`, the identity where there is none."""
        found = self.first(element, "origin", where)
        if found is None:
            return np.eye(4)
        xyz = self.numbers(found.get("xyz", "0 0 0"), (3,), f"{where} origin")
        rpy = self.numbers(found.get("rpy", "0 0 0"), (3,), f"{where} origin")
        return transform(xyz, rpy)

    def first(self, element: Element, tag: str, where: str) -> Element | None:
        """The only child of this tag; the first of several, which is said."""
        found = children(element, tag)
        if len(found) > 1:
            self.repairs.add(f"The first of several <{tag}> was taken", where)
        return found[0] if found else None


def parse(path: Path, repairs: Repairs) -> Robot:
    """Read and check a URDF; meshes are not opened.

    Args:
        path: The `.urdf` file.
        repairs: Receives what was put right.

    Raises:
        AssetError: Not a URDF tree, or one whose meaning is not single.
    """
    root = read_xml(path, repairs)
    reader = _Reader(path=path, repairs=repairs, colors={})
    for material in children(root, "material"):
        color = _color(reader, material)
        if color is not None:
            reader.colors[material.get("name", "")] = color
    links = {link.name: link for link in _links(reader, root)}
    joints = {joint.name: joint for joint in _joints(reader, root)}
    _limit_counts(reader, links)
    robot = build_robot(path, root.get("name", path.stem), links, joints, repairs)
    check_mimics(path, robot.joints)
    _note_ignored(root, repairs)
    return robot


def _limit_counts(reader: _Reader, links: dict[str, Link]) -> None:
    if not links:
        raise refuse(reader.path, "at least one <link>", "none")
    if len(links) > MAX_LINKS:
        raise refuse(reader.path, f"at most {MAX_LINKS} links", str(len(links)))
    shapes = sum(len(link.shapes) for link in links.values())
    if shapes > MAX_SHAPES:
        raise refuse(reader.path, f"at most {MAX_SHAPES} visual shapes", str(shapes))


def _note_ignored(root: Element, repairs: Repairs) -> None:
    """Blocks that stop other loaders, and that a picture does not need."""
    for element in children(root, "transmission"):
        if not children(element, "type"):
            name = element.get("name", "")
            repairs.add("A transmission without <type> was left out", f"transmission {name!r}")
    for link in children(root, "link"):
        for inertial in children(link, "inertial"):
            tags = {local(child) for child in inertial}
            if not {"mass", "inertia"} <= tags:
                where = f"link {link.get('name')!r}"
                repairs.add("An inertial block without mass or inertia was left out", where)


def _links(reader: _Reader, root: Element) -> Iterator[Link]:
    seen: set[str] = set()
    for element in children(root, "link"):
        name = _new_name(reader, element, "link", seen)
        visuals = children(element, "visual")
        shapes = [_shape(reader, visual, f"link {name!r}") for visual in visuals]
        yield Link(name=name, shapes=tuple(shape for shape in shapes if shape is not None))


def _new_name(reader: _Reader, element: Element, what: str, seen: set[str]) -> str:
    name = reader.name(element, "name", f"<{what}>")
    if name in seen:
        raise refuse(reader.path, f"one {what} named {name!r}", "several")
    seen.add(name)
    return name


def _shape(reader: _Reader, visual: Element, where: str) -> Shape | None:
    geometry = reader.first(visual, "geometry", where)
    if geometry is None or len(geometry) == 0:
        reader.repairs.add("A visual without geometry was dropped", where)
        return None
    element = geometry[0]
    kind = local(element)
    size = _size(reader, element, f"{where} {kind}")
    material = reader.first(visual, "material", where)
    color = None if material is None else _color(reader, material)
    if material is not None and color is None:
        color = reader.colors.get(material.get("name", ""))
    return Shape(
        link_T_shape=reader.origin(visual, where),
        kind=cast("ShapeKind", kind),
        size=size,
        filename=reader.name(element, "filename", where) if kind == "mesh" else "",
        color=color,
    )


def _size(reader: _Reader, element: Element, where: str) -> tuple[float, ...]:
    kind = local(element)
    if kind == "mesh":
        size = reader.numbers(element.get("scale", "1 1 1"), (1, 3), f"{where} scale")
        if len(size) == 1:
            reader.repairs.add("A single scale was used for x, y and z", where)
            size = size * 3
        if 0.0 in size:
            raise reader.error(where, "a scale without zeros", repr(element.get("scale")))
        return size
    if kind == "box":
        size = reader.numbers(element.get("size"), (3,), where)
    elif kind == "sphere":
        size = (reader.one(element.get("radius"), where),)
    elif kind in ("cylinder", "capsule"):
        names = ("radius", "length")
        size = tuple(reader.one(element.get(name), where) for name in names)
    else:
        raise reader.error(where, f"one of {', '.join(get_args(ShapeKind))}", f"<{kind}>")
    if min(size) <= 0:
        raise reader.error(where, "sizes above zero", f"{size}")
    return size


def _color(reader: _Reader, material: Element) -> Color | None:
    found = children(material, "color")
    if not found or found[0].get("rgba") is None:
        return None
    where = f"material {material.get('name', '')!r}"
    values = reader.numbers(found[0].get("rgba"), (3, 4), where)
    if len(values) == 3:
        reader.repairs.add("A colour without alpha was read as opaque", where)
    if min(values) < 0 or max(values) > 1:
        reader.repairs.add("Colours were clamped to 0 to 1", where)
    red, green, blue, alpha = (min(max(value, 0.0), 1.0) for value in (*values, 1.0)[:4])
    return red, green, blue, alpha


def _joints(reader: _Reader, root: Element) -> Iterator[Joint]:
    seen: set[str] = set()
    for element in children(root, "joint"):
        yield _joint(reader, element, _new_name(reader, element, "joint", seen))


def _joint(reader: _Reader, element: Element, name: str) -> Joint:
    where = f"joint {name!r}"
    kind = reader.name(element, "type", where)
    if kind not in get_args(Kind):
        raise reader.error(where, f"a type out of {', '.join(get_args(Kind))}", repr(kind))
    ends = {}
    for role in ("parent", "child"):
        end = reader.first(element, role, where)
        if end is None:
            raise reader.error(where, f"a <{role}>", "none")
        ends[role] = reader.name(end, "link", where)
    lower, upper, unlimited = _limits(reader, element, kind, where)
    return Joint(
        name=name,
        kind=cast("Kind", kind),
        parent=ends["parent"],
        child=ends["child"],
        parent_T_joint=reader.origin(element, where),
        axis=_axis(reader, element, kind, where),
        lower=lower,
        upper=upper,
        unlimited=unlimited,
        mimic=_mimic(reader, element, kind, where),
    )


def _axis(reader: _Reader, element: Element, kind: str, where: str) -> Float[np.ndarray, " 3"]:
    found = reader.first(element, "axis", where)
    if kind not in MOVABLE:
        return np.array([1.0, 0.0, 0.0])
    if found is None:
        reader.repairs.add("A missing axis was read as x, the default of URDF", where)
        return np.array([1.0, 0.0, 0.0])
    axis = np.array(reader.numbers(found.get("xyz", "1 0 0"), (3,), f"{where} axis"))
    length = float(np.linalg.norm(axis))
    if not 1e-9 <= length < math.inf:
        raise reader.error(where, "an axis with a length", f"{found.get('xyz')!r}")
    if abs(length - 1) > 1e-4:
        reader.repairs.add("An axis was brought to length 1", where)
    return axis / length


def _limits(
    reader: _Reader, element: Element, kind: str, where: str
) -> tuple[float | None, float | None, str]:
    """Lower and upper, 0 where only one is given (URDF's default); or None and what there is."""
    if kind not in ("revolute", "prismatic"):
        return None, None, "none"
    found = reader.first(element, "limit", where)
    if found is None or (found.get("lower") is None and found.get("upper") is None):
        return None, None, "none"
    texts = found.get("lower", "0"), found.get("upper", "0")
    if any(text.strip().lower().lstrip("+-") in ("nan", "inf", "infinity") for text in texts):
        return None, None, "from {} to {}".format(*texts)
    lower, upper = (reader.one(text, f"{where} limit") for text in texts)
    if lower > upper:
        reader.repairs.add("Limits in the wrong order were exchanged", where)
        lower, upper = upper, lower
    # Adding 0 turns -0.0 into 0.0.
    return lower + 0.0, upper + 0.0, ""


def _mimic(reader: _Reader, element: Element, kind: str, where: str) -> Mimic | None:
    found = reader.first(element, "mimic", where)
    if found is None or kind not in MOVABLE:
        return None
    return Mimic(
        joint=reader.name(found, "joint", f"{where} mimic"),
        multiplier=reader.one(found.get("multiplier", "1"), f"{where} mimic"),
        offset=reader.one(found.get("offset", "0"), f"{where} mimic"),
    )


def build_robot(
    path: Path, name: str, links: dict[str, Link], joints: dict[str, Joint], repairs: Repairs
) -> Robot:
    """A robot from its links and joints in any order.

    Raises:
        AssetError: They make no single tree.
    """
    check_tree(path, links, joints.values())
    root = _root(path, links, joints, repairs)
    ordered = {joint.name: joint for joint in _outwards(root, joints)}
    reached = (root, *(joint.child for joint in ordered.values()))
    robot = Robot(
        path=path,
        name=name,
        links={link: links[link] for link in reached},
        joints=ordered,
        root=root,
    )
    _hold_loose(robot, repairs)
    return robot


def _root(path: Path, links: dict[str, Link], joints: dict[str, Joint], repairs: Repairs) -> str:
    hung = {joint.child for joint in joints.values()}
    parents = {joint.parent for joint in joints.values()}
    roots = [name for name in links if name not in hung]
    used = [name for name in roots if name in parents or links[name].shapes]
    if len(used) > 1:
        listed = ", ".join(repr(name) for name in used[:4])
        raise refuse(path, "one root link", f"{len(used)}: {listed}")
    kept = used or roots[:1]
    for name in roots:
        if name not in kept:
            repairs.add("An empty link that nothing hangs on was dropped", f"link {name!r}")
    return kept[0]


def _outwards(root: str, joints: dict[str, Joint]) -> Iterator[Joint]:
    """Breadth first, in file order within a link."""
    below: dict[str, list[Joint]] = {}
    for joint in joints.values():
        below.setdefault(joint.parent, []).append(joint)
    links = [root]
    for link in links:
        for joint in below.get(link, ()):
            yield joint
            links.append(joint.child)


def _hold_loose(robot: Robot, repairs: Repairs) -> None:
    """A free joint may hang the whole object in the world; it may not hold a piece of it."""
    solid = {name for name, link in robot.links.items() if link.shapes}
    for joint in robot.joints.values():
        if joint.kind not in ("floating", "planar"):
            continue
        below = robot.subtree(joint)
        if solid & below and solid - below:
            raise refuse(
                robot.path,
                "joints that are revolute, continuous, prismatic or fixed",
                f"the {joint.kind} joint {joint.name!r} between visible links",
            )
        repairs.add(f"A {joint.kind} joint was held at its origin", f"joint {joint.name!r}")
