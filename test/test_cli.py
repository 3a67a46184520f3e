# SPDX-License-Identifier: Apache-2.0
"""The command itself: its version, and what it says before it compiles."""

import argparse
import math
import os
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from tactile_resonance import cli, configuration
from tactile_resonance.commands.options import add_option
from tactile_resonance.mechanics import course
from tactile_resonance.processes import ENDING

ROOT = Path(__file__).resolve().parent.parent


def test_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    version = ElementTree.parse(ROOT / "package.xml").findtext("version")
    assert capsys.readouterr().out == f"tactile_resonance {version}\n"


def test_no_other_command_needs_the_file_of_the_version(monkeypatch, capsys):
    # it is not where the package alone was installed, as by pip into a folder or for one user
    def missing(_):
        raise FileNotFoundError("shared file 'package.xml' not found")

    monkeypatch.setattr(configuration, "share_path", missing)
    with pytest.raises(SystemExit, match="0"):
        cli.main(["analyze", "--help"])
    assert "--band" in capsys.readouterr().out
    assert cli.main(["--version"]) == 1
    assert "package.xml" in capsys.readouterr().err


def test_a_program_that_calls_a_command_keeps_its_handlers_of_signals(handlers):
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert {signal.getsignal(number) for number in ENDING} == {signal.SIG_IGN}


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_command_of_a_shell_ends_in_order_whichever_signal_ends_it(name):
    program = f"""
import os, signal
from types import SimpleNamespace
from tactile_resonance import cli

parsed = SimpleNamespace(run=lambda _: os.kill(os.getpid(), signal.{name}))
cli._parser = lambda _: SimpleNamespace(parse_args=lambda _: parsed)
cli.command()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "tactile_resonance: interrupted\n"


def test_the_commands_of_each_module_are_known_before_it_is_loaded():
    for module, own in cli.COMMANDS.items():
        for name in own:
            made = cli._parser([name])._actions[-1].choices
            assert tuple(made) == own, module
    every = tuple(name for own in cli.COMMANDS.values() for name in own)
    for asked in ([], ["nothing"], ["--help"]):
        assert tuple(cli._parser(asked)._actions[-1].choices) == every


def test_a_command_loads_nothing_of_the_others():
    program = "import sys; from tactile_resonance import cli; cli._parser(['demo']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    found = set(done.stdout.split())
    assert "tactile_resonance.commands.bench_scan" in found
    assert found.isdisjoint({"scipy", "numba", "matplotlib", "tactile_resonance.commands.simulate"})


def test_pages_of_a_run_load_no_statistics():
    """As each demo does at its end: they take longer to load than the pages to be made."""
    program = "import sys; from tactile_resonance.report import run_map, run_report; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    found = set(done.stdout.split())
    assert "tactile_resonance.report.drawing" in found
    assert found.isdisjoint({"scipy.signal", "scipy.stats"})


def test_an_option_has_the_kind_of_its_default_which_help_tells():
    parser = argparse.ArgumentParser()
    add_option(parser, "--level P", 0.01, "of a test")
    add_option(parser, "--most", 6)
    add_option(parser, "--thickness-m M", math.nan, "of a layer")
    add_option(parser, "--namespace", "", "of the nodes")
    add_option(parser, "--band LO HI", float, "[Hz]", dest="band_hz")
    add_option(parser, "--rigid", False)
    options = parser.parse_args([])
    assert (options.level, options.most, options.namespace, options.band_hz) == (0.01, 6, "", None)
    assert math.isnan(options.thickness_m)
    assert options.rigid is False
    options = parser.parse_args(["--level", "1", "--most", "2", "--band", "200", "300", "--rigid"])
    assert (options.level, options.most, options.band_hz) == (1.0, 2, [200.0, 300.0])
    assert type(options.level) is float
    assert options.rigid is True
    told = [" ".join(line.split()) for line in parser.format_help().splitlines()]
    for line in (
        *("--level P of a test (default: 0.01)", "--most MOST default: 6", "--band LO HI [Hz]"),
        *("--thickness-m M of a layer", "--namespace NAMESPACE", "of the nodes", "--rigid"),
    ):
        assert line in told


@pytest.mark.parametrize(
    "command", [["plan", "scene.yaml"], ["mechanics", "RUN"], ["analyze", ".", "--point", "2"]]
)
def test_a_library_for_runs_that_is_missing_is_named(command):
    code = """
