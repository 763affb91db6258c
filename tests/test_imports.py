"""Postponed imports: diffusers, numba and other libraries work as if the modules had been imported."""

import pytest
from support import python

pytestmark = pytest.mark.processes

IMPORTED = """
import copy, pickle
with postponing():
    import numba.np.arraymath, torch
    from diffusers import FlowMatchEulerDiscreteScheduler, UNet2DModel
    from diffusers.models.autoencoders import vae
assert not set(POSTPONED) & set(sys.modules), set(POSTPONED) & set(sys.modules)
sizes = {"block_out_channels": (8, 8), "down_block_types": ("DownBlock2D", "AttnDownBlock2D"), "norm_num_groups": 4}
sizes |= {"up_block_types": ("AttnUpBlock2D", "UpBlock2D"), "attention_head_dim": 4, "layers_per_block": 1}
"""
SCRIPTS = {
    "networks are compiled": """
network = UNet2DModel(**sizes).eval()
inputs = torch.randn(1, 3, 16, 16), torch.tensor([3])
with torch.no_grad():
    expected = network(*inputs).sample
    graphs = []
    def backend(graph, example):
        graphs.append(graph)
        return graph.forward
    compiled = torch.compile(network, backend=backend, fullgraph=True)
    assert torch.equal(compiled(*inputs).sample, expected) and len(graphs) == 1
import torch._dynamo.config
assert torch._dynamo is sys.modules["torch._dynamo"] and torch._dynamo.config is sys.modules["torch._dynamo.config"]
assert torch._dynamo.__file__ and torch.compiler.disable(len)([1]) == 1
""",
    "networks are copied": """
network = UNet2DModel(**sizes)
for twin in (copy.deepcopy(network), pickle.loads(pickle.dumps(network))):
    assert all(torch.equal(a, b) for a, b in zip(network.state_dict().values(), twin.state_dict().values()))
assert not set(POSTPONED) & set(sys.modules)
""",
    "schedulers use scipy": """
import scipy.stats
scheduler = FlowMatchEulerDiscreteScheduler(use_beta_sigmas=True)
scheduler.set_timesteps(4)
expected = scipy.stats.beta.ppf([1, 2 / 3, 1 / 3, 0], 0.6, 0.6)
sigmas = scheduler.sigmas[:4].numpy()
assert abs((sigmas - sigmas[-1]) / (sigmas[0] - sigmas[-1]) - expected).max() < 1e-5, (sigmas, expected)
from diffusers.schedulers import scheduling_lms_discrete
assert abs(scheduling_lms_discrete.integrate.quad(lambda x: x, 0, 1)[0] - 0.5) < 1e-9
""",
    "kernels multiply matrices": """
import numpy as np
product = numba.njit(lambda matrix: matrix @ matrix)(np.eye(2) + 1)
assert product.tolist() == [[5, 4], [4, 5]] and sys.modules["scipy.linalg.cython_blas"].__pyx_capi__
""",
}
ALONE = {
    "another library gets the modules themselves, which exist once and lie in their packages": """
with postponing():
    import torch._dynamo.config as config
    import scipy.stats.qmc
    from scipy.stats import norm
    import requests
    assert requests.codes.ok == 200
import torch
assert config is torch._dynamo.config is sys.modules["torch._dynamo.config"]
assert torch._dynamo.allow_in_graph.__module__ == "torch._dynamo.decorators"
assert scipy.stats.qmc is sys.modules["scipy.stats.qmc"] and norm is scipy.stats.norm
assert requests is not sys.modules["requests"] and requests.get is sys.modules["requests"].get
""",
    "what is imported already stays": """
import torch._dynamo, scipy.stats
before = sys.modules["torch._dynamo"], sys.modules["scipy.stats"]
with postponing():
    assert (sys.modules["torch._dynamo"], sys.modules["scipy.stats"]) == before
assert (sys.modules["torch._dynamo"], sys.modules["scipy.stats"]) == before
""",
    "the garbage collector rests while a name of the package is imported, but stays as the user has set it": """
import completesplat, gc
rounds = []
gc.callbacks.append(lambda phase, info: rounds.append(phase))
completesplat.CompleteSplat
assert rounds == [] and gc.isenabled() and gc.get_freeze_count() > 100_000
frozen = gc.get_freeze_count()
gc.disable()
completesplat.LatentDiffusion
assert not gc.isenabled() and gc.get_freeze_count() <= frozen
""",
    "what torch excludes from compilation can be called meanwhile": """
with postponing():
    import torch
    from torch.utils.checkpoint import checkpoint
    assert checkpoint(torch.cos, torch.zeros(2), use_reentrant=False).tolist() == [1, 1]
assert torch._dynamo.allow_in_graph.__module__ == "torch._dynamo.decorators"
""",
}
PROGRAMS = {name: IMPORTED + script for name, script in SCRIPTS.items()} | ALONE


@pytest.mark.parametrize("name", PROGRAMS)
def test_libraries_work_with_postponed_imports(name: str) -> None:
    python(f"import sys\nfrom completesplat.imports import POSTPONED, postponing\n{PROGRAMS[name]}")
