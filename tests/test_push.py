"""Models that are sent to the Hugging Face hub, by huggingface_hub's own client to a server that answers as the hub."""

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import huggingface_hub.constants as hub_constants
import jaxtyping
import pytest
import torch
from hub_server import TOKEN, Repositories, hub_with
from huggingface_hub import ModelCard
from omegaconf import OmegaConf
from PIL import Image

from completesplat import CompleteSplat, compose
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.weights import sha256_of, shipped
from completesplat.weights.model_card import own_modules

REPOSITORY = "me/things"
FILES = {"README.md", "SHA256SUMS", "config.json", "model.safetensors"}


@pytest.fixture
def hub(tmp_path, monkeypatch) -> Iterator[Repositories]:
    """An empty hub whose user has a token. Files go by LFS, because the server does not speak Xet's protocol."""
    with hub_with(tmp_path / "hub") as (address, repositories):
        monkeypatch.setattr(hub_constants, "ENDPOINT", address)
        monkeypatch.setattr(
            hub_constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}"
        )
        monkeypatch.setattr(hub_constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(hub_constants, "HF_TOKEN_PATH", str(tmp_path / "no_token"))
        monkeypatch.setattr(hub_constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(hub_constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setenv("no_proxy", "127.0.0.1")
        yield repositories


class Terminal(io.StringIO):
    """Standard input of a person who answers one question."""

    def isatty(self) -> bool:
        return True


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def weights_with(tiny_weights: Path, folder: Path) -> CompleteSplat:
    shutil.copytree(tiny_weights, folder)
    return CompleteSplat.from_pretrained(folder)


def test_what_is_pushed_is_read_back_from_the_hub(hub, tiny_weights, tmp_path):
    folder = tmp_path / "weights"
    model = weights_with(tiny_weights, folder)
    Image.new("RGB", (8, 8), "red").save(folder / "held_out.jpg")
    (folder / "LICENSE.txt").write_text("Do as you like.")
    Image.new("RGB", (8, 8), "blue").save(tmp_path / "sheet.png")
    address = model.push_to_hub(
        REPOSITORY,
        confirm=True,
        license="mit",
        datasets=["my_things"],
        pictures=[str(folder / "held_out.jpg"), str(tmp_path / "sheet.png")],
    )
    assert address == f"{hub_constants.ENDPOINT}/{REPOSITORY}"
    sent = hub.folder(REPOSITORY)
    assert names(sent) == FILES | {"held_out.jpg", "LICENSE.txt", "sheet.png"}
    for name in FILES - {"README.md"}:
        assert (sent / name).read_bytes() == (folder / name).read_bytes()
    assert len(hub.commits) == 1
    assert "lfsFile model.safetensors" in hub.commits[0]
    assert not hub.private[REPOSITORY]

    read = CompleteSplat.from_pretrained(REPOSITORY)
    assert read.architecture == model.architecture
    state = read.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in model.state_dict().items())

    card = ModelCard.load(sent / "README.md")
    assert card.data.to_dict() == {
        "license": "mit", "library_name": "completesplat", "pipeline_tag": "image-to-3d", "datasets": ["my_things"],
    }  # fmt: skip
    assert f"completesplat predict image=photo.jpg weights={REPOSITORY}" in card.text
    assert "![held_out](held_out.jpg)" in card.text
    assert "![sheet](sheet.png)" in card.text
    assert "## Scores" not in card.text


def test_a_changed_model_is_sent_as_it_is_now_without_the_pictures_and_scores_of_its_file(hub, pipeline, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(pipeline.diffusion, run)
    Image.new("RGB", (8, 8), "red").save(run / "weights/held_out.jpg")
    model = CompleteSplat.from_pretrained(run)
    with torch.no_grad():
        model.latent_mean += 1
    model.push_to_hub(REPOSITORY, confirm=True)
    assert names(hub.folder(REPOSITORY)) == FILES
    read = CompleteSplat.from_pretrained(REPOSITORY)
    assert torch.equal(read.latent_mean, model.latent_mean)
    data = ModelCard.load(hub.folder(REPOSITORY) / "README.md").data.to_dict()
    assert data["license"] == "unknown"
    assert "model-index" not in data


@pytest.mark.parametrize("weights", ["", "checkpoints/last.ckpt"])
def test_the_scores_of_a_tested_run_stand_on_the_card_with_their_protocol(hub, pipeline, weights):
    run = pipeline.diffusion
    metrics = json.loads((run / "metrics.json").read_text())
    CompleteSplat.from_pretrained(run / weights).push_to_hub(REPOSITORY, confirm=True)
    card = ModelCard.load(hub.folder(REPOSITORY) / "README.md")
    protocol = metrics["test"]["protocol"]
    assert card.data.datasets == [protocol["data_set"]]
    results = {result.metric_name: result for result in card.data.eval_results}
    for region, view, metric in [("full", "novel", "psnr"), ("object", "reference", "ssim")]:
        result = results[f"{metric} ({region}, {view})"]
        assert result.metric_value == metrics["test"]["model"][region][view][metric]
        assert (result.metric_type, result.dataset_type) == (metric, protocol["data_set"])
        assert (result.dataset_config, result.dataset_split) == (protocol["name"], "test")
        assert result.dataset_args["scenes"] == protocol["scenes"]
    assert f"protocol `{protocol['name']}`" in card.text


def test_no_score_comes_from_a_test_of_other_weights(hub, pipeline, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(pipeline.diffusion, run)
    model = CompleteSplat.from_pretrained(run)
    metrics = json.loads((run / "metrics.json").read_text())
    test = metrics["test"]
    scores = tmp_path / "scores"
    scores.mkdir()
    for checkpoint in ({"sha256": "0" * 64}, None):
        test["protocol"]["checkpoint"] = checkpoint
        (scores / "metrics.json").write_text(json.dumps(test))
        with pytest.raises(WeightsError, match="a test of other weights, by its SHA-256"):
            model.push_to_hub(REPOSITORY, confirm=True, scores=[str(scores)])
    assert hub.folder(REPOSITORY) is None

    test["protocol"] |= {"checkpoint": {"sha256": sha256_of(run / "weights/model.safetensors")}, "name": "mine"}
    (scores / "metrics.json").write_text(json.dumps(test))
    model.push_to_hub(REPOSITORY, confirm=True, scores=[str(scores)])
    card = ModelCard.load(hub.folder(REPOSITORY) / "README.md")
    assert {result.dataset_config for result in card.data.eval_results} == {"images", "mine"}

    test["protocol"]["checkpoint"] = None  # an earlier version's
    (run / "metrics.json").write_text(json.dumps(metrics))
    CompleteSplat.from_pretrained(run / "checkpoints/last.ckpt").push_to_hub(REPOSITORY, confirm=True)
    assert not ModelCard.load(hub.folder(REPOSITORY) / "README.md").data.eval_results
    model.replace_sampler(OmegaConf.to_container(compose("predict", "sampler=dpm20", "image=x").sampler))
    with pytest.raises(WeightsError, match="the model is not that of a file, which a test is of"):
        model.push_to_hub(REPOSITORY, confirm=True, scores=[str(scores)])


def test_the_card_beside_the_weights_keeps_its_text_and_licence(hub, tmp_path):
    folder = tmp_path / "fruits"
    shutil.copytree(shipped()["fruits"], folder)
    model = CompleteSplat.from_pretrained(folder)
    model.push_to_hub(REPOSITORY, confirm=True, datasets=["fruits-360"])
    sent = hub.folder(REPOSITORY)
    assert {"LICENSE.txt", "held_out.jpg"} <= names(sent)
    card, before = ModelCard.load(sent / "README.md"), ModelCard.load(folder / "README.md")
    assert card.data.to_dict() == {**before.data.to_dict(), "datasets": ["fruits-360"]}
    assert card.text.strip() == before.text.strip()
    assert (sent / "model.safetensors").read_bytes() == (folder / "model.safetensors").read_bytes()  # still in float16

    Image.new("RGB", (8, 8), "blue").save(tmp_path / "mine.png")
    model.push_to_hub(REPOSITORY, confirm=True, license="cc-by-sa-4.0", pictures=[str(tmp_path / "mine.png")])
    text = ModelCard.load(sent / "README.md").text.strip()
    assert text == before.text.strip() + "\n\n![mine](mine.png)"
    with pytest.raises(WeightsError, match=r"license=mit: README.md beside the weights says cc-by-sa-4.0"):
        model.push_to_hub(REPOSITORY, confirm=True, license="mit")


def test_graphs_go_to_try_and_those_of_earlier_weights_are_removed(hub, tiny_weights, tmp_path):
    model = weights_with(tiny_weights, tmp_path / "weights")
    graphs = tmp_path / "graphs"
    graphs.mkdir()
    with pytest.raises(CompleteSplatError, match=r"pipeline.json: no graphs that can be read .*; model.to_onnx"):
        model.push_to_hub(REPOSITORY, confirm=True, graphs=graphs)
    (graphs / "pipeline.json").write_text(json.dumps({"graphs": {"scene": {"file": "scene.onnx"}}}))
    with pytest.raises(CompleteSplatError, match=r"scene.onnx: no such file, although pipeline.json names it"):
        model.push_to_hub(REPOSITORY, confirm=True, graphs=graphs)
    (graphs / "scene.onnx").write_bytes(b"a graph")
    (graphs / "step.onnx").write_bytes(b"of another model")
    model.push_to_hub(REPOSITORY, confirm=True, graphs=graphs)
    sent = hub.folder(REPOSITORY)
    assert names(sent) == FILES | {"try/scene.onnx", "try/pipeline.json"}
    assert (sent / "try/scene.onnx").read_bytes() == b"a graph"
    model.push_to_hub(REPOSITORY, confirm=True)
    assert names(sent) == FILES


def test_nothing_is_sent_without_a_token_or_without_a_yes(hub, tiny_weights, tmp_path, monkeypatch, capsys):
    model = weights_with(tiny_weights, tmp_path / "weights")
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))  # no terminal
    with pytest.raises(
        CompleteSplatError, match=r"me/things: nothing was sent, because that needs a yes: confirm=true"
    ):
        model.push_to_hub(REPOSITORY)
    for answer in ("", "\n", "n\n", "what\n"):
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        with pytest.raises(CompleteSplatError, match=r"^me/things: nothing was sent$"):
            model.push_to_hub(REPOSITORY)
    assert hub.folder(REPOSITORY) is None
    assert not [request for request in hub.requests if not request.startswith("GET")]
    printed = capsys.readouterr().out
    assert "Files: README.md, config.json, model.safetensors, SHA256SUMS" in printed
    assert "me/things is made, public." in printed
    assert "Send 4 files (" in printed
    assert ") to me/things? [y/N]" in printed

    monkeypatch.setattr("sys.stdin", Terminal("y\n"))
    model.push_to_hub(REPOSITORY)
    assert names(hub.folder(REPOSITORY)) == FILES
    with pytest.raises(CompleteSplatError, match=r"^me/things: nothing was sent$"):
        model.push_to_hub(REPOSITORY)  # the answer was given once
    assert "me/things exists, public; its files of these names are replaced." in capsys.readouterr().out

    monkeypatch.delenv("HF_TOKEN")
    asked = len(hub.requests)
    with pytest.raises(
        CompleteSplatError, match=r"^me/things: there is no token .*; run `hf auth login`, or set HF_TOK"
    ):
        model.push_to_hub(REPOSITORY, confirm=True)
    assert len(hub.requests) == asked
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(WeightsError, match=r"^me/new: cannot be sent to the hub \(.*401") as caught:
        model.push_to_hub("me/new", confirm=True)
    assert "\n" not in str(caught.value)


def test_a_private_repository_is_made_private_and_a_public_one_is_not_taken_for_it(hub, tiny_weights, tmp_path):
    model = weights_with(tiny_weights, tmp_path / "weights")
    model.push_to_hub(REPOSITORY, private=True, confirm=True)
    assert hub.private[REPOSITORY]
    model.push_to_hub(REPOSITORY, private=True, confirm=True)
    model.push_to_hub("me/open", confirm=True)
    with pytest.raises(CompleteSplatError, match=r"me/open: is public already, which private=true does not change"):
        model.push_to_hub("me/open", private=True, confirm=True)


@pytest.mark.parametrize("name", ["things", "me/things@main", "https://huggingface.co/me/things", "../me", "me/a/b"])
def test_a_repository_is_named_by_owner_and_name(hub, tiny_weights, tmp_path, name):
    model = weights_with(tiny_weights, tmp_path / "weights")
    with pytest.raises(CompleteSplatError, match=r"give the repository as OWNER/NAME"):
        model.push_to_hub(name, confirm=True)


def test_pictures_must_be_images_with_names_of_their_own(hub, tiny_weights, tmp_path):
    model = weights_with(tiny_weights, tmp_path / "weights")
    (tmp_path / "a.txt").write_text("")
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        Image.new("RGB", (8, 8)).save(tmp_path / folder / "a.png")
    for pictures, match in [
        (["none.png"], r"pictures: none.png: no such file"),
        (["a.txt"], r"a.txt: must be one of .jpg"),
        (["one/a.png", "two/a.png"], r"a.png: there are two files of this name"),
    ]:
        paths = [name if name == "none.png" else str(tmp_path / name) for name in pictures]
        with pytest.raises(CompleteSplatError, match=match):
            model.push_to_hub(REPOSITORY, confirm=True, pictures=paths)


def test_weights_that_need_a_module_of_the_user_say_so(tiny_weights):
    part = {
        "encoder": {"_target_": "mine.Encoder", "layers": [{"_target_": "TinyEncoder"}, {"_target_": "mine.Layer"}]}
    }
    assert list(own_modules(part)) == ["mine.Encoder", "mine.Layer"]
    assert list(own_modules(CompleteSplat.from_pretrained(tiny_weights).architecture)) == []


def test_export_pushes_on_the_command_line(hub, command, tiny_weights):
    given = ["export", f"weights={tiny_weights}", f"push={REPOSITORY}", "graphs=false"]
    assert "nothing was sent, because that needs a yes: confirm=true" in command.refuses(*given)
    assert hub.folder(REPOSITORY) is None
    done = command.succeeds(*given, "confirm=true", "private=true", "license=mit", "datasets=[a,b]")
    assert f"{hub_constants.ENDPOINT}/{REPOSITORY}" in done.out
    assert hub.private[REPOSITORY]
    card = ModelCard.load(hub.folder(REPOSITORY) / "README.md")
    assert (card.data.license, card.data.datasets) == ("mit", ["a", "b"])
    assert "graphs=false: writes nothing" in command.refuses("export", f"weights={tiny_weights}", "graphs=false")


@pytest.mark.slow
def test_export_sends_the_graphs_that_it_writes(hub, command, tiny_weights, tmp_path, monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # torch cannot trace through the checks of shapes
    graphs = tmp_path / "graphs"
    command.succeeds("export", f"weights={tiny_weights}", f"push={REPOSITORY}", "confirm=true", f"out={graphs}")
    sent = hub.folder(REPOSITORY)
    assert names(sent) == FILES | {
        f"try/{name}" for name in ("image.onnx", "step.onnx", "decode.onnx", "pipeline.json")
    }
    assert (sent / "try/step.onnx").read_bytes() == (graphs / "step.onnx").read_bytes()
    assert "`try/` has the networks as ONNX graphs" in (sent / "README.md").read_text()
