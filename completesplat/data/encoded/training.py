"""Training items from an encoded store, drawn as those that are read from pictures."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from completesplat.data.augmentation import BoxMasks
from completesplat.data.encoded.store import EncodedStore
from completesplat.data.scenes import Choice, SceneStore, TrainingScenes
from completesplat.errors import CompleteSplatError
from completesplat.scene import EncodedScene


class EncodedTraining(TrainingScenes):
    """The items of `TrainingScenes`, without targets: the same sequence and reference frame for (seed, epoch, index).

    Where all frames were to be encoded, an item with a frame (target views included) that could not be read is
    replaced by the very item that `TrainingScenes` puts in its place. Where only some frames of a sequence were, the
    nearest of those that are there takes the reference's place (the earlier one of two).

    Args:
        encoded: where the items come from.
        store: the training set, whose names and groups tell the order; it is not read.
        choose: (number of a sequence's frames, random generator) -> views.
        box_masks: hide parts of the pictures, as `augment` does; None for none.
        references: items of a sequence in one epoch.

    Raises:
        CompleteSplatError: box masks, but the store holds features instead of pictures.
    """

    def __init__(
        self,
        encoded: EncodedStore,
        store: SceneStore,
        choose: Callable[[int, np.random.Generator], Choice],
        box_masks: BoxMasks | None,
        references: int,
        seed: int,
    ) -> None:
        super().__init__(store, choose, lambda scene, rng: scene, references, seed)
        if box_masks is not None and not encoded.holds_pictures:
            raise CompleteSplatError(
                "data.box_masks cannot hide parts of encoded features: use data.encoded=null, or encode pictures"
            )
        self.encoded = encoded
        self.box_masks = box_masks

    def draw(self, name: str, rng: np.random.Generator) -> EncodedScene:
        """An encoded reference frame of the sequence of this name.

        Raises:
            DataError: it is not in the store.
        """
        sequence = self.encoded.sequences[name]
        if not sequence.frames:
            raise self.encoded.missing(name)
        reference, targets = self.choose(sequence.frames, rng)
        if self.encoded.origin.frames is not None and sequence.stored:
            stored = np.array(sequence.stored)
            reference = int(stored[np.abs(stored - reference).argmin()])
        elif missing := {reference, *targets}.difference(sequence.stored):
            raise self.encoded.missing(name, min(missing))
        scene = self.encoded.scene(name, reference)
        if self.box_masks is None:
            return scene
        boxes_rng = rng.spawn(3)[2]  # the third, as in `augment`
        height, width = scene.condition.shape[-2:]
        visible = self.box_masks(height, width, boxes_rng)
        return replace(scene, condition=scene.condition * visible)
