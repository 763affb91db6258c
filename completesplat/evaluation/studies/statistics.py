"""Statistics of a data set: number of sequences, fields of view, and motion of the cameras."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.data.sequences import PosedSequence
from completesplat.evaluation.studies.figures import written_figure
from completesplat.evaluation.table_writers import show
from completesplat.evaluation.tables import Heading, records_table

# Key in the results, label, format.
MEASURES = [
    ("frames_per_sequence", "frames of a sequence", ",.0f"),
    ("fov_degrees", "horizontal field of view, degrees", ".1f"),
    ("near", "near, scene units", ".3g"),
    ("far", "far, scene units", ".3g"),
    ("distance_from_first", "distance from the first camera, scene units", ".3g"),
    ("path_extent", "largest distance of two cameras, scene units", ".3g"),
    ("largest_angle_degrees", "largest angle between two views, degrees", ".1f"),
]
PARTS = ("min", "median", "max")
BINS = 30
SMALLEST_SPAN = 1e-6  # of a histogram, relative to its values: closer ones differ by rounding, and bins would be empty
CHUNK = 256

# A sequence's smallest, median and largest value of each measure.
Row = dict[str, tuple[float, float, float]]


def statistics(sequences: Mapping[str, Iterable[PosedSequence]]) -> dict[str, Any]:
    """Return figures of each split, as numbers and None that JSON can hold.

    Sequences (of at least one frame) are read one by one and only a few numbers of each are kept. No image is read.

    Returns:
        `splits`: split -> `sequences` and `frames` (counts) and, for each of `MEASURES`, `min`, `max` of all frames and
        `median` of the sequences' medians; None in a split without sequences. `histograms`: measure -> `edges` and, by
        split, `counts` of the sequences' medians (of the maxima for the distance from the first camera).
    """
    rows = {split: [_measure(sequence) for sequence in members] for split, members in sequences.items()}
    return {
        "splits": {split: _of_split(members) for split, members in rows.items()},
        "histograms": {key: _histogram(key, rows) for key, _, _ in MEASURES},
    }


def _of_split(rows: list[Row]) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "sequences": len(rows),
        "frames": sum(int(row["frames_per_sequence"][0]) for row in rows),
    }
    for key, _, _ in MEASURES:
        figures[key] = _merged([row[key] for row in rows])
    return figures


def show_statistics(results: dict[str, Any]) -> None:
    """Print the splits side by side."""
    splits = results["splits"]
    counts = []
    columns = {"": Heading("", figures=False)}
    for split, summary in splits.items():
        counts.append({"split": split, "sequences": summary["sequences"], "frames": summary["frames"]})
        for part in PARTS:
            columns[f"{split} {part}"] = Heading(part, split)
    ranges: list[dict[str, object]] = []
    for key, label, form in MEASURES:
        row: dict[str, object] = {"": label}
        for split, summary in splits.items():
            for part in PARTS:
                value = summary[key][part]
                row[f"{split} {part}"] = "-" if value is None else format(value, form)
        ranges.append(row)
    show(records_table("Sequences and frames", counts), records_table("Smallest, median and largest", ranges, columns))


def _measure(sequence: PosedSequence) -> Row:
    cameras = sequence.cameras
    count = float(len(sequence.frames))
    extent = _largest_distance(cameras.centers)
    # Half the angle from the length of the chord, because the arc cosine is inaccurate for small angles.
    chord = _largest_distance(cameras.world_to_camera[:, 2, :3])
    angle = float(np.degrees(2 * np.arcsin(min(1.0, chord / 2))))
    return {
        "frames_per_sequence": (count, count, count),
        "fov_degrees": _range(_fields_of_view(cameras.intrinsics, cameras.image_size[1])),
        "near": _range(sequence.depth_ranges[:, 0]),
        "far": _range(sequence.depth_ranges[:, 1]),
        # The first camera's distance, zero, counts only if there is no other camera.
        "distance_from_first": _range((cameras.centers - cameras.centers[0]).norm(dim=-1)[min(1, int(count) - 1) :]),
        "path_extent": (extent, extent, extent),
        "largest_angle_degrees": (angle, angle, angle),
    }


def _range(values: Float[Tensor, " _"]) -> tuple[float, float, float]:
    values = values.double()
    return values.min().item(), values.quantile(0.5).item(), values.max().item()


def _fields_of_view(intrinsics: Float[Tensor, "view 3 3"], width: int) -> Float[Tensor, " view"]:
    """Return the horizontal angles in degrees between the left and the right edge."""
    focal = intrinsics[:, 0, 0]
    center = intrinsics[:, 0, 2]
    return (torch.atan(center / focal) + torch.atan((width - center) / focal)).rad2deg()


def _largest_distance(centers: Float[Tensor, "view 3"]) -> float:
    exact = "donot_use_mm_for_euclid_dist"
    parts = torch.split(centers, CHUNK)
    return max(torch.cdist(part, centers, compute_mode=exact).max().item() for part in parts)


def _merged(ranges: list[tuple[float, float, float]]) -> dict[str, float | None]:
    if not ranges:
        return {"min": None, "median": None, "max": None}
    low, middle, high = np.array(ranges).T
    return {"min": float(low.min()), "median": float(np.median(middle)), "max": float(high.max())}


def _histogram(key: str, rows: dict[str, list[Row]]) -> dict[str, Any]:
    column = 2 if key == "distance_from_first" else 1
    values = {split: np.array([row[key][column] for row in members]) for split, members in rows.items()}
    together = np.concatenate([np.empty(0), *values.values()])
    if key == "frames_per_sequence" and len(together):
        # Bins contain equally many whole numbers, with edges between them, so that rounding leaves no bin empty.
        step = int(np.ceil((np.ptp(together) + 1) / BINS))
        edges = np.arange(together.min() - 0.5, together.max() + step, step)
    else:
        low, high = (together.min(), together.max()) if len(together) else (0.0, 1.0)
        if high - low <= SMALLEST_SPAN * high:
            low = 0.5 * low
            high = 1.5 * high or 1.0
        edges = np.linspace(low, high, BINS + 1)
    counts = {split: np.histogram(members, edges)[0].tolist() for split, members in values.items()}
    return {"edges": edges.tolist(), "counts": counts}


PANELS = [measure for measure in MEASURES if measure[0] != "path_extent"]
DASHES = ["-", "--", ":"]


def plot_statistics(results: dict[str, Any], path: Path, title: str) -> None:
    """Write a PNG with histograms over the sequences of six measures of `statistics`, one line for each split."""
    total = {split: summary["sequences"] for split, summary in results["splits"].items()}
    numbers = ", ".join(f"{count:,} {split}" for split, count in total.items())
    with written_figure(path, f"{title}: sequences {numbers}", (13, 7)) as figure:
        for panel, (key, label, _) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
            histogram = results["histograms"][key]
            for index, (split, count) in enumerate(total.items()):
                if count:
                    shares = 100 * np.array(histogram["counts"][split]) / count
                    style: dict[str, Any] = {"color": f"C{index}", "linestyle": DASHES[index % len(DASHES)]}
                    panel.stairs(shares, histogram["edges"], baseline=None, linewidth=1.8, label=split, **style)
                    panel.stairs(shares, histogram["edges"], fill=True, alpha=0.15, color=f"C{index}")
            panel.set(xlabel=label, ylabel="sequences of the split, %")
            panel.set_ylim(bottom=0)
            panel.grid(alpha=0.3)
        if any(total.values()):
            figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(total))
