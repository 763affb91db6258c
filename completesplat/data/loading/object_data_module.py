"""Base class of data modules whose cameras surround an object."""

from typing import Any

import numpy as np

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.view_selection import Choice, ObjectViews
from completesplat.data.placement import ObjectFraming
from completesplat.data.sequences import PosedSequence
from completesplat.quantities import Positive


class ObjectDataModule(SceneDataModule):
    """Scenes of objects that the cameras surround.

    Training draws a random reference and other frames of a sequence. Validation and test take a sequence's first frame
    as the reference and other frames as targets.

    Args:
        evaluation_targets: at most this many evenly spaced targets of a test scene; None: all other frames.
        validation_targets: the same for a validation scene; None: as for a test scene.
        spread_targets: spread the training targets evenly around the reference (the sequence taken as a ring), in
            random order, for a posterior that sees them; false: draw random targets.
        depth_before, depth_after: depth range in front of and behind the centre of the object, whose half size is 0.57.
        **settings: of `SceneDataModule`.
    """

    def __init__(
        self,
        root: str,
        evaluation_targets: Positive | None = None,
        validation_targets: Positive | None = None,
        spread_targets: bool = False,
        depth_before: float = 2.0,
        depth_after: float = 2.0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        self.framing = ObjectFraming(self.image_size, depth_before, depth_after)
        self.views = ObjectViews(self.targets, spread_targets, evaluation_targets, validation_targets)

    def training_facts(self) -> dict[str, float | list[float]]:
        """Return the facts about training images that weights store, with the depth range around the object."""
        facts = super().training_facts()
        facts["depth_before"] = self.framing.depth_before
        facts["depth_after"] = self.framing.depth_after
        return facts

    def described_views(self, reference: str) -> dict[str, str | None]:
        """Return those facts of `describe` that all data of objects share, given what the reference of a test is."""
        return {
            "crop": "largest square around the principal point",
            "protocol_views": f"reference: {reference}; targets: {self.views.described_targets()}",
        }

    def training_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Draw a random reference and targets at random, or spread around it."""
        return self.views.training(frames, rng)

    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return the first frame as reference and others as targets."""
        return self.views.evaluation(len(sequence.frames), split)
