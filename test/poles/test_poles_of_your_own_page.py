# SPDX-License-Identifier: Apache-2.0
"""The Python in docs/poles.md does what the page says, and the page knows every status."""

import re
from pathlib import Path

import pytest

from tactile_resonance.poles.result import PolesStatus

PAGE = Path(__file__).resolve().parents[2] / "docs" / "poles.md"


def test_the_example_finds_its_mode(capsys):
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(compile(block, str(PAGE), "exec"), names)
    poles, batch = names["poles"], names["batch"]
    assert capsys.readouterr().out.startswith("ok")
    assert abs(poles.f0_hz[0] - 250) < 4 * poles.covariance[0, 0, 0] ** 0.5
    assert batch.f0_hz.shape == (2, 1)
    assert batch.f0_hz[1] == pytest.approx(batch.f0_hz[0], rel=1e-9)


def test_every_status_is_explained():
    said = set(re.findall(r"`([a-z ]+)`", PAGE.read_text(encoding="utf-8")))
    assert {status.value for status in PolesStatus} <= said
