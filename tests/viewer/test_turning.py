"""Scenes that turn by themselves: where the cameras of browsers are after some time."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from viewer_scenes import balls_sample

viser = pytest.importorskip("viser", reason="the viewer's extra is not installed")

from completesplat.viewer.access import start_server  # noqa: E402
from completesplat.viewer.splat_view import SplatView  # noqa: E402
from completesplat.viewer.turning import REST, SLOW, SPEED, Turntable  # noqa: E402

QUARTER = np.pi / 2 / SPEED  # seconds


class Browser(viser.ClientHandle):
    """Stands in for one that is connected."""

    def __init__(self) -> None:
        self.reports = []
        self.camera = SimpleNamespace(
            image_width=0, image_height=0, position=np.zeros(3), on_update=self.reports.append
        )

    def atomic(self):
        return nullcontext()


@pytest.fixture(scope="module")
def server():
    made = start_server(0)
    yield made
    made.stop()


@pytest.fixture
def browsers(server, monkeypatch):
    made = {0: Browser(), 1: Browser()}
    monkeypatch.setattr(server, "get_clients", lambda: made)
    return made


@pytest.fixture
def turntable(server):
    server.scene.reset()
    view = SplatView(server, (0.0, -1.0, 0.0))
    view.show([balls_sample()])
    return Turntable(server, view)


def place(browser: Browser) -> list[float]:
    return browser.camera.position


def test_the_camera_rests_at_the_front_and_then_goes_round_the_scene_at_its_height(turntable, browsers):
    front = turntable.view.arrangement.position
    pivot = turntable.view.arrangement.look_at
    for seconds in (0.0, REST):
        turntable.step(seconds)
        assert place(browsers[0]) == pytest.approx(np.zeros(3))  # nothing has moved it
    turntable.step(REST + 2 * QUARTER)
    behind = 2 * pivot - front
    assert place(browsers[0]) == pytest.approx(behind, abs=1e-4)
    for report in browsers[0].reports:
        report(browsers[0].camera)
    turntable.step(REST + QUARTER)
    aside = place(browsers[0]) - pivot
    assert aside @ (front - pivot) == pytest.approx(0, abs=1e-4)
    assert aside[1] == pytest.approx(0, abs=1e-4)
    assert browsers[0].camera.look_at == pytest.approx(pivot)


def test_a_touch_stops_the_scene_of_one_browser_until_it_turns_again_or_another_scene_comes(turntable, browsers):
    for browser in browsers.values():
        browser.camera.position = None
    turntable.step(0)
    turntable.stop(0)
    turntable.stop(7)  # has left
    turntable.step(REST + QUARTER)
    assert place(browsers[0]) is None
    assert place(browsers[1]) is not None
    turntable.start(0, REST + QUARTER)
    turntable.step(REST + QUARTER + 1)
    assert place(browsers[0]) is not None
    (report,) = browsers[0].reports
    report(browsers[0].camera)
    turntable.stop(0)
    turntable.view.set_up((0.0, -1.0, 0.0))
    turntable.view.show([balls_sample()])
    browsers[0].camera.position = None
    turntable.step(100)
    assert place(browsers[0]) is None
    turntable.step(100 + REST + 1)
    assert place(browsers[0]) is not None


@pytest.mark.parametrize(("seconds", "goes_on"), [(SLOW / 2, True), (2 * SLOW, False)])
def test_a_browser_is_moved_when_it_has_reported_the_last_move_and_a_slow_one_stops(
    turntable, browsers, seconds, goes_on
):
    turntable.step(0)
    turntable.step(REST + 3)
    first = place(browsers[0])
    turntable.step(REST + 3 + seconds)
    assert place(browsers[0]) is first
    (report,) = browsers[0].reports
    report(browsers[0].camera)
    turntable.step(REST + 4 + seconds)
    assert (place(browsers[0]) is not first) == goes_on


@pytest.mark.parametrize("kind", ["forming", "side by side", "nothing", "only the direction up"])
def test_these_stand_still(turntable, browsers, kind):
    view = turntable.view
    if kind == "forming":
        view.show([replace(balls_sample(), finished=False)])
    elif kind == "side by side":
        view.chosen = None
        view.show([balls_sample()] * 2)
    elif kind == "nothing":
        view.show([])
    else:
        view.set_up((0.0, 0.0, 1.0))
    for browser in browsers.values():
        browser.camera.position = None
    for seconds in (0, REST + QUARTER):
        turntable.step(seconds)
    assert place(browsers[0]) is None
