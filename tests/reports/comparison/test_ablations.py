"""The paper's ablations beside those of a sweep."""

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from completesplat.results.published import tables
from completesplat.results.tables import Table

PROTOCOL = {"data_set": "toy_objects", "resolution": 32, "scenes": 9, "missing": {"lpips": "missing: no weights"}}


@pytest.fixture
def job(runs: Path):
    """Writes a finished job of the sweep `runs/sweep`."""

    def write(ablation: str, seed: int, psnr: float, **protocol) -> None:
        folder = runs / f"sweep/ablation={ablation},seed={seed}"
        folder.mkdir(parents=True)
        OmegaConf.save(OmegaConf.create({"seed": seed}), folder / "config.yaml")
        record = {
            "command": ["completesplat fit"],
            "commit": "c",
            "overrides": [f"ablation={ablation}", f"seed={seed}"],
        }
        (folder / "run.json").write_text(json.dumps(record))
        seconds = {"inference": 2.0 + seed, "rendering": 0.5}
        model = {"scenes": 9, "views": 9, "seconds": seconds, "full": {"novel": {"psnr": psnr, "ssim": 0.5}}}
        mean_image = {"scenes": 9, "views": 9, "full": {"novel": {"psnr": 10.0}}}
        test = {"protocol": PROTOCOL | protocol, "model": model, "mean_image": mean_image}
        (folder / "metrics.json").write_text(json.dumps({"steps": 5, "test": test}))
        OmegaConf.save(OmegaConf.create({"hydra": {"overrides": {"task": []}}}), runs / "sweep/multirun.yaml")

    return write


def rows(table: Table) -> list[dict[str, str]]:
    names = [f"{heading.group} {heading.text}".strip() for heading in table.headings]
    return [dict(zip(names, (cell.text for cell in row.cells), strict=True)) for row in table.rows]


def test_a_sweep_stands_beside_the_papers_rows_in_columns_of_its_own(runs, job) -> None:
    for seed in (0, 1):
        job("full", seed, 20.0 + seed)
        job("no_skips", seed, 15.0)
    found = {table.name: table for table in tables(runs)[0]}
    assert list(found) == ["full_images", "realestate10k", "ablations_sweep", "objects_only"]  # and no table of jobs
    table = found["ablations_sweep"]
    lines = {row["published row of the paper"]: row for row in rows(table) if row["setting"] != "mean_image"}
    assert len(lines) == 9
    full = lines["Our AutoReconstructor"]
    assert (full["published PSNR ↑"], full["published LPIPS ↓"]) == ("17.59", "0.471")
    own = "ours: toy_objects, 32 pixels"
    assert (full[f"{own} PSNR ↑"], full[f"{own} seeds"], full[f"{own} scenes"]) == ("20.50 ± 0.71", "2", "9")
    assert (full[f"{own} inference"], full[f"{own} rendering"]) == ("2.5 sec", "500.0 ms")
    assert lines["No skip connections"][f"{own} PSNR ↑"] == "15.00 ± 0.00"
    assert lines["No SSIM"][f"{own} PSNR ↑"] == "-"
    number = full[f"{own} LPIPS ↓"].removeprefix("missing: note ")
    assert f"[{number}] lpips: missing: no weights" in table.below()


def test_jobs_tested_by_different_protocols_do_not_share_a_table(runs, job) -> None:
    job("full", 0, 20.0)
    job("no_skips", 0, 15.0, resolution=64)
    assert [table.name for table in tables(runs)[0]].count("ablations_sweep") == 2


def test_a_sweep_without_ablations_is_a_number_of_runs(runs, job) -> None:
    job("nothing_of_the_paper", 0, 20.0)
    job("nothing_of_the_paper", 1, 21.0)
    names = [table.name for table in tables(runs)[0]]
    assert names == ["full_images", "realestate10k", "ablations", "objects_only", "own_1"]
