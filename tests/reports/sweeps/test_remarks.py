"""What is said below a sweep's table."""

import time

from completesplat.results.machine import machine
from completesplat.results.sweeps import summarize


def test_jobs_that_have_not_finished_are_named(ablations) -> None:
    ablations.add("ablation=no_skips", "seed=7")
    broken = ablations.add("ablation=m1", "seed=8")
    (broken / "metrics.json").write_text('{"steps": 9, "te')
    (ablations.folder / "silent").mkdir()  # ended before it could say what it was
    (ablations.folder / ".submitit").mkdir()
    remarks = summarize(ablations.folder).remarks
    assert remarks[0] == "9 of 12 jobs have finished."
    assert remarks[1] == "Not finished: job=9; job=10; silent."
    assert [row["seeds"] for row in summarize(ablations.folder).rows[:3]] == [3, 3, 3]


def test_jobs_that_never_started_are_named_too(sweep) -> None:
    given = ["experiment=small", "ablation=m1,full", "seed=range(2)", "data.root=/home/someone/data/set"]
    sweep.plan([*given, "out=written/in/another/way"])
    sweep.scored("ablation=m1", "seed=0", psnr=20.0)
    sweep.add("ablation=full", "seed=0")
    remarks = summarize(sweep.folder).remarks
    assert remarks[:2] == ["1 of 4 jobs have finished.", "Not finished: job=1; m1, seed=1; full, seed=1."]


def test_a_job_that_could_not_say_what_it_was_is_counted_once(sweep) -> None:
    sweep.plan(["ablation=m1,full"])
    (sweep.folder / "ablation=full").mkdir()
    remarks = summarize(sweep.folder).remarks
    assert remarks[:2] == ["0 of 2 jobs have finished.", "Not finished: m1; full."]


def test_a_plan_that_depends_on_other_files_is_not_guessed(sweep) -> None:
    sweep.plan(["ablation=glob(*)", "seed=0,1"])
    sweep.scored("ablation=m1", "seed=0", psnr=20.0)
    assert summarize(sweep.folder).remarks[0] == "1 of 1 jobs have finished."


def test_all_jobs_finished_need_no_list(ablations) -> None:
    first, second, *_ = summarize(ablations.folder).remarks
    assert first == "9 of 9 jobs have finished."
    assert second == "Commit c0ffee."


def test_the_command_is_given_once_without_the_folders_of_a_machine(ablations) -> None:
    (command,) = summarize(ablations.folder).commands
    assert command == "completesplat fit -m experiment=small ablation=full,no_skips data.root=.../set"


def test_jobs_of_different_commits_are_told(sweep) -> None:
    for seed, commit in enumerate(("c0ffee", "decade-dirty", "c0ffee")):
        sweep.add(f"seed={seed}", commit=commit)
    assert "Commits c0ffee, decade-dirty." in summarize(sweep.folder).remarks


def test_the_machine_and_the_date_are_told(ablations) -> None:
    last = summarize(ablations.folder).remarks[-1]
    assert machine()["processor"] in last
    assert time.strftime("%Y-") in last
