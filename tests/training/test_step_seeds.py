"""What a step draws depends on its place alone."""

import itertools

import torch
from lightning import LightningModule, Trainer

from completesplat.training.callbacks import StepSeeds, step_seed


class Drawer(LightningModule):
    """Draws a number in every step, and before it as many others as it is told."""

    def __init__(self, others: int = 0) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.others = others
        self.drawn: list[float] = []

    def on_train_batch_end(self, *_) -> None:
        torch.rand(self.others)

    def training_step(self, batch, index):
        self.drawn.append(torch.rand(()).item())
        return self.weight**2

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def drawn(seed: int, others: int = 0) -> list[float]:
    """Of three epochs of four batches, of which two share an optimizer step."""
    module = Drawer(others)
    trainer = Trainer(
        max_epochs=3, accumulate_grad_batches=2, accelerator="cpu", logger=False, callbacks=[StepSeeds(seed)],
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, torch.utils.data.DataLoader(range(4), generator=torch.Generator()))
    return module.drawn


def test_every_batch_draws_its_own_numbers_whatever_else_is_drawn():
    first, again, other_seed = drawn(0), drawn(0, others=5), drawn(1)
    assert first == again
    assert len({*first, *other_seed}) == 2 * 12


def test_every_place_has_its_own_seed():
    seeds = {step_seed(*place) for place in itertools.product(range(3), repeat=4)}
    assert len(seeds) == 3**4
    assert all(0 <= seed < 2**64 for seed in seeds)
