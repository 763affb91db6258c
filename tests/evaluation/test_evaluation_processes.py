"""Evaluation by two processes, which talk through gloo, against one."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import distributed, multiprocessing

from completesplat.data.loading.scenes import EvaluationScenes, SceneStore
from completesplat.evaluation.scene_scores import SceneScores
from completesplat.geometry.cameras import Cameras
from completesplat.scene import Views

pytestmark = pytest.mark.processes
COUNTS = (1, 2, 5)
BATCH = 2


class Means:
    """Set metric: the difference of the mean images."""

    regions = ("full",)

    def describe(self, images: torch.Tensor) -> torch.Tensor:
        return images.flatten(1)

    def distances(self, true: torch.Tensor, predicted: torch.Tensor) -> dict[str, float]:
        return {"mean": (true.mean(0) - predicted.mean(0)).abs().sum().item()}

    def settings(self) -> dict[str, dict[str, str | int]]:
        return {"mean": {}}


def scored(count: int, skipped: set[str]) -> dict[str, Any]:
    """Return the results of some scenes, of which this process scores its share."""
    store = SceneStore.__new__(SceneStore)  # with names alone, because nothing is read
    store.names = [f"scene {index}" for index in range(count)]
    evaluation = SceneScores(samples=2, sets={"mean": Means()})
    cameras = Cameras(torch.eye(4).expand(3, 4, 4), torch.eye(3).expand(3, 3, 3), (16, 16))
    for name in EvaluationScenes(store, lambda _: (0, [1, 2]), store.names).share(BATCH).names:
        generator = torch.Generator().manual_seed(int(name.split()[1]))
        true, masks = torch.rand(3, 3, 16, 16, generator=generator), torch.ones(3, 1, 16, 16)
        images = torch.rand(2, 3, 3, 16, 16, generator=generator)
        evaluation.update_samples(name, images, Views(true, cameras, masks))
    evaluation.skipped = skipped
    evaluation.gather()
    return evaluation.results() | {"skipped": sorted(evaluation.skipped)}


def one_of_two(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    (Path(folder) / f"{rank}.json").write_text(
        json.dumps([scored(count, {"unreadable", f"unreadable {rank}"}) for count in COUNTS])
    )
    distributed.destroy_process_group()


def test_two_processes_have_the_scores_of_one_for_any_number_of_scenes(tmp_path):
    multiprocessing.spawn(one_of_two, (str(tmp_path),), nprocs=2)
    alone = json.loads(json.dumps([scored(count, {"unreadable", "unreadable 0", "unreadable 1"}) for count in COUNTS]))
    for rank in (0, 1):
        assert json.loads((tmp_path / f"{rank}.json").read_text()) == alone
    assert [results["model"]["scenes"] for results in alone] == list(COUNTS)
