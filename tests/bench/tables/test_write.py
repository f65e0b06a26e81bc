# SPDX-License-Identifier: MIT
"""The three tables: from scores on disk to text."""

from __future__ import annotations

import csv
import io
import shutil
import subprocess

import numpy as np
import pytest

from bench import __main__ as program
from bench.statistics import interval
from bench.tables import write as tables
from bench.tables.model import DASH
from bench.tables.paper import check, printed_cells
from bench.tables.precision import table_2
from bench.tables.render import escape, to_csv, to_latex, to_markdown
from bench.tables.results import Results, Series, load
from bench.tables.rows import display_name, general_notes
from bench.tables.significance import COLUMNS, significance_csv
from bench.tables.spec import PRECISION_KEYS, TABLE_1_CATEGORIES, TABLE_2_CATEGORIES
from tests.helpers.scored import OBJECTS, SAMPLES, make_scores

NUMBERS = ("1", "1-complete", "1b", "2", "3", "4", "5", "6", "7")


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """SCAPO with two seeds everywhere, ICP on laptops alone, a supervised method."""
    folder = tmp_path_factory.mktemp("scores")
    kept = {}
    for kind, names in (("clean", TABLE_1_CATEGORIES), ("sensor", TABLE_2_CATEGORIES)):
        for name in names:
            for seed in (1, 2):
                kept["scapo", kind, name, seed] = make_scores(folder, "scapo", name, seed=seed,
                                                              kind=kind)  # fmt: skip
    kept["icp"] = make_scores(folder, "icp", "laptop", quality=5, supervision=["segmentation"])
    make_scores(folder, "gcn3d", "laptop", quality=0.1,
                supervision=["pose", "segmentation", "joint"])  # fmt: skip
    make_scores(folder, "scapo", "laptop", variant="wo_shape_var")
    make_scores(folder, "scapo", "laptop", variant="[label-order=dataset]")
    make_scores(folder, "constant", "laptop", quality=9,
                supervision=["pose", "segmentation", "joint"])  # fmt: skip
    return folder, kept


@pytest.fixture(scope="module")
def built(scores):
    return tables.build(load(scores[0]))


def rows_of(table, **wanted):
    found = csv.DictReader(io.StringIO(to_csv(table)))
    return [row for row in found if all(row[k] == v for k, v in wanted.items())]


def one(table, **wanted):
    (row,) = rows_of(table, **wanted)
    return row


def test_cells_are_means_over_samples_slots_and_seeds(scores, built):
    kept = scores[1]
    table = built[0]
    blocks = {block.heading[0]: block.heading for block in table.blocks}
    for symbol, key, factor in (("S", ("iou", "1"), 100), ("D", ("joint_direction", "deg"), 1),
                                ("t", ("part_translation", "r4"), 1)):  # fmt: skip
        means = []
        for name in TABLE_1_CATEGORIES:
            row = one(table, block=blocks[symbol], method="SCAPO", source="ours",
                      column=name.capitalize())  # fmt: skip
            values = [factor * kept["scapo", "clean", name, seed][key] for seed in (1, 2)]
            joined = np.concatenate(values, 1)
            means.append(np.nanmean(joined))
            assert float(row["value"]) == pytest.approx(means[-1], rel=1e-6)
            assert float(row["deviation"]) == pytest.approx(
                np.std([np.nanmean(v) for v in values], ddof=1), rel=1e-4
            )
            assert int(row["n"]) == np.isfinite(joined).sum()
            assert int(row["undefined"] or 0) == np.isnan(joined).sum()
            assert float(row["low"]) < float(row["value"]) < float(row["high"])
        mean = one(table, block=blocks[symbol], method="SCAPO", source="ours", column="Mean")
        assert float(mean["value"]) == pytest.approx(np.mean(means), rel=1e-6)


def test_a_row_of_each_table_says_of_how_many_seeds_it_is(built):
    for table, name in ((built[0], "SCAPO"), (built[1], "SCAPO"), (built[2], "Full")):
        rows = rows_of(table, source="ours", method=name)
        values = [row["seeds"] for row in rows if row["block"] != "Seconds per cloud"]
        assert set(values) == {"2"}, table.number


