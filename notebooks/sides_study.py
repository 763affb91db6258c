"""What makes sides and backs sharp: short trainings with one change each (experiments.md, "Sides and backs").

python notebooks/sides_study.py train SCANS WEIGHTS OUT [steps=50] [steps2=50] [runs=start-0,control-0,...]
python notebooks/sides_study.py table OUT

SCANS is a folder of captures with splits.json, whose "train" and "val" are used, WEIGHTS the weights to start from. The
run `start` continues them at 64 px, and all others continue from its weights. Each run appends one line to
OUT/results.jsonl when it is done, and is skipped when it has one. All runs of a stage have equally many steps, and the
same random numbers in each step where they draw the same. Stage 2 takes stage 1 of its row's first seed, so that
latents are encoded once.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean

import sides_changes as changes
import torch
from lightning import Trainer

import completesplat
from completesplat.data.loading.view_selection import spread_around
from completesplat.evaluation.regions import object_only
from completesplat.geometry.cameras import nearest_to_axes
from completesplat.metrics.images import psnr, sharpness
from completesplat.sampling_settings import Sampling
from completesplat.scene import CachedScene
from completesplat.tensors import stack
from completesplat.training.callbacks import StepSeeds
from completesplat.training.latent_diffusion import LatentDiffusion

ENCODED = 6  # views that the posterior sees of a validation scan
OBJECT_RADIUS = 0.9  # scene units around the cameras' common point; an object's half size is 0.57
SIDES = {"aside": (30, 100), "behind": (100, 181)}  # degrees between optical axes
REFERENCES = 1  # latents of a training object
LEVELS = 8  # noise levels of the denoiser's validation loss
SAMPLES = 2
SETTINGS = [
    "data.image_size=64",
    "data.workers=0",
    "data.batch_size=4",
    "data.evaluation_targets=null",
    "autoreconstructor.reconstructor.parameterization.within_range=true",
    "schedule.warmup_steps=10",
]
STAGE1 = [
    "experiment=anything_var",
    "loss=things",
    "loss.terms.silhouettes=null",
    "data.random_background=0.5",
    *SETTINGS,
]
STAGE1 += ["optimizer.lr=2.5e-3", "optimizer.adam_lr=7.5e-4"]
STAGE2 = ["experiment=anything_diffusion", *SETTINGS, "model.autoreconstructor_checkpoint=null"]
STAGE2 += ["optimizer.lr=7e-3", "optimizer.adam_lr=2e-3"]
STAGE2_BATCH = 16


class OnCachedLatents(LatentDiffusion):
    """Stage 2 on latents that are given with their moments."""

    def on_fit_start(self):
        """Measure nothing."""


# name: (item of the issue, change). Stage 2: name: (item, stage 1's row, refined latents, change of the networks).
FIRST: dict[str, tuple[str, Callable]] = {
    "start": ("", changes.unchanged),
    "control": ("", changes.unchanged),
    "silhouettes": ("c", changes.silhouettes),
    "noisy_latents": ("b", changes.noisy_latents),
    "spread_of_views": ("e", changes.spread_of_views),
    "eight_channels": ("g", changes.eight_channels),
    "patch_discriminator": ("d", changes.patch_discriminator),
}
SECOND: dict[str, tuple[str, str, bool, Callable]] = {
    "control2": ("", "control", False, lambda parts: None),
    "refined_latents": ("a", "control", True, lambda parts: None),
    "encoder_features": ("f", "control", False, changes.encoder_features),
    "noisy_latents2": ("b", "noisy_latents", False, lambda parts: None),
}


# Controls first, then one seed of everything, so that a queue that is cut off says most.
CONTROLS = ["start-0", "control-0", "control-1"]
CHANGED = ["silhouettes", "noisy_latents", "spread_of_views", "eight_channels", "patch_discriminator"]
RUNS = CONTROLS + [f"{name}-{seed}" for seed in (0, 1) for name in CHANGED]
RUNS += [f"{name}-{seed}" for seed in (0, 1) for name in ("control2", "encoder_features")]
RUNS += [f"{name}-{seed}" for name in ("noisy_latents2", "refined_latents") for seed in (0, 1)]


class Study:
    """Data, weights to start from and results of all trainings.

    Args:
        scans, weights, out: folders, or a name of shipped weights.
        steps, steps2: optimizer steps of each training of stage 1 and of stage 2.
    """

    def __init__(self, scans, weights, out, steps, steps2):
        self.out = Path(out)
        self.out.mkdir(parents=True, exist_ok=True)
        self.root = f"data.root={scans}"
        self.start = completesplat.CompleteSplat.from_pretrained(weights)
        self.steps = steps
        self.steps2 = steps2
        self.config = completesplat.compose("fit", *STAGE1, self.root, "out=unused")
        self.data, _ = completesplat.instantiate(self.config)
        self.data.setup("fit")
        for split in ("train", "val"):
            store = self.data.store(split)
            for name in store.names:
                sequence = store.source.read(name)
                for view in range(len(sequence.frames)):
                    store.image(sequence, view)
        self.validation = self.scenes("val", (0, 12))

    def scenes(self, split, references):
        """Return scenes of all objects of a split. The first targets are those that the posterior may see."""
        store = self.data.store(split)
        scenes = []
        for name in store.names:
            sequence = store.source.read(name)
            frames = len(sequence.frames)
            for reference in references:
                seen = spread_around(frames, reference, ENCODED)
                rest = [view for view in range(frames) if view != reference and view not in seen]
                scenes.append(store.scene(sequence, reference, seen + rest))
        return scenes

    def trainer(self, steps, seed, **settings):
        """Return a trainer that writes nothing."""
        return Trainer(
            max_steps=steps,
            callbacks=[StepSeeds(seed)],
            precision=self.config.trainer.precision,
            gradient_clip_val=1.0,
            limit_val_batches=0,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            **settings,
        )

    def first_module(self, name, seed):
        """Return stage 1's module with its change and the weights to start from."""
        torch.manual_seed(seed)
        _, module = completesplat.instantiate(self.config)
        if name == "start":
            module.model.load_state_dict(self.start.autoreconstructor.state_dict())
        else:
            module.model.load_state_dict(torch.load(self.out / "start-0.pt", weights_only=True))
        FIRST[name][1](module, self.steps)
        return module

    def train_first(self, name, seed):
        """Train stage 1, keep its weights and return its scores."""
        module = self.first_module(name, seed)
        self.data.seed = seed
        before = time.process_time()
        self.trainer(self.steps, seed).fit(module, datamodule=self.data)
        seconds = (time.process_time() - before) / max(1, self.steps)
        model = module.model.eval()
        torch.save(model.state_dict(), self.out / f"{name}-{seed}.pt")
        return {"seconds_a_step": seconds, **self.posterior_scores(module)}

    @torch.no_grad()
    def posterior_scores(self, module):
        """Return the scores of the posterior's mean on views that it did not see."""
        drawn = []
        for scene in self.validation:
            batch = stack([scene])
            views = batch.all_views()[:, : 1 + ENCODED]
            image = module.model.eval()(batch.reference.images, views, batch.depth_range).splatter_image
            gaussians = image.gaussians(batch.reference.cameras, batch.depth_range)
            drawn.append(self.rendered(module, gaussians, scene))
        return scores(drawn)

    def rendered(self, module, gaussians, scene):
        """Return true views that the posterior does not see, and of each sample its images and the object's opacity."""
        truth = scene.targets[ENCODED:]
        images = module.render_from(gaussians, truth.cameras).over(module.background)
        near = near_object(gaussians, truth.cameras.repeated(len(gaussians.means)))
        return truth, images.clamp(0, 1), module.render_from(near, truth.cameras).alpha

    def latents(self, stage1, split, references, refined):
        """Return encoded scenes of a split, which are kept in a file."""
        file = self.out / f"latents-{stage1}-{split}{'-refined' if refined else ''}.pt"
        if not file.exists():
            module = self.first_module(stage1, 0)
            module.model.load_state_dict(torch.load(self.out / f"{stage1}-0.pt", weights_only=True))
            module.eval().requires_grad_(False)
            encoded = [self.encoded(module, scene, refined) for scene in self.scenes(split, references)]
            torch.save([vars(scene) for scene in encoded], file)
        return [CachedScene(**fields) for fields in torch.load(file, weights_only=True)]

    def encoded(self, module, scene, refined):
        """Return a scene's posterior, whose mean may go 8 gentle steps towards what renders all views best."""
        batch = stack([scene])
        views = batch.all_views()[:, : 1 + ENCODED]
        model = module.model
        posterior, features = model.posterior(batch.reference.images, views, batch.depth_range)
        latent = posterior.mean.clone().requires_grad_()
        optimizer = torch.optim.Adam([latent], lr=0.02)
        for _ in range(8 if refined else 0):
            gaussians = model.reconstructor(latent, features).gaussians(batch.reference.cameras, batch.depth_range)
            drawn = module.rasterizer(gaussians, views.cameras).over(module.background)
            optimizer.zero_grad()
            (drawn - views.images).square().mean().backward()
            optimizer.step()
        fields = (latent.detach()[0], posterior.log_variance[0], scene.reference.images)
        return CachedScene(*fields, scene.reference_frame, scene.names)

    def second_module(self, name, cached):
        """Return stage 2's module with its change, the weights to start from and the latents' moments."""
        stage1, change = SECOND[name][1], SECOND[name][3]
        config = completesplat.compose("fit", *STAGE2, self.root, "out=unused")
        config.model._target_ = f"{__name__}.OnCachedLatents"
        _, module = completesplat.instantiate(config)
        parts = module.completesplat
        parts.load_state_dict(self.start.state_dict())
        parts.autoreconstructor.load_state_dict(torch.load(self.out / f"{stage1}-0.pt", weights_only=True))
        means = torch.stack([scene.mean for scene in cached])
        variance = means.var((0, 2, 3)) + torch.stack([scene.log_variance for scene in cached]).exp().mean((0, 2, 3))
        parts.set_latent_moments(means.mean((0, 2, 3)).tolist(), variance.sqrt().tolist())
        change(parts)
        return module

    def train_second(self, name, seed):
        """Train stage 2 and return the denoiser's loss and the scores of samples, each counted by itself."""
        _, stage1, refined, _ = SECOND[name]
        cached = self.latents(stage1, "train", range(0, 24, 24 // REFERENCES), refined)
        held_out = self.latents(stage1, "val", (0, 12), refined)
        torch.manual_seed(seed)
        module = self.second_module(name, cached)
        order = torch.Generator().manual_seed(seed)
        loader = torch.utils.data.DataLoader(cached, STAGE2_BATCH, True, collate_fn=stack, generator=order)
        before = time.process_time()
        self.trainer(self.steps2, seed).fit(module, loader)
        seconds = (time.process_time() - before) / max(1, self.steps2)
        module.eval()
        return {"seconds_a_step": seconds, "loss": self.loss(module, held_out), **self.sample_scores(module)}

    @torch.no_grad()
    def loss(self, module, held_out):
        """Return the mean error of the denoiser on held-out latents, with fixed noise at evenly spaced levels."""
        parts = module.completesplat
        batch = stack(held_out)
        latent = parts.standardised(batch.mean)
        noise = torch.randn(latent.shape, generator=torch.Generator().manual_seed(0))
        conditioning = parts.conditioning(batch.condition)
        errors = []
        for level in range(LEVELS):
            timestep = torch.full((len(latent),), (2 * level + 1) * 1000 // (2 * LEVELS))
            noisy = parts.sampler.add_noise(latent, noise, timestep)
            errors.append((parts.denoiser(noisy, timestep, conditioning) - (noise - latent)).square().mean().item())
        return mean(errors)

    @torch.no_grad()
    def sample_scores(self, module):
        """Return the scores of samples, on the views that the posterior's are measured on."""
        drawn = []
        for scene in self.validation:
            batch = stack([scene])
            inputs = (batch.reference.images, batch.reference.cameras, batch.depth_range)
            gaussians = module.completesplat.generate(*inputs, Sampling(samples=SAMPLES, seed=0))
            drawn.append(self.rendered(module, gaussians, scene))
        return scores(drawn)

    def run(self, name, seed):
        """Train and score one run, and append its line."""
        print(name, seed, flush=True)
        steps, train = (self.steps, self.train_first) if name in FIRST else (self.steps2, self.train_second)
        row = {"name": name, "seed": seed, "steps": steps, **train(name, seed)}
        print(json.dumps(row), flush=True)
        with (self.out / "results.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")


def near_object(gaussians, cameras):
    """Return Gaussians [batch] whose opacity is 0 unless they are near the point that cameras [batch view] look at.

    A background is painted by Gaussians, too, so the opacity of all of them says nothing about the object.
    """
    count = len(cameras.world_to_camera)
    centers = torch.stack([nearest_to_axes(cameras[scene]) for scene in range(count)]).float()
    near = (gaussians.means - centers[:, None]).norm(dim=-1) < OBJECT_RADIUS
    return replace(gaussians, opacities=gaussians.opacities * near)


def scores(drawn):
    """Return PSNR of all pixels and with a black background, sharpness and object's opacity within masks, by side."""
    results = {}
    for side, (least, most) in SIDES.items():
        true, images, alphas = [], [], []
        for views, rendered, opacity in drawn:
            angles = torch.rad2deg(views.cameras.world_to_camera[:, 2, 2].clamp(-1, 1).acos())
            chosen = (angles > least) & (angles <= most)
            for sample in range(len(rendered)):
                true.append(replace(views, cameras=None)[chosen])
                images.append(rendered[sample, chosen])
                alphas.append(opacity[sample, chosen])
        truth = torch.cat([views.images for views in true])
        masks = torch.cat([views.masks for views in true])
        image = torch.cat(images)
        results |= {
            f"psnr_{side}": psnr(image, truth).mean().item(),
            f"object_{side}": psnr(object_only(image, masks), object_only(truth, masks)).mean().item(),
            f"sharpness_{side}": sharpness(image, truth, masks > 0.5),
            f"opacity_{side}": torch.cat(alphas)[masks > 0.5].mean().item(),
        }
    return results


def read_results(out):
    """Return the lines of a study that has begun."""
    file = Path(out) / "results.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def table(out):
    """Print a table for each stage: means over seeds, and by how much they differ from the control.

    The difference is that of runs of one seed, which see the same scenes in the same order: its mean over seeds, and
    half of the distance between its lowest and its highest value. For controls that distance is of the values.
    """
    rows = read_results(out)
    for names, control in ((FIRST, "control"), (SECOND, "control2")):
        controls = {row["seed"]: row for row in rows if row["name"] == control}
        keys = [key for row in rows if row["name"] in names for key in row if key not in ("name", "seed", "steps")]
        keys = list(dict.fromkeys(keys))
        print("| | seeds | " + " | ".join(keys) + " |\n|" + "---|" * (len(keys) + 2))
        for name in names:
            runs = [
                row for row in rows if row["name"] == name and (name in ("start", control) or row["seed"] in controls)
            ]
            if runs:
                cells = [table_cell(runs, {} if name in ("start", control) else controls, key) for key in keys]
                print(f"| {name} {names[name][0]} | {len(runs)} | " + " | ".join(cells) + " |")
        print()


def table_cell(runs, controls, key):
    """Return the mean of runs with its spread, or with the difference from the controls and its spread."""
    digits = 2 if key.startswith(("psnr", "object", "seconds")) else 3
    values = [run[key] for run in runs]
    compared = [run[key] - controls[run["seed"]][key] for run in runs] if controls else values
    spread = (max(compared) - min(compared)) / 2
    shown = f"{mean(values):.{digits}f}"
    around = f" ± {spread:.{digits}f}" if len(runs) > 1 else ""  # one seed has no spread
    return f"{shown} ({mean(compared):+.{digits}f}{around})" if controls else shown + around


def main(verb, *words):
    """Do what the command says."""
    if verb == "table":
        table(*words)
        return
    places = [word for word in words if "=" not in word]
    given = dict(word.split("=", 1) for word in words if "=" in word)
    study = Study(*places, int(given.get("steps", 50)), int(given.get("steps2", 50)))
    for run in given["runs"].split(",") if "runs" in given else RUNS:
        name, seed = run.rsplit("-", 1)
        if not any(row["name"] == name and row["seed"] == int(seed) for row in read_results(study.out)):
            study.run(name, int(seed))


if __name__ == "__main__":
    main(*sys.argv[1:])
