import os
import subprocess
import sys

import pytest
from support import python

from completesplat import __version__
from completesplat.cli import VERBS
from completesplat.settings.help import help_page

NOT_THERE = [["predict", "a.jpg"], ["predict"], ["test"], ["test", "ckpt=a.ckpt"]]
NOT_THERE += [["predict", __file__, setting] for setting in ("weights=none", "formats=obj", "video=zoom")]
NOT_THERE += [["view", "weights=none"]]


@pytest.mark.processes
def test_help_needs_no_heavy_import():
    for given, unneeded in (("", ["hydra"]), ("'predict', ", [])):
        program = f"import sys; sys.argv = ['', {given}'--help']; from completesplat.cli import main; main()\n"
        unneeded += ["torch", "lightning", "diffusers", "numpy"]
        assert python(program + f"print(sys.modules.keys() & {unneeded})").splitlines()[-1] == "set()"


@pytest.mark.processes
@pytest.mark.parametrize("given", NOT_THERE, ids=" ".join)
def test_what_is_not_there_is_refused_before_torch_is_imported(given, tmp_path):
    program = f"import sys; sys.argv = ['', *{given}]; from completesplat.cli import main\n"
    program += "try: main()\nexcept SystemExit as stop: print(stop.code, 'torch' in sys.modules)"
    assert python(program, cwd=tmp_path) == "2 False\n"


@pytest.mark.processes
def test_a_reader_that_goes_away_is_no_fault_of_the_program():
    program = "import sys; sys.argv = ['completesplat', 'fit', '--help']; from completesplat.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 1


@pytest.mark.processes
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs Linux's /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("arguments", ["--version", "doctor"])
def test_an_output_that_cannot_be_written_is_one_line(arguments, unbuffered, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    started = [sys.executable, "-m", "completesplat", *arguments.split()]
    with open("/dev/full", "w") as full:
        done = subprocess.run(started, stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    refused = "error: standard output: cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, refused)


@pytest.mark.processes
@pytest.mark.parametrize("given", [None, "7"])
@pytest.mark.parametrize("user", ["completesplat.CompleteSplat", "from completesplat.cli import main; main()"])
def test_torch_is_loaded_with_threads_that_spin_briefly(user, given):
    """The setting counts at the moment when torch is loaded, so a new process prints it there and ends."""
    program = "import os, sys; sys.argv = ['completesplat', 'doctor']; import completesplat\n"
    program += "class Watch:\n    def find_spec(self, name, *_):\n        if name == 'torch':\n"
    program += "            print('torch with', os.environ.get('GOMP_SPINCOUNT'), flush=True); os._exit(0)\n"
    program += f"sys.meta_path.insert(0, Watch())\n{user}"
    environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    environment |= {} if given is None else {"GOMP_SPINCOUNT": given}
    assert f"torch with {given or 1500}" in python(program, env=environment).splitlines()


def test_help_shows_all_verbs_and_the_settings_of_each(command):
    assert command("--version").out == f"completesplat {__version__}\n"
    verbs = command.succeeds("--help").out
    for verb in VERBS:
        assert f"  {verb} " in verbs
        assert command.succeeds(verb, "--help").out == help_page(verb) + "\n"


@pytest.mark.processes
def test_two_launches_in_one_second_do_not_share_a_directory():
    program = "import os, hydra; os.fork(); from completesplat.settings.composition import RUN_NAME; print(RUN_NAME)"
    assert len(set(python(program).splitlines())) == 2
