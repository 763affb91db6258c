"""What is read of a job's results."""

from completesplat.results.runs import collect
from completesplat.results.sweeps import summarize

PREDICTOR = {"scenes": 4, "views": 8, "seconds": {"inference": 2.0}, "full": {"novel": {"psnr": 20.0}}}


def test_the_protocol_is_no_predictor(sweep) -> None:
    sweep.add("seed=0", test={"protocol": {"scenes": 4}, "model": PREDICTOR, "mean_image": PREDICTOR})
    (job,) = collect(sweep.folder)
    assert list(job.test) == ["model", "mean_image"]
    assert job.protocol == {"scenes": 4}
    assert [row["ablation"] for row in summarize(sweep.folder).rows] == ["small", "mean_image"]


def test_seconds_are_no_scores(sweep) -> None:
    sweep.add("seed=0", test={"model": PREDICTOR})
    (row,) = summarize(sweep.folder).rows
    assert [name for name in row if name.endswith("_mean")] == ["full_novel_psnr_mean"]


def test_a_job_without_results_has_no_protocol(sweep) -> None:
    sweep.add("seed=0")
    assert [job.protocol for job in collect(sweep.folder)] == [{}]
