# SPDX-License-Identifier: MIT
"""The report of a run is one page that says what was run, where, how fast, and how to go on."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from bench.run_files import METRICS, read_metrics, read_timing
from bench.runs.report import commands, stages_table, write_report
from scapo.store import provenance
from scapo.store.checkpoint import read_checkpoint
from scapo.store.schema import StoreError
from scapo.training import fit
from tests.helpers.tiny import tiny, tiny_data
from tests.helpers.two_ranks import CONFIG


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    fit.fit(tiny(), tiny_data(), folder, replace(CONFIG, pictures_every=1e6))
    write_report(folder)
    return folder


class Page(HTMLParser):
    """Text, links to anything, and open tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_needs_no_other_file(run: Path) -> None:
    page = Page((run / "report.html").read_text())
    assert page.open == []
    assert len(page.sources) == 6  # the curves and five pictures
    for source in page.sources:
        head, _, data = source.partition(",")
        assert head == "data:image/png;base64"
        assert base64.b64decode(data, validate=True).startswith(b"\x89PNG")
    assert "http" not in (run / "report.html").read_text()


def test_it_says_what_was_run(run: Path) -> None:
    text = " ".join(Page((run / "report.html").read_text()).words)
    _, header = read_checkpoint(run)
    assert header["commit"] == provenance.commit()
    assert header["machine"] == provenance.machine()
    for expected in (
        "scapo on laptop",
        f"{header['parameters']:,}",
        header["data_digest"],
        header["commit"],
        header["machine"]["cpu"],
        "12 steps, finished",
        "canonicalise",
        "scapo-bench predict RUN",
        '"gamma": 0.01',
    ):
        assert expected in text, expected
    assert header["parameters"] == sum(item.numel() for item in tiny().parameters())
    assert not re.search(r"(?<!\w)/(?:home|tmp|root)/", text)


def test_time_per_stage_adds_up(run: Path) -> None:
    timing = read_timing(run)
    assert timing.seconds == pytest.approx(sum(timing.stage_seconds.values()))
    rows = Page(stages_table(timing, read_metrics(run / METRICS))).words
    assert rows[4:7] == ["canonicalise", "6", f"{timing.stage_seconds['canonicalise']:.1f}"]
    assert rows[8:10] == ["articulate", "6"]
    assert rows[12:14] == ["all", "12"]
    assert f"{timing.memory / 1e9:.2f} GB" in rows


def test_supervised_runs_need_no_calibration(run: Path) -> None:
    _, header = read_checkpoint(run)
    assert "--calibration" in commands(header)
    assert "--calibration" not in commands({**header, "supervision": ["pose"]})


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="expected a file, found none"):
        write_report(tmp_path)
