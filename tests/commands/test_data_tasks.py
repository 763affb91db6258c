"""`completesplat data toy`, `stats`, `show`, `prepare`, `import` and `latents`: what they write, say and refuse."""

import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest
from omegaconf import OmegaConf
from support import LIMIT, SMALL, flip_bit, refused, strict_json, write_capture

from completesplat.data.loading.latent_cache import LatentCache
from completesplat.data.toy import write_rooms
from completesplat.data.toy.module import OWN_PLACE
from completesplat.settings.options import conf_folder


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("rooms")
    write_rooms(root, scenes=6, frames=4, size=16, seed=0, workers=1, progress=False)
    return root


@pytest.fixture
def sets(toy_root: Path, rooms: Path) -> dict[str, list[str]]:
    roots = {"objects": toy_root, "rooms": rooms}
    return {kind: [f"data=toy_{kind}", "data.image_size=16", f"data.root={root}"] for kind, root in roots.items()}


def test_toy_objects_are_written_where_asked(command, tmp_path):
    settings = ["kind=objects", "scenes=3", "frames=3", "size=16", "seed=1", "workers=1"]
    finished = command("data", "toy", f"out={tmp_path / 'toy'}", *settings)
    assert (finished.status, finished.out.splitlines()[-1]) == (0, str(tmp_path / "toy"))
    assert len(list((tmp_path / "toy").glob("*/*/images/*.jpg"))) == 9
    typed = ["completesplat data", "toy", f"out={tmp_path / 'toy'}", *settings]
    assert strict_json(tmp_path / "toy/run.json")["command"] == typed


COUNTS = {
    "objects": {"train": (2, 8), "val": (1, 4), "test": (1, 4)},
    "rooms": {"train": (4, 16), "val": (1, 4), "test": (1, 4)},
}


@pytest.mark.parametrize("kind", COUNTS)
def test_statistics_are_drawn_and_the_sheet_shows_as_many_scenes_as_asked(command, sets, kind, tmp_path):
    finished = command("data", "stats", *sets[kind], f"out={tmp_path / 'out'}")
    assert (finished.status, finished.out.splitlines()[-1]) == (0, str(tmp_path / "out"))
    splits = strict_json(tmp_path / "out/stats.json")["splits"]
    assert {split: (n["sequences"], n["frames"]) for split, n in splits.items()} == COUNTS[kind]
    assert imageio.imread(tmp_path / "out/stats.png").shape[2] >= 3
    heights = []
    for scenes in (1, 2) if kind == "objects" else ():
        command.succeeds("data", "show", *sets[kind], f"scenes={scenes}", f"out={scenes}")
        heights.append(imageio.imread(tmp_path / f"{scenes}/show.png").shape[0])
    assert heights == sorted(set(heights))
    assert "scenes=9: must lie between 1 and 8" in refused("data", "data_task=show", *sets[kind], "scenes=9")


@pytest.mark.processes
@pytest.mark.parametrize("option", ["disabled", "none", "stdout"])
def test_hydras_other_ways_of_logging_work(sets, option, tmp_path):
    """In processes, because Hydra disables all loggers of this one."""
    started = [sys.executable, "-m", "completesplat", "data", "stats", *sets["objects"], f"out={tmp_path / 'out'}"]
    done = subprocess.run([*started, f"hydra/job_logging={option}"], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, str(tmp_path / "out")), done.stderr


def test_prepared_data_pass_the_check_until_a_bit_flips_and_are_not_prepared_again(command, sets, tmp_path):
    store = tmp_path / "store"
    settings = [*sets["rooms"][:2], f"data.root={store}"]

    def checked():
        command.succeeds("data", "check", *settings, "workers=1", "out=check")
        return strict_json(tmp_path / "check/check.json")

    made = []
    for _ in range(2):
        command.succeeds("data", "prepare", *sets["rooms"], "workers=1", f"out={store}")
        made.append({path: path.stat().st_mtime_ns for path in store.glob("*.arrow")})
    assert made[0] == made[1]
    assert "prepared already" in refused("data", "data_task=prepare", *settings)
    own_place = f"out={sets['rooms'][2].removeprefix('data.root=')}"
    assert "the data to be prepared lie there" in command.refuses("data", "prepare", *sets["rooms"], own_place)
    assert checked()["refused"] == []
    shard = next(store.glob("train-*.arrow"))
    flip_bit(shard)
    results = checked()
    assert any(entry["file"] == str(shard) for entry in results["refused"])
    assert "changed file" in results["counts"]


