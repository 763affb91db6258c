"""Metrics of images, of image sets and of samples, and their averages over scenes."""

from dataclasses import dataclass

PSNR_LIMIT = 100.0
"""Largest reported PSNR (dB); identical images have an infinite one, and averages must stay finite."""


@dataclass(frozen=True)
class Style:
    """How tables show a metric: heading, what is better (↑ or ↓, else no value is marked as the best) and decimals."""

    heading: str
    better: str = ""
    decimals: int = 3

    @property
    def higher_is_better(self) -> bool | None:
        return {"↑": True, "↓": False}.get(self.better)

    def text(self, value: float) -> str:
        return f"{value:.{self.decimals}f}"


STYLES = {"psnr": Style("PSNR", "↑", 2), "ssim": Style("SSIM", "↑"), "lpips": Style("LPIPS", "↓")}
STYLES |= {"fid": Style("FID", "↓", 1), "kid": Style("KID", "↓", 4), "sharpness": Style("sharpness", "(truth: 1)", 2)}
"""Styles of the package's metrics. Of sharpness a blur has less than the truth and noise has more."""
