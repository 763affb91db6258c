"""Refusals of odd values and mistyped names, in one line and before anything is read or trained."""

import re

import pytest
from support import compose_config, refused

from completesplat.cli import VERBS
from completesplat.errors import CompleteSplatError
from completesplat.settings import checks

ONE = "give one of ckpt=FILE, weights=DIR and scenes=DIR; all but ckpt need data=NAME"
NO_DATA = "weights=DIR and scenes=DIR need data: give data=NAME data.root=DIR"
PRETRAINED = "CompVis/stable-diffusion-v1-4, or null for random weights"
WHOLE, NUMBER = "must be a whole number", "must be a number"
FIRST_DEPTH = "autoreconstructor.reconstructor.parameterization.first_depth"
ODD = [
    ("predict", "samples=abc", f"samples=abc: {WHOLE}"),
    ("predict", "samples=-1", "samples=-1: must lie between 1 and 1000"),
    ("view", "port=99999", "port=99999: must lie between 1 and 65535"),
    ("predict", "maps=perhaps", "maps=perhaps: must be true or false"),
    ("predict", "box=[a,b,c,d]", f"box=['a', 'b', 'c', 'd']: {NUMBER}"),
    ("predict", "weights=[a]", "weights=['a']: must be a text"),
    ("predict", "video=1", "video=1: choose one of orbit, swipe, wobble"),
    (
        "predict",
        "formats=[ply,obj]",
        "formats=['ply', 'obj']: choose one of ply, compressed.ply, splat, spz, glb, usdz, mesh, sog, html",
    ),
    ("fit", "model=capture model.videos=[zoom]", "model.videos=['zoom']: choose one of orbit, swipe, wobble"),
    ("data", "scenes=many", f"scenes=many: {WHOLE}"),
    ("test", "overrides=5", "overrides=5: must be a list, such as overrides=[5]"),
    ("test", "evaluation=hidden_modes evaluation.samples=1", "evaluation.samples=1: must be at least 2"),
    ("fit", "test=1", "test=1: must be true or false"),
    ("fit", "data.image_size=50", "data.image_size=50: must be a multiple of 8 for the levels of these networks"),
    ("fit", "data.color_jitter=1", "data.color_jitter=1: must be a mapping"),
    (
        "data",
        "data_task=check data.camera_jitter={rol:3}",
        "data: {'rol': 3}: got an unexpected keyword argument 'rol'",
    ),
    ("fit", "+data.rot=x", "ToyObjectsDataModule has no setting rot (data.rot); did you mean root?"),
    ("fit", "optimizer.lr=nan", "optimizer: Invalid learning rate: nan"),
    ("fit", "callbacks.images.scenes=0", "callbacks.images.scenes=0: must be at least 1"),
    ("fit", "schedule=exponential schedule.final_ratio=0", "schedule.final_ratio=0: must lie between 1e-09 and 1"),
    ("view", "skip_weight=null", f"skip_weight=null: {NUMBER}"),
    ("fit", f"{FIRST_DEPTH}=1", f"{FIRST_DEPTH}=1: must lie between 0.001 and 0.999"),
    ("fit", "optimizer.lr=-1", "optimizer: Invalid learning rate: -1"),
    ("fit", "trainer.val_check_interval=0", "trainer.val_check_interval=0: must be at least "),
    ("fit", "trainer.precision=half", "trainer.precision=half: choose one of "),
    ("fit", "trainer.accelerator=abacus", "trainer: "),
    ("fit", "loss.terms.kl.weight=inf", "loss.terms.kl.weight=inf: must be finite"),
    ("data", "data_task=check workers=-1", "workers=-1: must be at least 1"),
    ("data", "frames=1001", "toy_objects: frames=1001: must lie between 2 and 1000"),
    ("fit", "autoreconstructor.encoder.channels=8", "autoreconstructor.encoder.channels=8: must be a list, such as "),
    ("fit", "trainer.precision=bf16-true", "trainer.precision=bf16-true: choose one of 32-true, bf16-mixed, 16-mixed"),
    ("fit", "trainer.precision=64-true", "trainer.precision=64-true: choose one of 32-true, bf16-mixed, 16-mixed"),
    ("plan", "trainer.precision=16-true", "trainer.precision=16-true: choose one of 32-true, bf16-mixed, 16-mixed"),
    ("fit", "evaluation.precision=64", "evaluation.precision=64: choose one of 32-true, bf16-mixed, 16-mixed"),
    ("test", "evaluation.precision=bf16-true", "evaluation.precision=bf16-true: choose one of 32-true, bf16-mixed"),
    ("fit", "model=capture model.fitting.most=99999999999999", "model.fitting.most=99999999999999: must lie between 4"),
    ("fit", "model=per_scene model.fitting.count=99999999999", "model.fitting.count=99999999999: must lie between"),
    ("fit", "model=capture model.fitting.opacity=1", "model.fitting.opacity=1: must lie between 0.01 and 0.99"),
    ("fit", "model=per_scene model.fitting.opacity=0", "model.fitting.opacity=0: must lie between 0.01 and 0.99"),
    ("fit", "model=capture model.fitting=null", "model.fitting=null: must not be null; leave it out"),
    ("fit", "model=per_scene model.fitting=null", "model.fitting=null: must not be null; leave it out"),
    ("fit", "model.optimizer=null", "model.optimizer=null: must not be null; leave it out"),
    ("fit", "data=toy_rooms data.crop=top", "data.crop=top: choose one of center, principal"),
    ("fit", "experiment=paper_var_stage1 data=toy_objects", f"give autoreconstructor.pretrained={PRETRAINED}"),
    ("fit", "experiment=toy_var_masked", "model.checkpoint is needed: give model.checkpoint=RUN/checkpoints/last.ckpt"),
    ("fit", "experiment=paper_diffusion", "data.root is needed: give data.root=DIR"),
    ("fit", "experiment=toy_diffusion", "give model.autoreconstructor_checkpoint=RUN/checkpoints/last.ckpt of stage 1"),
    ("data", "data_task=check splits=[x]", "splits=['x']: choose one of train, val, test"),
    ("data", "data_task=check splits=[]", "splits=[]: must not be empty"),
    ("data", "data_task=show split=x", "split=x: choose one of train, val, test"),
    ("plan", "timed_steps=0", "timed_steps=0: must be at least 1"),
    ("plan", "trainer.devices=3", "must be a multiple of 3 processes"),
    ("plan", "model=per_scene", "PerScene fits scenes"),
    ("plan", "model=reconstructor_only", "ReconstructorOnly fits scenes"),
    ("plan", "model=capture", "CaptureFit fits scenes"),
    ("report", "samples=1", "samples=1: must be at least 2"),
    ("report", "guidance_weights=0.5", "guidance_weights=0.5: must be a list, such as guidance_weights=[0.5]"),
    ("report", "seed=0", "nowhere: no such checkpoint"),
    ("test", "ckpt=null", ONE),
    ("test", "weights=a", ONE),
    ("test", "scenes=a", ONE),
    ("test", "ckpt=null scenes=a weights=b data=toy_objects data.root=x", ONE),
    ("test", "ckpt=null scenes=a", NO_DATA),
    ("test", "ckpt=null weights=a", NO_DATA),
    ("test", "ckpt=null weights=a overrides=['data.targets=1']", "overrides change a run's settings: give ckpt=FILE"),
    ("test", "data=toy_objects data.root=x", "a checkpoint's data are its run's"),
    ("test", "ckpt=null data=toy_objects data.root=x scenes=no", "scenes=no: no such folder; give one with SCENE/"),
    ("test", "scenes=a frame=colmap", "frame=colmap: choose one of opencv, opengl"),
    ("test", "scenes=a align=all", "align=all: choose one of none, scale"),
]


