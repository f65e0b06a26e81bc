# SPDX-License-Identifier: MIT
"""The page: uploads answered or refused with the reason, fifty at once, no file else reached."""

from __future__ import annotations

import http.client
import io
import json
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from werkzeug.datastructures import FileStorage
from werkzeug.serving import make_server
from werkzeug.test import Client, encode_multipart

from bench.infer import server as room
from bench.infer.server import Demo, Handler
from bench.requests import DemoRequest
from tests.helpers.placed import Told, placed_run, told_model


@pytest.fixture(scope="module")
def told() -> Told:
    return Told(1)


@pytest.fixture(scope="module")
def cloud(told) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, points=told.clouds()[0])
    return buffer.getvalue()


@pytest.fixture
def demo(told, tmp_path) -> Demo:
    (tmp_path / "demo").mkdir()
    request = DemoRequest(mode="fast", max_upload=1, queue=60, keep=2)
    return Demo(request, [told_model(told)], tmp_path / "demo")


def post(demo: Demo, data: bytes, name: str = "box.npz", **more: Any):
    headers = {"Host": "127.0.0.1:8000", **more.pop("headers", {})}
    kind, body = multipart(data, name, **more)
    return Client(demo).post("/results", data=body, content_type=kind, headers=headers)


def multipart(data: bytes, name: str, **fields: str) -> tuple[str, bytes]:
    """Type and body of an upload."""
    form = {"input": FileStorage(io.BytesIO(data), name), **fields}
    boundary, body = encode_multipart(form)
    return f"multipart/form-data; boundary={boundary}", body


def get(demo: Demo, path: str, host: str = "localhost:8000"):
    return Client(demo).get(path, headers={"Host": host})


def reason(answer: Any) -> str:
    found = re.search(r'<p role="alert">(.*?)</p>', answer.text)
    return "" if found is None else found[1]


def test_a_dropped_file_gives_its_page_and_files(demo, cloud):
    answer = post(demo, cloud)
    assert answer.status_code == 303
    place = answer.headers["Location"]
    assert place.endswith("/page.html")
    record = get(demo, place.replace("page.html", "joints.json"))
    assert record.content_type == "application/json"
    assert json.loads(record.data)["input"] == "box"
    assert get(demo, place.replace("page.html", "parts.ply")).data.startswith(b"ply")
    for page in (get(demo, place), get(demo, "/")):
        assert page.status_code == 200
        assert page.headers["X-Content-Type-Options"] == "nosniff"
        assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert not list(demo.folder.rglob("input*"))  # what was dropped is not kept


@pytest.mark.parametrize("given", ["run", "category"])
def test_a_result_says_what_named_its_model(given, told, cloud, tmp_path):
    request = DemoRequest(mode="fast", checkpoint=Path("oven") if given == "run" else None)
    demo = Demo(request, [told_model(told)], tmp_path)
    place = post(demo, cloud).headers["Location"]
    record = json.loads(get(demo, place.replace("page.html", "joints.json")).data)
    assert record["category"]["chosen_by"] == given


@pytest.mark.parametrize(
    ("data", "name", "form", "code", "message"),
    [
        (b"junk", "a.npz", {}, 422, "a.npz: expected a readable .npz file"),
        (b"", "a.ply", {}, 422, "a.ply: expected a PLY header"),
        (b"x", "a.exe", {}, 400, "expected a file .ply .pcd .npz .png .tif .tiff, found .exe"),
        (b"x", "", {}, 400, "expected a file, found none"),
        (b"x", "a.ply", {"scale": "-1"}, 400, "scale: expected a number above 0"),
        (b"x", "a.png", {"intrinsics": "/etc/passwd"}, 400, "camera: expected fx,fy,cx,cy"),
        (b"x", "a.png", {"intrinsics": "a,b,c,/etc/passwd"}, 400, "camera: expected fx"),
        (b"x", "a.ply", {"category": "ship"}, 400, "expected a category of this page"),
        (b"0 1 2\n" * 150_000, "a.ply", {}, 422, "a.ply: expected a PLY header"),  # large, of lines
        (bytes(1_200_000), "a.ply", {}, 413, "expected a file of at most 1 MB"),
        (bytes(18_000_000), "a.ply", {}, 413, "expected an upload of at most 1 MB, found"),
    ],
)
def test_what_cannot_be_answered_is_refused_with_the_reason(demo, data, name, form, code, message):
    answer = post(demo, data, name, **form)
    assert answer.status_code == code
    assert message in reason(answer)
    assert str(demo.folder) not in answer.text
    assert list(demo.folder.iterdir()) == []


@pytest.mark.parametrize(
    "name",
    ["../../evil.npz", "..\\..\\evil.npz", "/etc/cron.d/evil.npz", "a\x00b.npz", ".hidden.npz",
     "<script>alert(1)</script>.npz", "x" * 5000 + ".npz"],
)  # fmt: skip
def test_no_name_becomes_a_path_or_markup(demo, cloud, name, tmp_path):
    answer = post(demo, cloud, name)
    assert answer.status_code in (303, 400)
    inside = {path.name for path in tmp_path.iterdir()}
    assert inside == {"demo"}
    names = {path.name for path in demo.folder.rglob("*")}
    assert not any("evil" in one or "script" in one or "xxx" in one for one in names)
    broken = post(demo, b"junk", name)
    assert "<script>alert" not in broken.text


