"""FSDP2: trained networks, their gradients, averages and the optimizer's state, divided over processes."""

import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import torch
from lightning import LightningModule
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor, nn
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageWriter
from torch.distributed.checkpoint.state_dict_saver import save
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard
from torch.distributed.tensor import DTensor, distribute_tensor

from completesplat.errors import CompleteSplatError, DiskError
from completesplat.files import writing
from completesplat.training.stage import Stage
from completesplat.weights import sha256_of
from completesplat.weights.checkpoint_reading import DIVIDED, SHARDS, SHARDS_SUFFIX, shards_of


class FullyShardedStrategy(DDPStrategy):
    """DDP strategy that also divides the trained networks: each process keeps a share and trains on a share of a batch.

    Networks are whole while they compute. Each of `Stage.networks` is one unit of torch's `fully_shard`, and so
    is its average. Outside of training everything is as with DDP, because processes that test have different numbers
    of scenes, and cannot wait for each other in every layer.

    A checkpoint has two parts: `last.ckpt` holds what all processes have, and the names and checksums of the files
    beside it, one for each process, in which `torch.distributed.checkpoint` writes the divided tensors as safetensors.
    `read_checkpoint` joins them, so that any number of processes can read what any other number wrote.
    """

    def configure_ddp(self) -> None:
        """Divide the networks instead of wrapping the module."""
        module = cast(Stage, self.lightning_module)
        _refuse_undivided(module)
        mesh = init_device_mesh(self.root_device.type, (self.world_size,))
        self.whole: list[tuple[nn.Module, str, nn.Module]] = []
        for root in (module, *_averages(module)):
            for name in module.networks:
                network = root.get_submodule(name)
                self.whole.append((root, name, _without_weights(network)))
                # Networks are always divided outside of their passes, also after those of validation.
                fully_shard(network, mesh=mesh, reshard_after_forward=True)

    def load_optimizer_state_dict(self, checkpoint: Mapping[str, Any]) -> None:
        """Load this process's share of a whole state."""
        for optimizer, state in zip(self.optimizers, checkpoint["optimizer_states"], strict=True):
            trained = [parameter for group in optimizer.param_groups for parameter in group["params"]]
            for index, entries in state["state"].items():
                entries |= {name: _divided_as(trained[index], value) for name, value in entries.items()}
        super().load_optimizer_state_dict(checkpoint)

    def save_checkpoint(self, checkpoint: dict[str, Any], filepath: str | Path, storage_options: object = None) -> None:
        """Write each process's share, then the rest in the first one; raise DiskError if the disk refuses."""
        path, divided = Path(filepath), dict[str, Tensor]()
        contents = _without_divided(checkpoint, "", divided)
        folder = path.parent / self.broadcast(f"{secrets.token_hex(6)}{SHARDS_SUFFIX}")
        if self.is_global_zero:
            remove_unused_shards(path.parent)
            with writing(folder):
                folder.mkdir()
        self.barrier()
        with writing(path, sum(value.nbytes for value in divided.values())):
            self._save_shards(divided, folder)
        self.barrier()
        if self.is_global_zero:
            files = {file.name: sha256_of(file) for file in sorted(folder.iterdir())}
            contents[SHARDS] = {"folder": folder.name, "files": files}
        try:
            super().save_checkpoint(contents, filepath, storage_options)
        except DiskError:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _save_shards(self, divided: dict[str, Tensor], folder: Path) -> None:
        """Write this process's share of the tensors. If one process fails, all end; the first raises the error."""
        try:
            save(divided, storage_writer=HuggingFaceStorageWriter(str(folder), save_distributed=True))
        except CheckpointException as error:  # is not a subclass of `Exception`
            shutil.rmtree(folder, ignore_errors=True)
            self.barrier()
            if not self.is_global_zero:
                raise SystemExit(DiskError.exit_status) from error  # the message should appear once
            raise next(iter(error.failures.values()))[0] from error

    def on_exception(self, exception: BaseException) -> None:
        """Leave the networks divided, because other processes may be gone."""
        self.whole = []
        super().on_exception(exception)

    def teardown(self) -> None:
        """Give every process the whole networks, which are saved and tested next."""
        for root, name, network in getattr(self, "whole", []):
            divided = root.get_submodule(name)
            weights = {key: whole(value) for key, value in divided.state_dict().items()}
            network.load_state_dict(weights, assign=True)
            root.set_submodule(name, network.train(divided.training))
        self.whole = []
        super().teardown()


