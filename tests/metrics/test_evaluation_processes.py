"""Evaluation by two processes, which talk through gloo, against one."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import distributed, multiprocessing

from completesplat.data.loading.scenes import EvaluationScenes, SceneStore
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.image_sets import Patches
from completesplat.metrics.scoring import Evaluation
from completesplat.scene import Views

COUNTS = range(1, 10)
BATCH = 2


def scored(count: int) -> dict[str, Any]:
    """Results of so many scenes, of which this process scores its share."""
    store = SceneStore.__new__(SceneStore)  # of names alone: nothing is read
    store.names = [f"scene {index}" for index in range(count)]
    evaluation = Evaluation(samples=2, sets={"swd": Patches(patches=2)})
    cameras = Cameras(torch.eye(4).expand(3, 4, 4), torch.eye(3).expand(3, 3, 3), (16, 16))
    for name in EvaluationScenes(store, lambda _: (0, [1, 2])).share(BATCH).names:
        generator = torch.Generator().manual_seed(int(name.split()[1]))
        true, masks = torch.rand(3, 3, 16, 16, generator=generator), torch.ones(3, 1, 16, 16)
        images = torch.rand(2, 3, 3, 16, 16, generator=generator)
        evaluation.update_samples(name, images, Views(true, cameras, masks))
    evaluation.gather()
    return evaluation.results()


def one_of_two(rank: int, folder: str) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    results = [scored(count) for count in COUNTS]
    (Path(folder) / f"{rank}.json").write_text(json.dumps(results))
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def of_two_processes(tmp_path_factory) -> list[list[dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("two")
    multiprocessing.spawn(one_of_two, (str(folder),), nprocs=2)
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in (0, 1)]


@pytest.mark.parametrize("count", COUNTS)
def test_two_processes_tell_what_one_tells_for_any_number_of_scenes(of_two_processes, count):
    alone = json.loads(json.dumps(scored(count)))
    for results in of_two_processes:
        assert results[count - 1] == alone
    assert alone["model"]["scenes"] == count
