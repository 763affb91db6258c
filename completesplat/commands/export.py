"""`completesplat export`: a model as ONNX graphs, and a model that is sent to the Hugging Face hub."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.generator import CompleteSplat
from completesplat.weights.hub import check_destination

OF_CARD = ("license", "datasets", "pictures", "scores")
"""Settings for the model's card."""


def run(config: DictConfig, out: Path) -> None:
    """Write the graphs and `pipeline.json` of `config.weights` into `out`, and print the graphs' sizes.

    With `config.push`, send the model to that repository, and print its address.

    Raises:
        WeightsError, CompleteSplatError: those of `from_pretrained`, `to_onnx` and `push_to_hub`.
    """
    if config.push is None and not config.graphs:
        raise CompleteSplatError("graphs=false: writes nothing; give push=OWNER/NAME to send the weights")
    if config.push is not None:
        check_destination(config.push)
    model = CompleteSplat.from_pretrained(config.weights, config.trust)
    if config.graphs:
        model.to_onnx(out, config.precision)
        for file in sorted(out.glob("*.onnx")):
            print(f"{file.name}: {file.stat().st_size / 1e6:.1f} MB")
    if config.push is not None:
        card: Any = OmegaConf.to_container(OmegaConf.masked_copy(config, list(OF_CARD)))
        graphs = out if config.graphs else None
        print(model.push_to_hub(config.push, config.private, config.confirm, graphs, **card))