def test_intervals_are_resampled_by_instance(scores, built):
    kept = scores[1]
    table = built[0]
    row = one(table, block=table.blocks[3].heading, method="ICP", source="ours", column="Laptop")
    values = kept["icp"]["part_rotation", "deg"]
    expected = interval(values, np.arange(SAMPLES) % OBJECTS)
    assert float(row["low"]) == pytest.approx(expected.low, rel=1e-6)
    assert float(row["high"]) == pytest.approx(expected.high, rel=1e-6)


def test_what_was_not_run_is_a_dash_and_no_mean_and_an_empty_row_is_one_line(built):
    table = built[0]
    heading = table.blocks[0].heading
    assert one(table, block=heading, method="ICP", source="ours", column="Oven")["value"] == ""
    assert one(table, block=heading, method="ICP", source="ours", column="Mean")["value"] == ""
    text = to_markdown(table)
    icp = next(line for line in text.splitlines() if "| ICP | ours" in line)
    assert icp.count(DASH) == 6  # five cells, and nobody said whether it uses the camera
    for block in table.blocks:
        assert not any(row.empty for row in block.rows)
    note = next(line for line in text.splitlines() if line.startswith("- Not run: "))
    assert note.startswith("- Not run: Oracle pose; PointNet++; NPCS-EPN; ")
    assert "Not scored as one part order: Constant prediction; 3DGCN; ICP; SCAPO (wo_" in note
    assert "NPCS-EPN as printed (S); ICP as printed (D, C)" in note
    assert "3DGCN (" not in note.partition("Without a value")[2]
    assert (
        "SCAPO, laptop on clean@0123456789ab (test), 40 samples; labels: none; device cpu, "
        "batch –, seconds per cloud –; budget: seconds 12.5; seeds 1, 2."
    ) in text


def test_best_is_bold_among_the_self_supervised(built):
    table = built[0]
    for block in table.blocks[1:5]:
        best = {
            (row["method"], row["source"])
            for row in rows_of(table, block=block.heading, column="Laptop", best="1")
        }
        assert ("3DGCN", "paper") not in best  # fully supervised
        assert ("3DGCN", "ours") not in best
        assert ("Constant prediction", "ours") not in best
        assert ("ICP", "ours") not in best
        assert {source for _, source in best} == {"paper", "ours"}
    heading = table.blocks[1].heading
    printed = rows_of(table, block=heading, column="Oven", best="1", source="paper")
    assert [row["method"] for row in printed] == ["OP-Align"]  # 4.41 against SCAPO's 4.70


def test_scores_that_lack_a_calibration_are_marked_in_every_table(tmp_path):
    for name in TABLE_1_CATEGORIES:
        make_scores(tmp_path / "bare", "scapo", name)
        make_scores(tmp_path / "bare", "eap", name, calibration={"at": "training", "samples": 9})
        make_scores(tmp_path / "bare", "gcn3d", name, supervision=["pose", "segmentation"])
        make_scores(tmp_path / "bare", "op-align", name, supervision=["joint", "segmentation"])
    make_scores(tmp_path / "bare", "scapo", "drawer", kind="sensor")
    made = tables.make_tables(tmp_path / "bare")
    marked = {(row["block"].split()[0], row["method"]) for table in made.tables[:1]
              for row in rows_of(table, uncalibrated="1")}  # fmt: skip
    assert marked == {(symbol, "SCAPO") for symbol in ("R", "t", "q")} | {
        (symbol, "OP-Align") for symbol in ("R", "t")
    }
    rates = {row["column"] for row in rows_of(made.tables[1], uncalibrated="1", block="Drawer")}
    assert rates == {"Part 5°5cm", "Part 10°10cm", "Part 15°15cm", "State"}
    paths = {path.name: path.read_text() for path in made.write(tmp_path / "out", page=True)}
    for name, mark in (("table1.md", "‡"), ("table1.tex", r"$^\ddagger$"), ("index.html", "‡")):
        assert paths[name].count(f"{mark} Not calibrated: ") == (4 if name == "index.html" else 1)
        assert paths[name].count(mark) > 10
    assert "‡" not in paths["table3.md"]


