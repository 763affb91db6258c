"""Broken clips as texts beside frames: each at its source, and one of each kind of error through the data module.

35 cases by name: 20 in which the clip's content is wrong, 15 in which its text or folder is.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
from bad_clips import BAD, BAD_CLIPS, CLIPS, SETTINGS, changed, check_policies, check_source
from bad_inputs import one_of_each_kind
from realestate10k_trees import assert_refusal, module, write_text_form, write_tree

from completesplat.data.realestate10k import clips
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    BadPicture,
    MissingFile,
    TooFewFrames,
    UnreadableFile,
)
from completesplat.errors import DataError

TEXT, SECOND = f"{BAD}.txt", f"{BAD}/66000.jpg"
Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> RE10KDataModule:
    """What the damaged trees would be."""
    root = write_tree(tmp_path_factory.mktemp("intact"), "text", CLIPS, CLIPS)
    return module(root, **SETTINGS, cache=True)


def text(edit: Callable[[list[str]], list[str]]) -> Damage:
    """Change the lines: the address, and one for each of the four frames."""

    def damage(folder: Path) -> None:
        lines = edit((folder / TEXT).read_text().splitlines())
        (folder / TEXT).write_text("\n".join(lines))

    return damage


def column(number: int, value: str) -> Damage:
    """Another value in the third frame's line."""

    def edit(lines: list[str]) -> list[str]:
        columns = lines[3].split()
        columns[number] = value
        return [*lines[:3], " ".join(columns), *lines[4:]]

    return text(edit)


def content(file: str, data: bytes) -> Damage:
    return lambda folder: (folder / file).write_bytes(data)


def replaced(file: str, make: Callable[[Path], object]) -> Damage:
    def damage(folder: Path) -> None:
        (folder / file).unlink()
        make(folder / file)

    return damage


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**27)


# name: (damage, kind, file, frame)
BAD_TEXTS: dict[str, tuple[Damage, type[DataError], str, int | None]] = {
    "empty_text": (content(TEXT, b""), TooFewFrames, TEXT, None),
    "address_only": (text(lambda lines: lines[:1]), TooFewFrames, TEXT, None),
    "text_in_another_encoding": (content(TEXT, "http://x\né".encode("latin-1")), UnreadableFile, TEXT, None),
    "text_is_a_picture": (content(TEXT, CLIPS[0].pictures[0]), UnreadableFile, TEXT, None),
    "text_of_134_megabytes": (replaced(TEXT, sparse), UnreadableFile, TEXT, None),
    "text_is_a_folder": (replaced(TEXT, Path.mkdir), MissingFile, TEXT, None),
    "text_is_a_ring_of_links": (replaced(TEXT, lambda path: path.symlink_to(path.name)), MissingFile, TEXT, None),
    "cut_line": (text(lambda lines: [*lines[:-1], lines[-1][:40]]), BadAnnotation, TEXT, 3),
    "column_too_many": (text(lambda lines: [*lines[:2], f"{lines[2]} 0", *lines[3:]]), BadAnnotation, TEXT, 1),
    "letters_instead_of_a_number": (column(5, "k1"), BadAnnotation, TEXT, 2),
    "timestamp_with_a_fraction": (column(0, "99000.5"), BadAnnotation, TEXT, 2),
    "timestamp_twice": (column(0, "66000"), BadAnnotation, TEXT, 1),
    "timestamp_without_a_picture": (column(0, "98999"), MissingFile, f"{BAD}/98999.jpg", 2),
    "missing_picture": (lambda folder: (folder / SECOND).unlink(), MissingFile, SECOND, 1),
    "picture_is_a_dead_link": (
        replaced(SECOND, lambda path: path.symlink_to("none.jpg")), MissingFile, SECOND, 1,
    ),
}  # fmt: skip


