import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from completesplat.data.captures import import_capture
from completesplat.errors import CompleteSplatError, DataError

pycolmap = pytest.importorskip("pycolmap")

MODELS = {
    "SIMPLE_PINHOLE": [200, 112.5, 66],
    "PINHOLE": [190, 205, 112.5, 66],
    "SIMPLE_RADIAL": [200, 100, 80, -0.15],
    "RADIAL": [200, 112.5, 66, 0.1, 0.03],
    "OPENCV": [190, 205, 112.5, 66, -0.18, 0.04, 0.002, -0.003],
}


def write_model(captures, folder: Path, model: str, binary: bool = True) -> Path:
    """A capture with pictures drawn through COLMAP's own lens model; returns the model's folder."""
    shot = captures.Shot()
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 200.0, 210, 150)
    if model in MODELS:
        camera.params = MODELS[model]
    reconstruction.add_camera_with_trivial_rig(camera)
    (folder / "images/left").mkdir(parents=True)
    for number, pose in enumerate(captures.opengl_poses(), start=1):
        matrix = np.linalg.inv(pose @ np.diag([1, -1, -1, 1]))
        image = pycolmap.Image()
        image.name, image.camera_id, image.image_id = f"left/{number}.png", 1, number
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(matrix[:3, :3]), matrix[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, rigid)
        local = captures.POINTS @ matrix[:3, :3].T + matrix[:3, 3]
        Image.fromarray(shot.draw(camera.img_from_cam(local))).save(folder / "images" / image.name)
    for point in captures.POINTS:
        reconstruction.add_point3D(point, pycolmap.Track(), np.array([10, 20, 30], dtype=np.uint8))
    model_folder = folder / "sparse"
    model_folder.mkdir()
    (reconstruction.write_binary if binary else reconstruction.write_text)(str(model_folder))
    return model_folder


def run_import(folder: Path, **settings):
    sources = {"colmap": folder / "sparse", "images": folder / "images", **settings}
    return import_capture(folder / "out", "desk", progress=False, **sources)


@pytest.mark.parametrize(("model", "binary"), [*((model, True) for model in MODELS), ("OPENCV", False)])
def test_known_points_are_where_the_written_cameras_see_them(captures, tmp_path, model, binary):
    write_model(captures, tmp_path, model, binary)
    errors = captures.reprojection_errors(run_import(tmp_path), captures.POINTS)
    assert len(errors) > 20
    assert errors.max() < 0.1


def test_the_points_become_the_point_cloud_also_of_models_from_before_rigs(captures, tmp_path):
    model = write_model(captures, tmp_path, "PINHOLE")
    reconstruction = pycolmap.Reconstruction(str(model))
    for name in ("rigs.bin", "frames.bin"):
        (model / name).unlink()
    category = run_import(tmp_path, sequence="a")
    assert len(captures.annotations(category)) == 8
    vertices = PlyData.read(str(category / "a/pointcloud.ply"))["vertex"]
    found = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    order, wanted = np.lexsort(found.T), np.lexsort(captures.POINTS.T)
    np.testing.assert_allclose(found[order], captures.POINTS[wanted], atol=1e-6)
    assert set(vertices["green"]) == {20}
    reconstruction.delete_all_points2D_and_points3D()
    reconstruction.write_binary(str(model))
    category = import_capture(tmp_path / "no points", "desk", colmap=model, images=tmp_path / "images", progress=False)
    assert not list(category.glob("*/pointcloud.ply"))


@pytest.mark.parametrize("name", ["{}.png.png", "{}.png"])
def test_masks_have_the_names_of_their_pictures(captures, tmp_path, name):
    write_model(captures, tmp_path, "PINHOLE")
    (tmp_path / "masks/left").mkdir(parents=True)
    for number in range(1, 9):
        mask = Image.new("L", (210, 150), 20 * number)
        mask.save(tmp_path / "masks/left" / name.format(number))
    category = run_import(tmp_path, masks=tmp_path / "masks")
    found = [int(captures.pixels_of(category, e, "mask")[3, 4]) for e in captures.annotations(category)]
    assert found == [20, 40, 60, 80, 100, 120, 140, 160]


@pytest.mark.parametrize("file", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("share", [0.01, 0.99])
def test_cut_files_are_refused(captures, tmp_path, file, share):
    path = write_model(captures, tmp_path, "OPENCV") / f"{file}.bin"
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=rf"{file}\.bin: cut off"):
        run_import(tmp_path)


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "FULL_OPENCV", "FOV"])
@pytest.mark.parametrize("binary", [True, False])
def test_other_lenses_are_refused(captures, tmp_path, model, binary):
    write_model(captures, tmp_path, model, binary)
    with pytest.raises(DataError, match="not supported"):
        run_import(tmp_path)


def test_missing_pictures_and_masks_and_those_outside_and_what_is_no_model_are_refused(captures, tmp_path):
    model = write_model(captures, tmp_path, "PINHOLE", binary=False)
    (tmp_path / "masks").mkdir()
    with pytest.raises(DataError, match=r"left/1\.png\.png, frame 1: no such file, nor 1\.png"):
        run_import(tmp_path, masks=tmp_path / "masks")
    (tmp_path / "images/left/3.png").unlink()
    with pytest.raises(DataError, match=r"left/3\.png, frame 3: no such file"):
        run_import(tmp_path)
    text = (model / "images.txt").read_text()
    (model / "images.txt").write_text(text.replace("left/3.png", "../3.png"))
    with pytest.raises(DataError, match=r"frame 3: leads outside"):
        run_import(tmp_path)
    (model / "points3D.txt").write_text("1 2 three\n")
    with pytest.raises(DataError, match=r"sparse: not a COLMAP model"):
        run_import(tmp_path)
    for file in model.iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"sparse: not a COLMAP model"):
        run_import(tmp_path)


def test_without_pycolmap_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(CompleteSplatError, match=r"pip install completesplat\[colmap\]"):
        run_import(tmp_path)