def test_the_papers_tables_from_the_same_code():
    """Without scores: every printed cell, in the paper's places."""
    one_, two, three, *_ = tables.build(Results([]))
    cells = printed_cells()
    seen = [
        cell.text
        for table in (one_, two, three)
        for block in table.blocks
        for row in block.rows
        for cell in row.cells
        if cell.text is not None
    ]
    assert sorted(seen) == sorted(cell.text for cell in cells.values())
    flagged = [row for table in (one_, two) for row in rows_of(table, printed_mean_mismatch="1")]
    assert len(flagged) == 20
    assert all(row["column"] == "Mean" or row["block"] == "Mean" for row in flagged)
    scapo = one(one_, block=one_.blocks[0].heading, method="SCAPO", source="paper", column="Mean")
    assert scapo["value"] == "84.98"
    basket = one(two, block="Basket", method="SCAPO", source="paper", column="Joint 10°10cm")
    assert basket["value"] == "93.32"
    ablation = rows_of(three, method="w/o L_joint-prox", source="paper")
    assert [row["value"] for row in ablation] == ["82.77", "4.73", "0.137"]


def test_precision_is_k_of_n_and_monotone(scores, built):
    folder, kept = scores
    for rule in ("mean", "min", "per-part"):
        table = tables.build(load(folder), rule)[1]
        for name in TABLE_2_CATEGORIES:
            rows = rows_of(table, block=name.capitalize(), method="SCAPO", source="ours")
            counts = []
            for row, key in zip(rows, PRECISION_KEYS, strict=False):
                k, n = int(row["k"]), int(row["n"])
                slots = 1
                if rule == "per-part":
                    parts = 3 if name == "basket" else 2
                    slots = parts - 1 if key.startswith("joint") else parts
                assert n == 2 * SAMPLES * slots
                assert float(row["value"]) == pytest.approx(100 * k / n)
                counts.append(k)
            assert counts[0] <= counts[1]
            assert counts[2:5] == sorted(counts[2:5])
            assert counts[5:8] == sorted(counts[5:8])
    first = one(built[1], block="Drawer", method="SCAPO", source="ours",
                column="Part 10°10cm")  # fmt: skip
    passed = 0
    for seed in (1, 2):
        errors = kept["scapo", "sensor", "drawer", seed]
        turn = errors["part_rotation", "deg"].mean(1) < 10
        passed += (turn & (errors["part_translation", "m"].mean(1) < 0.1)).sum()
    assert int(first["k"]) == passed


def test_mean_errors_of_all_other_categories(scores, built, tmp_path):
    kept = scores[1]
    table = built[3]
    assert table.columns == tuple(f"{name.capitalize()} (sensor)" for name in TABLE_2_CATEGORIES)
    row = one(table, block=table.blocks[1].heading, method="SCAPO", column="Drawer (sensor)")
    values = [kept["scapo", "sensor", "drawer", s]["joint_direction", "deg"] for s in (1, 2)]
    assert float(row["value"]) == pytest.approx(np.mean(values), rel=1e-6)
    make_scores(tmp_path, "scapo", "basket")
    assert tables.build(load(tmp_path))[3].columns[-2:] == ("Suitcase (sensor)", "Basket (clean)")


def test_ablations_by_the_end_of_the_variant(built):
    table = built[2]
    ours = [row for row in table.blocks[0].rows if row.source == "ours"]
    assert [row.method for row in ours] == ["Full"]
    assert ours[0].cells[0].value is not None
    # one category is no mean
    assert "run: w/o L_shape-var (wo_shape_var)." in " ".join(table.notes)


def test_significance(scores, tmp_path):
    folder, kept = scores
    tables.make_tables(folder).write(tmp_path)
    text = (tmp_path / "significance.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    row = next(r for r in rows if (r["first"], r["second"], r["metric"]) ==
               ("icp", "scapo", "joint_direction"))  # fmt: skip
    scapo = [kept["scapo", "clean", "laptop", seed]["joint_direction", "deg"] for seed in (1, 2)]
    difference = np.mean(scapo, 0) - kept["icp"]["joint_direction", "deg"]
    assert float(row["difference"]) == pytest.approx(difference.mean(), rel=1e-5)
    assert float(row["p_value"]) < 0.05
    assert int(row["samples"]) == SAMPLES


