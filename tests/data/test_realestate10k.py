import json
import logging
import shutil
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from realestate10k_trees import FORMS, HEIGHT, encode, epoch, equal, make_clip, module, same, write_tree
from support import change_json, compose_config

from completesplat.data.realestate10k import clips
from completesplat.data.validation.audit import check
from completesplat.errors import BadAnnotation, BadCamera, CompleteSplatError, DataError, OutsidePath, UnreadableFile
from completesplat.geometry.cameras import project

TRAIN = [make_clip(f"train{i}", frames=5 + i % 3) for i in range(7)]
TEST = [make_clip(f"test{i}", frames=8) for i in range(5)]


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> list[Path]:
    return [write_tree(tmp_path_factory.mktemp(form), form, TRAIN, TEST) for form in FORMS]


@pytest.fixture
def root(both) -> Path:
    return both[1]


def test_both_forms_give_the_same_batches(both):
    text, chunks = (module(folder, scale=2.0) for folder in both)
    assert equal(list(text.test_dataloader()), list(chunks.test_dataloader()))
    assert equal(list(text.val_dataloader()), list(chunks.val_dataloader()))
    one, other = text.store("train"), chunks.store("train")
    assert sorted(one.names) == sorted(other.names)
    for name in one.names:
        assert same(*(store.scene(store.source.read(name), 1, [0, 3]) for store in (one, other)))
    torch.testing.assert_close(text.mean_image(), chunks.mean_image())
    assert text.typical_camera() == chunks.typical_camera()


def test_training_batches_have_the_stated_shapes_and_every_item_once_an_epoch(root):
    data = module(root, scale=3.0, references_per_sequence=3)
    batches = epoch(data.train_dataloader(), 0)
    assert sorted(name for batch in batches for name in batch.names) == sorted(data.store("train").names * 3)
    batch = batches[0]
    assert batch.reference.images.shape == (2, 3, 16, 16)
    assert batch.targets.images.shape == (2, 2, 3, 16, 16)
    assert batch.reference.images.dtype == batch.targets.cameras.world_to_camera.dtype == torch.float32
    assert batch.reference.cameras.image_size == (16, 16)
    torch.testing.assert_close(batch.depth_range, torch.tensor([[2.1, 30.0]] * 2))
    torch.testing.assert_close(batch.reference.cameras.world_to_camera, torch.eye(4).expand(2, 4, 4))
    assert (batch.all_views().masks == 1).all()


@pytest.mark.parametrize("crop", ["center", "principal"])
def test_a_point_reprojects_onto_its_pixel(tmp_path, crop):
    """Every frame shows one bright disc where the stored camera, by the format's definition, sees a fixed point."""
    height, width, world = 90, 160, np.array([0.2, 0.1, 4.0])
    clip = make_clip("a", frames=4, size=(height, width))
    clip.rows[:, 2:4] = [0.46, 0.53]
    rows, columns = np.mgrid[:height, :width] + 0.5
    for frame, row in enumerate(clip.rows):
        x, y, z = row[6:].reshape(3, 4) @ [*world, 1]
        u, v = width * (row[0] * x / z + row[2]), height * (row[1] * y / z + row[3])
        disc = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18)
        clip.images[frame] = encode(disc[..., None].repeat(3, axis=2).astype(np.uint8))
    root = write_tree(tmp_path, "text", [clip, make_clip("b")], TEST)
    store = module(root, image_size=64, crop=crop, scale=2.0, val_fraction=0.0).store("train")
    scene = store.scene(store.source.read("a"), 1, [0, 2, 3])
    pose = clip.rows[1, 6:].reshape(3, 4)
    point = torch.tensor(2.0 * (pose[:, :3] @ world + pose[:, 3]), dtype=torch.float32)
    views = scene.all_views()
    for view in range(4):
        weight = views.images[view].mean(dim=0).clamp(min=0.1) - 0.1
        j, i = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        seen = torch.stack([(i * weight).sum(), (j * weight).sum()]) / weight.sum()
        expected = project(views.cameras[view], point[None])[0][0]
        assert (seen - expected).abs().max() < 0.15
    # The central square of 160 x 90 begins 35 pixels from the left.
    central = ((0.46 * width - 35) * 64 / 90, 0.53 * height * 64 / 90)
    expected = torch.tensor(central if crop == "center" else (32.0, 32.0)).expand(4, 2)
    torch.testing.assert_close(views.cameras.intrinsics[:, :2, 2], expected)


