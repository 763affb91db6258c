"""Hidden modes of toy objects: all possible colours of the patch, and the frames that show it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from completesplat.data.hidden_modes import LEAK, HiddenModes, Shown, differ, spread_views, views_of_modes
from completesplat.data.images.crop import cut_square, principal_square
from completesplat.data.images.files import to_bytes
from completesplat.data.loading.scenes import Choice, SceneStore, with_true_depths
from completesplat.data.sequences import PosedSequence
from completesplat.data.toy.object_scene import PATCH_COLORS, ToyScene, render_frame
from completesplat.data.toy.raytracing import WHITE, trace
from completesplat.data.toy.writing import FORMAT_VERSION, draw
from completesplat.data.validation import at, field, finite_array, read_json
from completesplat.errors import CompleteSplatError, DataError
from completesplat.geometry.cameras import Cameras, invert_rigid, pinhole, pixel_centers, project, unproject
from completesplat.scene import SceneBatch
from completesplat.tensors import stack

# A ray that stops before a point by more than this share of the point's distance meets a surface in front of it.
CLOSER = 1e-3


def unseen(scene: ToyScene, reference: int, frame: int, size: int) -> Bool[Tensor, "size size"]:
    """Mark the pixels of `frame` whose centre shows a point that is occluded in the reference image or outside it."""
    camera, other = (frame_camera(scene, index, size) for index in (frame, reference))
    depth = torch.from_numpy(render_frame(scene, frame, size)[2]).flatten()
    points = unproject(camera, pixel_centers(size, size, dtype=torch.float64).flatten(0, 1), depth)
    pixels, distance_ahead = project(other, points)
    within = (distance_ahead > 0) & (pixels > 0).all(-1) & (pixels < size).all(-1)
    offsets = points - other.centers
    distances = offsets.norm(dim=-1)
    rays = (offsets / distances[:, None]) @ other.world_to_camera[:3, :3].mT
    pose = scene.camera_to_world[reference]
    met = trace(scene.shapes, scene.light, (scene.dome, scene.patch), pose, rays.numpy()[:, None].copy())[2]
    seen: Tensor = within & (torch.from_numpy(met) > (1 - CLOSER) * distances)
    return ~seen.view(size, size)


def frame_camera(scene: ToyScene, frame: int, size: int) -> Cameras:
    """Return the camera of a frame, float64, in the scene's own units."""
    pose = torch.from_numpy(scene.camera_to_world[frame])
    return Cameras(invert_rigid(pose), pinhole(scene.fov_degrees, size).double(), (size, size))


# Limit of the RMS difference between an image and its render: JPEG causes less, another patch colour more.
SAME_IMAGE = 0.025


@dataclass
class ToyHiddenModes:
    """Scenes of a store with all their modes; see `SceneDataModule.hidden_modes`.

    `folder` is named after a category (a key of `DRAW`) and must hold a complete set of this format version. `choose`
    returns a reference and targets, of which only the reference is used.
    """

    folder: Path
    store: SceneStore
    choose: Callable[[PosedSequence], Choice]
    image_size: int
    views: int
    spread_views: int

    def __post_init__(self) -> None:
        description = self.folder / "toy.json"
        if not description.is_file():
            raise DataError("no toy.json: hidden modes need toy objects as they were written", str(self.folder))
        with at(description):
            parameters = read_json(description)
            if field(parameters, "format", int) != FORMAT_VERSION:
                raise DataError("of another version: write the toy objects again into another folder")
            self.seed, self.frames, self.size = (field(parameters, key, int) for key in ("seed", "frames", "size"))
            self.light = finite_array(parameters.get("light", WHITE), (3,), "light")

    def __len__(self) -> int:
        return len(self.store.names)

    def __getitem__(self, index: int) -> HiddenModes:
        name = self.store.names[index]
        toy, sequence, reference = self._read(name)
        frames = sequence.frames
        behind, truths, region = self._from_behind(toy, name, frames, reference)
        spread = spread_views(len(frames), reference, self.spread_views)
        targets = sorted({*behind, *spread})
        scene = stack([with_true_depths(self.store.scene(sequence, reference, targets), sequence, reference, targets)])
        true_mode, views = list(PATCH_COLORS).index(toy.patch_color), tuple(map(targets.index, behind))
        # The scene that was drawn again must equal the one on the disk.
        drawn = torch.cat([self._render(toy, frames[reference])[None], truths[true_mode]])
        stored = torch.cat([scene.reference.images, scene.targets.images[0, list(views)]])
        if (drawn - stored).square().mean((1, 2, 3)).sqrt().max() > SAME_IMAGE:
            raise self._other_set(name)
        hidden = [unseen(toy, frames[reference], frames[target], self.image_size) for target in targets]
        chances = torch.tensor(toy.chances, dtype=torch.float32)
        return HiddenModes(scene, views, truths, region, chances, torch.stack(hidden), tuple(PATCH_COLORS), true_mode)

    def versions(self, index: int) -> SceneBatch:
        """See `HiddenModeScenes`."""
        toy, sequence, reference = self._read(self.store.names[index])
        spread = spread_views(len(sequence.frames), reference, self.spread_views)
        scene = self.store.scene(sequence, reference, spread)
        truths = torch.stack([self._truths(toy, sequence.frames[view]) for view in spread], dim=1)
        return stack([replace(scene, targets=replace(scene.targets, images=images)) for images in truths])

    def _read(self, name: str) -> tuple[ToyScene, PosedSequence, int]:
        """Return a scene (drawn again), its sequence on the disk, and the index of its reference view."""
        toy, sequence = self._drawn_again(name), self.store.source.read(name)
        reference, _ = self.choose(sequence)
        if differ(self._truths(toy, sequence.frames[reference]), LEAK).any():
            raise DataError("the reference view tells the patch's colour", sequence=name)
        return toy, sequence, reference

    def _drawn_again(self, name: str) -> ToyScene:
        number, _, family = name.partition("_")
        scene = draw(self.folder.name, self.seed, int(number), self.frames, self.light) if number.isdigit() else None
        if scene is None or scene.family != family:
            raise self._other_set(name)
        return scene

    def _other_set(self, name: str) -> CompleteSplatError:
        reason = "is not the scene that toy.json describes: write the set again"
        return CompleteSplatError(f"{self.folder}: {name} {reason}")

    def _truths(self, scene: ToyScene, frame: int) -> Float[Tensor, "mode 3 size size"]:
        """Render a frame in every mode, in the same way as the images of the data set."""
        modes = [scene.patch._replace(color=np.array(color)) for color in PATCH_COLORS.values()]
        return torch.stack([self._render(replace(scene, patch=mode), frame) for mode in modes])

    def _render(self, scene: ToyScene, frame: int) -> Float[Tensor, "3 size size"]:
        """Render a frame as if it was written to disk (without JPEG) and read again."""
        image = Image.fromarray(to_bytes(render_frame(scene, frame, self.size)[0]))
        square = principal_square((self.size / 2, self.size / 2), (self.size, self.size))
        return cut_square(image, square, self.image_size).float() / 255

    def _from_behind(self, scene: ToyScene, name: str, frames: tuple[int, ...], reference: int) -> Shown:
        """Select the most frontal views of the patch."""
        toward = scene.camera_to_world[:, :3, 3] * np.array([1, 0, 1])
        facing = (toward @ scene.patch.facing / np.linalg.norm(toward, axis=-1))[list(frames)]
        views = [view for view in np.argsort(-facing, kind="stable").tolist() if facing[view] > 0 and view != reference]
        return views_of_modes(views, lambda view: self._truths(scene, frames[view]), self.views, name)
