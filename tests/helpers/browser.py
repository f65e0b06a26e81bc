# SPDX-License-Identifier: MIT
"""A headless Chromium that shows a page, for tests of pages and viewers."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
    "--window-size=1280,800",
)
LOADED = "document.readyState == 'complete' && location.href != 'about:blank'"
WAIT = 60.0
"""Seconds for the browser to start and a page to be there."""


class Page:
    """An open page, driven by the DevTools protocol."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.number = 0

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """The result of a command."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=WAIT))
            if message.get("id") == self.number:
                assert "result" in message, message
                return message["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of an expression of JavaScript, a promise's once it is there."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        return result["result"].get("value")

    def text(self) -> str:
        """What can be read on it."""
        return str(self.evaluate("document.body.innerText") or "")

    def picture(self, file: Path | None = None) -> np.ndarray:
        """A screenshot, (H, W, 3) uint8; kept in a file where one is named."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            file.write_bytes(png)
        return np.asarray(Image.open(BytesIO(png)).convert("RGB"))


@contextmanager
def open_page(url: str, folder: Path, *flags: str) -> Iterator[Page]:
    """Chromium showing a page; skips the test where there is none. `folder` is its profile."""
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no chromium on this machine")
    connect = pytest.importorskip("websockets.sync.client").connect
    process = subprocess.Popen(
        [program, *FLAGS, *flags, f"--user-data-dir={folder}", url],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        with connect(_address(folder, process), max_size=None) as socket:
            page, until = Page(socket), time.monotonic() + WAIT
            while not page.evaluate(LOADED) and time.monotonic() < until:
                time.sleep(0.1)
            yield page
    finally:
        process.terminate()
        process.wait(timeout=30)


def _address(folder: Path, process: subprocess.Popen[bytes]) -> str:
    """Of the page's DevTools."""
    until = time.monotonic() + WAIT
    ports = folder / "DevToolsActivePort"
    while time.monotonic() < until and process.poll() is None:
        if ports.exists() and (lines := ports.read_text().split()):
            list_url = f"http://127.0.0.1:{lines[0]}/json/list"
            with urllib.request.urlopen(list_url, timeout=10) as answer:
                pages = [page for page in json.load(answer) if page["type"] == "page"]
            if pages:
                return str(pages[0]["webSocketDebuggerUrl"])
        time.sleep(0.1)
    raise RuntimeError(f"expected a page in Chromium, found none (exit code {process.poll()})")
