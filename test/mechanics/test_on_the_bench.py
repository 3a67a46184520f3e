# SPDX-License-Identifier: Apache-2.0
"""Relaxation as contact control carries it out on the bench, and the command that reads it."""

import json

import numpy as np
import pytest

from tactile_resonance import cli
from tactile_resonance.commands.mechanics import COLUMNS
from tactile_resonance.mechanics.fit import fit_indentation
from tactile_resonance.mechanics.indentation import Protocol
from tactile_resonance.sensor import sensor_named
from tactile_resonance.simulation.plant.contact_bench import indent_tissue
from tactile_resonance.simulation.tissue.library import read_tissues


def relaxed(name, hold_s, **options):
    tissue = read_tissues()[name]
    asked = {"hold_s": hold_s, "force_n": 0.015, **options}
    return tissue, indent_tissue(tissue, sensor_named("bimorph"), Protocol.RELAXATION, **asked)


@pytest.mark.parametrize(
    ("name", "hold_s", "least", "most"),
    [("cortex", 40.0, 0.6, 0.8), ("liver", 60.0, 0.6, 0.8), ("gel12", 40.0, 0.1, 0.35)],
)
def test_brain_and_liver_lose_most_of_the_force_and_gelatine_does_not(name, hold_s, least, most):
    tissue, record = relaxed(name, hold_s)
    fit = fit_indentation(record)
    assert least < fit.relaxed_share < most
    for at in (1.0, 10.0):
        value, std = fit.modulus(at)
        assert abs(np.log(value / tissue.prony.relaxation_modulus(at))) < 4 * std


def test_the_command_reads_a_file_and_needs_to_know_what_holds_the_ball(tmp_path, capsys):
    tissue, record = relaxed("liver", 15.0, rigid=False)
    path = tmp_path / "relax.csv"
    columns = np.column_stack([record.time_s, record.force_n, record.depth_m])
    np.savetxt(path, columns, delimiter=",", header="time_s,force_n,indentation_m", comments="")
    command = ["mechanics", str(path), "--radius-m", "2.5e-3"]
    assert cli.main(command) == 1
    assert "--stiffness-n-per-m: got None; accepted is one of it and --rigid" in capsys.readouterr().err
    out, plot = tmp_path / "out.json", tmp_path / "out.png"
    given = ["--stiffness-n-per-m", str(record.ball.stiffness_n_per_m)]
    assert cli.main([*command, *given, "--json", str(out), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    assert "relaxation" in printed
    assert "not determined: slower than the hold" in printed
    (found,) = json.loads(out.read_text())
    value, std = found["modulus_pa"]["1"]
    assert abs(np.log(value / tissue.prony.relaxation_modulus(1.0))) < 4 * std
    assert found["modulus_pa"]["60"] == [None, None]
    assert plot.stat().st_size > 20_000
    # the stage's way taken for the ball's: softer than it is, by much
    assert cli.main([*command, "--rigid", "--json", str(out)]) == 0
    (wrong,) = json.loads(out.read_text())
    assert wrong["modulus_pa"]["1"][0] < 0.7 * tissue.prony.relaxation_modulus(1.0)
    # what a run holds would be written anew: wrong options are refused before anything is read
    assert cli.main([*command, "--rigid", "--terms", "0"]) == 1
    assert capsys.readouterr().err.endswith("most_terms: got 0; accepted is 1 to 6\n")
    in_millimetres = ["mechanics", str(path), "--radius-m", "2.5", "--rigid"]
    assert cli.main(in_millimetres) == 1
    told = capsys.readouterr().err
    assert told.endswith("--radius-m: got 2.5; accepted is metres, at most 0.1: 1.5 mm are 1.5e-3\n")
    # in millimetres: what comes of it is said with its digits
    for name, of in (("mm", 1.0), ("nan", np.nan)):
        path = tmp_path / f"{name}.npz"
        np.savez(path, **dict(zip(COLUMNS, columns.T * np.array([[1], [of], [1e3]]), strict=True)))
        assert cli.main(["mechanics", str(path), *command[2:], "--rigid"]) == int(name == "nan")
        printed = capsys.readouterr()
        assert " 0 Pa" not in printed.out
    assert printed.err.endswith("nan.npz: force_n: got 'nan at sample 0'; accepted is finite numbers\n")
    np.savez(tmp_path / "complex.npz", **dict(zip(COLUMNS, columns.T + 1j, strict=True)))
    assert cli.main(["mechanics", str(tmp_path / "complex.npz"), *command[2:], "--rigid"]) == 1
    assert "complex.npz: time_s: got 'complex numbers'" in capsys.readouterr().err
