"""How the rows of a sweep are called and ordered."""

import pytest

from completesplat.results.sweeps import summarize


def named(sweep) -> list[str]:
    return [row["ablation"] for row in summarize(sweep.folder).rows if row["seeds"] is not None]


def test_a_row_is_named_by_the_one_override_that_varies_the_full_method_last(ablations) -> None:
    assert named(ablations) == ["m1", "no_skips", "full"]


def test_two_overrides_that_vary_are_both_named(sweep) -> None:
    for model in ("var", "splatter_image"):
        for ablation in ("no_skips", "full", "m1"):
            sweep.scored(f"model={model}", f"ablation={ablation}", psnr=20.0)
    assert named(sweep) == [
        f"{model}, {ablation}" for model in ("splatter_image", "var") for ablation in ("m1", "no_skips", "full")
    ]


@pytest.mark.parametrize(
    ("varied", "names"),
    [
        (["optimizer.lr=0.1", "optimizer.lr=0.2"], ["optimizer.lr=0.1", "optimizer.lr=0.2"]),
        (["+loss.kl.weight=1", "+loss.kl.weight=2"], ["loss.kl.weight=1", "loss.kl.weight=2"]),
        (["batch=2", "batch=10"], ["batch=10", "batch=2"]),  # no group, though without a dot
        (["model=var", "model=splatter_image"], ["splatter_image", "var"]),
        (["data/source=a", "data/source=b"], ["a", "b"]),
        (["a.b=[0,1]", "a.b=[0]"], ["a.b=[0,1]", "a.b=[0]"]),
    ],
)
def test_groups_are_named_by_their_choice_and_settings_with_their_key(sweep, varied, names) -> None:
    for override in varied:
        sweep.scored(override, "seed=3", psnr=20.0)
    assert named(sweep) == names


def test_an_override_that_only_some_jobs_have_names_those_jobs(sweep) -> None:
    sweep.scored("ablation=no_skips", psnr=20.0)
    sweep.scored("model=splatter_image", psnr=20.0)
    sweep.scored(psnr=20.0)
    assert named(sweep) == ["no_skips", "small", "splatter_image"]


def test_seeds_alone_make_one_row_with_the_name_of_the_experiment(sweep) -> None:
    for seed in range(4):
        sweep.scored(f"seed={seed}", psnr=20.0)
    (row,) = (row for row in summarize(sweep.folder).rows if row["seeds"] is not None)
    assert (row["ablation"], row["seeds"]) == ("small", 4)
    for run in sweep.folder.glob("*/run.json"):
        run.write_text(run.read_text().replace('"experiment=small", ', ""))
    assert named(sweep) == ["all"]


def test_a_seed_of_something_else_makes_another_row(sweep) -> None:
    for seed in range(2):
        sweep.scored(f"data.seed={seed}", psnr=20.0)
    assert named(sweep) == ["data.seed=0", "data.seed=1"]


def test_the_order_in_which_overrides_were_given_is_no_difference(sweep) -> None:
    sweep.scored("ablation=m1", "model=var", "seed=0", psnr=20.0)
    sweep.scored("model=var", "seed=1", "ablation=m1", psnr=21.0)
    sweep.scored("ablation=full", "model=var", "seed=1", psnr=21.0)
    rows = summarize(sweep.folder).rows
    assert [(row["ablation"], row["seeds"]) for row in rows[:2]] == [("m1", 2), ("full", 1)]
