"""Better weights for photos of anything from minutes of one GPU, part by part into one folder: `make gpu-weights`.

python notebooks/gpu_weights.py INPUTS OUT [--minutes 14] [--stage2] [--small]

INPUTS is packed by `gpu_weights_inputs.py`. The parts: data and the GPU's kernels; stage 1 from the weights in INPUTS;
a look at it early on, which may halve the perceptual loss; latents; stage 2; scores on the validation scans. What is
done is not done again. What was cut goes on from its last checkpoint, with the minutes that are left. OUT/results has
weights in files of at most 15 MB as soon as stage 1 is done: cat model.safetensors.? > model.safetensors
"""

import argparse
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

import completesplat
from completesplat.evaluation.provenance import git_commit, machine
from completesplat.evaluation.studies.ladder import BEHIND
from completesplat.evaluation.studies.samples import near_reference
from completesplat.files import write_json
from completesplat.metrics.images import psnr, sharpness
from completesplat.weights.checkpoint_reading import load_part

HERE = Path(__file__).parent
GPU = torch.cuda.is_available()

# Ends of the trainings, as shares of the time after kernels and data, which take two to three minutes. Stage 2's has
# latents in it (50 s); scores follow.
ENDS = {"early": 0.18, "stage1": 0.57, "stage2": 0.91}
START_SECONDS = 20  # in which a training's process begins, and ends
STEPS_A_SECOND = {"early": 7.0, "stage2": 8.8}  # assumed on an H200, until they are measured
PERCEPTUAL = 0.2
# The perceptual weight is halved unless views from behind are so many times as sharp, and lost at most so many dB.
SHARPER, LOST = 1.3, 0.6
PART_BYTES = 15_000_000
CAMERA = ("depth_range", "fov_degrees", "up")

KERNELS = "from completesplat.rasterizers.selection import auto; auto()"
DEPTHS = ["data.depth_before=1", "data.depth_after=3"]
SPLITS = ["data.val_fraction=0.01", "data.test_fraction=0"]  # as the experiments have them; a splits.json decides
WITHIN_RANGE = "autoreconstructor.reconstructor.parameterization.within_range=true"
TRAINING = [WITHIN_RANGE, "callbacks.checkpoint.every_minutes=1", "trainer.val_check_interval=100000", "test=false"]
STAGE1 = ["experiment=anything_var", "loss=things", "data.random_background=0.5", "callbacks.images=null"]
STAGE1 += ["optimizer.lr=2.5e-3", "optimizer.adam_lr=7.5e-4"]
STAGE2 = ["experiment=anything_diffusion", "model.autoreconstructor_checkpoint=null", "callbacks.images=null"]
STAGE2 += ["optimizer.lr=7e-3", "optimizer.adam_lr=2e-3", "callbacks.samples=null"]


class Sizes(NamedTuple):
    """Sizes of images, batches and data; for trainings that do not end by time, their last steps."""

    image: int
    batch1: int
    batch2: int
    solids: int
    frames: int
    last_steps: dict[str, int]


WHOLE = Sizes(image=128, batch1=32, batch2=64, solids=1500, frames=6, last_steps={})
LAST_STEPS = {"early": 4, "stage1": 10, "stage2": 6}
SMALL = Sizes(image=32, batch1=2, batch2=2, solids=2, frames=2, last_steps=LAST_STEPS)


class Clock:
    """Seconds that a folder's parts have had, also in runs that were cut, and all that they may have."""

    def __init__(self, out: Path, minutes: float) -> None:
        self.file = out / "seconds.txt"
        self.data_file = out / "data_seconds.txt"
        self.whole = 60 * minutes
        before = float(self.file.read_text()) if self.file.is_file() else 0.0
        self.begun = time.monotonic() - before

    def seconds(self) -> float:
        """Return the seconds so far, and store them."""
        so_far = time.monotonic() - self.begun
        unfinished = self.file.with_suffix(".unfinished")
        unfinished.write_text(f"{so_far:.1f}")
        unfinished.replace(self.file)
        return so_far

    def end_data(self) -> None:
        """Store that the data have taken the time so far."""
        self.data_file.write_text(f"{self.seconds():.1f}")

    def left_until(self, share: float) -> float:
        """Return the seconds until a share of the time after the data is over."""
        data = float(self.data_file.read_text())
        return data + share * (self.whole - data) - self.seconds()


