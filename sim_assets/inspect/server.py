# SPDX-License-Identifier: MIT
"""The viewer's web server: viser, for the pages and machines that are meant to reach it.

A browser lets any page open a WebSocket to any address, this machine's own among them, and a host
name of somebody else may be made to mean this machine. So every request is checked before viser
sees it: its `Host` must name this server, and its `Origin`, which browsers send, must be a page of
this server. Viser's share request, which opens a tunnel to the public, does nothing.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any
from urllib.parse import urlsplit

MISSING = "view: expected the package viser (pip install 'scapo[view]'), found none"
LOOPBACK = ("localhost", "127.0.0.1", "::1")
PORTS = {"http": 80, "https": 443}
_PATCH = threading.Lock()


def start_server(host: str, port: int) -> Any:  # noqa: ANN401 - of an extra that may be missing
    """A viser server that answers only what `refusal` lets pass.

    Raises:
        ValueError: This machine has no such address.
        RuntimeError: viser is not installed, or takes its requests in an unknown way.
    """
    try:
        viser = import_module("viser")
    except ImportError as error:
        raise RuntimeError(MISSING) from error
    _check_address(host)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """No page of the server may publish it."""
            del verbose

    with _checked_requests(host) as checked:
        server = Server(host=host, port=port, label="scapo", verbose=False)
    if not checked:
        server.stop()
        raise RuntimeError(
            "view: expected a viser that serves by websockets.asyncio.server.serve, found "
            f"{viser.__version__}"
        )
    return server


def _check_address(host: str) -> None:
    """Whether this machine can listen there: viser would try for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        raise ValueError(f"host: expected an address of this machine, found {host!r}") from error


@contextmanager
def _checked_requests(host: str) -> Iterator[list[bool]]:
    """While open, a websockets server that starts checks its requests, which viser has no way for.

    Yields:
        A list that is not empty once one has started.
    """
    module: Any = import_module("websockets.asyncio.server")
    serve, started = module.serve, list[bool]()

    def checked(*arguments: Any, process_request: Any, **options: Any) -> Any:  # noqa: ANN401
        def check(connection: Any, request: Any) -> Any:  # noqa: ANN401
            port = connection.local_address[1]
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            reason = refusal(hosts, origins, host, port)
            if reason is not None:
                return connection.respond(403, f"{reason}\n")
            return process_request(connection, request)

        started.append(True)
        return serve(*arguments, process_request=check, **options)

    with _PATCH:
        module.serve = checked
        try:
            yield started
        finally:
            module.serve = serve


def refusal(hosts: list[str], origins: list[str], bound: str, port: int) -> str | None:
    """Why a request is not answered; None if it is.

    Args:
        hosts: Values of its header `Host`.
        origins: Values of its header `Origin`; programs that are no browsers send none.
        bound: The address that the server listens at, as the user named it. A loopback one is
            reached by loopback names at its port only; another one by itself, by loopback names
            and by numbers and this machine's own name, at any port, which may be forwarded.
        port: That it listens at.
    """
    called = _name_and_port(f"http://{hosts[0]}") if len(hosts) == 1 else None
    if called is None or not _is_ours(*called, bound.lower(), port):
        return f"expected a Host of this server, found {_shown(hosts)} (see --host)"
    if not origins:
        return None
    scheme = origins[0].partition("://")[0].lower()
    page = _name_and_port(origins[0]) if len(origins) == 1 and scheme in PORTS else None
    if page is None or page != _name_and_port(f"{scheme}://{hosts[0]}"):
        return f"expected an Origin of this server, found {_shown(origins)}"
    return None


def _is_ours(name: str, number: int, bound: str, port: int) -> bool:
    if _is_loopback(bound):
        return number == port and name in (*LOOPBACK, bound)
    own = socket.gethostname().lower()
    return name in (*LOOPBACK, bound, own, f"{own}.local") or _address(name) is not None


def _is_loopback(name: str) -> bool:
    address = _address(name)
    return name == "localhost" if address is None else address.is_loopback


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _name_and_port(url: str) -> tuple[str, int] | None:
    """Of a URL that is nothing but scheme, name and port; None for others."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return None
    name = parts.hostname
    if not name or "@" in parts.netloc or parts.path or parts.query or parts.fragment:
        return None
    return name, port or PORTS.get(parts.scheme, 0)


def _shown(values: list[str]) -> str:
    return ", ".join(f"{value!r:.80}" for value in values) or "none"
