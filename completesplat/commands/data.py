"""`completesplat data`: check data sets, show their statistics and images, prepare them, and encode them."""

import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from completesplat.errors import CompleteSplatError, DataError, WeightsError
from completesplat.files import write_json
from completesplat.quantities import Entries, Positive, Range
from completesplat.weights import RUN_CHECKPOINT

if TYPE_CHECKING:
    from completesplat.data.loading.data_module import SceneDataModule
    from completesplat.data.sequences import PosedSequence, SequenceSource
    from completesplat.data.tolerance import ErrorTolerance
else:  # Settings are checked against annotations before torch is imported, which these modules need.
    SceneDataModule = PosedSequence = SequenceSource = ErrorTolerance = object

logger = logging.getLogger(__name__)

SplitName = Literal["train", "val", "test"]
SplitNames = Annotated[Sequence[SplitName], Entries(1)]


def check(data: SceneDataModule, splits: SplitNames, workers: Positive | None, out: Path) -> None:
    """Read everything once and write `check.json`.

    The exit status is 1 when no sequence is usable.
    """
    from completesplat.data.validation import audit

    try:
        sources = {split: data.select_sequences(split, source) for split, source in _open_sources(data, splits).items()}
        findings = audit.check(sources, workers, splits_share_sequences=data.splits_share_sequences)
    except DataError as error:  # concerns the data set as a whole
        findings = audit.AuditReport(0, 0, [error], {}, {})
    write_json(out / "check.json", findings.json())
    audit.show_findings(findings)
    if not findings.sequences:
        print(out)
        sys.exit(1)


def stats(data: SceneDataModule, splits: SplitNames, out: Path) -> None:
    """Write `stats.json` and `stats.png`, and print the numbers."""
    from rich.progress import track

    from completesplat.evaluation.studies.statistics import plot_statistics, show_statistics, statistics

    sources = _open_sources(data, splits)
    tracked_names = {split: track(source.names, f"reading cameras of {split}") for split, source in sources.items()}
    results = statistics({split: _readable(sources[split], names) for split, names in tracked_names.items()})
    write_json(out / "stats.json", results)
    plot_statistics(results, out / "stats.png", str(data.root))
    show_statistics(results)


def show(
    data: SceneDataModule, split: SplitName, scenes: Annotated[int, Range(1, 8)], images: Positive, out: Path
) -> None:
    """Write `show.png`: images of some sequences, evenly spread over a split."""
    from completesplat.evaluation.studies.contact_sheet import write_contact_sheet

    source = _open_sources(data, [split])[split]
    names = source.names
    chosen = [names[i * len(names) // scenes] for i in range(scenes)] if len(names) > scenes else names
    sequences = list(_readable(source, chosen))
    if not sequences:
        raise DataError(f"no {split} sequences that can be used", str(data.root))
    title = f"{data.root}, {split}: {len(sequences)} of {len(names)} sequences"
    write_contact_sheet(sequences, out / "show.png", images, title)


def prepare(
    data: SceneDataModule,
    splits: SplitNames,
    out: Path,
    codec: str,
    sequences_per_shard: Positive,
    workers: Positive | None,
    on_bad: Literal["raise", "skip"],
    max_bad_fraction: float,
) -> None:
    """Write packed data into `out`.

    See `completesplat.data.packed.preparation.prepare`.
    """
    from completesplat.data.packed import manifest, preparation
    from completesplat.data.tolerance import ErrorTolerance

    if manifest.is_packed(data.root):
        raise CompleteSplatError(f"{data.root} is prepared already")
    if Path(data.root).resolve().is_relative_to(out.resolve()):
        raise CompleteSplatError(f"out={out}: the data to be prepared lie there; choose another out=DIR")
    tolerance = ErrorTolerance(on_bad, max_bad_fraction)
    sources = _open_sources(data, splits, tolerance)
    settings = data.packed_settings()
    preparation.prepare(sources, settings, out, codec, sequences_per_shard, workers, tolerance)


def latents(
    ckpt: str | Path,
    overrides: Sequence[str],
    trust: bool,
    out: Path,
    frames: Positive | None,
    views: Positive,
    precision: Literal["float32", "float16"],
    batch_size: Positive,
    devices: Positive,
    num_nodes: Positive,
    conditioning: Any = None,
) -> None:
    """Encode the training set of a stage-1 run into `out`.

    See `completesplat.training.encoding`.
    """
    from hydra.utils import instantiate
    from lightning import Fabric

    from completesplat.autoreconstructor.model import VariationalAutoReconstructor
    from completesplat.training.encoding import FrameEncoder, encode_training_set
    from completesplat.training.stopping import stopped_together
    from completesplat.weights.checkpoint_reading import load_part
    from completesplat.weights.runs import config_of_run

    ckpt = Path(ckpt, RUN_CHECKPOINT) if Path(ckpt).is_dir() else Path(ckpt)
    run_config = config_of_run(ckpt, list(overrides), trust)
    autoreconstructor = instantiate(run_config.model.get("model"), _convert_="all")
    if not isinstance(autoreconstructor, VariationalAutoReconstructor):
        raise WeightsError(f"{ckpt}: not of stage 1, which trains an autoreconstructor (model=var)")
    load_part(autoreconstructor, ckpt, prefix="model.")
    data = instantiate(run_config.data, _convert_="all")
    data.prepare_data()
    fabric = Fabric(devices=devices, num_nodes=num_nodes)
    with stopped_together():
        fabric.launch()
        encoder = FrameEncoder(autoreconstructor, conditioning, precision, fabric.device)
        store = encode_training_set(encoder, data, out, frames, views, batch_size)
    logger.info("standard deviation of the latents' channels: %s", " ".join(f"{value:.4g}" for value in store.std))


def _open_sources(
    data: SceneDataModule, splits: Sequence[str], tolerance: ErrorTolerance | None = None
) -> dict[str, SequenceSource]:
    """Prepare the data, give them the tolerance of errors in files, and return the sources of the splits that exist.

    By default all errors are tolerated, and each source collects those in its files.
    """
    from completesplat.data.tolerance import SKIP_ALL

    data.tolerance = tolerance or SKIP_ALL
    data.prepare_data()
    sources = {}
    missing = []
    for split in splits:
        try:
            sources[split] = data.source(split)
        except DataError as error:
            missing.append(error)
    if not sources:
        raise missing[0]
    for left_out in missing:
        logger.warning("left out: %s", left_out)
    return sources


def _readable(source: SequenceSource, names: Iterable[str]) -> Iterator[PosedSequence]:
    """Yield the sequences that can be read, and name the others."""
    for name in names:
        try:
            yield source.read(name)
        except DataError as error:
            logger.warning("left out: %s", error)
