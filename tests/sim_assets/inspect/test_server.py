# SPDX-License-Identifier: MIT
"""The viewer's server answers its own pages alone: header by header, on the wire, in Chromium."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, HTTPServer
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from sim_assets.inspect import server as module
from sim_assets.inspect.server import refusal, start_server
from tests.helpers.browser import open_page

needs_viser = pytest.mark.skipif(
    find_spec("viser") is None, reason="the package viser (extra [view]) is not installed"
)
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:websockets")


@pytest.mark.parametrize(
    ("host", "origin", "bound"),
    [
        ("localhost:8080", None, "localhost"),
        ("LocalHost:8080", "http://localhost:8080", "localhost"),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", "localhost"),
        ("[::1]:8080", "http://[::1]:8080", "::1"),
        ("127.0.0.5:8080", None, "127.0.0.5"),
        ("192.168.1.7:8080", "http://192.168.1.7:8080", "0.0.0.0"),
        ("192.168.1.7:9000", "http://192.168.1.7:9000", "0.0.0.0"),  # a forwarded port
        ("[fe80::1]:8080", "http://[fe80::1]:8080", "::"),
        ("box.lan:8080", "http://box.lan:8080", "box.lan"),
        ("box.lan", "https://box.lan", "box.lan"),  # behind a proxy with a certificate
        ("localhost:8080", None, "box.lan"),
    ],
)
def test_own_pages_are_answered(host: str, origin: str | None, bound: str):
    assert refusal([host], [origin] if origin else [], bound, 8080) is None


@pytest.mark.parametrize(
    ("hosts", "bound"),
    [
        ([], "localhost"),
        (["evil.test:8080"], "localhost"),
        (["localhost:8081"], "localhost"),
        (["localhost"], "localhost"),
        (["localhost.evil.test:8080"], "localhost"),
        (["127.0.0.1.evil.test:8080"], "localhost"),
        (["evil.test@localhost:8080"], "localhost"),
        (["localhost:8080", "localhost:8080"], "localhost"),
        (["localhost:8080/evil"], "localhost"),
        (["localhost:x"], "localhost"),
        (["[::1:8080"], "localhost"),
        (["192.168.1.7:8080"], "localhost"),
        (["evil.test:8080"], "0.0.0.0"),
        (["evil.test:8080"], "192.168.1.7"),
        (["\x1b[2J:8080"], "localhost"),
    ],
)
def test_requests_to_another_host_are_refused(hosts: list[str], bound: str):
    reason = refusal(hosts, [], bound, 8080)
    assert reason is not None
    assert reason.startswith("expected a Host of this server, found ")
    assert reason.isprintable()


@pytest.mark.parametrize(
    "origins",
    [
        ["http://evil.test"],
        ["http://localhost:3000"],  # another program's page on this machine
        ["http://127.0.0.1:8080"],  # not the name that was asked for
        ["https://localhost:8080"[:-5]],
        ["null"],
        [""],
        ["file://"],
        ["http://"],
        ["ftp://localhost:8080"],
        ["http://localhost:8080", "http://localhost:8080"],
        ["http://evil.test@localhost:8080"],
        ["http://localhost:8080/"],
    ],
)
@pytest.mark.parametrize("bound", ["localhost", "0.0.0.0"])
def test_requests_from_another_page_are_refused(origins: list[str], bound: str):
    reason = refusal(["localhost:8080"], origins, bound, 8080)
    assert reason is not None
    assert reason.startswith("expected an Origin of this server, found ")


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    pytest.importorskip("viser")
    server = start_server("localhost", 18180)
    yield server.get_port()
    server.stop()


@needs_viser
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Origin": "http://localhost:{port}"}, 200),
        ({"Host": "evil.test:{port}"}, 403),
        ({"Host": "localhost:1"}, 403),
        ({"Origin": "http://evil.test"}, 403),
        ({"Origin": "http://evil.test", "Upgrade": "websocket", "Connection": "Upgrade"}, 403),
        ({"Host": "evil.test", "Upgrade": "websocket", "Connection": "Upgrade"}, 403),
    ],
)
def test_foreign_requests_get_403(headers: dict[str, str], status: int, port: int):
    connection = HTTPConnection("localhost", port, timeout=20)
    sent = {name: value.format(port=port) for name, value in headers.items()}
    connection.request("GET", "/", headers=sent)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    assert answer.status == status
    assert (b"expected a" in body) is (status == 403)
    assert (b"<html" in body) is (status == 200)


@needs_viser
def test_the_socket_opens_for_own_pages_alone(port: int):
    connect = import_module("websockets.sync.client").connect
    refused = import_module("websockets.exceptions").InvalidStatus
    version = import_module("viser").__version__
    address = f"ws://localhost:{port}"
    for origin in (f"http://localhost:{port}", None):
        with connect(address, origin=origin, subprotocols=[f"viser-v{version}"]) as socket:
            assert socket.recv(timeout=20)
    with pytest.raises(refused, match="HTTP 403"):
        connect(address, origin="http://evil.test", subprotocols=[f"viser-v{version}"])


@needs_viser
def test_a_page_cannot_publish_the_server(monkeypatch: pytest.MonkeyPatch):
    """A share request as viser's own button sends it opens no tunnel."""
    viser_module = import_module("viser._viser")
    messages = import_module("viser._messages")
    opened: list[object] = []
    monkeypatch.setattr(viser_module, "ViserTunnel", lambda *where: opened.append(where))
    server = start_server("localhost", 18190)
    try:
        handlers = server._websock_server._incoming_handlers[messages.ShareUrlRequest]
        for handler in handlers:
            handler(0, messages.ShareUrlRequest())
        server._thread_executor.shutdown(wait=True)
        assert handlers
        assert server.request_share_url() is None
        assert opened == []
    finally:
        server.stop()


@needs_viser
def test_a_viser_whose_requests_cannot_be_checked_is_not_used(monkeypatch: pytest.MonkeyPatch):
    stopped: list[bool] = []

    class Unchecked:
        def __init__(self, **_: object) -> None: ...

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(import_module("viser"), "ViserServer", Unchecked)
    with pytest.raises(RuntimeError, match=r"expected a viser that serves by websockets"):
        start_server("localhost", 18200)
    assert stopped == [True]
    assert import_module("websockets.asyncio.server").serve.__module__.startswith("websockets")
    assert not module._PATCH.locked()


class _Page(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html><body>another page</body></html>")

    def log_message(self, format: str, *args: Any) -> None: ...  # noqa: A002


OPENED = """new Promise(resolve => {{
    const socket = new WebSocket("ws://localhost:{port}", "viser-v{version}");
    socket.onopen = () => resolve("open");
    socket.onerror = () => resolve("refused");
}})"""


@needs_viser
def test_chromium_is_refused_from_another_page_and_by_another_name(port: int, tmp_path: Path):
    script = OPENED.format(port=port, version=import_module("viser").__version__)
    other = HTTPServer(("localhost", 0), _Page)
    threading.Thread(target=other.serve_forever, daemon=True).start()
    try:
        with open_page(f"http://localhost:{other.server_port}", tmp_path / "other") as page:
            assert page.evaluate(script) == "refused"
    finally:
        other.shutdown()
        other.server_close()
    with open_page(f"http://localhost:{port}", tmp_path / "own") as page:
        assert page.evaluate(script) == "open"
    rebound = "--host-resolver-rules=MAP evil.test 127.0.0.1"
    with open_page(f"http://evil.test:{port}", tmp_path / "name", rebound) as page:
        assert "expected a Host of this server, found 'evil.test" in page.text()
