"""Samplers against closed forms: equations, and latents whose exact denoiser is known."""

import re
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import product
from threading import Barrier

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, HeunDiscreteScheduler
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support import compose_config

from completesplat.commands import conf_folder
from completesplat.diffusion.sampling import Sampler, with_forward_process
from completesplat.errors import CompleteSplatError
from completesplat.generator import CompleteSplat
from completesplat.settings.schema import check_value

NOISE = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
DDIM = NOISE | {"clip_sample": False, "set_alpha_to_one": True, "timestep_spacing": "trailing"}
NAMES = sorted(p.stem for p in (conf_folder() / "sampler").glob("[!_]*.yaml") if not p.stem.startswith("flow"))
SOLVERS = ["ddim50", "dpm20", "unipc10"]
MEAN = 0.7
STD = 0.5


@cache
def config(name: str):
    return compose_config("fit", f"sampler={name}").sampler


def made(name: str, kind: str = "epsilon") -> Sampler:
    settings = {} if name.startswith("flow") else {"scheduler": {"prediction_type": kind}}
    return instantiate(OmegaConf.merge(config(name), settings), _convert_="all")


@pytest.fixture
def sampler():
    return Sampler(DDIMScheduler(**DDIM))


def alpha_bar() -> torch.Tensor:
    """Eq. 2's product, from the scaled-linear schedule's own definition."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    return torch.cumprod(1 - betas, 0)


def nothing(count: int) -> torch.Tensor:
    return torch.zeros(count, 1, 4, 4)


def gaussian_noise(count: int) -> torch.Tensor:
    return torch.randn(count, 1, 4, 4, generator=torch.Generator().manual_seed(0))


def exact_prediction(kind: str, sigmas: torch.Tensor | None = None):
    """The best prediction for latents N(MEAN, STD^2), in closed form: of E[h | h_t], E[eps | h_t] or both.

    `sigmas`: the solver's own noise levels, one a call, which it rounds to timesteps before it asks.
    """
    levels = iter(() if sigmas is None else sigmas)

    def denoise(latent, timestep, conditioning):
        bar = alpha_bar()[timestep].to(latent).view(-1, 1, 1, 1)
        if sigmas is not None:
            bar = 1 / (1 + next(levels).to(latent) ** 2)
        surplus = (latent - bar.sqrt() * MEAN) / (bar * STD**2 + 1 - bar)
        noise = (1 - bar).sqrt() * surplus
        clean = MEAN + bar.sqrt() * STD**2 * surplus
        velocity = bar.sqrt() * noise - (1 - bar).sqrt() * clean
        return {"epsilon": noise, "sample": clean, "v_prediction": velocity}[kind]

    return denoise


def exact_result(noise: torch.Tensor) -> torch.Tensor:
    """Where the probability flow leads: it keeps a Gaussian's quantiles (h_t's standardised value)."""
    bar = alpha_bar()[999]
    return MEAN + STD * (noise - bar.sqrt() * MEAN) / (bar * STD**2 + 1 - bar).sqrt()


def exact_result_of_solvers(noise: torch.Tensor) -> torch.Tensor:
    """The flow down to the first noise level, and from there E[h | h_0]: solvers of higher order end with this step."""
    first = alpha_bar()[0]
    std = (first * STD**2 + 1 - first).sqrt()
    return MEAN + first.sqrt() * STD**2 / std * (exact_result(noise) - MEAN) / STD


def error(sampler: Sampler, steps: int, exact=exact_result, at_solver: bool = False) -> float:
    noise = torch.linspace(-1.5, 1.5, 16, dtype=torch.float64).view(1, 1, 4, 4)
    sigmas = sampler.set_up(steps).sigmas if at_solver else None
    drawn = sampler(exact_prediction("epsilon", sigmas), noise, nothing(1).double(), steps=steps)
    return (drawn - exact(noise)).abs().max().item()


@pytest.mark.parametrize("name", NAMES)
def test_forward_noising_is_equation_two_and_diffusers_with_every_sampler(name):
    own = made(name)
    assert own.training_timesteps == 1000
    torch.manual_seed(0)
    latent = torch.randn(3, 4, 2, 2)
    noise = torch.randn(3, 4, 2, 2)
    step = torch.tensor([0, 500, 999])
    noisy = own.add_noise(latent, noise, step)
    bar = alpha_bar()[step].view(-1, 1, 1, 1).float()
    torch.testing.assert_close(noisy, bar.sqrt() * latent + (1 - bar).sqrt() * noise, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(noisy, DDPMScheduler(**NOISE).add_noise(latent, noise, step))
    assert torch.equal(own.scheduler.alphas_cumprod, made("ddim50").scheduler.alphas_cumprod)
    assert torch.equal(noisy, made("ddim50").add_noise(latent, noise, step))


def test_one_step_is_ddims_equation(sampler):
    """DDIM (Song et al. 2021, Eq. 12, sigma = 0): from t = 999 straight to the clean latent."""
    torch.manual_seed(0)
    noise = torch.randn(2, 4, 2, 2)
    predicted = torch.randn(2, 4, 2, 2)
    result = sampler(lambda *_: predicted, noise, torch.zeros(2, 1, 2, 2), steps=1)
    last = alpha_bar()[999].float()
    torch.testing.assert_close(result, (noise - (1 - last).sqrt() * predicted) / last.sqrt(), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
@pytest.mark.parametrize("name", SOLVERS)
def test_an_exact_denoiser_gives_the_data_distribution(name, kind):
    own = made(name, kind)
    drawn = own(exact_prediction(kind), gaussian_noise(2000), nothing(2000))
    # Pure noise stands for h_T, of which a little is signal: the mean comes out 0.03 too low even by the exact flow.
    assert abs(drawn.mean() - MEAN) < 0.04
    assert abs(drawn.mean() - exact_result(gaussian_noise(2000)).mean()) < 0.01
    # In 50 steps DDIM's first order is still seen.
    assert abs(drawn.std() - STD) < {"ddim50": 0.04}.get(name, 0.02)


@pytest.mark.parametrize("steps", [25, 50])
def test_ddim_is_of_first_order_and_dpm_solver_2m_of_second(steps):
    assert error(made("ddim50"), steps) / error(made("ddim50"), 2 * steps) == pytest.approx(2, rel=0.15)
    coarse, fine = (error(made("dpm20"), n, exact_result_of_solvers, at_solver=True) for n in (steps, 2 * steps))
    assert coarse / fine == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize(("name", "steps"), [*product(NAMES, [1, None]), ("ddim50", 1000)])
def test_a_step_costs_one_call_of_the_whole_batch(name, steps):
    own = made(name)
    calls = []
    noise = gaussian_noise(3)
    drawn = own(lambda x, t, c: calls.append((len(x), len(t), len(c))) or 0.1 * x, noise, nothing(3), steps=steps)
    assert calls == [(3, 3, 3)] * (steps or int(name.lstrip("dimpunc")))
    assert drawn.isfinite().all()


def test_the_default_is_fifty_steps_and_a_single_step_solver_of_second_order_asks_twice_a_step(sampler):
    calls = []
    sampler(lambda x, t, c: calls.append(t[0].item()) or x * 0, torch.zeros(1, 1, 2, 2), torch.zeros(1, 1, 2, 2))
    assert calls == list(range(999, 18, -20))
    calls.clear()
    own = Sampler(HeunDiscreteScheduler(**NOISE), steps=5)
    own(lambda x, t, c: calls.append(t) or x * 0, gaussian_noise(1), nothing(1))
    assert len(calls) == 2 * 5 - 1  # but not in the last


@pytest.mark.parametrize("steps", [30, 0, 1001])
def test_steps_that_ddim_cannot_make_are_refused(sampler, steps):
    with pytest.raises(CompleteSplatError, match=f"steps={steps}"):
        sampler(lambda x, t, c: x, nothing(1), nothing(1), steps=steps)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_estimates_are_shown_at_every_step_and_samples_do_not_depend_on_their_batch(name, kind):
    own = made(name, kind)
    shown = []
    noise = gaussian_noise(2)
    exact = exact_prediction(kind)
    drawn = own(exact, noise, nothing(2), on_step=lambda *step: shown.append(step))
    alone = [own(exact, noise[i : i + 1], nothing(1)) for i in range(2)]
    torch.testing.assert_close(drawn, torch.cat(alone), atol=1e-6, rtol=1e-5)
    assert [step for step, _, _ in shown] == list(range(own.steps))
    assert shown[0][1] in (998, 999)  # UniPC rounds down
    # The last is the result; DPM-Solver and UniPC place their levels between the timesteps.
    tolerance = 1e-5 if name.startswith("ddim") else 5e-3
    torch.testing.assert_close(shown[-1][2], drawn, atol=tolerance, rtol=0)
    # The first is E[h | h_T], nearly the mean whatever the noise.
    assert (shown[0][2] - MEAN).abs().max() < 0.1


@pytest.mark.parametrize("name", ["ddim50", "dpm20", "unipc10", "flow25"])
def test_calls_in_four_threads_draw_what_each_draws_alone(name):
    own = made(name)
    steps = (5, 10, 20, 25)
    meeting = Barrier(4)

    def draw(steps: int, wait=lambda: None) -> torch.Tensor:
        """Every call has begun before any makes its first step."""
        waits = iter([wait])

        def denoise(latent, timestep, conditioning):
            next(waits, lambda: None)()
            return (latent + timestep.view(-1, 1, 1, 1) / 1000).sin()

        return own(denoise, gaussian_noise(2), nothing(2), steps=steps)

    alone = [draw(n) for n in steps]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda n: draw(n, lambda: meeting.wait(60)), steps))
    assert all(torch.equal(one, other) for one, other in zip(alone, together, strict=True))


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_another_sampler_keeps_what_training_was_done_with(kind):
    changes = {"prediction_type": kind, "beta_end": 0.02, "rescale_betas_zero_snr": kind == "v_prediction"}
    trained = OmegaConf.merge(OmegaConf.to_container(config("ddim50")), {"scheduler": changes})
    merged = with_forward_process(config("dpm20"), trained)
    assert merged["scheduler"]["_target_"] == "diffusers.DPMSolverMultistepScheduler"
    assert merged["scheduler"]["use_lu_lambdas"]
    own = instantiate(merged, _convert_="all")
    assert (own.steps, own.scheduler.config.prediction_type) == (20, kind)
    levels = instantiate(trained).scheduler.alphas_cumprod  # DPM-Solver++ writes 2^-24 for 0
    torch.testing.assert_close(own.scheduler.alphas_cumprod, levels, rtol=0, atol=1e-7)


def test_seeds_and_weights_may_be_numpys():
    check_value("seed", int, np.int64(7))
    check_value("skip_weight", float, np.float32(0.5))
    with pytest.raises(CompleteSplatError, match="must be a whole number"):
        check_value("seed", int, np.float32(7))
    with pytest.raises(CompleteSplatError, match="must be a number"):
        check_value("skip_weight", float, np.bool_(True))


@pytest.mark.parametrize("verb", ["predict", "view", "test"])
def test_the_samplers_that_the_help_recommends_fit_the_weights_that_it_names(verb):
    model = CompleteSplat.from_pretrained("toy_objects")
    (line,) = re.findall("# Sampler that replaces .*", (conf_folder() / f"{verb}.yaml").read_text())
    name = re.search(r"(\w+) for (those|weights) in the package", line).group(1)
    model.replace_sampler(OmegaConf.to_container(config(name), resolve=True))
    assert model.sampler.steps == config(name).steps
