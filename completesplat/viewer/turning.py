"""Scenes that turn by themselves until they are touched."""

import math
from contextlib import suppress
from dataclasses import dataclass

import viser

from completesplat.viewer.splat_view import Arrangement, SplatView

SPEED = math.radians(15)  # a second
REST = 2.0  # seconds in which a new scene is seen from the front


@dataclass
class Turn:
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

    A new scene turns again. Samples that form and samples side by side stand still.
    """

    def __init__(self, server: viser.ViserServer, view: SplatView) -> None:
        self.server = server
        self.view = view
        self._turns: dict[int, Turn] = {}

    def step(self, now: float) -> None:
        """Move each browser's camera to its place at a time in seconds."""
        view = self.view
        arrangement = view.arrangement
        clients = self.server.get_clients()
        for left in self._turns.keys() - clients.keys():
            self._turns.pop(left, None)
        finished = [sample.finished for sample in view.visible]
        if arrangement is None or finished != [True]:
            return
        for number, client in clients.items():
            turn = self._turns.get(number)
            if turn is None or turn.arrangement is not arrangement:
                turn = Turn(arrangement, now)
                self._turns[number] = turn
            angle = SPEED * (now - turn.began - REST)
            if angle > 0 and not turn.stopped:
                with suppress(RuntimeError):  # it has left
                    view.look_from_aside(client, angle)

    def start(self, client_id: int | None, now: float) -> None:
        """Turn the scene of a browser again, from the front."""
        if client_id is not None and self.view.arrangement is not None:
            self._turns[client_id] = Turn(self.view.arrangement, now - REST)

    def stop(self, client_id: int | None) -> None:
        """Let the scene of a browser stand still."""
        if client_id in self._turns:
            self._turns[client_id].stopped = True
