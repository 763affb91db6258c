"""Extensions: installed packages that add networks, data sets and metrics, which the verbs list, use and record."""

import shutil
import subprocess
import sys
import venv
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
from support import SMALL, strict_json

from completesplat import compose
from completesplat.commands.new import filled_template
from completesplat.settings import extensions
from completesplat.settings.extensions import ENTRY_POINTS

OWN = "my_method"
FROM = f"(from {OWN} 0.1.0)"
QUICK = [*SMALL, "callbacks.images=null", "regressor.width=8", "regressor.dilations=[1,2]"]
DRAW = ["video=[]", "samples=1", "color_fits=1"]


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


class Site:
    """A folder of installed packages, which Python searches first."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, name: str, value: str, group: str = ENTRY_POINTS[0]) -> None:
        """Declare an extension, as pip does when it installs a distribution of version 0.1.0."""
        metadata = self.folder / f"{name}-0.1.0.dist-info"
        put(metadata / "METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
        put(metadata / "entry_points.txt", f"[{group}]\n{name} = {value}\n")
        extensions.installed.cache_clear()


@pytest.fixture
def site(tmp_path_factory, monkeypatch) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("python") / "site-packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    before = set(sys.modules)
    extensions.installed.cache_clear()
    yield Site(folder)
    extensions.installed.cache_clear()
    for name in set(sys.modules) - before:
        if Path(getattr(sys.modules[name], "__file__", None) or "/").is_relative_to(folder):
            del sys.modules[name]


@pytest.fixture
def method(site: Site) -> Site:
    """What `completesplat new package my_method` writes, as it is when it is installed."""
    for path, text in filled_template("package", OWN).items():
        if path.parts[1] == OWN:
            put(site.folder / Path(*path.parts[1:]), text)
    site.add(OWN, OWN)
    return site


def listed(text: str, group: str) -> str:
    """Return the options of a group on a page of `--help`."""
    return next(line for line in text.splitlines() if line.startswith(f"  {group}=")).partition("[")[2][:-1]


def test_help_lists_options_with_their_distribution_and_imports_no_code(command, method):
    text = command.succeeds("fit", "--help").out
    assert listed(text, "regressor") == f"{OWN} {FROM}, splatter_image, tiny"
    assert f"images, {OWN} {FROM}, realestate10k_100" in listed(text, "evaluation")
    assert f"{OWN} {FROM}" in listed(text, "experiment")
    assert "(from" not in listed(text, "data")
    refused = command.refuses("fit", "regressor=my_metod")
    assert refused == f"no regressor 'my_metod': there are {OWN}, splatter_image, tiny; did you mean {OWN}?"
    assert OWN not in sys.modules
    doctor = command.succeeds("doctor", "out=OUT").out
    assert f"extension {OWN}      0.1.0: evaluation={OWN}, experiment={OWN}, regressor={OWN}\n" in doctor


def test_a_network_and_a_metric_are_trained_tested_and_recorded(command, method, toy_root, tmp_path):
    root = f"data.root={toy_root}"
    command.succeeds("fit", f"experiment={OWN}", root, *QUICK, "out=RUN")
    versions = {OWN: "0.1.0"}
    assert strict_json(tmp_path / "RUN/run.json")["extensions"] == versions
    protocol = strict_json(tmp_path / "RUN/metrics.json")["test"]["protocol"]
    assert (protocol["method"], protocol["name"], protocol["extensions"]) == ("MyMethod", OWN, versions)
    command.succeeds("test", "ckpt=RUN", "trainer.accelerator=cpu", "out=TEST")
    tested = strict_json(tmp_path / "TEST/metrics.json")
    assert strict_json(tmp_path / "TEST/run.json")["extensions"] == {}  # its own config names only the package's parts
    assert (tested["protocol"]["extensions"], tested["protocol"]["method"]) == (versions, "MyMethod")
    given = ["weights=toy_objects", "data=toy_objects", root, "trainer.accelerator=cpu", "sampler.steps=2"]
    command.succeeds("test", "sampler=flow25", *given, f"evaluation={OWN}", "out=METRIC")
    tested = strict_json(tmp_path / "METRIC/metrics.json")
    assert (tested["protocol"]["extensions"], tested["protocol"]["method"]) == (versions, "LatentDiffusion")
    assert 0 < tested["model"]["full"]["novel"]["absolute_error"] < 1
    command.succeeds("test", "sampler=flow25", *given, "out=PLAIN")
    assert strict_json(tmp_path / "PLAIN/metrics.json")["protocol"]["extensions"] == {}


def test_weights_that_name_an_extension_need_trust_outside_of_the_users_folder(
    command, method, pipeline, tmp_path, monkeypatch
):
    command.succeeds("fit", f"experiment={OWN}", f"data.root={pipeline.toy}", *QUICK, "test=false", "out=RUN")
    predict = ["predict", pipeline.photograph(), *DRAW]
    command.succeeds(*predict, "weights=RUN", "out=HERE")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for name in [name for name in sys.modules if name.partition(".")[0] == OWN]:
        del sys.modules[name]
    for weights in ("RUN", "RUN/weights"):
        refused = command.refuses(*predict, f"weights={tmp_path / weights}", "out=OUT")
        assert f"names {OWN}.network.MyMethod, which is no part of models" in refused
        assert refused.endswith("trust=true")
    assert "trust=true" in command.refuses("test", f"ckpt={tmp_path / 'RUN'}", "out=OUT")
    assert OWN not in sys.modules
    command.succeeds(*predict, f"weights={tmp_path / 'RUN'}", "trust=true", "out=OUT")
    assert OWN in sys.modules


def test_trust_does_not_open_what_an_extension_imports_or_what_is_installed_without_an_entry_point(
    command, method, pipeline, tmp_path
):
    command.succeeds("fit", f"experiment={OWN}", f"data.root={pipeline.toy}", *QUICK, "test=false", "out=RUN")
    config = tmp_path / "RUN/config.yaml"
    text = config.read_text()
    put(method.folder / "another/__init__.py", "def Another(**settings): ...\n")
    for target in (f"{OWN}.network.nn.Conv2d", "another.Another"):
        config.write_text(text.replace(f"{OWN}.network.MyMethod", target))
        refused = command.refuses("test", "ckpt=RUN", "trust=true", "out=OUT")
        assert f"names {target}, which is no part of models or data in this package, and not defined in" in refused
    assert "another" not in sys.modules


def test_a_data_set_of_an_extension_is_read(command, site, tmp_path):
    files = filled_template("dataset", "scans")
    put(site.folder / "scans_data/__init__.py", "")
    put(site.folder / "scans_data/scans.py", files[Path("scans.py")])
    config = files[Path("conf/data/scans.yaml")].replace("_target_: scans", "_target_: scans_data.scans")
    put(site.folder / "scans_data/conf/data/scans.yaml", config)
    put(site.folder / "write_scans.py", files[Path("test_dataset_scans.py")])
    site.add("Scans-Data", "scans_data", group=ENTRY_POINTS[1])
    import_module("write_scans").write("DATA")
    assert "scans (from Scans-Data 0.1.0)" in listed(command.succeeds("data", "check", "--help").out, "data")
    command.succeeds("data", "check", "data=scans", "data.root=DATA", "workers=1", "out=OUT")
    assert strict_json(tmp_path / "OUT/check.json")["usable"]["sequences"] == 1
    assert strict_json(tmp_path / "OUT/run.json")["extensions"] == {"Scans-Data": "0.1.0"}


def test_the_packages_options_come_first_then_those_of_extensions(command, method, tmp_path):
    put(method.folder / OWN / "conf/rasterizer/reference.yaml", "_target_: my_method.Hidden\n")
    put(tmp_path / f"conf/regressor/{OWN}.yaml", "_target_: mine.Hidden\n")
    put(tmp_path / "conf/regressor/mine.yaml", "_target_: mine.Mine\n")
    text = command.succeeds("fit", "--help").out
    assert listed(text, "rasterizer") == "auto, cuda, reference, tiled"
    assert listed(text, "regressor") == f"mine, {OWN} {FROM}, splatter_image, tiny"
    config = compose("fit", "rasterizer=reference", f"regressor={OWN}")
    assert config.rasterizer._target_.startswith("completesplat.")
    assert config.regressor._target_ == f"{OWN}.network.MyMethod"
    assert compose("fit", "regressor=mine").regressor._target_ == "mine.Mine"


@pytest.mark.parametrize("value", ["nowhere", "json", "my_method.network", "not a package", "my_method:conf"])
def test_a_distribution_without_options_is_one_line_and_the_others_stay(command, method, caplog, value):
    method.add("broken", value)
    text = command.succeeds("fit", "--help").out
    reason = f"{value!r}, which it declares as an extension, is no package with a folder conf"
    assert caplog.messages == [f"broken is left out: {reason}; update or uninstall it"]
    assert f"{OWN} {FROM}" in listed(text, "regressor")
    assert f"extension broken         broken: {reason}\n" in command.succeeds("doctor", "out=OUT").out


def test_metadata_that_cannot_be_read_disturb_nobody(command, method, caplog):
    for name in ("a", "z"):
        folder = method.folder / f"{name}-1.dist-info"
        folder.mkdir()
        (folder / "entry_points.txt").write_bytes(b"\xff\xfe[completesplat.methods]")
    extensions.installed.cache_clear()
    assert f"{OWN} {FROM}" in command.succeeds("fit", "--help").out
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("file", "text", "refusal"),
    [
        ("network.py", "import no_such_module\n", "No module named 'no_such_module'"),
        ("network.py", "class MyMethod(:\n", "SyntaxError"),
        ("network.py", "class Other: ...\n", "No module named 'my_method.network.MyMethod'"),
        ("conf/regressor/my_method.yaml", "_target_: {\n", "conf/regressor/my_method.yaml"),
    ],
)
def test_an_extension_that_fails_is_refused_in_one_line_that_names_its_distribution(
    command, method, toy_root, file, text, refusal
):
    put(method.folder / OWN / file, text)
    refused = command.refuses("fit", f"experiment={OWN}", f"data.root={toy_root}", *SMALL, "out=RUN")
    assert refusal in refused
    assert f"update or uninstall {OWN} 0.1.0" in refused or f"(a file of {OWN} 0.1.0; update" in refused
    assert command.succeeds("fit", "--help").err == ""


def test_an_extension_is_not_blamed_for_the_users_own_options(command, method, tmp_path):
    """Hydra's message lists all folders of options."""
    put(tmp_path / "conf/experiment/mine.yaml", "# @package _global_\ndefaults:\n  - /nothing: here\n")
    refused = command.refuses("fit", "experiment=mine")
    assert str(method.folder) in refused
    assert "uninstall" not in refused


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tiny", "name=tiny: the package has conf/regressor/tiny.yaml"),
        ("json", "name=json: a module has this name"),
        ("a-b", "name=a-b: must be a Python name"),
    ],
)
def test_a_package_whose_name_is_taken_is_not_begun(command, tmp_path, name, message):
    assert command.refuses("new", "package", name).startswith(message)
    assert list(tmp_path.iterdir()) == []


