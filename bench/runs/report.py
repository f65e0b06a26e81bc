# SPDX-License-Identifier: MIT
"""`report.html` of a run: one page that needs no other file, made from those of the run's folder.

What was trained on what, by which code, on which machine, how long it took, the curves, the
pictures and how to go on. Read again at any time: `write_report(RUN)`.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from html import escape
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.run_files import METRICS, Timing, read_metrics, read_timing
from scapo.store.checkpoint import RUN_FIELDS, check_header, read_checkpoint, require_fields
from scapo.store.files import Header, write_bytes
from scapo.training.log import PICTURES

REPORT = "report.html"
CURVES = "curves.png"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 2rem auto;
       max-width: 62rem; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: 0.2rem; }
h2 { font-size: 1.1rem; margin: 2rem 0 0.5rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { padding: 0.15rem 1.2rem 0.15rem 0; text-align: left; vertical-align: top; }
td.n, th.n { text-align: right; }
code, pre { font: 13px/1.5 ui-monospace, monospace; overflow-wrap: anywhere; }
pre { background: #f5f5f5; padding: 0.7rem 1rem; white-space: pre-wrap; border-radius: 4px; }
img { max-width: 100%; height: auto; }
figure { margin: 0.5rem 0 1.2rem; }
figcaption, .lead { color: #666; }
"""


def write_report(run: Path) -> Path:
    """Write the page of a run with a checkpoint; returns its path.

    Raises:
        StoreError: No checkpoint there, or a file of the run that is not what it should be.
    """
    _, header = read_checkpoint(run)
    require_fields(header, RUN_FIELDS, run)
    timing = read_timing(run)
    rows = read_metrics(run / METRICS)
    sections = [
        ("What was run", facts(header)),
        ("Time", stages_table(timing, rows)),
        ("Loss", curves(run) + losses_table(rows)),
        ("Pictures", pictures(run, list(timing.stage_seconds))),
        ("How to go on", f"<pre>{escape(commands(header))}</pre>"),
        ("Configuration", _folded(header["config"])),
    ]
    body = "".join(f"<h2>{title}</h2>{text}" for title, text in sections if text)
    title = escape(f"{header['method']} on {header['category']}")
    state = "finished" if header["finished"] else "not finished: resume continues it"
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
        f'<h1>{title}</h1><div class="lead">{header["steps"]:,} steps, {state}</div>{body}'
        "</body></html>\n"
    )
    write_bytes(run / REPORT, page.encode())
    return run / REPORT


def facts(header: Header) -> str:
    """Method, data, code and machine."""
    machine: Mapping[str, Any] = header.get("machine", {})
    training: Mapping[str, Any] = header.get("training", {})
    cores = f"{machine.get('cores', '?')} cores, {machine.get('threads', '?')} threads"
    device = " ".join(str(machine[name]) for name in ("device", "gpu") if name in machine)
    pairs = {
        "Method": header["method"],
        "Category": header["category"],
        "Supervision": ", ".join(header["supervision"]) or "none",
        "Parameters": f"{header['parameters']:,}" if "parameters" in header else "",
        "Seed": header["seed"],
        "Data digest": header["data_digest"],
        "Commit": header.get("commit", ""),
        "Device": device,
        "Processor": f"{machine['cpu']}, {cores}" if "cpu" in machine else "",
        "Software": ", ".join(f"{name} {text}" for name, text in header["versions"].items()),
        "Arithmetic": arithmetic(training),
        "Processes": training.get("ranks", ""),
        "Part frames": frame_words(header),
    }
    return table([], [[name, value] for name, value in pairs.items() if value != ""])


def frame_words(header: Header) -> str:
    """In which frame the run answers, and by which labels."""
    if "pose" in header["supervision"]:
        return "the object's, as labelled"
    found = check_header(header, "header").alignment
    if found is None:
        return "the method's own"
    return (
        f"the object's: {found.numbers} numbers fitted after training with the labels of "
        f"{found.clouds.samples} clouds of {found.clouds.split}; no weight depends on them"
    )


def arithmetic(training: Mapping[str, Any]) -> str:
    """Precision of the networks, and whether they were compiled."""
    words = [str(training.get("precision", "")), "compiled" if training.get("compiled") else ""]
    return ", ".join(word for word in words if word)


