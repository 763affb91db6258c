"""A public page for a Space of the Hugging Face hub: from an image to complete scenes that turn in the browser.

`python -m completesplat.viewer.space WEIGHTS` opens it on this machine; this folder's README has the Space's files.
"""

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    del sys.path[0]  # as `python -m completesplat` does

import html
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from completesplat.errors import CompleteSplatError
from completesplat.export.prediction import Wanted, write_prediction
from completesplat.files import printable
from completesplat.generator import CompleteSplat
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.selection import auto
from completesplat.scene_model import SceneModel
from completesplat.viewer.sample import Sample

MOST_SAMPLES, MOST_BYTES, HOUR = 4, 32 * 2**20, 3600
SETTINGS = ("samples", "skip_weight", "guidance_weight", "seed")  # of `CompleteSplat`
FRAMES = '<div style="display: flex; flex-wrap: wrap; gap: 8px">{}</div>'
# The sandbox keeps its scripts away from the page around it.
FRAME = '<iframe sandbox="allow-scripts" style="flex: 1 1 320px; height: 360px; border: 0" srcdoc="{}"></iframe>'


def completed(
    model: SceneModel, rasterizer: Rasterizer, image: Path, folder: Path, settings: dict[str, Any]
) -> tuple[str, str, list[str]]:
    """Complete an image; return HTML frames of turning scenes, the path of the contact sheet, and those of other files.

    Raises:
        CompleteSplatError: the image cannot be read, or the model refuses the settings.
    """
    photograph = model.read(image)
    scenes, camera = model(photograph, **settings), model.camera(photograph)
    recorded = {**settings, "image": printable(image.name), "screen_space_dilation": True}
    write_prediction(folder, photograph.image, scenes, camera, rasterizer, model.up, Wanted(videos=()), recorded)
    frames = []
    for i, scene in enumerate(scenes):
        page = folder / f"sample_{i:02}.html"
        write_offline(page, Sample(scene, 1, camera, exact=True), model.up.tolist())
        frames.append(FRAME.format(html.escape(page.read_text(encoding="utf-8"))))
    files = [str(path) for path in sorted(folder.iterdir()) if path.name != "sheet.png"]
    return FRAMES.format("".join(frames)), str(folder / "sheet.png"), files


def write_offline(path: Path, sample: Sample, up: Sequence[float]) -> None:
    """Write a sample as the viewer's offline page through a new server, because a used one keeps earlier scenes."""
    from completesplat.viewer.access import start_server, stop_server
    from completesplat.viewer.page import write_page
    from completesplat.viewer.splat_view import SplatView

    server = start_server(0)
    try:
        SplatView(server, up).show([sample])
        write_page(server, path)
    finally:
        stop_server(server)


def make_space(weights: str) -> Any:
    """Return the page, a `gradio.Blocks`.

    Raises:
        CompleteSplatError: gradio or viser is missing, or `CompleteSplat.from_pretrained` fails.
    """
    try:
        import gradio as gr

        from completesplat.viewer.panel import MOST_SEED
    except ImportError as error:
        raise CompleteSplatError('the Space needs gradio and viser: pip install "completesplat[space]"') from error
    model = CompleteSplat.from_pretrained(weights).to("cuda" if torch.cuda.is_available() else "cpu")
    rasterizer, draws = auto(), model.draws_samples

    def complete(file: str | None, *values: float) -> Iterator[tuple[str, str, list[str]]]:
        if file is None:
            raise gr.Error("Load an image first.")
        settings = dict(zip(SETTINGS, values, strict=True)) if draws else {"samples": 1, "seed": 0}
        with TemporaryDirectory() as folder:
            try:
                # gradio copies the files before it resumes this generator.
                yield completed(model, rasterizer, Path(file), Path(folder), settings)
            except CompleteSplatError as error:
                raise gr.Error(printable(str(error).replace(file, Path(file).name))) from error

    with gr.Blocks(title="completesplat", analytics_enabled=False, delete_cache=(HOUR, HOUR)) as page:
        gr.Markdown(f"# completesplat\nOne image, complete scenes of Gaussian splats; weights: `{weights}`.")
        with gr.Row():
            # The unchanged file, because its EXIF may contain the field of view.
            image = gr.Image(type="filepath", image_mode=None, sources=["upload", "clipboard"], label="Image")
            with gr.Column():
                samples = gr.Slider(1, MOST_SAMPLES, 2, step=1, label="Samples", visible=draws)
                skips = gr.Slider(0, 1, 1, label="Skip weight (1: most faithful)", visible=draws)
                guidance = gr.Slider(0, 1, 0, label="Guidance (more: more diverse)", visible=draws)
                seed = gr.Slider(0, MOST_SEED, 0, step=1, label="Seed", visible=draws)
                draw = gr.Button("Complete", variant="primary")
        scenes, sheet = gr.HTML(), gr.Image(label="Around each sample")
        outputs = [scenes, sheet, gr.Files(label="For other programs")]
        draw.click(complete, [image, samples, skips, guidance, seed], outputs, api_name="complete")
    return page


def main() -> None:
    """Serve the page with the given weights on this machine; the program of a Space calls `make_space`."""
    try:
        if len(sys.argv) != 2:
            raise CompleteSplatError("give the weights: python -m completesplat.viewer.space WEIGHTS")
        make_space(sys.argv[1]).launch(max_file_size=MOST_BYTES)
    except CompleteSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_status)


if __name__ == "__main__":
    main()