class Lease:
    """The parts, in their order; each raises SystemExit if it fails or is cut.

    Args:
        inputs: folder that `gpu_weights_inputs.py` wrote.
        out: folder of all output.
        stage2_alone: whether stage 1 of the inputs' weights stays as it is, but for one step at a rate of almost 0.
    """

    def __init__(self, inputs: Path, out: Path, minutes: float, sizes: Sizes, stage2_alone: bool) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self.inputs = inputs
        self.out = out
        self.results = out / "results"
        self.sizes = sizes
        self.stage2_alone = stage2_alone
        self.clock = Clock(out, minutes)
        self.size = f"data.image_size={sizes.image}"
        workers = max(0, (os.cpu_count() or 1) - 2) if GPU else 0
        self.training_settings = [*TRAINING, f"data.root={out / 'store'}", self.size, f"data.workers={workers}"]
        if GPU:
            self.training_settings += ["rasterizer=cuda", "+trainer.benchmark=true"]

    def is_done(self, part: str) -> bool:
        return (self.out / f"{part}.txt").is_file()

    def run(self, part: str, *arguments: object) -> None:
        """Run Python with these arguments, unless the part is done; what it prints is in `PART.txt` when it is."""
        if self.is_done(part):
            return
        log = self.out / f"{part}.unfinished.txt"
        begun = time.monotonic()
        with log.open("a") as written:
            command = [sys.executable, *map(str, arguments)]
            # A group of its own: a second signal, such as one to all of this group, would end a training at once.
            process = subprocess.Popen(command, stdout=written, stderr=subprocess.STDOUT, process_group=0)
        stopped: list[int] = []

        def stop(number: int, frame: object) -> None:
            if not stopped:
                process.terminate()  # a training then saves, and ends
            stopped.append(number)

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        while process.poll() is None:
            self.clock.seconds()
            time.sleep(0.2)
        if process.returncode == 0:
            log.replace(self.out / f"{part}.txt")
            print(f"{part}: {time.monotonic() - begun:.0f} s, all so far {self.clock.seconds():.0f} s", flush=True)
        if stopped or process.returncode != 0:
            sys.exit(f"{part}: {'cut' if stopped else 'failed'}, status {process.returncode}, {log}")
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def verb(self, part: str, *arguments: object) -> None:
        self.run(part, "-m", "completesplat", *arguments, f"out={self.out / part}")

    def data(self) -> None:
        """Unpack the captures, copy those with exact masks onto random colours, add solids, and pack all for training.

        The GPU's kernels are compiled beside it.
        """
        if self.clock.data_file.is_file():
            return
        kernels = subprocess.Popen([sys.executable, "-c", KERNELS if GPU else ""])
        mix = self.out / "mix"
        if not mix.is_dir():
            unfinished = self.out / "mix.unfinished"
            shutil.rmtree(unfinished, ignore_errors=True)
            with tarfile.open(self.inputs / "captures.tar.gz") as packed:
                packed.extractall(unfinished, filter="data")
            unfinished.rename(mix)
        names = json.loads((self.inputs / "captures.json").read_text())
        self.run("solids", HERE / "shapes.py", mix, self.sizes.solids, 647, self.sizes.image)
        colored = copies_on_colors(mix, names["scans"])
        solids = [f"{index:05d}" for index in range(self.sizes.solids)]
        train = names["scans"] + names["more"] + colored + solids
        write_json(mix / "splits.json", {"train": train, "val": names["val"], "test": []})
        packing = ["data=captures", f"data.root={mix}", self.size, *DEPTHS, *SPLITS, "splits=[train,val]"]
        self.verb("store", "data", "prepare", *packing, *([] if GPU else ["workers=1"]))
        while kernels.poll() is None:
            self.clock.seconds()
            time.sleep(0.2)
        self.clock.end_data()

    def training(self, part: str, settings: list[str], first: Path | None = None, schedule: str | None = None) -> None:
        """Train until the part's time is over.

        Args:
            first: checkpoint of another run that this one goes on from.
            schedule: part at whose end the schedule ends; None: at this one's. Its steps are those that the measured
                steps a second allow, or, before the first checkpoint, the assumed ones.
        """
        if self.is_done(part):
            return
        last = self.out / part / "checkpoints/last.ckpt"
        before = last if last.is_file() else first
        steps, seconds = progress_of(before) if before is not None else (0, 0.0)
        rate = steps / seconds if seconds > 0 else STEPS_A_SECOND[part]
        left = self.left_of(part)
        planned = steps + max(1, round(rate * self.left_of(schedule or part)))
        settings = [*self.training_settings, *settings]
        settings.append(f"trainer.max_steps={self.sizes.last_steps.get(part, planned)}")
        settings.append(f"trainer.max_time='{clock_time(seconds + left)}'")
        if before is not None:
            settings.append("ckpt_path=last" if before == last else f"ckpt_path='{before}'")
        self.verb(part, "fit", *settings)

    def left_of(self, part: str) -> float:
        """Return the seconds that are left for a training, at least one."""
        return max(1.0, self.clock.left_until(ENDS[part]) - START_SECONDS)

    def stage1(self) -> None:
        """Train stage 1 from the inputs' weights, and look at it when it has had a while."""
        start = self.out / "start1.ckpt"
        runpy.run_path(str(HERE / "starts.py"))["main"](self.inputs, start)
        settings = [*STAGE1, f"data.batch_size={self.sizes.batch1}", f"model.checkpoint={start}"]
        early = self.out / "early/checkpoints/last.ckpt"
        if self.stage2_alone:
            self.verb("stage1", "fit", *self.training_settings, *settings, "trainer.max_steps=1", "ckpt_path=last")
            return
        self.training("early", settings, schedule="stage1")
        weight = self.perceptual_weight(start, early)
        self.training("stage1", [*settings, f"loss.terms.efficientnet.weight={weight}"], early)

    def perceptual_weight(self, start: Path, early: Path) -> float:
        """Return the weight of the perceptual loss after a look at the early checkpoint and at the start."""
        file = self.out / "look.json"
        if not file.is_file():
            settings = [*STAGE1, f"data.root={self.out / 'store'}", self.size, WITHIN_RANGE, "data.workers=0"]
            looks = {name: look(path, settings) for name, path in (("start", start), ("early", early))}
            sharper = looks["early"]["sharpness_behind"] >= SHARPER * looks["start"]["sharpness_behind"]
            lost = looks["start"]["psnr"] - looks["early"]["psnr"]
            write_json(file, looks | {"weight": PERCEPTUAL if sharper and lost <= LOST else PERCEPTUAL / 2})
        return json.loads(file.read_text())["weight"]

    def latents(self) -> None:
        """Encode the training set, without augmentation, which the copies on colours stand for."""
        if not self.is_done("latents"):
            shutil.rmtree(self.out / "latents", ignore_errors=True)
        changes = "overrides=['data.horizontal_flip=false','data.random_background=0']"
        encoding = [f"ckpt={self.out / 'stage1/checkpoints/last.ckpt'}", f"frames={self.sizes.frames}"]
        self.verb("latents", "data", "latents", *encoding, "precision=float16", changes)

    def stage2(self) -> None:
        """Train stage 2 on stage 1's latents, from the inputs' denoiser."""
        start = self.out / "start2.ckpt"
        runpy.run_path(str(HERE / "starts.py"))["main"](self.inputs, start, self.out / "stage1")
        settings = [*STAGE2, f"data.batch_size={self.sizes.batch2}", f"model.checkpoint={start}"]
        self.training("stage2", [*settings, f"data.latent_cache={self.out / 'latents'}"])

    def export(self, trained: dict[str, torch.Tensor]) -> None:
        """Write the inputs' weights with trained tensors in their place, whole and in small files."""
        weights = self.out / "weights"
        for folder in (weights, self.results):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            shutil.copy(self.inputs / "config.json", folder)
        tensors = {}
        for name, before in load_file(self.inputs / "model.safetensors").items():
            tensors[name] = before if name in CAMERA else trained.get(name, before).to(before.dtype).contiguous()
        save_file(tensors, weights / "model.safetensors", metadata={"format": "pt"})
        content = (weights / "model.safetensors").read_bytes()
        for number, first in enumerate(range(0, len(content), PART_BYTES)):
            (self.results / f"model.safetensors.{number}").write_bytes(content[first : first + PART_BYTES])
        facts = machine() | {"commit": git_commit(), "seconds": round(self.clock.seconds())}
        for part in ("stage1", "stage2"):
            if self.is_done(part):
                facts[part] = progress_of(self.out / part / "checkpoints/last.ckpt")._asdict()
        if (self.out / "look.json").is_file():
            facts["look"] = json.loads((self.out / "look.json").read_text())
        write_json(self.results / "facts.json", facts)

    def scores(self) -> None:
        """Test the weights on the captures that training kept for validation."""
        names = json.loads((self.inputs / "captures.json").read_text())
        write_json(self.out / "scored.json", {"train": [], "val": [], "test": names["val"]})
        scored = ["data=captures", f"data.root={self.out / 'mix'}", f"data.splits={self.out / 'scored.json'}", *DEPTHS]
        self.verb("test", "test", f"weights={self.out / 'weights'}", *scored, self.size, "data.workers=0")
        shutil.copy(self.out / "test/metrics.json", self.results)

    def all_parts(self) -> None:
        self.data()
        self.stage1()
        if not self.is_done("stage2"):
            state = torch.load(self.out / "stage1/checkpoints/last.ckpt", map_location="cpu", weights_only=True)
            first = {name.replace("model.", "autoreconstructor.", 1): x for name, x in state["state_dict"].items()}
            self.export(first)
        self.latents()
        self.stage2()
        if not self.is_done("test"):
            self.export(load_file(self.out / "stage2/weights/model.safetensors"))
        self.scores()


