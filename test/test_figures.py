# SPDX-License-Identifier: Apache-2.0
from tactile_resonance import cli


def test_variance_figure_is_drawn_and_marked_as_simulated(tmp_path, capsys):
    assert cli.main(["figures", "variance", "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    for source in ("period", "repetition", "position", "preparation"):
        assert f"over {source}: -" in printed
    assert (tmp_path / "variance.png").stat().st_size > 20_000


def test_figures_of_the_simulation_are_drawn(tmp_path, capsys):
    assert cli.main(["figures", "simulation", "--output", str(tmp_path)]) == 0
    assert "tissues.png" in capsys.readouterr().out
    for name in ("tissues", "indentation", "scene", "creep"):
        assert (tmp_path / f"{name}.png").stat().st_size > 40_000
