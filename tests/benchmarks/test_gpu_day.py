"""`make gpu`: what is done stays done, what fails holds up nothing else, and every step works at tiny sizes."""

import gpu_day
import pytest
from gpu_day import Step
from support import strict_json

GOOD, BAD = ["-c", "print('good')"], ["-c", "import sys; sys.exit('bad')"]


def test_a_failed_step_and_those_that_need_it_are_tried_again(tmp_path, monkeypatch):
    planned = [Step("one", GOOD), Step("two", BAD), Step("three", GOOD, needs="two"), Step("four", GOOD, needs="one")]
    monkeypatch.setattr(gpu_day, "steps", lambda out, small: planned)
    assert gpu_day.run(tmp_path, small=True) == ["two", "three"]
    assert (tmp_path / "four.txt").read_text() == "good\n"
    assert (tmp_path / "two.failed.txt").read_text() == "bad\n"
    assert not (tmp_path / "three.txt").exists()
    assert {"processor", "torch", "date", "commit"} <= set(strict_json(tmp_path / "machine.json"))
    planned[:] = [Step("one", BAD), Step("two", GOOD), *planned[2:]]
    assert gpu_day.run(tmp_path, small=True) == []
    assert {path.name for path in tmp_path.glob("*.txt")} == {f"{name}.txt" for name in ("one", "two", "three", "four")}


def test_small_steps_are_the_steps(tmp_path):
    small, whole = (list(gpu_day.steps(tmp_path, is_small)) for is_small in (True, False))
    assert [step.name.split("_")[0] for step in small] == [step.name.split("_")[0] for step in whole]
    assert [step.arguments[:3] for step in small] == [step.arguments[:3] for step in whole]


@pytest.mark.slow
def test_every_step_works_at_tiny_sizes(tmp_path):
    lacking = gpu_day.run(tmp_path, small=True)
    assert lacking == [], "\n".join((tmp_path / f"{name}.failed.txt").read_text()[-2000:] for name in lacking)
    for file in ("rasterizers/rasterizers.json", "plan_diffusion/plan.json", "test_48/metrics.json"):
        assert strict_json(tmp_path / file)
