from dataclasses import replace

import pytest
import torch
from viewer_scenes import balls, balls_sample, reference_camera

from completesplat.errors import CompleteSplatError
from completesplat.export.description import UP, write_scene_json
from completesplat.export.ply import write_ply
from completesplat.gaussians import merge_gaussians
from completesplat.geometry.cameras import project
from completesplat.viewer.sample import Sample, framing_camera, read_scene


def prediction(folder, count=2, points=1024):
    """A prediction's folder as far as the viewer reads it."""
    scene = balls(points=points // 4)
    for i in range(count):
        write_ply(folder / f"sample_{i:02}.ply", scene)
    settings = {"up": [0.0, -0.8, -0.6], "seed": 0}
    write_scene_json(folder / "scene.json", reference_camera(40.0, 16), settings, 0, {})
    return folder


@pytest.mark.parametrize(("points", "layers"), [(1024, 4), (1020, 1)])  # of 16 x 16 pixels, or some are missing
def test_a_prediction_is_read_with_its_camera_layers_and_up(tmp_path, points, layers):
    folder = prediction(tmp_path, points=points)
    for path, count in ((folder, 2), (folder / "sample_01.ply", 1)):
        samples, up = read_scene(path)
        assert up == (0.0, -0.8, -0.6)
        assert [sample.layers for sample in samples] == [layers] * count
        assert torch.equal(samples[0].reference.intrinsics, reference_camera(40.0, 16).intrinsics)


def test_a_ply_alone_is_seen_as_a_whole(tmp_path):
    write_ply(tmp_path / "scene.ply", balls())
    samples, up = read_scene(tmp_path / "scene.ply")
    assert up == UP
    pixels, depths = project(samples[0].reference, balls().means)
    height, width = samples[0].reference.image_size
    assert (depths > 0).all()
    assert ((pixels > 0) & (pixels < torch.tensor([width, height]))).all(-1).float().mean() > 0.85


CAMERA = '{"world_to_camera": [[1.0]], "intrinsics": [[1.0]], "image_size": [4, 4]}'


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not a JSON file"),
        ('{"reference_camera": null}', "reference_camera must be of type dict, not None"),
        (f'{{"reference_camera": {CAMERA}, "settings": {{}}}}', "world_to_camera must be 4 x 4 numbers"),
    ],
)
def test_broken_descriptions_and_folders_without_samples_are_refused(tmp_path, text, reason):
    with pytest.raises(CompleteSplatError, match=r"no sample_\*\.ply"):
        read_scene(tmp_path)
    (prediction(tmp_path) / "scene.json").write_text(text)
    with pytest.raises(CompleteSplatError, match=rf"scene\.json: {reason}"):
        read_scene(tmp_path)


@pytest.mark.parametrize("text", ['{"name": "a scene of Unity"}', "[1]"])
def test_another_programs_description_does_not_count(tmp_path, text):
    (prediction(tmp_path) / "scene.json").write_text(text)
    samples, up = read_scene(tmp_path)
    assert (len(samples), up) == (2, UP)


def test_the_pivot_is_in_the_middle_of_the_image_despite_faint_gaussians():
    pivot, scene = balls_sample().pivot(), balls()
    assert pivot.tolist() == [0, 0, pytest.approx(4, abs=0.25)]  # within the red ball
    ghosts = replace(scene, means=scene.means + torch.tensor([0, 0, 20.0]), opacities=scene.opacities * 0.01)
    among_them = Sample(merge_gaussians([scene, ghosts]), 1, reference_camera()).pivot()
    assert among_them[2] == pytest.approx(pivot[2].item(), abs=0.05)


@pytest.mark.parametrize("count", [0, 1])
def test_almost_empty_scenes_have_a_camera_and_a_pivot(count):
    scene = balls()[:count]
    camera = framing_camera(scene)
    assert Sample(scene, 1, camera).pivot().isfinite().all()
    assert camera.world_to_camera.isfinite().all()
