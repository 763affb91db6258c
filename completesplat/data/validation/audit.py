"""Check of a whole data set: numbers of usable sequences and frames, and reasons for those that are not usable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from completesplat.data.sequences import SequenceSource
from completesplat.data.splits import overlaps, shared_names
from completesplat.data.validation.processes import map_in_processes
from completesplat.errors import DataError, TooFewFrames, refused_to
from completesplat.wording import printable

FEWEST_FRAMES = 2
LARGEST_BATCH = 16
EXAMPLES = 3

Sources = Mapping[str, SequenceSource]
# Names of sequences, each with the splits that contain it.
_Batch = list[tuple[str, list[str]]]


class ExcludedSequence(DataError, kind="left out"):
    """Intact sequence that the settings leave out."""


@dataclass(frozen=True)
class AuditReport:
    """Result of a check, with the numbers of usable sequences (with at least two usable frames) and of their frames.

    Attributes:
        refused: errors without duplicates, in the order of the data set.
        splits: the same two numbers for each split.
        shared: the sequences that two splits share, see `shared_names`.
    """

    sequences: int
    frames: int
    refused: list[DataError]
    splits: dict[str, dict[str, int]]
    shared: dict[str, list[str]]

    def by_kind(self) -> dict[str, list[DataError]]:
        """Group errors by kind, and sequences left out by reason. The most frequent group comes first."""
        kinds: dict[str, list[DataError]] = {}
        for error in self.refused:
            kind = f"{error.kind}: {error.reason}" if isinstance(error, ExcludedSequence) else error.kind
            kinds.setdefault(kind, []).append(error)
        return dict(sorted(kinds.items(), key=lambda item: -len(item[1])))

    def json(self) -> dict[str, object]:
        """Return the content of `check.json`."""
        parts = ("sequence", "frame", "file", "reason")
        return {
            "usable": {"sequences": self.sequences, "frames": self.frames},
            "refused": [{part: getattr(error, part) for part in parts} for error in self.refused],
            "counts": {kind: len(errors) for kind, errors in self.by_kind().items()},
            "splits": self.splits,
            "shared": self.shared,
        }


def check(
    sources: Sources, workers: int | None = None, progress: bool = True, splits_share_sequences: bool = False
) -> AuditReport:
    """Read every sequence and every image once, even if several splits share them.

    A sequence without errors that is not usable is refused for too few frames. Shared sequences are reported unless the
    splits share them on purpose (`SceneDataSet.splits_share_sequences`).

    Args:
        sources: sequences by split, which several processes must be able to pickle.
        workers: processes; None: one for each core.
    """
    refused = [error for source in sources.values() for error in _source_errors(source)]
    sequences = list[_Sequence]()
    batches = _batches(sources)
    with Progress(disable=not progress) as bar:
        task = bar.add_task("reading sequences", total=sum(map(len, batches)))
        for batch in map_in_processes(partial(_read_batch, sources), batches, workers):
            sequences += batch
            bar.advance(task, len(batch))
    return _report(sources, sequences, refused, splits_share_sequences)


def _report(
    sources: Sources, sequences: Sequence["_Sequence"], refused: list[DataError], splits_share_sequences: bool
) -> AuditReport:
    """Return the findings about sequences, which were read, and about sources, which refused some before."""
    errors = refused + [error for sequence in sequences for error in sequence.refused]
    explained = {error.sequence for error in errors}
    for sequence in sequences:
        if len(sequence.usable) < FEWEST_FRAMES and sequence.name not in explained:
            reason = f"{len(sequence.usable)} usable, {FEWEST_FRAMES} are needed"
            errors.append(TooFewFrames(reason, sequence=sequence.name))
    unique = {(error.kind, error.reason, error.file, error.sequence, error.frame): error for error in errors}
    splits = {}
    for split in sources:
        splits[split] = _numbers([sequence.usable & sequence.frames.get(split, set()) for sequence in sequences])
    numbers = _numbers([sequence.usable for sequence in sequences])
    shared = {} if splits_share_sequences else shared_names({split: x.names for split, x in sources.items()})
    return AuditReport(numbers["sequences"], numbers["frames"], list(unique.values()), splits, shared)


def _source_errors(source: SequenceSource) -> list[DataError]:
    """Return what a source refuses or leaves out before its sequences are read."""
    errors = list(source.refused)
    for reason, names in source.left_out.items():
        errors.extend(ExcludedSequence(reason, sequence=name) for name in names)
    errors.extend(source.verify())
    return errors


def show_findings(findings: AuditReport) -> None:
    """Print errors by kind, with the first few of each, and the numbers of usable sequences and frames."""
    console = Console(width=None if Console().is_terminal else 120)
    if findings.refused:
        table = Table(title="not usable", show_lines=True)
        table.add_column("what", overflow="fold", max_width=30)
        table.add_column("count", justify="right", no_wrap=True)
        table.add_column(f"the first {EXAMPLES}", overflow="fold")
        for kind, errors in findings.by_kind().items():
            examples = "\n".join(printable(str(error)) for error in errors[:EXAMPLES])
            table.add_row(Text(printable(kind)), str(len(errors)), Text(examples))
        console.print(table)
    for overlap in overlaps(findings.shared):
        console.print(Text(printable(overlap)), soft_wrap=True)
    splits = ", ".join(f"{split} {x['sequences']} and {x['frames']}" for split, x in findings.splits.items())
    usable = f"usable sequences: {findings.sequences}, their usable frames: {findings.frames} ({splits})"
    console.print(Text(usable), soft_wrap=True)


@dataclass
class _Sequence:
    """Result of reading one sequence: its frames in each split, usable frames of all splits, and errors."""

    name: str
    frames: dict[str, set[int]] = field(default_factory=dict)
    usable: set[int] = field(default_factory=set)
    refused: list[DataError] = field(default_factory=list)


def _batches(sources: Sources) -> list[_Batch]:
    """Divide all names, each once, into batches that are best read by one process."""
    splits: dict[str, list[str]] = {}
    for split, source in sources.items():
        for name in dict.fromkeys(source.names):
            splits.setdefault(name, []).append(split)
    batches = []
    for split, source in sources.items():
        names = [name for name in dict.fromkeys(source.names) if splits[name][0] == split]
        for group in source.groups(names):
            ordered = [(names[index], splits[names[index]]) for index in group]
            batches += [ordered[start : start + LARGEST_BATCH] for start in range(0, len(ordered), LARGEST_BATCH)]
    return batches


def _read_batch(sources: Sources, batch: _Batch) -> list[_Sequence]:
    return [_read(sources, name, splits) for name, splits in batch]


def _read(sources: Sources, name: str, splits: list[str]) -> _Sequence:
    sequence = _Sequence(name)
    done = set[int]()
    for split in splits:
        with refused_to(sequence.refused.append, sequence=name):
            posed = sources[split].read(name)
            sequence.frames[split] = set(posed.frames)
            for index, frame in enumerate(posed.frames):
                if frame not in done:
                    done.add(frame)
                    with refused_to(sequence.refused.append, sequence=name, frame=frame):
                        posed.read(index)
                        sequence.usable.add(frame)
    return sequence


def _numbers(usable: list[set[int]]) -> dict[str, int]:
    frames = [len(frames) for frames in usable if len(frames) >= FEWEST_FRAMES]
    return {"sequences": len(frames), "frames": sum(frames)}