@pytest.mark.parametrize("suffix", [".jpeg", ".JPG", ".png"])
def test_image_files_have_any_of_their_suffixes(suffix, tmp_path):
    root = write_tree(tmp_path, "text", [make_clip("a")], [])
    expected = module(root, val_fraction=0.0).source("train").read("a").read(3).image
    for path in root.glob("train/a/*.jpg"):
        path.rename(path.with_suffix(suffix))
    assert torch.equal(module(root, val_fraction=0.0).source("train").read("a").read(3).image, expected)


def test_targets_stay_near_the_reference_and_may_be_none(root):
    data = module(root, min_gap=1, max_gap=2)
    for seed in range(50):
        reference, targets = data.training_views(7, 0, np.random.default_rng(seed))
        assert {abs(target - reference) for target in targets} <= {1, 2}
    growing = module(root, targets=9, max_gap={"first": 2, "last": 6, "epochs": 4})
    drawn = {epoch: growing.training_views(40, epoch, np.random.default_rng(epoch)) for epoch in range(9)}
    farthest = {epoch: max(abs(target - views[0]) for target in views[1]) for epoch, views in drawn.items()}
    assert [farthest[epoch] for epoch in (0, 2, 4, 8)] == [2, 4, 6, 6]
    assert growing.describe()["protocol_views"].endswith("the last 6 frames away")  # what is trained is tested
    (batch, *_) = epoch(module(root, targets=0, horizontal_flip=True).train_dataloader(), 0)
    assert batch.targets.images.shape == (2, 0, 3, 16, 16)
    assert torch.equal(batch.all_views().images, batch.reference.images[:, None])


def test_evaluation_goes_from_the_first_frame_to_those_that_follow(root):
    data = module(root, evaluation_targets=2, evaluation_gap=4, evaluation_batch_size=5)
    (batch,) = list(data.test_dataloader())
    store = data.store("test")
    for number, key in enumerate(store.names):
        assert same(batch[number], store.scene(store.source.read(key), 0, [2, 4]))
    assert sorted(batch.names) == sorted(clip.key for clip in TEST)


def test_a_model_sees_images_made_as_its_training_images_were_whatever_size_is_scored(root):
    small, large = module(root, image_size=8), module(root, image_size=HEIGHT)
    expected = list(module(root, image_size=HEIGHT).test_dataloader())
    large.low_resolution = small
    for batch, truth, model_input in zip(large.test_dataloader(), expected, small.test_dataloader(), strict=True):
        assert same(batch, truth)
        assert same(batch.low_resolution, model_input)
        assert same(batch[0].low_resolution, model_input[0])


def test_the_evaluation_index_and_the_scene_list_decide(root, tmp_path, caplog):
    views = {key: {"context": [2, 7], "target": [3, 5]} for key in ("test0", "test2", "test3")}
    (tmp_path / "index.json").write_text(json.dumps(views))
    (tmp_path / "scenes.txt").write_text("test0\ntest3\nelsewhere\n")
    files = {"evaluation_index": str(tmp_path / "index.json"), "scene_list": str(tmp_path / "scenes.txt")}
    data = module(root, **files)
    with caplog.at_level(logging.INFO, logger="completesplat"):
        (batch,) = list(data.test_dataloader())
    assert batch.names == ("test0", "test3")
    store = data.store("test")
    assert same(batch[0], store.scene(store.source.read("test0"), 2, [3, 5]))
    for count in ("2 clips to test", "1 in the list, not in the data", "1 not in the list"):
        assert count in caplog.messages[0]
    (tmp_path / "index.json").write_text(json.dumps({"test0": {"context": [0, 7], "target": [8]}}))
    with pytest.raises(DataError, match="test0, frame 8"):
        list(module(root, **files).test_dataloader())


@pytest.mark.parametrize("form", FORMS)
def test_missing_clips_are_counted_and_left_out(form, tmp_path, caplog):
    write_tree(tmp_path, form, TRAIN, TEST)
    if form == "chunks":
        change_json(tmp_path / "train/index.json", lambda index: index | dict.fromkeys("xy", "000099.torch"))
    else:
        for name in "xy":
            (tmp_path / f"train/{name}.txt").write_text("address\n")
    with caplog.at_level(logging.INFO, logger="completesplat"):
        data = module(tmp_path)
        data.setup("fit")
    assert sorted(data.store("train").names + data.store("val").names) == sorted(clip.key for clip in TRAIN)
    assert data.source("train").left_out == {"frames are missing": ["x", "y"]}
    assert caplog.messages == [
        f"{split}: {count}; 2 left out: frames are missing"
        for split, count in (("train", "6 sequences"), ("val", "1 sequence"))
    ]