import sys
sys.modules["rosbags"] = None
from tactile_resonance.cli import main
sys.exit(main(sys.argv[1:]))
"""
    done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        "tactile_resonance: rosbags not found, which reads runs: pip install 'rosbags>=0.11.1,<0.12'\n"
    )


def test_a_larger_grid_is_refused_where_there_is_none(tmp_path, capsys):
    assert cli.main(["benchmark", "frf", "--full", "--output", str(tmp_path / "out")]) == 1
    assert "--full: got True; accepted is with contact, hostile only" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_compiling_is_announced_once_and_before_it_begins():
    """A cheap function in place of the kernels, compiled twice; what the cache holds is not announced."""
    code = """
import numba, sys
from tactile_resonance.poles import compiled

def kernels():
    add = numba.njit(lambda x: x + 1)
    print("called", file=sys.stderr)
    add(1), add(1.0)

compiled.rehearse = kernels
compiled.compiled()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    called, *said = done.stderr.splitlines()
    assert called == "called"
    (line,) = said
    assert line.startswith("compiling the pole fits, once per installation: about a minute")
    assert line.endswith("tactile_resonance compile")


def test_compile_says_that_nothing_is_missing(capsys):
    """The tests before have compiled, or set-up has."""
    assert cli.main(["compile"]) == 0
    assert cli.main(["compile"]) == 0
    assert capsys.readouterr().out.count("fits: ") == 2


def test_what_compile_has_compiled_is_all_that_mechanical_tests_need():
    """In another process compile, and then first fits, compile nothing and load nothing else from the cache."""
    code = """
import sys

import numpy as np
from numba.core import event

from tactile_resonance.mechanics import course
from tactile_resonance.mechanics.fit import fit_indentation
from tactile_resonance.mechanics.indentation import Prony

sys.path.insert(0, sys.argv[1])
from benchmarks.mechanics import relaxation

print(course.compiled())
kernels = course._pressed, course._press
before = [kernel.signatures for kernel in kernels]
solid, rng = Prony(3e3, np.array([2e3]), np.array([1.5])), np.random.default_rng(1)
with event.install_recorder("numba:compile") as heard:
    for stiffness in (np.inf, 15.0):
        test = relaxation(solid, rng, hold_s=3.0, stiffness_n_per_m=stiffness)
        for array in (test.time_s, test.force_n, test.depth_m):
            array.setflags(write=False)
        fit_indentation(test)
print(len(heard.buffer))
print(sum(len(kernel.signatures) for kernel in kernels) - sum(map(len, before)))
"""
    course.compiled()
    done = subprocess.run(
        [sys.executable, "-c", code, str(ROOT)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["0", "0", "0"]


def test_files_and_folders_taken_for_each_other_are_named(tmp_path, capsys):
    file = tmp_path / "file.yaml"
    file.touch()
    for arguments, message in (
        (["report", file], f"path: {file} is a file; accepted is the folder of a scan's run"),
        (["report", tmp_path], f"path: {tmp_path} is a folder without run.json"),
        (["scan", "--scene", tmp_path], f"--scene: {tmp_path} is a folder; accepted is a scene"),
        (["scan", "--scene", tmp_path / "no"], "no is not there; accepted is a scene file"),
        (["demo", "--output", file], f"--output: {file} is a file; accepted is a new or empty"),
        (["analyze", tmp_path, "--sample-rate", "1"], "(--sample-rate): only for a file"),
        (["analyze", file], "file.yaml: no record, accepted are .npz, .mat and .csv"),
    ):
        assert cli.main([os.fspath(argument) for argument in arguments]) == 1
        assert message in capsys.readouterr().err


def test_a_letter_that_the_terminal_does_not_have_is_no_error(tmp_path):
    """Before, a scene with an umlaut in its name ended `plan` in a terminal without one."""
    scene = tmp_path / "scene.yaml"
    scene.write_text("name: Gewölbe\nforce_n: 0.01\npositions: {list: [[0, 0]]}\n", "utf-8")
    code = "from tactile_resonance.cli import command; command()"
    done = subprocess.run(
        [sys.executable, "-c", code, "plan", scene],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("plan of Gew\\xf6lbe\n")


def test_a_command_that_has_no_standard_output_says_what_is_wrong_all_the_same():
    command = f"{sys.executable} -m tactile_resonance.cli analyze nowhere.npz >&-"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "tactile_resonance: nowhere.npz: no such file or folder\n")