class Progress(NamedTuple):
    """Steps of a training, and the seconds in which it took them."""

    steps: int
    seconds: float


def progress_of(checkpoint: Path) -> Progress:
    """Read how far a training is from its checkpoint."""
    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    timer = content["callbacks"].get("Timer", {"time_elapsed": {"train": 0.0}})
    return Progress(content["global_step"], round(timer["time_elapsed"]["train"], 1))


def clock_time(seconds: float) -> str:
    """Return seconds as DD:HH:MM:SS, as Lightning's `max_time` takes them."""
    return time.strftime("00:%H:%M:%S", time.gmtime(max(1, seconds)))


def copies_on_colors(mix: Path, names: list[str]) -> list[str]:
    """Copy every second capture with one random colour behind its masks; the names of the copies.

    Latents have no augmentation, so these are the random backgrounds of stage 2.
    """
    generator = np.random.default_rng(648)
    copies = []
    for name in names[::2]:
        copy = f"color_{name}"
        copies.append(copy)
        color = generator.uniform(0, 255, 3)
        shutil.rmtree(mix / copy, ignore_errors=True)
        shutil.copytree(mix / name, mix / copy)
        for frame in json.loads((mix / copy / "transforms.json").read_text())["frames"]:
            file = mix / copy / frame["file_path"]
            mask = np.array(Image.open(mix / copy / frame["mask_path"]))[..., None] / 255
            image = np.rint(np.array(Image.open(file)) * mask + color * (1 - mask)).astype(np.uint8)
            Image.fromarray(image).save(file, "WEBP", quality=90, method=0)
    return copies


