# SPDX-License-Identifier: MIT
"""`demo`: a local page where a file is dropped and what `infer` makes of it appears.

Every upload gets a folder of its own, in a temporary one that goes with the server. No name from a
request ever becomes a path: uploads are stored under fixed names, results are looked up in a table.
Hosts by name that are not this machine's are refused, so that no web page can reach the server by
a name of its own (DNS rebinding), and so are uploads from the pages of other origins.
"""

from __future__ import annotations

import ipaddress
import logging
import re
import secrets
import shutil
import socket
import tempfile
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from importlib.resources import files
from math import isfinite
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import Any, Protocol, runtime_checkable

from werkzeug.exceptions import (
    BadRequest,
    Forbidden,
    HTTPException,
    LengthRequired,
    MisdirectedRequest,
    NotFound,
    RequestEntityTooLarge,
    RequestTimeout,
    ServiceUnavailable,
    UnprocessableEntity,
)
from werkzeug.serving import WSGIRequestHandler, make_server
from werkzeug.wrappers import Request, Response

from bench.infer.files import PAGE, write_result
from bench.infer.infer import answer
from bench.infer.model import Model, load_models
from bench.infer.readers import SUFFIXES, ReadOptions, read_input
from bench.requests import DemoRequest
from bench.runs.train import pick_device
from scapo.text import is_word, one_line

MEGABYTE = 1_000_000
OTHER_FIELDS = 64 * 1024
"""Bytes of an upload beside its files."""
MASK = 16 * MEGABYTE
FIELDS = 8
"""Of a form."""
IDLE, UPLOAD = 30.0, 120.0
"""Seconds that a connection may say nothing, and that an upload may take."""
TYPES = {".html": "text/html; charset=utf-8", ".json": "application/json", ".ply": "model/ply",
         ".glb": "model/gltf-binary"}  # fmt: skip
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {script}; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
NUMBERS = re.compile(r"[-+0-9.eE ]+(,[-+0-9.eE ]+){3}")
"""Intrinsics as numbers: as a file's name they would be read."""
logger = logging.getLogger(__name__)


class Upload(Request):
    """A request whose files are stored in the server's folder, and which ends in time."""

    max_form_memory_size = 2 * OTHER_FIELDS
    """Also of a file's piece of 64 KiB with the line before it, which may begin the form's end."""
    max_form_parts = FIELDS
    folder: str

    def _get_file_stream(
        self,
        total_content_length: int | None,
        content_type: str | None,
        filename: str | None = None,
        content_length: int | None = None,
    ) -> Any:  # noqa: ANN401 - a file
        del total_content_length, content_type, filename, content_length
        return tempfile.TemporaryFile(dir=self.folder)


@runtime_checkable
class Readable(Protocol):
    """A stream of bytes."""

    def read(self, size: int = -1, /) -> bytes:
        """As of a file."""
        ...


class Timed:
    """A request's body that must be there before a moment."""

    def __init__(self, stream: Readable, seconds: float) -> None:
        """Time runs from now."""
        self.stream, self.end = stream, time.monotonic() + seconds

    def read(self, size: int = -1) -> bytes:
        """As of a file.

        Raises:
            RequestTimeout: Too late.
        """
        try:
            data = self.stream.read(size)
        except OSError as error:  # a connection that says nothing
            raise RequestTimeout("expected the upload, found a silent connection") from error
        if time.monotonic() > self.end:
            raise RequestTimeout(f"expected an upload of at most {UPLOAD:.0f} seconds")
        return data


