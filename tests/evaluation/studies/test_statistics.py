import json
import math
import warnings
from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from completesplat.evaluation.studies.statistics import MEASURES, plot_statistics, show_statistics, statistics

BLUE, ORANGE = (31, 119, 180), (255, 127, 14)


def only(*sequences):
    """The figures of a split."""
    return statistics({"a": sequences})["splits"]["a"]


def test_an_orbit_has_the_figures_of_its_circle(orbit):
    summary = only(orbit(24, radius=2.0, read=lambda _: pytest.fail("statistics need no images")))
    assert (summary["sequences"], summary["frames"]) == (1, 24)
    assert summary["fov_degrees"]["median"] == pytest.approx(50, abs=1e-4)
    assert summary["path_extent"]["max"] == pytest.approx(4)
    assert summary["largest_angle_degrees"]["max"] == pytest.approx(180, abs=1e-5)
    # Chords 2 r sin(pi k / n); the median of k = 1 to 23 is at k = 6 and 18.
    distances = {"min": 4 * math.sin(math.pi / 24), "median": 2 * math.sqrt(2), "max": 4}
    assert summary["distance_from_first"] == pytest.approx(distances)


def test_a_path_is_measured_between_all_its_cameras(walk):
    places = [(float(10 - abs(i - 400) / 40), 0.0, 0.0) if i != 300 else (-5.0, 0.0, 0.0) for i in range(900)]
    assert only(walk(*places))["path_extent"]["max"] == pytest.approx(15)
    alone = only(walk((1.0, 2.0, 3.0)))
    for key in ("distance_from_first", "path_extent", "largest_angle_degrees"):
        assert alone[key] == {"min": 0, "median": 0, "max": 0}


def test_a_field_of_view_ends_at_the_borders_of_the_image(orbit):
    sequence = orbit(3)
    intrinsics = sequence.cameras.intrinsics.clone()
    intrinsics[:, 0, 0], intrinsics[:, 0, 2] = 24.0, 0.0  # the axis goes through the left border: atan(24 / 24)
    cameras = replace(sequence.cameras, intrinsics=intrinsics)
    assert only(replace(sequence, cameras=cameras))["fov_degrees"]["median"] == pytest.approx(45)


def test_ranges_are_of_all_frames_and_medians_of_sequences(orbit):
    first, *others = (orbit(count, depth_range=depths) for count, depths in [(3, (1, 9)), (5, (2, 4)), (9, (3, 5))])
    depths = first.depth_ranges.clone()
    depths[0, 0] = 0.25
    summary = only(replace(first, depth_ranges=depths), *others)
    assert summary["frames_per_sequence"] == {"min": 3, "median": 5, "max": 9}
    assert summary["near"] == {"min": 0.25, "median": 2, "max": 3}
    assert summary["far"] == {"min": 4, "median": 5, "max": 9}
    assert summary["frames"] == 17


def test_the_figures_are_strict_json_and_tables_even_of_a_split_without_sequences(orbit, capsys):
    results = statistics({"train": [orbit(1234, radius=2.0)], "val": []})
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert results["splits"]["val"]["sequences"] == 0
    assert results["splits"]["val"]["near"] == {"min": None, "median": None, "max": None}
    show_statistics(results)
    printed = capsys.readouterr().out
    for word in ("train", "val", "1,234", "50.0", "180.0", " - "):
        assert word in printed


def test_every_sequence_is_in_one_bin_of_each_histogram(orbit):
    lengths = {"train": range(2, 90), "test": [4, 4]}
    results = statistics({split: [orbit(n, fov=30 + n / 7) for n in counts] for split, counts in lengths.items()})
    for key, _, _ in MEASURES:
        histogram = results["histograms"][key]
        assert {split: sum(counts) for split, counts in histogram["counts"].items()} == {"train": 88, "test": 2}
        assert all(len(counts) == len(histogram["edges"]) - 1 for counts in histogram["counts"].values())
    histogram = statistics({"a": [orbit(n) for n in (3, 5, 3)]})["histograms"]["frames_per_sequence"]
    assert histogram == {"edges": [2.5, 3.5, 4.5, 5.5], "counts": {"a": [2, 0, 1]}}  # by whole numbers


@pytest.mark.parametrize("far", [4.0, 1e-30, 1e30])
def test_values_that_differ_by_rounding_alone_share_a_histogram_around_them(orbit, far):
    """As of two splits of a capture whose cameras are all equally far, about any distance."""
    depths = {"train": far, "test": math.nextafter(far, math.inf), "val": far}
    ranges = {split: torch.tensor([[far / 2, value]] * 3, dtype=torch.float64) for split, value in depths.items()}
    sequences = {split: [replace(orbit(3), depth_ranges=depth)] for split, depth in ranges.items()}
    histogram = statistics(sequences)["histograms"]["far"]
    assert {split: sum(counts) for split, counts in histogram["counts"].items()} == dict.fromkeys(depths, 1)
    assert histogram["edges"][0] < far < histogram["edges"][-1]
    assert np.all(np.diff(histogram["edges"]) > 0)


def test_the_plot_has_a_line_for_each_split_with_sequences(orbit, tmp_path):
    def plotted(**splits):
        with warnings.catch_warnings(action="error"):
            plot_statistics(statistics(splits), tmp_path / "stats.png", "a title")
        image = imageio.imread(tmp_path / "stats.png")[..., :3]
        return [np.flatnonzero((image == color).all(-1).any(1)) / len(image) for color in (BLUE, ORANGE)]

    blue, orange = plotted(train=[orbit(5)], test=[orbit(9)])
    assert blue.min() < 0.2
    assert blue.max() > 0.8  # in the panels of both rows
    assert len(orange) > 0
    assert len(plotted(train=[])[0]) == 0


def test_small_angles_are_exact(walk):
    sequence, angle = walk((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), 1e-6
    poses = sequence.cameras.world_to_camera[:1].repeat(2, 1, 1)
    poses[1, 0, 0] = poses[1, 2, 2] = math.cos(angle)
    poses[1, 0, 2], poses[1, 2, 0] = math.sin(angle), -math.sin(angle)
    turned = replace(sequence, cameras=replace(sequence.cameras, world_to_camera=poses))
    assert only(turned)["largest_angle_degrees"]["max"] == pytest.approx(math.degrees(angle), rel=1e-6)
