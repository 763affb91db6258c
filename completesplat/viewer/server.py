"""viser's server, on this machine only and without its own announcements."""

import contextlib
import io
import logging

import numpy as np
import viser

HOST = "127.0.0.1"


def start_server(port: int, background: float = 0.5) -> viser.ViserServer:
    """Listen on the port or, if it is taken, on the next free one; 0 takes any.

    Args:
        background: grey value where a scene leaves a pixel open.
    """
    logging.getLogger("websockets").setLevel(logging.WARNING)
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(HOST, port, verbose=False)
    server.scene.set_background_image(np.full((1, 1, 3), round(255 * background), np.uint8), format="png")
    server.gui.configure_theme(show_logo=False, show_share_button=False)  # sharing would lead through the internet
    server.gui.set_panel_label("completesplat")
    server.gui.main_panel.dock_right()
    return server


def stop_server(server: viser.ViserServer) -> None:
    """End it, and with it what browsers show."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
