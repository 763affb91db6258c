"""The published tables, as `figures.yaml` holds them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

FILE = Path(__file__).with_name("figures.yaml")
MARKS = ("best", "second", "dagger", "star")
METRICS = ("psnr", "lpips", "fid", "kid")


@dataclass(frozen=True)
class Figure:
    """A cell as printed, with its marks, which are among `MARKS`."""

    text: str
    marks: frozenset[str]


@dataclass(frozen=True)
class Column:
    """A column: all levels of its heading joined, and what stands in it."""

    heading: str
    key: str
    """`method`, `speed`, `inference`, `rendering`, `scenes`, `resolution`, or one of `METRICS`."""
    data_set: str
    """As a run's protocol names it; empty where the table holds several and the column belongs to none."""


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper, and the protocol of its figures."""

    name: str
    place: str
    label: str
    title: str
    region: str
    view: str
    evaluations: list[str]
    """The protocols (`conf/evaluation/`) by which a run of ours is measured as these figures are."""
    resolution: str
    """Of all rows; empty where each row states its own."""
    subset: str
    """The list of sequences that the figures are taken to be of; empty where there is one list only."""
    oracle_samples: int | None
    """Of the row "k-best oracle"; None where there is no such row."""
    legend: Mapping[str, str]
    """What the marks dagger and star mean here."""
    says: list[str]
    columns: list[Column]
    rows: list[list[Figure]]
    complete: Mapping[str, str]
    """How many scenes a complete run has, by the number that the paper prints, where they differ."""
    remarks: list[str]
    """What must be known to compare with it."""
    options: Mapping[str, str]
    """Names of our configurations, and the methods that they stand for."""

    def data_sets(self) -> list[str]:
        """Those whose figures the table holds."""
        return list(dict.fromkeys(column.data_set for column in self.columns if column.key in METRICS))


def published() -> list[PublishedTable]:
    """All tables, in the paper's order."""
    return [_table(entry) for entry in _content()["tables"]]


def source() -> str:
    """Authors, title and place of the paper."""
    return _content()["source"]


def parse(cell: str) -> Figure:
    """`17.93 best` is the text `17.93` with the mark `best`."""
    words = cell.split()
    marks = set()
    while words and words[-1] in MARKS:
        marks.add(words.pop())
    return Figure(" ".join(words), frozenset(marks))


@cache
def _content() -> dict[str, Any]:
    content = OmegaConf.to_container(OmegaConf.load(FILE))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def _table(entry: dict[str, Any]) -> PublishedTable:
    given = {key: entry[key] for key in ("name", "place", "label", "title", "region", "view", "evaluations", "says")}
    columns = [Column(c["heading"], c["key"], c.get("data_set", entry.get("data_set", ""))) for c in entry["columns"]]
    rows = [[parse(cell) for cell in line.split("|")] for line in entry["rows"].splitlines()]
    return PublishedTable(
        **given,
        resolution=entry.get("resolution", ""),
        subset=entry.get("subset", ""),
        oracle_samples=entry.get("oracle_samples"),
        legend={mark: entry[mark] for mark in ("dagger", "star") if mark in entry},
        columns=columns,
        rows=rows,
        complete=entry.get("complete", {}),
        remarks=entry.get("remarks", []),
        options=entry.get("options", {}),
    )
