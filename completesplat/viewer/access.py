"""Access control of the page: browsers on this machine need its token.

viser itself answers everyone who reaches its port, and a web page of any site, opened on the same machine, reaches it.
This module does not need torch, so that the page opens before torch is imported.
"""

import contextlib
import io
import logging
import secrets
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import viser
from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from completesplat.errors import CompleteSplatError

TITLE = "completesplat"
LOADING = "loading the model or scene"
HEAD = Path(__file__).with_name("head.html")

HOST = "127.0.0.1"
NAMES = (HOST, "localhost", "[::1]")
MOST_FRAME = 2**20  # bytes of one websocket message; the page sends files in parts of half of that

Answer = Callable[[ServerConnection, Request], Response | None]


class GuardedServer(viser.ViserServer):
    """viser's server behind our checks, on this machine's port or, if that is taken, on the next free one.

    A request or websocket handshake is answered if its `Host` is a loopback name with the server's port, its `Origin`
    is that host too (only a handshake must have one), and it has the token; otherwise the answer is 403. The token is
    in the address, or in the page's cookie, because viser's page drops the query of its address when it opens the
    websocket. Longer websocket messages than the page sends are refused before they are received. No two servers may
    be made at the same time.

    Raises:
        CompleteSplatError: this version of viser starts its websocket server without our checks.
    """

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(32)
        self._guarded = False
        # viser's constructor starts the websocket server in a thread, waits for it, and has no options for it. A proxy
        # in front would leave viser's own port open to every page of this machine's browsers. This can go when viser
        # takes a `process_request`, or asks for a token itself.
        serve = websockets_server.serve
        websockets_server.serve = partial(self._serve, serve)  # type: ignore[assignment, misc]
        try:
            super().__init__(HOST, port, verbose=False)
        finally:
            websockets_server.serve = serve  # type: ignore[misc]
        if not self._guarded:
            self.stop()
            raise CompleteSplatError(f"viser {viser.__version__}: cannot be guarded; pip install viser==1.1.1")

    @property
    def address(self) -> str:
        """Address that opens the page.

        It contains the token.
        """
        return f"http://{self.get_host()}:{self.get_port()}/?token={self.token}"

    def _serve(self, serve: Callable[..., Any], *args: Any, process_request: Answer, **settings: Any) -> Any:
        """Start viser's websocket server with our checks.

        viser calls this instead of `serve`.
        """
        self._guarded = True
        answer = partial(self._answer, process_request)
        return serve(*args, process_request=answer, **settings | {"max_size": MOST_FRAME})

    def _answer(self, answer: Answer, connection: ServerConnection, request: Request) -> Response | None:
        port = connection.local_address[1]
        refusal = self._refusal(request, port)
        if refusal is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, refusal + "\n")
        if "Accept-Encoding" in request.headers:
            del request.headers["Accept-Encoding"]  # else viser would compress the page before our head is added
        response = answer(connection, request)
        if response is not None:
            if response.headers.get("Content-Type") == "text/html":
                response.body = with_head(response.body.decode()).encode()
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            cookie = f"{cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            response.headers.update({"Set-Cookie": cookie, "Referrer-Policy": "no-referrer"})
        return response

    def _refusal(self, request: Request, port: int) -> str | None:
        """Return why the request is refused, or None if it is answered."""
        hosts = [f"{name}:{port}" for name in NAMES] + list(NAMES if port == 80 else ())
        host = request.headers.get_all("Host")
        if len(host) != 1 or host[0].lower() not in hosts:
            return f"The viewer is reached at {', '.join(hosts)} only. Through ssh: the same port on both sides."
        origin = request.headers.get_all("Origin")
        if origin != [f"http://{host[0].lower()}"] and (origin or "Upgrade" in request.headers):
            return "The viewer answers its own page only."
        expected = self.token.encode()
        if not any(secrets.compare_digest(token, expected) for token in tokens(request, port)):
            return "Open the address that completesplat view has printed: its token is missing here, or wrong."
        return None


def start_server(port: int) -> GuardedServer:
    """Start a server on the port or, if that is taken, the next free one (0: any)."""
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with contextlib.redirect_stdout(io.StringIO()):
        server = GuardedServer(port)
    show_background(server, 0.5)
    server.gui.configure_theme(show_logo=False, show_share_button=False)  # sharing would use the internet
    show_status(server, LOADING)
    server.gui.main_panel.dock_right()
    return server


def show_background(server: viser.ViserServer, grey: float) -> None:
    server.scene.set_background_image(np.full((1, 1, 3), round(255 * grey), np.uint8), format="png")


def show_status(server: viser.ViserServer, text: str) -> None:
    """Show what the page does or did as its panel's title, all that narrow windows first show."""
    server.gui.set_panel_label(f"{TITLE}: {text}" if text else TITLE)


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server.

    Browsers then lose the page.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def cookie_name(port: int) -> str:
    """Return a name for each port, because browsers share the cookies of a host between all its ports."""
    return f"completesplat-{port}"


def tokens(request: Request, port: int) -> list[bytes]:
    candidates = parse_qs(request.path.partition("?")[2]).get("token", [])
    pairs = [pair.strip().partition("=") for line in request.headers.get_all("Cookie") for pair in line.split(";")]
    candidates += [value for name, _, value in pairs if name == cookie_name(port)]
    return [token.encode(errors="replace") for token in candidates]


def with_head(page: str) -> str:
    """Return viser's HTML with our title, icon and script at the start of its head.

    viser has no settings for them.
    """
    return page.replace("<head>", f"<head>{HEAD.read_text()}", 1)