@torch.no_grad()
def look(checkpoint: Path, settings: list[str]) -> dict[str, float]:
    """Return means over validation of what stage 1 makes of every second view, in the views between.

    `psnr` is in dB over all of them, `sharpness_behind` the gradient energy over the truth's, within the masks of those
    more than `BEHIND` degrees from the reference.
    """
    data, module = completesplat.instantiate(completesplat.compose("fit", *settings, "data.evaluation_batch_size=1"))
    data.setup("fit")
    load_part(module.model, checkpoint, prefix="model.")
    module.eval().to("cuda" if GPU else "cpu")
    qualities, sharp = [], []
    for scenes in data.val_dataloader():
        scenes = scenes.map(lambda tensor: tensor.to(module.device))
        seen = replace(scenes, targets=scenes.targets[:, ::2])
        between = scenes.targets[:, 1::2]
        splats = module(seen, seen.targets.images.shape[1]).splatter_image
        gaussians = splats.gaussians(scenes.reference.cameras, scenes.depth_range)
        images = module.rasterizer(gaussians, between.cameras).over(module.background)[0].clamp(0, 1)
        views = between[0]
        qualities.append(psnr(images, views.images).mean().item())
        behind = ~near_reference(scenes.reference.cameras[0], views.cameras, BEHIND)
        found = sharpness(images[behind], views.images[behind], views.masks[behind] > 0.5) if behind.any() else None
        if found is not None:
            sharp.append(found)
    return {"psnr": float(np.mean(qualities)), "sharpness_behind": float(np.mean(sharp)) if sharp else 0.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=14)
    parser.add_argument("--stage2", action="store_true", help="keep stage 1 of the inputs' weights")
    parser.add_argument("--small", action="store_true", help="tiny sizes, on any machine")
    options = parser.parse_args()
    sizes = SMALL if options.small else WHOLE
    Lease(options.inputs.resolve(), options.out.resolve(), options.minutes, sizes, options.stage2).all_parts()


if __name__ == "__main__":
    main()
