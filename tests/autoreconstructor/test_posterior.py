import torch
from torch.distributions import Independent, Normal, kl_divergence

from completesplat.autoreconstructor.posterior import Posterior, from_moments


def random_posterior() -> Posterior:
    torch.manual_seed(0)
    return Posterior(torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2))


def test_kl_agrees_with_torch_distributions():
    posterior = random_posterior()
    ours = Independent(Normal(posterior.mean, posterior.std), 3)
    prior = Independent(Normal(torch.zeros(3, 4, 2, 2), torch.ones(3, 4, 2, 2)), 3)
    torch.testing.assert_close(posterior.kl(), kl_divergence(ours, prior))


def test_samples_have_the_posteriors_moments_and_are_reparameterized():
    posterior = random_posterior()
    draws = torch.stack([posterior.sample(torch.Generator().manual_seed(i)) for i in range(4000)])
    torch.testing.assert_close(draws.mean(0), posterior.mean, atol=0.2, rtol=0)
    torch.testing.assert_close(draws.std(0) / posterior.std, torch.ones(3, 4, 2, 2), atol=0.06, rtol=0)
    mean = posterior.mean.clone().requires_grad_()
    Posterior(mean, posterior.log_variance).sample().sum().backward()
    torch.testing.assert_close(mean.grad, torch.ones_like(mean))


def test_extreme_log_variances_stay_finite():
    for extreme in (-1e4, 1e4):
        moments = torch.full((1, 8, 2, 2), extreme, requires_grad=True)
        posterior = from_moments(moments)
        (posterior.kl().sum() + posterior.sample().sum()).backward()
        assert posterior.kl().isfinite().all()
        assert moments.grad.isfinite().all()