def whole(value: Tensor) -> Tensor:
    """Return the whole of a tensor; if it is divided over processes, all of them must call this."""
    return value.full_tensor() if isinstance(value, DTensor) else value


def local_part(value: object) -> Any:
    """Return this process's part of a tensor that may be divided over processes, without a copy."""
    return value.to_local() if isinstance(value, DTensor) else value


@contextmanager
def whole_networks(module: nn.Module) -> Iterator[None]:
    """Make divided networks whole inside, so that a process can compute alone; all have to enter and leave."""
    networks = [part for part in module.modules() if isinstance(part, FSDPModule)]
    for network in networks:
        network.set_reshard_after_forward(False)
        network.unshard()
    try:
        yield
    finally:
        for network in networks:
            network.reshard()
            network.set_reshard_after_forward(True)


def remove_unused_shards(folder: Path) -> None:
    """Remove all shards that no readable checkpoint of the folder names."""
    used = {shards_of(path).get("folder") for path in folder.glob("*.ckpt")}
    for shards in folder.glob(f"*{SHARDS_SUFFIX}"):
        if shards.name not in used:
            shutil.rmtree(shards)


def _averages(module: LightningModule) -> list[nn.Module]:
    callbacks: list[object] = module.trainer.callbacks  # type: ignore[attr-defined]
    averages = [callback._average_model for callback in callbacks if isinstance(callback, WeightAveraging)]
    return [average.module for average in averages if average is not None]


def _refuse_undivided(module: Stage) -> None:
    """Raise CompleteSplatError if a trained parameter is in none of the networks, or is not contiguous."""
    inside = {parameter for network in module.networks for parameter in module.get_submodule(network).parameters()}
    for name, parameter in module.named_parameters():
        if parameter.requires_grad and parameter not in inside:
            raise CompleteSplatError(f"trainer=fsdp: {name} of {type(module).__name__} is not divided: use trainer=ddp")
        if parameter in inside and not parameter.is_contiguous():
            raise CompleteSplatError("trainer=fsdp: set model.channels_last=false, or use trainer=ddp")


def _without_weights(network: nn.Module) -> nn.Module:
    """Copy a network with parameters that take no memory."""
    empty = {
        id(parameter): nn.Parameter(torch.empty_like(parameter, device="meta"), parameter.requires_grad)
        for parameter in network.parameters()
    }
    return deepcopy(network, empty)


def _divided_as(parameter: Tensor, value: object) -> object:
    """Divide a value of a parameter's optimizer state like the parameter, if it has its shape."""
    if not isinstance(parameter, DTensor) or not isinstance(value, Tensor) or value.shape != parameter.shape:
        return value
    mesh, placements = parameter.device_mesh, parameter.placements
    return distribute_tensor(value.to(parameter.device), mesh, placements, src_data_rank=None)


def _without_divided(contents: Any, name: str, divided: dict[str, Tensor]) -> Any:
    """Replace divided tensors in nested containers by names, and store them in `divided` by these names."""
    if isinstance(contents, DTensor):
        divided[name] = contents
        return DIVIDED + name
    if isinstance(contents, Mapping):
        return {key: _without_divided(value, f"{name}.{key}".lstrip("."), divided) for key, value in contents.items()}
    if isinstance(contents, list | tuple):
        return type(contents)(_without_divided(value, f"{name}.{i}", divided) for i, value in enumerate(contents))
    return contents