@pytest.mark.parametrize(("verb", "setting", "message"), ODD, ids=lambda text: text[:40])
def test_a_wrong_value_is_refused_with_the_allowed_values(verb, setting, message):
    given = {"predict": f"image={__file__} weights=nowhere", "data": "data_task=toy", "test": f"ckpt={__file__}"}
    given |= {"fit": "trainer.max_steps=1", "report": "report_task=controls ckpt=nowhere", "view": ""}
    given |= {"plan": "experiment=toy_var data.image_size=32"}
    assert message in refused(verb, *given[verb].split(), *setting.split())


@pytest.mark.parametrize("chosen", [*VERBS, "data_task=check", "bench_task=rasterizers", "report_task=summary"])
def test_the_defaults_of_each_verb_pass_the_checks(chosen):
    verb = chosen.partition("_")[0]
    config = compose_config(verb, *([chosen] if "=" in chosen else []))
    checks.check_values(verb, config)
    checks.check_parts_of_verb(verb, config)


def test_a_task_takes_the_settings_that_its_function_names_unless_it_states_another_value():
    report, prepare = compose_config("report", "report_task=depth"), compose_config("data", "data_task=prepare")
    report.far_degrees, prepare.data.on_bad, prepare.codec = 60, "raise", "png"
    for config in (report, prepare):
        checks.complete_task(config)
        assert not {"out", "verb", "description"} & config.task.keys()
    assert (report.task.far_degrees, report.task.scenes) == (60, report.scenes)
    assert (prepare.task.codec, prepare.task.on_bad) == ("png", "raise")