def test_a_package_may_be_begun_in_an_empty_clone_of_its_name(command, tmp_path):
    (tmp_path / OWN / ".git").mkdir(parents=True)
    printed = command.succeeds("new", "package", OWN).out.splitlines()
    assert printed[-3:] == [
        f"first: {sys.executable} -m pip install --editable {OWN}",
        f"next: {sys.executable} -m pytest {OWN}",
        f"then: completesplat fit experiment={OWN} data.root=DATA out=RUN",
    ]
    assert all((tmp_path / name).is_file() for name in printed[:-3])
    assert "exists already" in command.refuses("new", "package", OWN)


@pytest.mark.slow
def test_a_package_that_is_begun_is_installed_beside_the_wheel_and_used_from_an_empty_folder(
    installed, toy_root, tmp_path
):
    """It gets an environment of its own, which borrows the packages of that with the wheel."""
    (tmp_path / "clone").mkdir()
    (tmp_path / "empty").mkdir()
    installed.run(tmp_path / "clone", "completesplat", "new", "package", OWN)
    venv.create(tmp_path / "env", with_pip=True)
    packages = next((tmp_path / "env").glob("lib/python*/site-packages"))
    (borrowed,) = installed.environment.glob("lib/python*/site-packages")
    parents = [str(borrowed), *(borrowed / "parent.pth").read_text().splitlines()]
    (packages / "parent.pth").write_text("\n".join(parents) + "\n")
    shutil.copy(installed.environment / "bin/completesplat", tmp_path / "env/bin")
    python = tmp_path / "env/bin/python"
    subprocess.run([python, "-m", "pip", "install", "-q", "--no-deps", f"./{OWN}"], cwd=tmp_path / "clone", check=True)
    run = partial(installed._replace(environment=tmp_path / "env").run, tmp_path / "empty", "python", "-m")
    assert "2 passed" in run("pytest", "-q", "-p", "no:cacheprovider", tmp_path / "clone" / OWN)
    assert f"{OWN} {FROM}" in run("completesplat", "fit", "--help")
    run("completesplat", "fit", f"experiment={OWN}", f"data.root={toy_root}", *QUICK, "test=false", "out=RUN")
    run("completesplat", "test", "ckpt=RUN", f"evaluation={OWN}", "trainer.accelerator=cpu", "out=TEST")
    protocol = strict_json(tmp_path / "empty/TEST/metrics.json")["protocol"]
    assert (protocol["method"], protocol["extensions"]) == ("MyMethod", {OWN: "0.1.0"})