def test_states_of_joints_that_slide_are_compared_in_metres(tmp_path):
    first, second = (
        make_scores(tmp_path, method, "drawer", kind="sensor")["joint_state", "m"]
        for method in ("icp", "scapo")
    )
    rows = csv.DictReader(significance_csv(load(tmp_path)).splitlines())
    (row,) = [row for row in rows if row["metric"] == "joint_state"]
    assert row["unit"] == "m"
    assert float(row["difference"]) == pytest.approx((second - first).mean(), rel=1e-5)
    assert int(row["samples"]) == SAMPLES


def test_latex_compiles_and_golden(scores, tmp_path, repository, update_golden):
    table = tables.table_3(Results([]), printed_cells())
    golden = repository / "tests" / "golden" / "table3.tex"
    text = to_latex(table)
    if update_golden:
        golden.write_text(text)
    assert text == golden.read_text()
    program_ = shutil.which("pdflatex")
    if program_ is None:
        pytest.skip("no pdflatex on this machine")
    folder, _ = scores
    tables.make_tables(folder).write(tmp_path)
    for number in NUMBERS:
        command = [program_, "-interaction=nonstopmode", "-halt-on-error", f"table{number}.tex"]
        done = subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
        )
        if "not found" in done.stdout:
            pytest.skip("a LaTeX package is missing on this machine")
        assert done.returncode == 0, done.stdout[-2000:]
        assert (tmp_path / f"table{number}.pdf").stat().st_size > 1000


def test_names_of_rows():
    assert display_name(Series("scapo", "", "")) == "SCAPO"
    assert display_name(Series("scapo", "cpu", "label-order=dataset")) == (
        "SCAPO (cpu), one part order"
    )
    assert display_name(Series("mine", "default", "iou=soft")) == "mine, iou=soft"


def test_notes_are_under_every_table():
    for table in tables.build(Results([])):
        assert set(general_notes()) <= set(table.notes)
        assert all(note in to_markdown(table) for note in general_notes())


def test_one_method_alone_has_no_comparison(tmp_path):
    make_scores(tmp_path, "scapo", "drawer", kind="sensor")
    results = load(tmp_path)
    assert significance_csv(results).splitlines() == [",".join(COLUMNS)]
    cells = table_2(results, printed_cells(), [], "mean")
    row = one(cells, block="Drawer", method="SCAPO", source="ours", column="State")
    assert row["value"] != ""


def test_names_cannot_break_latex():
    assert escape(r"50% of_$x & {y}~#\^") == (
        r"50\% of\_\$x \& \{y\}\textasciitilde{}\#\textbackslash{}\textasciicircum{}"
    )
    assert escape("é") == "?"


def test_scores_of_another_split_are_named_with_the_flag(tmp_path, capsys):
    make_scores(tmp_path, "scapo", "laptop", split="val")
    with pytest.raises(SystemExit) as ended:
        program.main(["tables", "--scores", str(tmp_path), "--out", str(tmp_path / "out")])
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert "expected scores on test (NAME.csv.gz), found those on val; --split val" in said
    program.main(["tables", "--scores", str(tmp_path), "--out", str(tmp_path / "out"),
                  "--split", "val"])  # fmt: skip


def test_the_commands(scores, tmp_path, capsys):
    folder, _ = scores
    program.main(["tables", "--scores", str(folder), "--out", str(tmp_path), "--ap-rule", "min"])
    names = [f"table{n}.{suffix}" for n in NUMBERS for suffix in ("md", "csv", "tex")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names, "significance.csv"])
    capsys.readouterr()
    program.main(["tables", "--check-paper"])
    out = capsys.readouterr().out.splitlines()
    assert out == check()
    with pytest.raises(SystemExit) as ended:
        program.main(["tables", "--scores", str(tmp_path / "none")])
    assert ended.value.code == 1
