# SPDX-License-Identifier: MIT
"""The data card beside every split."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from scapo.store import Split, write_bytes
from scapo.store.manifest import Manifest, read_manifest
from sim_assets.describe.card import CARD, card, remake, write_card
from sim_assets.generation.build import build
from sim_assets.generation.generate import Running, generate
from sim_assets.generation.request import make_request, versions
from sim_assets.options import DataOptions


def make(folder: Path, category: str = "eyeglasses", **given) -> Split:
    options = DataOptions(
        **{"protocol": "full", "points": 128, "count": 8, "instances": 2, "seed": 3, **given}
    )
    request, assets = make_request(category, options)
    found = versions(request.settings.backend)
    generate(request, assets, folder, found, Running(workers=0))
    return Split(folder)


def test_the_card_says_what_the_data_is(tmp_path: Path):
    split = make(tmp_path / "split")
    text = (tmp_path / "split" / CARD).read_text()
    manifest = split.manifest
    assert text.startswith("# eyeglasses, train\n")
    for line in (
        "| samples | 8 |",
        "| points per sample | 128 |",
        "| objects | 2 |",
        f"| digest | `{manifest.digest}` |",
        f"| plan digest | `{manifest.plan_digest}` |",
        f"| version of numpy | {manifest.versions['numpy']} |",
        "Parts: 0 frame, 1 left temple, 2 right temple.",
        "licence (MIT)",
    ):
        assert line in text
    states = split.arrays("joint_state")["joint_state"]
    degrees = 180 / 3.141592653589793
    (line,) = [line for line in text.splitlines() if line.startswith("joint 1 ")]
    words = line.split()
    assert float(words[2]) == pytest.approx(states[:, 1].min() * degrees, rel=1e-3)
    assert float(words[-1]) == pytest.approx(states[:, 1].mean() * degrees, rel=1e-3)


def test_the_card_is_a_function_of_the_data_alone(tmp_path: Path):
    texts = [make(tmp_path / name).folder.joinpath(CARD).read_bytes() for name in ("a", "b/c")]
    assert texts[0] == texts[1]
    assert str(tmp_path).encode() not in texts[0]
    write_card(tmp_path / "a")
    assert (tmp_path / "a" / CARD).read_bytes() == texts[0]


def test_a_missing_card_is_written_when_the_data_is_there(tmp_path: Path):
    split = make(tmp_path / "split")
    before = (tmp_path / "split" / CARD).read_bytes()
    (tmp_path / "split" / CARD).unlink()
    times = {path.name: path.stat().st_mtime_ns for path in split.folder.iterdir()}
    make(tmp_path / "split")
    assert (tmp_path / "split" / CARD).read_bytes() == before
    assert times.items() <= {p.name: p.stat().st_mtime_ns for p in split.folder.iterdir()}.items()


def parsed(command: str) -> tuple[str, DataOptions]:
    """Category and options of a `scapo-data generate` command."""
    words = command.split()
    assert words[:2] == ["scapo-data", "generate"]
    given: dict[str, object] = {}
    rest = iter(words[3:])
    types = {name: (hint, *get_args(hint)) for name, hint in get_type_hints(DataOptions).items()}
    for word in rest:
        name = word.removeprefix("--").replace("-", "_")
        if name == "out":
            next(rest)
        elif bool in types[name]:
            given[name] = True
        else:
            text = next(rest)
            kind = float if float in types[name] else int if int in types[name] else str
            given[name] = kind(text)
    return words[2], DataOptions(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"protocol": "joint", "backend": "raycast", "color": True, "image_size": 96},
        {"preset": "op-align", "protocol": "full", "states_per_view": 2, "sampling": "fps"},
        {"protocol": "joint", "backend": "raycast", "ambiguity": True},
        {"protocol": "isolated", "backend": "raycast", "noise": "kinect", "mask": "imperfect"},
    ],
    ids=["plain", "image", "preset", "ambiguity", "noise"],
)
def test_the_command_makes_the_same_data(given: dict[str, object], tmp_path: Path):
    asked = DataOptions(**{"protocol": "full", "points": 128, "count": 8, "instances": 2, **given})
    request, _ = make_request("laptop", asked)
    manifest = replace(
        make(tmp_path / "split", "laptop").manifest,
        options={**request.options(), "samples_per_instance": 4},
        seed=asked.seed,
    )
    command = remake(manifest)
    assert command is not None
    category, options = parsed(command)
    again, _ = make_request(category, options)
    assert again == request


def test_models_and_other_peoples_sets_have_their_own_terms(tmp_path: Path):
    list(build("laptop", count=2, seed=4, out=tmp_path / "models", split="train"))
    split = make(tmp_path / "split", "laptop", source=str(tmp_path / "models"))
    assert "The terms of those models apply" in card(split)
    assert "--source FOLDER" in str(remake(split.manifest))
    foreign = changed(split.manifest, {"source": "their-set", "noise": "real"})
    write_bytes(split.folder / "manifest.json", foreign.to_json().encode())
    text = card(Split(split.folder))
    assert "other authors' set `their-set`" in text
    assert "| files refused | 2 |" in text
    assert "scapo-data generate" not in text
    assert read_manifest(split.folder / "manifest.json") == foreign


def changed(manifest: Manifest, options: dict[str, str]) -> Manifest:
    return replace(manifest, options=options, statistics={"files_refused": 2.0})
