"""Stage 1 of the paper, from files in the layout of CO3D to metrics."""

from co3d_trees import CATEGORY, write_tree
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pretrained_vaes import random_vae
from support import strict_json

LISTS = {"train": "abcdef", "val": "g", "test": "hi"}


def test_stage1_starts_from_a_vae_tests_on_unseen_sequences_and_resumes_without_the_vae(command, tmp_path):
    write_tree(tmp_path / "co3d", dict.fromkeys("abcdefghi", 4), LISTS)
    random_vae().save_pretrained(tmp_path / "vae")
    run = tmp_path / "run"
    fit = ["fit", "experiment=paper_var_stage1", f"data.root={tmp_path / 'co3d'}", f"data.category={CATEGORY}"]
    fit += ["data.image_size=32", "data.batch_size=2", "data.workers=0", "rasterizer=tiled", "trainer.accelerator=cpu"]
    fit += ["trainer.max_steps=2", "trainer.max_epochs=null", "trainer.val_check_interval=2", "callbacks.progress=null"]
    fit += ["callbacks.images=null"]
    fit += [f"autoreconstructor.encoder.{name}" for name in ("channels=[8,8,16,16]", "layers_per_block=1")]
    fit += ["autoreconstructor.encoder.norm_groups=4"]

    command.succeeds(*fit, f"out={run}", f"autoreconstructor.pretrained={tmp_path / 'vae'}")
    results = strict_json(run / "metrics.json")
    protocol = results["test"]["protocol"]
    assert results["steps"] == 2
    assert (protocol["subset"], protocol["scenes"], protocol["scenes_listed"]) == ("fewview_dev", 2, 2)
    data = instantiate(OmegaConf.load(run / "config.yaml").data, _convert_="all")
    assert data.source("test").names == list(LISTS["test"])
    assert not set(data.source("train").names) & set(data.source("test").names)
    resume = [f"ckpt_path={run / 'checkpoints/last.ckpt'}", "trainer.max_steps=3", "test=false"]
    command.succeeds(*fit, *resume, f"out={tmp_path / 'more'}")
    assert strict_json(tmp_path / "more/metrics.json")["steps"] == 3