def test_a_capture_can_be_shown_where_it_is_and_prepared_and_its_splits_share_sequences_on_purpose(command, tmp_path):
    write_capture(tmp_path / "capture", frames=8)
    settings, store = ["data=capture", "data.image_size=12"], tmp_path / "store"
    given = [*settings, f"data.root={tmp_path / 'capture'}"]
    assert command("data", "prepare", *given, "workers=1", f"out={store}").status == 0
    for root in (tmp_path / "capture", store):
        out = tmp_path / f"shown/{root.name}"
        assert command("data", "show", *settings, f"data.root={root}", f"out={out}").status == 0
        assert (out / "show.png").is_file()
        checked = command("data", "check", *settings, f"data.root={root}", "workers=1", f"out={out}")
        assert "are in both" not in checked.out
        results = strict_json(out / "check.json")
        assert (results["shared"], results["usable"]["sequences"]) == ({}, 1)


@pytest.mark.parametrize("data", ["toy_objects", "toy_rooms"])
def test_toy_data_are_not_made_where_a_path_may_be_mistyped(tmp_path, monkeypatch, data):
    monkeypatch.chdir(tmp_path)
    line = refused("data", "data_task=stats", f"data={data}", "data.root=typo", "out=stats")
    assert line == "typo: no toy data: data.make=true makes them there, and so does completesplat data toy"
    assert not (tmp_path / "typo").exists()
    config = OmegaConf.load(conf_folder() / f"data/{data}.yaml")
    assert Path(config.root).is_relative_to(OWN_PLACE)  # where they are made without being asked for


def test_a_run_is_encoded_as_asked_and_trained_from(command, pipeline, packed_toys, tmp_path):
    cache, checkpoint = tmp_path / "cache", pipeline.var / "checkpoints/last.ckpt"
    given = [f"ckpt={checkpoint}", f"overrides=['data.root={packed_toys}']", f"out={cache}"]
    made = command("data", "latents", *given, "frames=2", "precision=float16", "batch_size=1")
    assert (made.status, made.out.splitlines()[-1]) == (0, str(cache))
    assert "for 4 frames of 2 sequences" in made.out + made.err
    store = LatentCache(cache)
    assert [sequence.stored for sequence in store.sequences.values()] == [(1, 3)] * 2
    arrays = store.arrays(next(iter(store.sequences)))
    assert (arrays["mean"].dtype, arrays["condition"].dtype) == ("float16", "uint8")

    stage2 = [f"data.root={pipeline.toy}", *SMALL, "experiment=toy_diffusion", "sampler.steps=2", "test=false"]
    stage2 += [f"model.autoreconstructor_checkpoint={checkpoint}", f"data.latent_cache={cache}"]
    assert command("fit", *stage2, f"out={tmp_path / 'run'}").status == 0
    assert strict_json(tmp_path / "run/metrics.json")["steps"] == 2


@pytest.mark.slow
def test_two_processes_write_what_one_writes(pipeline, packed_toys, tmp_path):
    """Three batches: the last one has half of a batch, and no counterpart."""
    given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']", "batch_size=3"]
    torchrun = ["-m", "torch.distributed.run", "--nproc_per_node=2", "--standalone"]
    for out, launcher in (("one", []), ("two", torchrun)):
        program = [sys.executable, *launcher, "-m", "completesplat", "data", "latents", *given, f"out={tmp_path / out}"]
        subprocess.run(program, check=True, timeout=LIMIT, env=os.environ | {"OMP_NUM_THREADS": "1"})
    one, two = (LatentCache(tmp_path / name) for name in ("one", "two"))
    assert (one.origin, one.mean, one.std, one.sequences) == (two.origin, two.mean, two.std, two.sequences)
    files = [(tmp_path / folder / "latents.arrow").read_bytes() for folder in ("one", "two")]
    assert files[0] == files[1]
    assert sum(len(sequence.stored) for sequence in one.sequences.values()) == 8


@pytest.mark.parametrize(
    ("stage", "setting", "message"),
    [
        ("diffusion", "frames=2", "not of stage 1"),
        ("var", "conditioning=learned", "needs images"),
        ("var", "precision=float8", "precision=float8: choose one of float32, float16"),
        ("var", "overrides=[]", "run `completesplat data prepare` first"),
    ],
)
def test_what_cannot_be_encoded_is_refused(pipeline, packed_toys, stage, setting, message):
    given = ["data_task=latents", f"ckpt={getattr(pipeline, stage)}", f"overrides=['data.root={packed_toys}']", setting]
    assert message in refused("data", *given)
