# SPDX-License-Identifier: MIT
"""Categories of a file: read as written, refused by field, carried by what is made of them."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from math import pi

import pytest

from scapo.categories import CATEGORIES, TURN_X, Category, JointSpec, Window, check_category
from scapo.store import StoreError
from scapo.store.definitions import (
    category_of,
    defined,
    definition,
    foreign,
    known_category,
    read_categories,
)
from tests.helpers import made

TOML = """
[chest]
parts = ["body", "lid", "drawer"]
joints = [{ kind = "revolute", degrees = 90 }, { kind = "revolute", upper = 1, lower = 0.5 }]
window = { azimuth = [-60, 60], elevation = [0, 55] }
diagonal = 1
words = ["lid"]
symmetry = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
"""
CHEST = Category(
    name="chest",
    parts=("body", "lid", "drawer"),
    joints=(
        JointSpec(kind="revolute", parent=0, child=1, lower=0.0, upper=pi / 2),
        JointSpec(kind="revolute", parent=0, child=2, lower=0.5, upper=1.0),
    ),
    window=Window(azimuth=(-60.0, 60.0), elevation=(0.0, 55.0)),
    diagonal=1.0,
    words=("lid",),
    symmetry=TURN_X,
)


def read(tmp_path, text: str) -> dict[str, Category]:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return read_categories(path)


def test_a_file_is_read_as_written(tmp_path):
    assert read(tmp_path, TOML) == {"chest": CHEST}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[chest]", "[oven]", "oven: expected a name that the package has not"),
        ("[chest]", '["a/b"]', "name: expected a folder's name, found 'a/b'"),
        ("diagonal = 1", "", "chest: expected field 'diagonal', found none"),
        ("diagonal = 1", "diagonal = 0", "diagonal: expected metres above 0, found 0"),
        ("diagonal", "diagonl", "chest: expected fields of Category, found 'diagonl'"),
        ("diagonal = 1", "diagonal = 1\nbenchmark = []", "fields of Category but benchmark"),
        ("degrees = 90", "degrees = 90, upper = 1", "joints[0]: expected degrees, a number, or"),
        ("degrees = 90", "degrees = -90", "joints[0]: expected 0 <= lower < upper"),
        (
            '"revolute", degrees',
            '"helical", degrees',
            "joints[0].kind: expected revolute or prismatic, found 'helical'",
        ),
        ("degrees = 90", "angle = 90", "joints[0]: expected child, degrees, kind, lower, parent"),
        ('"revolute", degrees = 90', '"prismatic", degrees = 90', "degrees: expected only of a"),
        ('"revolute", degrees = 90', '"prismatic", upper = 1', "joints: expected all of one kind"),
        ("upper = 1,", "upper = 1, parent = 1,", "joints[1]: expected parent 0 and child 2"),
        ('"lid", "drawer"', '"lid"', "parts: expected two or more, one more than joints, found 2"),
        ('"lid", "drawer"', '"lid", "lid"', "parts: expected different names"),
        ("[-60, 60]", "[60, -60]", "window.azimuth: expected rising degrees from -180 to 180"),
        ("[0, 55]", "[0, 95]", "window.elevation: expected rising degrees from -90 to 90"),
        ("[0, 0, -1]]", "[0, 0, 1]]", "symmetry: expected a rotation"),
        ("[chest]", "[chest", "expected categories in TOML, found"),
        (TOML, "", "expected a table for each category, found none"),
        (TOML, "chest = 3", "chest: expected a table [chest], found 3"),
    ],
)
def test_what_cannot_be_is_refused_with_its_field(tmp_path, old, new, message):
    assert old in TOML
    with pytest.raises(StoreError) as caught:
        read(tmp_path, TOML.replace(old, new, 1))
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{tmp_path / 'mine.toml'}: ")


def test_no_file_is_said_in_a_line(tmp_path):
    with pytest.raises(StoreError, match=r"none\.toml: expected categories in TOML, found none$"):
        read_categories(tmp_path / "none.toml")
    with pytest.raises(StoreError, match=r"expected categories in TOML, found a folder$"):
        read_categories(tmp_path)


@pytest.mark.parametrize("kind", CATEGORIES.values(), ids=CATEGORIES)
def test_the_packages_own_are_sound_and_carry_nothing(kind):
    check_category(kind)
    assert definition(kind) == {}
    assert foreign(kind) is None
    assert defined({}, kind.name, "x") is kind


def test_a_header_carries_what_the_package_has_not():
    fields = json.loads(json.dumps(definition(CHEST)))
    assert defined(fields, "chest", "x") == defined(definition(CHEST), "chest", "x") == CHEST
    assert foreign(CHEST) is CHEST
    assert defined({}, "chest", "x") is None
    with pytest.raises(StoreError, match="x: definition: expected of 'box', found of 'chest'"):
        defined(fields, "box", "x")
    fields["definition"]["diagonal"] = -1
    with pytest.raises(StoreError, match="x: definition: diagonal: expected metres above 0"):
        defined(fields, "chest", "x")


def test_a_manifest_is_believed_where_nobody_defines_its_category(tmp_path):
    own = made.make_data(tmp_path, "oven", count=2, points=8).manifest
    assert category_of(own) is CATEGORIES["oven"]
    other = replace(own, category="kiln")
    assert known_category(other) is None
    kiln = category_of(other)
    assert (kiln.name, kiln.parts, kiln.joints) == ("kiln", own.parts, own.joints)
    with pytest.raises(StoreError, match=r"of kiln/test: joints\[0\]: expected 0 <= lower"):
        category_of(replace(other, joints=(replace(own.joints[0], lower=9.0, upper=9.0),)))
    options = {"definition": {**asdict(CHEST), "name": "kiln"}}
    with pytest.raises(StoreError, match="definition: expected its parts and joints, found others"):
        category_of(replace(other, options=options))