def test_nothing_but_results_is_read(demo, cloud, tmp_path):
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "page.html").write_text("not for you")
    key = post(demo, cloud).headers["Location"].split("/")[2]
    for path in (
        "/results/KEY/../../../etc/passwd", "/results/KEY/%2e%2e/%2e%2e/etc/passwd", "/etc/passwd",
        "/results/KEY//etc/passwd", "/results/../secret/page.html", "/results/KEY/.made.jsonx",
        "/results/other/page.html", "/results/KEY/", "//etc/passwd",
    ):  # fmt: skip
        answer = get(demo, path.replace("KEY", key))
        assert answer.status_code == 404, path
        assert "not for you" not in answer.text
        assert "root:" not in answer.text


@pytest.mark.parametrize(
    ("host", "code"),
    [("localhost:8000", 200), ("127.0.0.1", 200), ("[::1]:8000", 200), ("192.168.1.5:80", 200),
     ("evil.example", 421), ("evil.example:8000", 421), ("localhost.evil.example", 421), ("", 421)],
)  # fmt: skip
def test_other_names_of_this_machine_are_refused(demo, host, code):
    assert get(demo, "/", host).status_code == code


def test_uploads_from_pages_of_others_are_refused(demo, cloud):
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9"):
        answer = post(demo, cloud, headers={"Origin": origin})
        assert answer.status_code == 403
    own = post(demo, cloud, headers={"Origin": "http://127.0.0.1:8000"})
    assert own.status_code == 303


def test_only_the_newest_results_are_kept(demo, cloud):
    places = [post(demo, cloud).headers["Location"] for _ in range(3)]
    codes = [get(demo, place.replace("page.html", "joints.json")).status_code for place in places]
    assert codes == [404, 200, 200]
    assert len(list(demo.folder.iterdir())) == 2


def test_a_full_queue_sends_away(demo, cloud, monkeypatch):
    for _ in range(60):
        demo.places.acquire()
    answer = post(demo, cloud)
    assert answer.status_code == 503
    assert "expected fewer than 60 uploads at a time" in reason(answer)
    for _ in range(60):
        demo.places.release()
    monkeypatch.setattr(room, "read_input", lambda *_: 1 / 0)
    assert post(demo, cloud).status_code == 422
    monkeypatch.setattr(room, "read_input", lambda *_: {}["no"])
    broken = post(demo, cloud)
    assert broken.status_code == 500
    assert demo.places.acquire(blocking=False)  # nothing holds its place


@contextmanager
def serving(demo: Demo) -> Iterator[int]:
    server = make_server("127.0.0.1", 0, demo, threaded=True, request_handler=Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()


def test_fifty_at_once_are_all_served(demo, cloud, monkeypatch):
    def send(port: int) -> int:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        kind, body = multipart(cloud, "a.npz")
        connection.request("POST", "/results", body, {"Content-Type": kind})
        return connection.getresponse().status

    one = room.answer("a", room.read_input(_saved(demo, cloud), room.ReadOptions()), demo.models,
                      "fast", "category")  # fmt: skip
    monkeypatch.setattr(room, "answer", lambda *_: one)  # the networks are not what is tried here
    monkeypatch.setattr(room, "write_result", lambda _, folder: folder.mkdir() or ["joints.json"])
    with serving(demo) as port, ThreadPoolExecutor(50) as pool:
        codes = list(pool.map(send, [port] * 50))
    assert codes == [303] * 50


def _saved(demo: Demo, data: bytes) -> Path:
    path = demo.folder.parent / "a.npz"
    path.write_bytes(data)
    return path


def test_a_silent_connection_is_closed(demo, monkeypatch):
    monkeypatch.setattr(Handler, "timeout", 0.2)
    with serving(demo) as port, socket.create_connection(("127.0.0.1", port), timeout=5) as line:
        line.sendall(b"POST /results HTTP/1.1\r\nHost: localhost\r\n")
        assert line.recv(1000) == b""


def test_an_upload_ends_in_time():
    late = room.Timed(io.BytesIO(b"abc"), -1.0)
    with pytest.raises(room.RequestTimeout):
        late.read(1)
    assert room.Timed(io.BytesIO(b"abc"), 10.0).read(2) == b"ab"


def test_the_program_serves_until_it_is_ended_and_leaves_nothing(tmp_path, repository, monkeypatch):
    run = placed_run(tmp_path / "run")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    command = [sys.executable, "-m", "bench", "demo", "--run", str(run), "--mode", "fast"]
    with subprocess.Popen([*command, "--port", "0"], cwd=repository, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:  # fmt: skip
        assert program.stdout is not None
        said = program.stdout.readline()
        port = int(re.findall(r"127\.0\.0\.1:(\d+)/", said)[0])
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert answer.status == 200
        assert b"Joints of a scan" in answer.read()
        taken = subprocess.run([*command, "--port", str(port)], cwd=repository, text=True,
                               capture_output=True, check=False)  # fmt: skip
        assert taken.returncode == 1
        assert taken.stderr.count("\n") == 1
        assert f"--port {port}: Address already in use" in taken.stderr
        assert list((tmp_path / "tmp").glob("scapo-demo-*"))
        program.send_signal(signal.SIGTERM)
        _, errors = program.communicate(timeout=30)
    assert program.returncode in (0, 130)
    assert "Traceback" not in errors
    assert not list((tmp_path / "tmp").glob("scapo-demo-*"))
