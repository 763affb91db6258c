"""The panels of a workspace on Weights & Biases, by section, in the order in which they are to be pinned."""

from dataclasses import dataclass
from itertools import groupby

from rich.table import Table

STAGE1, STAGE2, TEST, MODES = "stage 1", "stage 2", "test", "hidden modes"
FIT = (STAGE1, STAGE2)
TESTED = (STAGE1, STAGE2, TEST)
"""`fit` ends with a test."""


@dataclass(frozen=True)
class Panel:
    """What runs log by keys that match `keys` (`*` stands for anything), and which runs do.

    `needs` is what a run must have besides, if anything.
    """

    section: str
    keys: str
    kind: str
    shows: str
    runs: tuple[str, ...]
    needs: str = ""


PANELS = [
    Panel("Learning", "train/loss", "line", "loss in total", FIT),
    Panel("Learning", "val/psnr_novel", "line", "PSNR of novel views, validation scenes, dB", FIT),
    Panel("Learning", "train/mse", "line", "term of the loss", (STAGE1,)),
    Panel("Learning", "train/ssim", "line", "term of the loss", (STAGE1,)),
    Panel("Learning", "train/kl", "line", "term of the loss", (STAGE1,), "a variational model"),
    Panel("Learning", "train/lpips", "line", "term of the loss", (STAGE1,), "loss=stage2"),
    Panel("Learning", "train/loss_t*", "line", "loss by quarter of the timesteps, 0 the least noise", (STAGE2,)),
    Panel("Pictures", "pictures", "image", "input, target, render, error, depth, opacity, each layer", FIT),
    Panel("Pictures", "samples", "image", "several samples from the reference and the targets, depth", (STAGE2,)),
    Panel("Pictures", "denoising", "image", "one sample while it is denoised", (STAGE2,)),
    Panel("Samples", "samples/psnr", "line", "mean over samples, dB", (STAGE2,)),
    Panel("Samples", "samples/psnr_of_mean", "line", "of the mean picture, dB", (STAGE2,)),
    Panel("Samples", "samples/diversity", "line", "pairwise difference of samples", (STAGE2,)),
    Panel("Gaussians", "histograms/opacity", "histogram", "opacities", FIT),
    Panel("Gaussians", "histograms/log10_scale", "histogram", "scales, decimal logarithm", FIT),
    Panel("Gaussians", "histograms/depth", "histogram", "depths, scene units", FIT),
    Panel("Gaussians", "gaussians/opacity_p*", "line", "percentiles", FIT),
    Panel("Gaussians", "gaussians/log10_scale_p*", "line", "percentiles", FIT),
    Panel("Gaussians", "gaussians/depth_p*", "line", "percentiles", FIT),
    Panel("Latents", "latent/bits", "line", "KL of a scene's latent, bits", (STAGE1,), "a variational model"),
    Panel("Latents", "latent/bits_*", "line", "the same of each channel", (STAGE1,), "a variational model"),
    Panel("Latents", "latent/active_channels", "line", "active channels", (STAGE1,), "a variational model"),
    Panel("Latents", "latent_scale", "line", "factor that gives latents unit deviation", (STAGE2,)),
    Panel("Latents", "latents/std", "line", "deviation of all channels", (STAGE2,)),
    Panel("Latents", "latents/std_*", "line", "deviation of each channel", (STAGE2,)),
    Panel("Latents", "latents/mean_*", "line", "mean of each channel", (STAGE2,)),
    Panel("Speed", "speed/scenes_per_second", "line", "of all processes", FIT),
    Panel("Speed", "speed/data_wait", "line", "share of the time", FIT),
    Panel("Speed", "memory/process_gb", "line", "GiB", FIT, "Linux"),
    Panel("Speed", "memory/gpu_gb", "line", "GiB", FIT, "a GPU"),
    Panel("Test", "test/model/*", "line", "scores by region, view and metric", TESTED),
    Panel("Test", "test/best_of_k/*", "line", "scores of the best sample", (STAGE2, TEST), "several samples"),
    Panel("Test", "test/mean_of_k/*", "line", "mean scores of the samples", (STAGE2, TEST), "several samples"),
    Panel("Test", "test/mean_image/*", "line", "scores of the training set's mean picture", TESTED),
    Panel("Test", "test/copy_reference/*", "line", "scores of the input itself", TESTED),
    Panel("Test", "test/scenes", "table", "by scene: input, truth, samples, depth, turntable, scores", TESTED),
    Panel("Test", "test/turntables", "video", "the first sample of each scene", TESTED),
    Panel("Test", "test/predictors", "table", "scores of the model beside naive predictors", TESTED),
    Panel("Test", "report/*", "table", "the paper's tables with this run, or tables of its protocol", TESTED),
    Panel("Hidden modes", "hidden_modes", "image", "the figure of test evaluation=hidden_modes", (MODES,)),
    Panel("Hidden modes", "hidden_modes/*", "line", "coverage, total variation, ... of each method", (MODES,)),
]


def layout() -> Table:
    """The panels by section; the horizontal axis of lines is `trainer/global_step`, by default."""
    table = Table(title="Panels to pin, over trainer/global_step, grouped by group", title_justify="left")
    for heading in ("section", "panel", "kind", "shows", "logged by"):
        table.add_column(heading, no_wrap=heading != "shows")
    for section, panels in groupby(PANELS, lambda panel: panel.section):
        for index, panel in enumerate(panels):
            runs = ", ".join(panel.runs) + (f" with {panel.needs}" if panel.needs else "")
            table.add_row("" if index else section, panel.keys, panel.kind, panel.shows, runs)
        table.add_section()
    return table
