"""What machines are like: no home, SLURM's variables, links of the hub, few open files, little shared memory."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import huggingface_hub
import pytest
import torch
from hydra.utils import instantiate
from packed_sequences import ListedSource, pack
from scenes_for_training import opened, quiet_trainer
from support import LIMIT, compose_config, python, refused, tiny_generator, waited_for, write_program

import completesplat
from completesplat import files
from completesplat.autoreconstructor.model import Reconstruction
from completesplat.commands import refusal
from completesplat.commands.jobs import LogFile
from completesplat.data.loading.loader import workers_refusal
from completesplat.data.packed.source import PackedSource
from completesplat.data.validation import path_below
from completesplat.errors import CompleteSplatError, OutsidePath, WeightsError
from completesplat.evaluation.table_writers import as_markdown
from completesplat.evaluation.tables import Cell, Heading, Table, TableRow
from completesplat.export.splat_transform import convert
from completesplat.weights import check_folder, from_hub

SLURM = {"NTASKS": "2", "JOB_NAME": "train", "JOB_ID": "7", "PROCID": "0", "LOCALID": "0", "NODEID": "0"}


def trainer_refusal(*settings: str, group: str = "trainer") -> str:
    """Return the line with which a part of Lightning is refused."""
    config = compose_config("fit", "experiment=toy_var", *settings)
    with pytest.raises(Exception) as caught:  # noqa: PT011
        instantiate(config[group], _convert_="all")
    return refusal(caught.value) or ""


def test_what_lightning_refuses_while_it_is_set_up_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert trainer_refusal("trainer.accelerator=tpu").startswith("trainer: Requirement 'torch_xla")
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.setattr("lightning.fabric.loggers.tensorboard._TENSORBOARD_AVAILABLE", False)
    monkeypatch.setattr("lightning.fabric.loggers.tensorboard._TENSORBOARDX_AVAILABLE", False)
    board = "+logger.board={_target_: lightning.pytorch.loggers.TensorBoardLogger, save_dir: x}"
    assert trainer_refusal(board, group="logger").startswith("logger.board: Neither `tensorboard`")
    for name, value in SLURM.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    line = trainer_refusal("trainer.accelerator=cpu")
    assert "--ntasks-per-node=2" in line
    assert "\n" not in line


@pytest.mark.parametrize("strategy", ["ddp_notebook", "ddp_fork", "ddp_spawn", "ddp_fork_find_unused_parameters_true"])
def test_strategies_that_lose_the_best_checkpoint_are_refused(strategy: str) -> None:
    line = refused("fit", "experiment=toy_var", "data.root=/nowhere", f"trainer.strategy={strategy}")
    assert line.startswith(f"trainer.strategy={strategy}: ")
    assert line.endswith("take ddp")


def test_a_jobs_name_may_have_folders(tmp_path: Path) -> None:
    LogFile(str(tmp_path / "x/y.log")).close()
    assert (tmp_path / "x/y.log").is_file()


NO_HOME = """
import os, pwd, sys

def unknown(number):
    raise KeyError(f"getpwuid(): uid not found: {number}")

pwd.getpwuid = unknown
os.environ.pop("HOME", None)
os.environ.pop("XDG_CACHE_HOME", None)
import completesplat
from completesplat.autoreconstructor import pretrained
from completesplat.rasterizers.kernels import compilation
from completesplat.weights import locate
print(locate("toy_objects"))
print(*compilation._user_folders())
"""


@pytest.mark.processes
def test_a_user_without_a_home_has_a_cache_among_the_temporary_files(tmp_path: Path) -> None:
    weights, folders = python(NO_HOME, env={**os.environ, "TMPDIR": str(tmp_path)}).splitlines()
    assert weights.endswith("model.safetensors")
    assert set(folders.split()) == {str(tmp_path / f"completesplat-{os.getuid()}")}
    assert (tmp_path / f"completesplat-{os.getuid()}").stat().st_mode & 0o777 == 0o700


def test_a_temporary_folder_that_others_may_write_to_is_not_used(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(files.tempfile, "gettempdir", lambda: str(tmp_path))
    folder = files.private_folder()
    assert folder == tmp_path / f"completesplat-{os.getuid()}"
    folder.chmod(0o777)
    assert files.private_folder() is None
    folder.rmdir()
    folder.symlink_to(tmp_path)
    assert files.private_folder() is None


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (RuntimeError("DataLoader worker (pid 7) is killed by signal: Bus error."), "--shm-size=2g"),
        (RuntimeError("unable to allocate shared memory(shm) for file </torch_1>: Success (0)"), "--shm-size=2g"),
        (OSError(24, "Too many open files"), "`ulimit -n`"),
        (RuntimeError("received 0 items of ancdata"), "`ulimit -n`"),
    ],
)
def test_workers_without_memory_or_files_are_told_of_in_one_line(error: Exception, advice: str, toy_root: Path) -> None:
    data, _ = opened(toy_root)
    data.setup("fit")
    loader = data.train_dataloader()

    class Failing:
        def __iter__(self):
            raise error

    loader._loader = Failing()
    with pytest.raises(CompleteSplatError, match=f"^data.workers: .*{advice}.* data.workers=0$"):
        next(iter(loader))
    assert workers_refusal(RuntimeError("another")) is None


WORKERS = """
import sys
import time