def stages_table(timing: Timing, rows: Iterable[Mapping[str, Any]]) -> str:
    """Seconds and samples per second of each stage; memory at the peak."""
    steps: dict[str, int] = {}
    for row in rows:
        steps[row["stage"]] = row["step"]
    lines, before = [], 0
    for name, seconds in timing.stage_seconds.items():
        rate = timing.samples_per_second.get(name)
        last = steps.get(name, before)
        shown = "" if rate is None else f"{rate:.1f}"
        lines.append([name or "fit", last - before, f"{seconds:.1f}", shown])
        before = last
    lines.append(["all", before, f"{timing.seconds:.1f}", ""])
    if timing.memory:
        lines.append(["peak memory", f"{timing.memory / 1e9:.2f} GB", "", ""])
    return table(["stage", "steps", "seconds, start included", "samples/s, last epoch"], lines)


def losses_table(rows: Iterable[Mapping[str, Any]]) -> str:
    """Every term at the beginning and at the end of each stage."""
    first: dict[tuple[str, str], float] = {}
    last: dict[tuple[str, str], float] = {}
    for row in rows:
        for name, value in row.items():
            if name.startswith("loss") and isinstance(value, (int, float)):
                key = (row["stage"], name)
                first.setdefault(key, value)
                last[key] = value
    lines = [
        [stage, name.removeprefix("loss/"), f"{first[stage, name]:.5f}", f"{value:.5f}"]
        for (stage, name), value in last.items()
    ]
    return table(["stage", "term", "first line", "last line"], lines) if lines else ""


def curves(run: Path) -> str:
    """The curves of the losses, drawn anew where matplotlib is installed."""
    if find_spec("matplotlib") is not None and read_metrics(run / METRICS):
        from bench.figures.pictures import training_curve

        training_curve(run / METRICS, run / CURVES)
    return image(run / CURVES, "terms of the loss against the step")


def pictures(run: Path, stages: list[str]) -> str:
    """All pictures that training left, the latest of each name, the last stage first."""
    found = list((run / PICTURES).glob("*.png")) if (run / PICTURES).is_dir() else []
    order = {stage: number for number, stage in enumerate(reversed(stages))}
    ranked = sorted((order.get(path.stem.rpartition("-")[0], 0), path) for path in found)
    return "".join(image(path, path.stem.replace("-", ": ", 1)) for _, path in ranked)


def image(path: Path, caption: str) -> str:
    """A PNG inside the page; nothing where there is none."""
    if not path.is_file():
        return ""
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def commands(header: Header) -> str:
    """How the run is used, as typed in the folder that holds it."""
    known = "pose" in header["supervision"] or header.get("alignment") is not None
    calibration = "" if known else " --calibration train.safetensors"
    first = (
        ""
        if known
        else ("scapo-bench predict RUN --data DATA --split train --out train.safetensors\n")
    )
    return (
        f"{first}scapo-bench predict RUN --data DATA --split test --out test.safetensors\n"
        f"scapo-bench evaluate --predictions test.safetensors{calibration} --data DATA "
        f"--out {header['category']}.csv.gz\n\n"
        "from scapo import load\n"
        'prediction = load("RUN").predict(points)  # (N, 3) or (B, N, 3), metres, camera frame'
    )


def _folded(config: Mapping[str, Any]) -> str:
    text = json.dumps(config, indent=1, sort_keys=True)
    return f"<details><summary>all fields</summary><pre>{escape(text)}</pre></details>"


def table(head: list[str], rows: Iterable[Iterable[object]]) -> str:
    """An HTML table; numbers to the right."""

    def cell(value: object) -> str:
        text = f"{value:,}" if isinstance(value, int) else str(value)
        number = bool(head) and text.replace(",", "").replace(".", "").lstrip("-").isdigit()
        return f"<td{' class=n' if number else ''}>{escape(text)}</td>"

    lines = [f"<tr>{''.join(f'<th>{escape(name)}</th>' for name in head)}</tr>"] if head else []
    lines += [f"<tr>{''.join(cell(value) for value in row)}</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"