def test_stage_2_needs_image_sizes_that_are_multiples_of_32():
    stage2 = ["model=latent_diffusion", "model.autoreconstructor_checkpoint=null"]
    checks.check_image_size(compose_config("fit", "data.image_size=72"))
    with pytest.raises(CompleteSplatError, match=r"data\.image_size=72: must be a multiple of 32 .* such as 64$"):
        checks.check_image_size(compose_config("fit", *stage2, "data.image_size=72"))


def test_a_wrong_value_is_reported_under_the_setting_that_the_user_gave():
    with pytest.raises(CompleteSplatError, match=r"^seed=x: "):
        checks.check_parts(compose_config("fit", "seed=x").callbacks, "callbacks")


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("fit optimzer.lr=1", r"Could not override 'optimzer.lr'. .* use \+optimzer.lr=1; did you mean optimizer.lr"),
        ("fit experiment=toy_minis_var data.scene=3", r"Could not override 'data.scene'.* did you mean data.scenes"),
        ("fit xyzzy=1", r"Could not override 'xyzzy'. To append to your config use \+xyzzy=1$"),
        ("fit max_steps=3", r"Could not override 'max_steps'.* did you mean trainer.max_steps\?$"),
        (
            "fit trainer.max_epochs=3",
            r"Could not override .* use \+trainer.max_epochs=3; did you mean trainer.max_steps",
        ),
        ("fit experiment=toy_vr", r"no experiment 'toy_vr': there are anything_diffusion, .*; did you mean toy_var"),
        ("fit ablation=no_skip", r"no ablation 'no_skip': there are full, .*; did you mean no_skips"),
        (
            "fit -m loss=stge1,stage2",
            r"no loss 'stge1': .* perceptual, .*, things; did you mean stage1",
        ),
        ("fit data=null", "Config group override must be a string or a list"),
        ("fit ablaton=no_ssim", r"Could not override 'ablaton'.*; did you mean ablation"),
        ("data stats data=co3d_hydrants", r"data.root is needed: give data.root=VALUE$"),
        ("data latents", r"ckpt is needed: give ckpt=VALUE$"),
        ("bench rasterizers sizes=[]", r"sizes=\[\]: must not be empty$"),
        ("fit toy_var", "Error parsing override 'toy_var' missing EQUAL"),
        ("fit seed=0,1", r"Ambiguous value for argument 'seed=0,1' .*--multirun"),
        ("data chck", r"no data_task 'chck': there are check, .*; did you mean check\?"),
        ("predict sampels=1", r"Could not override 'sampels'.*; did you mean samples"),
        ("predcit a.png", r"no verb 'predcit': there are data, .*; did you mean predict\?"),
        (f"predict image={__file__} weights=toy_object", r"toy_object: no such folder.*toy_objects"),
        ("report controls", "give one of ckpt=FILE, weights=DIR"),
        ("test ckpt=nowhere/checkpoints/last.ckpt", ".*no such checkpoint"),
        ("data toy kind=nonsense", "no toy data of kind 'nonsense'"),
        ("fit -m seed=0,1 --cfg job", "--cfg shows the settings of one run: leave out -m$"),
        ("fit rasterizer._target_=nowhere.Mine", "Error loading 'nowhere.Mine': ModuleNotFoundError"),
    ],
)
def test_a_refusal_is_one_line_that_suggests_the_nearest_name(command, typed, message):
    refused = command.refuses(*typed.split())
    assert re.match(message, refused), refused
    assert len(refused) < 700


@pytest.mark.parametrize("empty", ["out=", "out=''", "out=null"])
def test_an_empty_name_of_the_output_folder_is_refused_and_nothing_is_written(command, tmp_path, empty):
    assert command.refuses("fit", empty) == f"{empty}: names no folder; give out=DIR"
    assert not list(tmp_path.iterdir())