import torch

from completesplat.data.loading.loader import SceneLoader
from completesplat.data.loading.scenes import LoadedScenes
from completesplat.data.tolerance import SKIP_ALL
from completesplat.scene import CachedScene

latent = torch.zeros(4, 8, 8)
scenes = [LoadedScenes(CachedScene(latent, latent, latent, torch.tensor(0), "scene"), ())] * 1000
batches = iter(SceneLoader(scenes, 1, None, 2, SKIP_ALL))
next(batches)
print("ready", flush=True)
time.sleep(float(sys.argv[1]))
"""


@pytest.mark.processes
def test_folders_of_killed_workers_are_removed_by_the_next_run() -> None:
    with tempfile.TemporaryDirectory() as temporary:  # of a short name, because sockets have no long ones
        environment = os.environ | {"TMPDIR": temporary}

        def start(seconds: float) -> subprocess.Popen[str]:
            command = [sys.executable, "-c", WORKERS, str(seconds)]
            settings = {"env": environment, "start_new_session": True, "text": True}
            return subprocess.Popen(command, stdout=subprocess.PIPE, **settings)

        def sockets() -> set[Path]:
            return set(Path(temporary).rglob("pymp-*/listener-*"))

        running = start(10 * LIMIT)
        assert running.stdout.readline() == "ready\n"
        of_running = sockets()
        killed = start(10 * LIMIT)
        assert killed.stdout.readline() == "ready\n"
        assert sockets() > of_running
        os.killpg(killed.pid, signal.SIGKILL)
        killed.wait()
        # Workers end a moment after they are killed, and hold the folder's lock until then.
        removed = waited_for(lambda: start(0).wait() == 0 and sockets() == of_running, LIMIT)
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        assert removed
        assert [path.name for path in Path(temporary).iterdir()] == [f"completesplat-{os.getuid()}"]


def snapshot(root: Path, store: Path) -> Path:
    """Write a folder of files as the hub's client does: links to files in `blobs`."""
    folder = root / "snapshots/abc"
    (root / "blobs").mkdir()
    for path in (path for path in store.rglob("*") if path.is_file()):
        name = hashlib.sha256(path.read_bytes()).hexdigest()
        shutil.copy(path, root / "blobs" / name)
        link = folder / path.relative_to(store)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(root / "blobs" / name, link.parent))
    return folder


def test_snapshots_of_the_hub_are_read_and_other_links_are_not_followed(tmp_path: Path) -> None:
    store = pack(ListedSource(["a", "b"]), tmp_path / "store")
    folder = snapshot(tmp_path, store)
    source = PackedSource(folder, "train")
    assert source.names
    assert source.read(source.names[0]).read(0).image is not None
    (tmp_path / "secret").write_text("secret")
    (folder / "out").symlink_to(tmp_path / "secret")
    with pytest.raises(OutsidePath, match="leads outside of"):
        path_below(folder, "out")
    with pytest.raises(OutsidePath, match="leads outside of"):
        path_below(store, "../blobs")
    for cache in (".dvc/cache/files", ".git/annex/objects"):
        (tmp_path / cache).mkdir(parents=True)
        (tmp_path / cache / "content").write_text("content")
        (store / "link").symlink_to(tmp_path / cache / "content")
        assert path_below(store, "link").read_text() == "content"
        (store / "link").unlink()


@pytest.mark.parametrize(
    ("name", "repository", "revision"),
    [
        ("me/toy", "me/toy", None),
        ("me/toy@v2", "me/toy", "v2"),
        ("hf:me/toy", "me/toy", None),
        ("hf://me/toy@v1.0", "me/toy", "v1.0"),
        ("https://huggingface.co/me/toy", "me/toy", None),
        ("https://huggingface.co/me/toy/tree/main", "me/toy", "main"),
    ],
)
def test_repositories_of_the_hub_have_several_spellings(name, repository, revision, monkeypatch, command) -> None:
    asked = []

    def download(repository, revision=None, **_: object) -> str:
        asked.append((repository, revision))
        raise OSError("offline")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", download)
    with pytest.raises(WeightsError, match="offline"):
        from_hub(name)
    assert asked == [(repository, revision)]
    Path("a.png").touch()
    assert "offline" in command.refuses("predict", "a.png", f"weights={name}", "out=x")


