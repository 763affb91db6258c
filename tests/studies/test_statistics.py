import json
import math
import warnings
import weakref
from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from completesplat.studies.statistics import MEASURES, plot_statistics, show_statistics, statistics

BLUE, ORANGE = (31, 119, 180), (255, 127, 14)


def never_read(index):
    raise AssertionError("statistics need no pictures")


def test_an_orbit_has_the_figures_of_its_circle(orbit):
    summary = statistics({"train": [orbit(24, radius=2.0, read=never_read)]})["splits"]["train"]
    assert (summary["sequences"], summary["frames"]) == (1, 24)
    assert summary["fov_degrees"]["median"] == pytest.approx(50, abs=1e-4)
    assert summary["path_extent"]["max"] == pytest.approx(4)
    assert summary["largest_angle_degrees"]["max"] == pytest.approx(180, abs=1e-5)
    # Chords 2 r sin(pi k / n); the median of k = 1 to 23 is at k = 6 and 18.
    assert summary["distance_from_first"]["min"] == pytest.approx(4 * math.sin(math.pi / 24))
    assert summary["distance_from_first"]["median"] == pytest.approx(2 * math.sqrt(2))
    assert summary["distance_from_first"]["max"] == pytest.approx(4)


def test_a_long_path_is_measured_between_all_its_cameras(walk):
    places = [(float(10 - abs(i - 400) / 40), 0.0, 0.0) if i != 300 else (-5.0, 0.0, 0.0) for i in range(900)]
    assert statistics({"a": [walk(*places)]})["splits"]["a"]["path_extent"]["max"] == pytest.approx(15)


def test_a_field_of_view_ends_at_the_borders_of_the_picture(orbit):
    sequence = orbit(3)
    intrinsics = sequence.cameras.intrinsics.clone()
    intrinsics[:, 0, 0], intrinsics[:, 0, 2] = 24.0, 0.0  # the axis goes through the left border: atan(24 / 24)
    cameras = replace(sequence.cameras, intrinsics=intrinsics)
    summary = statistics({"a": [replace(sequence, cameras=cameras)]})["splits"]["a"]
    assert summary["fov_degrees"]["median"] == pytest.approx(45)


def test_ranges_are_of_all_frames_and_medians_of_sequences(orbit):
    first, second, third = (
        orbit(count, depth_range=(near, far)) for count, near, far in [(3, 1, 9), (5, 2, 4), (9, 3, 5)]
    )
    depths = first.depth_ranges.clone()
    depths[0, 0] = 0.25
    summary = statistics({"a": [replace(first, depth_ranges=depths), second, third]})["splits"]["a"]
    assert summary["frames_per_sequence"] == {"min": 3, "median": 5, "max": 9}
    assert summary["near"] == {"min": 0.25, "median": 2, "max": 3}
    assert summary["far"] == {"min": 4, "median": 5, "max": 9}
    assert summary["frames"] == 17


def test_a_camera_alone_has_no_baseline(walk):
    summary = statistics({"a": [walk((1.0, 2.0, 3.0))]})["splits"]["a"]
    for key in ("distance_from_first", "path_extent", "largest_angle_degrees"):
        assert summary[key] == {"min": 0, "median": 0, "max": 0}


def test_the_figures_are_strict_json_even_of_a_split_without_sequences(orbit):
    results = statistics({"train": [orbit(3)], "val": []})
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert results["splits"]["val"]["sequences"] == 0
    assert results["splits"]["val"]["near"] == {"min": None, "median": None, "max": None}


def test_every_sequence_is_in_one_bin_of_each_histogram(orbit):
    lengths = {"train": range(2, 90), "test": [4, 4]}
    results = statistics({split: [orbit(n, fov=30 + n / 7) for n in counts] for split, counts in lengths.items()})
    for key, _, _ in MEASURES:
        histogram = results["histograms"][key]
        assert {split: sum(counts) for split, counts in histogram["counts"].items()} == {"train": 88, "test": 2}
        assert all(len(counts) == len(histogram["edges"]) - 1 for counts in histogram["counts"].values())


def test_lengths_are_counted_by_whole_numbers(orbit):
    histogram = statistics({"a": [orbit(n) for n in (3, 5, 3)]})["histograms"]["frames_per_sequence"]
    assert histogram == {"edges": [2.5, 3.5, 4.5, 5.5], "counts": {"a": [2, 0, 1]}}


def test_sequences_are_not_kept(orbit):
    known = []

    def stream():
        for _ in range(4):
            sequence = orbit(3)
            known.append(weakref.ref(sequence))
            yield sequence
            del sequence
            assert sum(reference() is not None for reference in known) <= 1

    assert statistics({"a": stream()})["splits"]["a"]["sequences"] == 4


def test_the_tables_name_splits_and_numbers(orbit, capsys):
    show_statistics(statistics({"train": [orbit(1234, radius=2.0)], "val": []}))
    printed = capsys.readouterr().out
    for word in ("train", "val", "1,234", "50.0", "180.0", " - "):
        assert word in printed


@pytest.mark.parametrize(("test_sequences", "orange"), [(1, True), (0, False)])
def test_the_plot_has_a_line_for_each_split_with_sequences(orbit, tmp_path, test_sequences, orange):
    results = statistics({"train": [orbit(5)], "test": [orbit(9)] * test_sequences})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_statistics(results, tmp_path / "stats.png", "a title")
    image = imageio.imread(tmp_path / "stats.png")[..., :3]
    rows = np.flatnonzero((image == BLUE).all(-1).any(1)) / len(image)
    assert rows.min() < 0.2
    assert rows.max() > 0.8  # in the panels of both rows
    assert (image == ORANGE).all(-1).any() == orange


def test_a_data_set_without_sequences_is_plotted_empty(tmp_path):
    plot_statistics(statistics({"train": []}), tmp_path / "stats.png")
    assert not (imageio.imread(tmp_path / "stats.png")[..., :3] == BLUE).all(-1).any()


def test_small_angles_are_exact(walk):
    sequence = walk((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    angle = 1e-6
    turn = torch.eye(4).double()
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    poses = torch.stack([sequence.cameras.world_to_camera[0], turn])
    turned = replace(sequence, cameras=replace(sequence.cameras, world_to_camera=poses))
    summary = statistics({"a": [turned]})["splits"]["a"]
    assert summary["largest_angle_degrees"]["max"] == pytest.approx(math.degrees(angle), rel=1e-6)