class Demo:
    """The WSGI application."""

    def __init__(self, request: DemoRequest, models: Sequence[Model], folder: Path) -> None:
        """Serve these models; everything that is written lies in `folder`."""
        self.request, self.models, self.folder = request, models, folder
        self.results: OrderedDict[str, dict[str, Path]] = OrderedDict()
        self.lock, self.work = Lock(), Lock()
        self.places = BoundedSemaphore(request.queue)
        self.hosts = {"localhost", request.host.lower(), socket.gethostname().lower()}

    def __call__(self, environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        """Answer a request; an error is answered with its reason."""
        request = Upload(environ, populate_request=False)
        request.folder = str(self.folder)
        try:
            self._check_host(request)
            response = self._route(request)
        except HTTPException as refused:
            response = self._page(refused.description or "", refused.code or 500)
        except Exception as error:  # the server goes on, whatever one upload does
            logger.exception("demo: %s", one_line(error))
            response = self._page("expected an answer, found an error of the program", 500)
        finally:
            request.close()
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "same-origin"  # none would make Origin null
        response.headers["Cache-Control"] = "no-store"
        return response(environ, start)

    def _check_host(self, request: Request) -> None:
        """Refuse names that are not this machine's; an address in numbers cannot be rebound."""
        named = request.environ.get("HTTP_HOST", "")
        host = re.sub(r":\d+$", "", named).strip("[]").lower()
        try:
            ipaddress.ip_address(host)
        except ValueError:
            if host not in self.hosts:
                words = f"Host: expected this machine's name or address, found {named[:80]!r}"
                raise MisdirectedRequest(words) from None

    def _route(self, request: Upload) -> Response:
        path = request.path
        if path == "/" and request.method in ("GET", "HEAD"):
            return self._page()
        if path == "/results" and request.method == "POST":
            return self._take(request)
        found = re.fullmatch(r"/results/([\w-]{1,40})/(.{1,200})", path)
        if found and request.method in ("GET", "HEAD"):
            return self._file(found[1], found[2])
        raise NotFound(f"expected /, found {one_line(path, 80)}")

    def _page(self, message: str = "", code: int = 200) -> Response:
        """The upload page, with what was wrong."""
        nonce = secrets.token_urlsafe(12)
        text = files("bench.infer").joinpath("page.html").read_text(encoding="utf-8")
        names = [model.category.name for model in self.models]
        options = [f'<option value="{name}">{name}</option>' for name in names]
        if len(names) > 1:
            options.insert(0, '<option value="">whatever fits best</option>')
        values = {
            "MESSAGE": f'<p role="alert">{escape(one_line(message))}</p>' if message else "",
            "OPTIONS": "".join(options),
            "MEGABYTES": str(self.request.max_upload),
            "BYTES": str(self.request.max_upload * MEGABYTE),
            "NONCE": nonce,
        }
        for name, value in values.items():
            text = text.replace(f"@{name}@", value)
        response = Response(text, code, mimetype="text/html")
        script = f"'nonce-{nonce}'"
        response.headers["Content-Security-Policy"] = POLICY.format(script=script)
        return response

    def _file(self, key: str, name: str) -> Response:
        with self.lock:
            path = self.results.get(key, {}).get(name)
        if path is None:
            raise NotFound("expected a result that is still kept, found none; drop the file again")
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise NotFound("expected a result that is still kept, found none") from None
        kind = TYPES.get(path.suffix, "application/octet-stream")
        response = Response(data, content_type=kind)
        response.headers["Content-Security-Policy"] = POLICY.format(script="'unsafe-inline'")
        return response

    def _take(self, request: Upload) -> Response:
        """An upload's result, after those that came before it."""
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.environ.get("HTTP_HOST"):
            raise Forbidden("expected an upload from this page, found one from another origin")
        limit = self.request.max_upload * MEGABYTE
        length = request.content_length
        if length is None:
            raise LengthRequired("expected an upload that says its length")
        if length > limit + MASK + OTHER_FIELDS:
            raise RequestEntityTooLarge(
                f"expected an upload of at most {self.request.max_upload} MB, found one of "
                f"{length / MEGABYTE:.0f} MB"
            )
        with self._place():
            request.environ["wsgi.input"] = Timed(request.environ["wsgi.input"], UPLOAD)
            request.max_content_length = length
            key = secrets.token_urlsafe(12)
            folder = self.folder / key
            folder.mkdir()
            try:
                self._answer(request, key, folder)
            finally:
                if key not in self.results:
                    shutil.rmtree(folder, ignore_errors=True)
        return Response(status=303, headers={"Location": f"/results/{key}/{PAGE}"})

    @contextmanager
    def _place(self) -> Iterator[None]:
        """One of the places in the queue.

        Raises:
            ServiceUnavailable: All are taken.
        """
        if not self.places.acquire(blocking=False):
            raise ServiceUnavailable(
                f"expected fewer than {self.request.queue} uploads at a time, found more; try again"
            )
        try:
            yield
        finally:
            self.places.release()

    def _answer(self, request: Upload, key: str, folder: Path) -> None:
        """Store the upload, ask, and keep the result."""
        given = request.files.get("input")
        if given is None or not given.filename:
            raise BadRequest("expected a file, found none")
        stem, suffix = _name(given.filename)
        path, mask = folder / f"input{suffix}", None
        _store(given.stream, path, self.request.max_upload * MEGABYTE)
        shown = request.files.get("mask")
        if shown is not None and shown.filename:
            mask = folder / "mask.png"
            _store(shown.stream, mask, MASK)
        options = ReadOptions(
            scale=_number(request.form.get("scale", "")),
            intrinsics=_intrinsics(request.form.get("intrinsics", "")),
            mask=mask,
        )
        models = self._models(request.form.get("category", ""))
        given = "category" if self.request.checkpoint is None else "run"
        try:
            with self.work:  # one at a time: a model uses all cores by itself
                cloud = read_input(path, options)
                result = answer(stem, cloud, models, self.request.mode, given)
                made = write_result(result, folder / "result")
        except (ValueError, OSError, ArithmeticError, RuntimeError, MemoryError) as error:
            words = one_line(error).replace(str(path), f"{stem}{suffix}")
            words = words.replace(str(mask), "mask").replace(str(folder), "result")
            raise UnprocessableEntity(words) from error
        path.unlink(missing_ok=True)
        self._keep(key, {name: folder / "result" / name for name in made})

    def _models(self, category: str) -> Sequence[Model]:
        chosen = [model for model in self.models if category in ("", model.category.name)]
        if not chosen:
            raise BadRequest(f"expected a category of this page, found {one_line(category, 40)!r}")
        return chosen

    def _keep(self, key: str, made: dict[str, Path]) -> None:
        """Remember a result, and forget the oldest."""
        with self.lock:
            self.results[key] = made
            old = [self.results.popitem(last=False)[0]
                   for _ in range(len(self.results) - self.request.keep)]  # fmt: skip
        for one in old:
            shutil.rmtree(self.folder / one, ignore_errors=True)


def _name(filename: str) -> tuple[str, str]:
    """What a result is called, and its kind, by an upload's name.

    Raises:
        BadRequest: A kind that cannot be read.
    """
    name = filename.replace("\\", "/").rpartition("/")[2]
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        found = one_line(suffix, 20) or "none"
        raise BadRequest(f"expected a file {' '.join(SUFFIXES)}, found {found}")
    return (path.stem if is_word(path.stem) else "object"), suffix


def _store(stream: Readable, path: Path, limit: int) -> None:
    """Copy an upload.

    Raises:
        RequestEntityTooLarge: More than `limit` bytes.
    """
    with path.open("xb") as file:
        while piece := stream.read(1 << 20):
            if file.tell() + len(piece) > limit:
                words = f"expected a file of at most {limit / MEGABYTE:.0f} MB, found a larger one"
                raise RequestEntityTooLarge(words)
            file.write(piece)


def _number(text: str) -> float | None:
    if not text.strip():
        return None
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (isfinite(value) and value > 0):
        raise BadRequest(f"scale: expected a number above 0, found {one_line(text, 40)!r}")
    return value


def _intrinsics(text: str) -> str | None:
    if not text.strip():
        return None
    if not NUMBERS.fullmatch(text):
        raise BadRequest(f"camera: expected fx,fy,cx,cy in pixels, found {one_line(text, 40)!r}")
    return text


class Handler(WSGIRequestHandler):
    """Connections that say nothing end."""

    timeout = IDLE


def serve(request: DemoRequest, tell: Callable[[str], None]) -> None:
    """Serve until interrupted.

    Args:
        request: Models, address and limits.
        tell: Told where the page is.

    Raises:
        StoreError: No model.
        OSError: The address cannot be had.
    """
    models = load_models(
        request.checkpoint, request.category, pick_device(request.device), request.mode
    )
    family = socket.AF_INET6 if ":" in request.host else socket.AF_INET
    try:
        listening = socket.create_server((request.host, request.port), family=family, backlog=128)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise OSError(f"--host {request.host} --port {request.port}: {reason}") from error
    with listening, tempfile.TemporaryDirectory(prefix="scapo-demo-") as folder:
        app = Demo(request, models, Path(folder))
        port = listening.getsockname()[1]
        server = make_server(
            request.host, port, app, threaded=True, request_handler=Handler,
            fd=listening.fileno(),
        )  # fmt: skip
        host = f"[{request.host}]" if family == socket.AF_INET6 else request.host
        tell(f"http://{host}:{port}/ (Ctrl-C ends)")
        if not _loopback(request.host):
            tell("Whoever reaches this machine can use the page: it has no password.")
        server.serve_forever()  # until Ctrl-C


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
