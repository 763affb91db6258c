"""Metrics of images, of sets of images and of samples, and their format in tables."""

from dataclasses import dataclass

PSNR_LIMIT = 100.0
"""Largest reported PSNR (dB). Identical images have an infinite one, and averages must stay finite."""


@dataclass(frozen=True)
class MetricFormat:
    """Format of a metric in tables: its heading, what is better (↑ or ↓) and the number of decimals.

    No value is marked as the best if `better` is empty.
    """

    heading: str
    better: str = ""
    decimals: int = 3

    @property
    def higher_is_better(self) -> bool | None:
        return {"↑": True, "↓": False}.get(self.better)

    def text(self, value: float) -> str:
        return f"{value:.{self.decimals}f}"


METRIC_FORMATS = {
    "psnr": MetricFormat("PSNR", "↑", 2),
    "ssim": MetricFormat("SSIM", "↑"),
    "lpips": MetricFormat("LPIPS", "↓"),
    "fid": MetricFormat("FID", "↓", 1),
    "kid": MetricFormat("KID", "↓", 4),
    "sharpness": MetricFormat("sharpness", "(truth: 1)", 2),  # a blur has less than the truth, noise has more
}
"""Formats of the package's metrics."""
