"""Scenes that turn by themselves until they are touched."""

import math
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import viser

from completesplat.viewer.splat_view import Arrangement, SplatView

SPEED = math.radians(15)  # a second
REST = 2.0  # seconds in which a new scene is seen from the front
SLOW = 0.5  # seconds in which a browser draws an image


@dataclass
class TurnState:
    """Turning of a scene in one browser.

    Attributes:
        arrangement: the scene's, by which a new scene is told from this one.
        began: the time at which it was seen from the front.
        stopped: whether the scene was touched.
    """

    arrangement: Arrangement
    began: float
    stopped: bool = False


class Turntable:
    """Cameras that go round the scene, each browser's for itself, until its scene is touched.

    A new scene turns again. Samples that form and samples side by side stand still. A camera moves on when its browser
    has reported the last move, and stops if that took longer than `SLOW`: without a graphics card, a browser that draws
    all the time answers to nothing else.
    """

    def __init__(self, server: viser.ViserServer, view: SplatView) -> None:
        self.server = server
        self.view = view
        self._turns: dict[int, TurnState] = {}
        self._unreported: dict[int, float] = {}  # times of moves by browser
        self._now = 0.0

    def step(self, now: float) -> None:
        """Move each browser's camera to its place at a time in seconds."""
        self._now = now
        arrangement = self.view.arrangement
        clients = self.server.get_clients()
        for left in self._turns.keys() - clients.keys():
            self._turns.pop(left, None)
            self._unreported.pop(left, None)
        finished = [sample.finished for sample in self.view.visible]
        if arrangement is None or finished != [True]:
            return
        for number, client in clients.items():
            if number not in self._turns:
                client.camera.on_update(partial(self._reported_by, number))
            turn = self._turns.get(number)
            if turn is None or turn.arrangement is not arrangement:
                turn = TurnState(arrangement, now)
                self._turns[number] = turn
            angle = SPEED * (now - turn.began - REST)
            if angle > 0 and not self.has_stopped(number) and number not in self._unreported:
                self._unreported[number] = now
                self._move(client, angle)

    def start(self, client_id: int | None, now: float) -> None:
        """Turn the scene of a browser again, from the front."""
        if client_id in self._turns and self.view.arrangement is not None:
            self._turns[client_id] = TurnState(self.view.arrangement, now - REST)

    def stop(self, client_id: int | None) -> None:
        """Let the scene of a browser stand still."""
        if client_id in self._turns:
            self._turns[client_id].stopped = True

    def has_stopped(self, client_id: int) -> bool:
        """Return whether a browser's scene was touched, or the browser is slow."""
        return client_id in self._turns and self._turns[client_id].stopped

    def _reported_by(self, number: int, _: object) -> None:
        """Note that a browser has reported the camera that it was sent; stop turning where that took long."""
        sent = self._unreported.pop(number, self._now)
        if self._now - sent > SLOW:
            self.stop(number)

    def _move(self, client: viser.ClientHandle, angle: float) -> None:
        with warnings.catch_warnings(), suppress(RuntimeError):  # it has left
            warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
            self.view.look_from_aside(client, angle)