def test_files_of_weights_that_lack_something_say_what(tiny_weights: Path, tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    shutil.copytree(tiny_weights, folder)
    sums = folder / "SHA256SUMS"
    sums.write_text(sums.read_text().replace("  ", " *"))
    check_folder(folder)
    tensors = folder / "model.safetensors"
    for name, reason in (
        ("none", "the copy or download is not complete: fetch the folder again"),
        ("model-00001-of-00002.safetensors", "these tensors are in several parts: save them as one model.safetensors"),
    ):
        tensors.rename(folder / name)
        with pytest.raises(WeightsError, match=reason):
            check_folder(folder)
        (folder / name).rename(tensors)
    (folder / "empty").mkdir()
    with pytest.raises(WeightsError, match="give the folder that training wrote"):
        check_folder(folder / "empty")


def test_own_errors_come_out_of_hydras(tmp_path: Path) -> None:
    given = ["experiment=toy_var_stage2", "data.root=/nowhere", "loss.terms.lpips=null", "test=false"]
    config = completesplat.compose("fit", *given, f"model.checkpoint={tmp_path / 'none.ckpt'}")
    with pytest.raises(WeightsError, match=r"none\.ckpt: no such checkpoint"):
        completesplat.instantiate(config)


@pytest.mark.parametrize("precision", ["bf16-true", "16-true"])
def test_a_trainer_with_weights_of_half_precision_is_refused(precision: str, toy_root: Path) -> None:
    data, module = opened(toy_root)
    with pytest.raises(CompleteSplatError, match=rf"precision='{precision}'\): choose one of 32-true, bf16-mixed"):
        quiet_trainer(precision=precision, max_steps=1).fit(module, data)


def test_a_compiled_module_is_refused_with_the_setting_that_compiles_its_network(toy_root: Path) -> None:
    data, module = opened(toy_root)
    with pytest.raises(CompleteSplatError, match=r"ReconstructionModule\) cannot be trained: .* model\.compile=true"):
        quiet_trainer(max_steps=1).fit(torch.compile(module), data)


@pytest.mark.parametrize(
    ("variables", "settings"),
    [({"WANDB_MODE": "nonsense"}, []), ({}, ["wandb.project=a/b"]), ({}, ["wandb.project=" + "x" * 200])],
)
def test_what_wandb_refuses_is_one_line(variables, settings, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    config = compose_config("fit", "experiment=toy_var", "logger=wandb", *settings, f"out={tmp_path}")
    logger = instantiate(config.logger.wandb, _convert_="all")
    with pytest.raises(CompleteSplatError, match=r"^logger=wandb: [^\n]*check wandb\.project"):
        logger._begin()


def test_a_folders_name_is_no_markup_in_tables() -> None:
    row = TableRow("ours", [Cell("a <script>*b* [x](y) _z_ no_skips")])
    text = as_markdown(Table("t", "t", [Heading("method")], [row], ["run `x|y`"]))
    assert r"a \<script>\*b\* [x]\(y) \_z\_ no_skips" in text
    assert r"- run \`x\|y\`" in text


@pytest.mark.processes
def test_a_converter_ends_with_the_command_that_started_it(tmp_path: Path) -> None:
    script = f'[ "$1" = --version ] && exit 0\nsleep 600 & echo $! > {tmp_path}/pid\nwait'
    program = write_program(tmp_path / "splat-transform", script)
    code = "import sys; from pathlib import Path; from completesplat.export.splat_transform import convert\n"
    code += "convert(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))"
    command = [sys.executable, "-c", code, str(program), str(tmp_path / "a.ply"), str(tmp_path / "a.sog")]
    process = subprocess.Popen(command)
    assert waited_for(lambda: (tmp_path / "pid").is_file() and (tmp_path / "pid").read_text().strip())
    child = int((tmp_path / "pid").read_text())
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert waited_for(lambda: not Path(f"/proc/{child}").exists() or "Z" in Path(f"/proc/{child}/stat").read_text())


def test_what_npm_says_is_short(tmp_path: Path) -> None:
    lines = [
        "npm error code E404",
        "npm error 404 Not Found - GET https://x/y",
        "npm error 404",
        "npm error 404  is not",
    ]
    lines += [f"npm error line {number}" for number in range(6)] + ["npm error A complete log of this run is in: /x"]
    (tmp_path / "said").write_text("\n".join(lines))
    program = write_program(tmp_path / "splat-transform", f"cat {tmp_path}/said >&2\nexit 1")
    with pytest.raises(CompleteSplatError, match="status 1: 404 Not Found") as caught:
        convert(str(program), tmp_path / "a.ply", tmp_path / "a.sog")
    assert len(str(caught.value)) < 200
    assert "A complete log" not in str(caught.value)


def test_npx_keeps_its_files_elsewhere_where_the_home_cannot_be_written(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("npm_config_cache", raising=False)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    program = write_program(tmp_path / "splat-transform", 'echo "$npm_config_cache" >&2\nexit 1')
    with pytest.raises(CompleteSplatError, match=f"status 1: {files.private_folder()}/npm$"):
        convert(str(program), tmp_path / "a.ply", tmp_path / "a.sog")


def test_torch_exports_a_model_with_what_it_returns() -> None:
    model = tiny_generator().autoreconstructor
    images = torch.rand(2, 3, 32, 32)
    exported = torch.export.export(model, (images,)).module()(images)
    assert isinstance(exported, Reconstruction)
    assert torch.equal(exported.splatter_image.raw, model(images).splatter_image.raw)
    assert exported.splatter_image.parameterization == model.parameterization
