# SPDX-License-Identifier: MIT
"""The demo's steps and its printed table; the whole demo is run by `make demo`."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from bench.demo import (
    TABLE1,
    Demo,
    StepError,
    Steps,
    cell_text,
    closing_words,
    summary,
    take_joints,
)


def cell(method: str, source: str, column: str, value: str, block: str = "S") -> dict[str, str]:
    return {"block": block, "method": method, "source": source, "column": column, "value": value}


def printed(table: object) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_summary_shows_ours_beside_print_for_the_demo_categories_only() -> None:
    text = printed(
        summary(
            Demo(categories=("laptop", "oven")),
            [
                cell("SCAPO", "paper", "Laptop", "93.41"),
                cell("SCAPO (cpu)", "ours", "Laptop", "56.97"),
                cell("SCAPO (cpu)", "ours", "Oven", ""),
                cell("EAP", "paper", "Laptop", "86.04"),
                cell("SCAPO", "paper", "Safe", "89.20"),
                cell("ICP", "ours", "Oven", "0.0824", "t"),
            ],
        )
    )
    rows = [[part.strip() for part in line.split("│")[1:-1]] for line in text.splitlines()]
    rows = [row for row in rows if row]
    assert rows == [
        ["S", "SCAPO, paper", "93.41", "–"],
        ["", "SCAPO, ours", "56.97", "–"],
        ["t", "ICP, ours", "–", "0.082"],
    ]


@pytest.mark.parametrize(("value", "text"), [(93.414, "93.41"), (0.0824, "0.082"), (1.0, "1.00")])
def test_cell_text_keeps_three_digits_of_lengths(value: float, text: str) -> None:
    assert cell_text(value) == text


def test_a_failing_step_names_the_command_its_last_line_and_its_log(tmp_path: Path) -> None:
    steps = Steps(tmp_path, "laptop", Console(file=io.StringIO()))
    with pytest.raises(StepError, match=r"scapo-data info ended 1: .*nowhere.*01-info\.txt"):
        steps.data("info", str(tmp_path / "nowhere"))


def test_steps_are_timed_and_logged_one_file_each(tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=200)
    steps = Steps(tmp_path, "oven", console)
    steps.data("--help")
    steps.bench("--help")
    assert [path.name for path in sorted((tmp_path / "logs").iterdir())] == [
        "oven-01---help.txt",
        "oven-02---help.txt",
    ]
    assert isinstance(console.file, io.StringIO)
    assert "scapo-data --help" in console.file.getvalue()


def test_closing_words_name_the_folders_and_what_answered(tmp_path: Path) -> None:
    text = closing_words(Demo(out=tmp_path, train=7, methods=("icp",)), 90.0)
    assert f"{tmp_path}/tables/" in text
    assert "1.5 minutes" in text
    assert "trained from scratch on 7 clouds: icp" in text
    assert f"{tmp_path}/twins/" in closing_words(Demo(out=tmp_path), 60.0)


def test_categories_are_those_of_table_1_that_have_models() -> None:
    assert set(Demo().categories) <= set(TABLE1)
    assert Demo(categories=("drawer",)).categories == ("drawer",)


def test_one_depth_image_goes_through_infer_with_its_mask_and_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = tmp_path / "data" / "oven" / "test" / "images" / "00000"
    shown.mkdir(parents=True)
    for name in ("0000.png", "0000.mask.png", "0001.png", "intrinsics.json"):
        (shown / name).write_text(name)
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(Steps, "bench", lambda steps, *words: asked.append(words))
    take_joints(Demo(out=tmp_path), Steps(tmp_path, "oven", Console(file=io.StringIO())))
    scan = tmp_path / "scans" / "oven"
    assert asked == [
        ("infer", f"{scan}.png", "--mask", f"{scan}.mask.png", "--intrinsics", f"{scan}.json",
         "--category", "oven", "--out", f"{tmp_path}/twins")
    ]  # fmt: skip
    read = [Path(f"{scan}{suffix}").read_text() for suffix in (".png", ".mask.png", ".json")]
    assert read == ["0000.png", "0000.mask.png", "intrinsics.json"]
