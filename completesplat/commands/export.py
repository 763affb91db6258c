"""`completesplat export`: a model as ONNX graphs."""

from pathlib import Path

from omegaconf import DictConfig

from completesplat.generator import CompleteSplat
from completesplat.onnx_graphs import PIPELINE_FILE


def run(config: DictConfig, out: Path) -> None:
    """Write the graphs and `pipeline.json` of `config.weights` into `out`, and print their sizes.

    Raises:
        WeightsError, CompleteSplatError: those of `from_pretrained` and `to_onnx`.
    """
    model = CompleteSplat.from_pretrained(config.weights, config.trust)
    model.to_onnx(out, config.precision)
    for file in sorted(out.glob("*.onnx")):
        print(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
    print(out / PIPELINE_FILE)