def test_a_folder_of_frames_that_is_gone_is_an_error_of_its_clip(tmp_path):
    write_tree(tmp_path, "text", TRAIN[:1], TEST)
    source = clips.TextClips(tmp_path / "train")
    shutil.rmtree(tmp_path / "train/train0")
    with pytest.raises(UnreadableFile, match=r"train0.*cannot be listed"):
        source.clip("train0")


def test_what_is_not_there_or_makes_no_sense_is_refused(tmp_path):
    with pytest.raises(DataError, match="train"):
        module(tmp_path).setup("fit")
    with pytest.raises(DataError, match="no train sequences"):
        module(write_tree(tmp_path, "text", TRAIN[:1], TEST)).setup("fit")
    for setting in ({"min_gap": 0}, {"min_gap": 5}, {"near": 0.0}, {"scale": -1.0}):
        with pytest.raises(CompleteSplatError, match="data"):
            module(tmp_path, **setting)


@pytest.mark.parametrize(
    ("index", "kind"), [('{"a": 1}', BadAnnotation), ("[]", BadAnnotation), ("{", UnreadableFile), (None, DataError)]
)
def test_a_folder_without_any_use_is_raised_under_either_rule(tmp_path, index, kind):
    (tmp_path / "train").mkdir()
    if index is not None:
        (tmp_path / "train/index.json").write_text(index)
    for on_bad in ("raise", "skip"):
        with pytest.raises(kind, match=str(tmp_path / "train")):
            module(tmp_path, on_bad=on_bad).setup("fit")


def test_annotations_that_cannot_be_used_are_raised_or_skipped_with_a_line(tmp_path, caplog):
    index = write_tree(tmp_path, "chunks", TRAIN, TEST) / "train/index.json"
    change_json(index, lambda files: files | {"b": "../b.torch"})
    with pytest.raises(OutsidePath):
        module(tmp_path, on_bad="raise").setup("fit")
    module(tmp_path, on_bad="skip").setup("fit")
    (message,) = {record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING}
    assert message.startswith(f"1 annotations cannot be used; the first: {index}, b: ")


def test_a_principal_point_outside_matters_to_its_own_crop_only(tmp_path):
    clip = make_clip("bad")
    clip.rows[:, 2] = 1.5
    write_tree(tmp_path, "text", [clip, *TRAIN], TEST)
    assert check(module(tmp_path).open("train"), workers=1, progress=False).refused == []
    with pytest.raises(BadCamera, match=r"bad\.txt, bad, frame 0: "):
        module(tmp_path, crop="principal").open("train")["train"].read("bad")


@pytest.fixture
def loads(monkeypatch):
    """Names of the chunks in the order they are read, and the largest number of them alive at once."""
    names, alive, counts = [], [], []
    original = clips.read_chunk

    def watched(path: Path):
        chunk = original(path)
        alive.append(weakref.ref(next(iter(chunk.values()))["timestamps"]))
        counts.append(sum(ref() is not None for ref in alive))
        names.append(path.name)
        return chunk

    monkeypatch.setattr(clips, "read_chunk", watched)
    return names, counts


def test_two_chunks_in_memory_and_each_read_once_an_epoch(tmp_path, loads):
    names, counts = loads
    FORMS["chunks"](tmp_path / "few", TEST[:3], clips_per_chunk=1)
    result = clips.ChunkedClips(tmp_path / "few")
    for number in (0, 1, 0, 2, 0, 1):
        result.clip(f"test{number}")
    assert names == [f"{number:06}.torch" for number in (0, 1, 2, 1)]  # The chunk of the longest ago went.
    del result
    for split in ("train", "test"):
        FORMS["chunks"](tmp_path / split, [make_clip(f"{i:02}", frames=3) for i in range(18)], clips_per_chunk=3)
    data = module(tmp_path, image_size=8, batch_size=4, references_per_sequence=2, val_fraction=0.0)
    loader = data.train_dataloader()
    names.clear()
    assert sum(len(batch.names) for batch in epoch(loader, 0)) == 34
    assert sorted(names) == [f"{i:06}.torch" for i in range(6)]
    assert names != sorted(names)
    list(data.val_dataloader())
    list(data.train_dataloader())
    assert max(counts) == 2


@pytest.mark.parametrize("experiment", ["paper_diffusion", "toy_diffusion"])
def test_latent_diffusion_reads_no_targets(experiment):
    assert compose_config("fit", f"experiment={experiment}").data.targets == 0