def written(train: Path, name: str) -> tuple[type[DataError], Path, int | None]:
    """Write the clips with one that is broken; the kind of the error, its file and its frame."""
    if name in BAD_TEXTS:
        write_text_form(train, CLIPS)
        damage, kind, file, frame = BAD_TEXTS[name]
        damage(train)
        return kind, train / file, frame
    change, kind, frame = BAD_CLIPS[name]
    clips = changed(change)
    write_text_form(train, clips)
    return kind, train / (f"{BAD}/{clips[0].timestamps[frame or 0]}.jpg" if kind is BadPicture else TEXT), frame


@pytest.mark.parametrize("name", [*BAD_CLIPS, *BAD_TEXTS])
def test_a_broken_clip_is_refused_by_the_source_with_its_place(name, tmp_path):
    check_source(tmp_path / "train", *written(tmp_path / "train", name))


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", [*one_of_each_kind(BAD_CLIPS, 1), *one_of_each_kind(BAD_TEXTS, 1)])
def test_a_broken_clip_never_gets_into_a_batch(name, policy, tmp_path, intact):
    kind, file, frame = written(tmp_path / "train", name)
    check_policies(tmp_path / "train", policy, intact, kind, file, frame)


@pytest.mark.parametrize("policy", ["raise", "skip"])
def test_a_principal_point_outside_matters_to_its_own_crop_only(policy, tmp_path):
    def outside(clip):
        clip.rows[:, 2] = 1.5

    clips = changed(outside)
    write_text_form(tmp_path / "a/train", clips)
    intact = module(write_tree(tmp_path / "b", "text", CLIPS, CLIPS), **SETTINGS)
    principal = module(tmp_path / "b", **SETTINGS, crop="principal")
    folder = tmp_path / "a/train"
    assert intact.store("train").source.read(BAD).cameras.image_size == (16, 16)
    check_policies(folder, policy, principal, BadCamera, folder / TEXT, 0, crop="principal")


# name: (damage of the whole folder, kind)
BAD_SETS: dict[str, tuple[Damage, type[DataError]]] = {
    "no_folder": (lambda folder: folder.rename(folder.with_name("elsewhere")), DataError),
    "no_texts": (lambda folder: [path.unlink() for path in folder.glob("*.txt")], DataError),
    "no_frames": (lambda folder: [path.rename(folder.parent / path.name) for path in folder.glob("*/")], DataError),
    "index_is_a_list": (lambda folder: (folder / "index.json").write_text("[]"), BadAnnotation),
    "index_of_numbers": (lambda folder: (folder / "index.json").write_text('{"a": 1}'), BadAnnotation),
    "index_is_cut": (lambda folder: (folder / "index.json").write_text('{"a": '), UnreadableFile),
    "index_of_nothing": (lambda folder: (folder / "index.json").write_text("{}"), DataError),
}


@pytest.mark.parametrize(
    ("name", "policy"), [(n, "raise") for n in BAD_SETS] + [(n, "skip") for n in one_of_each_kind(BAD_SETS, 1)]
)
def test_a_folder_without_any_use_is_raised_under_either_policy(name, policy, tmp_path):
    damage, kind = BAD_SETS[name]
    write_text_form(tmp_path / "train", CLIPS)
    damage(tmp_path / "train")
    with pytest.raises(DataError) as caught:
        module(tmp_path, on_bad=policy, max_bad_fraction=10.0).setup("fit")
    assert type(caught.value) is kind
    assert str(tmp_path) in str(caught.value)


def test_a_text_may_be_large_but_not_endless(tmp_path, monkeypatch):
    write_text_form(tmp_path, CLIPS)
    texts, size = clips.TextClips(tmp_path), (tmp_path / TEXT).stat().st_size
    monkeypatch.setattr(clips, "MOST_BYTES", size)
    assert len(texts.clip(BAD).timestamps) == 4
    monkeypatch.setattr(clips, "MOST_BYTES", size - 1)
    with pytest.raises(DataError) as caught:
        texts.clip(BAD)
    assert_refusal(caught.value, UnreadableFile, tmp_path / TEXT, BAD, None)


def test_the_catalogues_are_complete():
    assert (len(BAD_CLIPS), len(BAD_TEXTS), len(BAD_SETS)) == (20, 15, 7)
