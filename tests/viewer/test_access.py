"""Requests to the server's port: from other pages, from other programs and from the page itself, without a browser."""

import http.client
import logging
import socket
import struct
from contextlib import closing, suppress
from types import SimpleNamespace

import pytest
from support import LIMIT

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")

import websockets.asyncio.server  # noqa: E402
from viser.infra import _infra  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from completesplat.errors import CompleteSplatError  # noqa: E402
from completesplat.viewer import access  # noqa: E402
from completesplat.viewer.access import MOST_FRAME, cookie_name, start_server  # noqa: E402

EVIL = "evil.example"
PROTOCOL = f"viser-v{viser.__version__}"
HANDSHAKE = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
HANDSHAKE |= {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Protocol": PROTOCOL}


@pytest.fixture(scope="module")
def server():
    made = start_server(0)
    yield made
    made.stop()


def headers_of(server, host: str = "127.0.0.1:{port}", origin: str | None = None, cookie: str = "") -> dict[str, str]:
    places = {"port": server.get_port(), "token": server.token}
    headers = {"Host": host, "Origin": origin or "", "Cookie": cookie}
    return {name: text.format(**places) for name, text in headers.items() if text}


def status(server, path: str, headers: dict[str, str]) -> tuple[int, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=LIMIT)
    connection.request("GET", path, headers=headers)
    with closing(connection), connection.getresponse() as response:
        return response.status, response.msg


def statuses(server, query: str, **headers: str) -> tuple[int, int]:
    """Return the statuses of a request for the page and of a websocket's handshake."""
    path, asked = "/" + query.format(token=server.token), headers_of(server, **headers)
    return status(server, path, asked)[0], status(server, path, asked | HANDSHAKE)[0]


def open_socket(server, path: str = "", cookie: str = ""):
    host = f"127.0.0.1:{server.get_port()}"
    given = {"origin": f"http://{host}", "additional_headers": {"Cookie": cookie}, "subprotocols": [PROTOCOL]}
    return connect(f"ws://{host}{path}", open_timeout=LIMIT, proxy=None, **given)


OWN = "http://127.0.0.1:{port}"
COOKIE = "other=1; completesplat-{port}={token}"


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "LocalHost:{port}", "[::1]:{port}"])
@pytest.mark.parametrize(("query", "cookie"), [("?token={token}", ""), ("", COOKIE), ("?a=b&token={token}", "x")])
def test_the_page_and_its_socket_open_with_the_token(server, host, query, cookie):
    assert statuses(server, query, host=host, origin=f"http://{host}".lower(), cookie=cookie) == (200, 101)


def test_the_page_sets_the_token_as_a_cookie_for_itself_only(server):
    assert server.address == f"http://127.0.0.1:{server.get_port()}/?token={server.token}"
    of_the_page, headers = status(server, f"/?token={server.token}", headers_of(server))
    assert of_the_page == 200  # a request of the address bar has no origin
    cookie, *attributes = headers["Set-Cookie"].split("; ")
    assert cookie == f"{cookie_name(server.get_port())}={server.token}"
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} == set(attributes)
    assert headers["Referrer-Policy"] == "no-referrer"
    with open_socket(server, cookie=cookie) as opened:
        assert opened.recv(timeout=LIMIT)


@pytest.mark.parametrize("cookie", ["", COOKIE])
@pytest.mark.parametrize(
    ("host", "origin"),
    [
        (EVIL, OWN),
        (f"{EVIL}:{{port}}", f"http://{EVIL}:{{port}}"),  # a name that its owner points at this machine
        ("127.0.0.1:1", OWN),
        (f"127.0.0.1:{{port}}.{EVIL}", OWN),
        ("127.0.0.1:{port}", f"http://{EVIL}:{{port}}"),
        ("127.0.0.1:{port}", "http://127.0.0.1:1"),  # another program's page on this machine
        ("127.0.0.1:{port}", "https://127.0.0.1:{port}"),
        ("127.0.0.1:{port}", "null"),  # a file, a sandbox
        ("127.0.0.1:{port}", f"{OWN}.{EVIL}"),
    ],
)
def test_other_sites_get_nothing_even_with_the_token(server, host, origin, cookie):
    assert statuses(server, "" if cookie else "?token={token}", host=host, origin=origin, cookie=cookie) == (403, 403)


@pytest.mark.parametrize("query", ["", "?token={token}x", "?token=%ff"])
@pytest.mark.parametrize("cookie", ["", "completesplat-{port}=wrong", "completesplat-1={token}", "\xfc; =;;"])
def test_nobody_gets_anything_without_the_token(server, query, cookie):
    assert statuses(server, query, origin=OWN, cookie=cookie) == (403, 403)


def test_a_handshake_needs_an_origin_and_every_request_one_host_and_refusals_are_not_logged(server, caplog):
    with caplog.at_level(logging.WARNING):
        assert statuses(server, "?token={token}") == (200, 403)
        assert statuses(server, "") == (403, 403)
    assert caplog.text == ""
    for hosts in ([], [f"127.0.0.1:{server.get_port()}"] * 2):
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=LIMIT)
        connection.putrequest("GET", f"/?token={server.token}", skip_host=True)
        for host in hosts:
            connection.putheader("Host", host)
        connection.endheaders()
        assert connection.getresponse().status == 403


def test_tokens_are_compared_in_constant_time_and_differ(server, monkeypatch):
    compared = []
    original = access.secrets.compare_digest
    monkeypatch.setattr(access.secrets, "compare_digest", lambda *two: compared.append(two) or original(*two))
    statuses(server, "?token=wrong", origin=OWN)
    assert compared == [(b"wrong", server.token.encode())] * 2
    assert len(server.token) >= 43  # 256 bits
    second = start_server(0)
    second.stop()
    assert second.token != server.token


def closed_with(opened) -> int:
    """Return the code with which the server ends the connection."""
    with suppress(ConnectionClosed):
        while True:
            opened.recv(timeout=LIMIT)
    return opened.close_code


def test_too_long_a_message_is_refused_when_it_is_announced(server):
    path = f"/?token={server.token}"
    with open_socket(server, path) as opened:
        announced = struct.pack("!BBQI", 0x82, 0x80 | 127, MOST_FRAME + 1, 0)  # the head of a frame, and nothing of it
        opened.socket.sendall(announced)
        assert closed_with(opened) == 1009
    with open_socket(server, path) as opened:
        with suppress(ConnectionClosed):  # it may be refused before its last frame is on its way
            opened.send(iter([bytes(MOST_FRAME // 2)] * 3))  # one message in three frames
        assert closed_with(opened) == 1009


def test_a_viser_without_our_checks_is_not_served(monkeypatch):
    """A future viser may call another function than the replaced one."""
    serve = websockets.asyncio.server.serve
    served = SimpleNamespace(server=SimpleNamespace(serve=serve))
    other = SimpleNamespace(asyncio=served, exceptions=websockets.exceptions)  # handlers of other tests may still end
    monkeypatch.setattr(_infra, "websockets", other)
    ports = []
    stop = access.GuardedServer.stop
    monkeypatch.setattr(access.GuardedServer, "stop", lambda self: (ports.append(self.get_port()), stop(self)))
    with pytest.raises(CompleteSplatError, match="cannot be guarded"):
        start_server(0)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", ports[0]), timeout=LIMIT).close()
    assert websockets.asyncio.server.serve is serve
