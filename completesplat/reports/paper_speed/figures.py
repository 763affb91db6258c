"""What the paper says about its speed, and what is aimed at."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A duration in ms: of the paper, on an A100, and what is aimed at on a newer GPU."""

    text: str
    paper_ms: float | None
    aim_ms: float | None

    def durations(self) -> dict[str, float | None]:
        """For the row of a table."""
        return {"paper_ms": self.paper_ms, "aim_ms": self.aim_ms}


FIGURES = {
    "reconstruct": Figure("encode and reconstruct a picture", 15.7, 5),  # Table 2, "Ours - AutoReconstructor"
    "sample": Figure("draw a sample", 2_700, 500),  # Table 2, "Ours - Diffusion single sample"
    "samples": Figure("draw all samples at once", 54_000, 2_000),  # Table 2, "20-best oracle"
    "render": Figure("render 100 views of a scene", 29.1, 5),  # Table 2; the paper does not say how many views
    "stage1_step": Figure("training step of stage 1", None, None),
    "stage2_step": Figure("training step of stage 2", 157, None),  # supplement: 1,100,000 steps in 2 days
}
