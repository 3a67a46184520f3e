# SPDX-License-Identifier: Apache-2.0
"""The Python in docs/force_sensors.md does what the page says."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.payload import Payload

PAGE = Path(__file__).resolve().parent.parent / "docs" / "force_sensors.md"
HOST = "127.0.6.6"


def block_with(word):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (found,) = [block for block in blocks if word in block]
    return found


def test_the_payload_is_found(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    turns = [[0, 0, 0], [0.9, 0, 0], [-0.9, 0, 0], [0, 0.9, 0], [0, -0.9, 0]]
    rotations = Rotation.from_rotvec(turns).as_matrix()
    payload = Payload(0.06, (0.0, 0.004, 0.03))
    loads = np.array([payload.wrench(tuple(rotation.ravel())) for rotation in rotations])
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((5, 1000, 6)) * np.repeat([1e-3, 5e-5], 3)
    readings = loads[:, None] + [0.02, 0, 0.03, 0, 0, 0] + noise
    np.savez("payload.npz", rotations=rotations, readings=readings)
    exec(compile(block_with("identify_payload"), str(PAGE), "exec"), {})
    text = capsys.readouterr().out
    mass, error = map(float, re.search(r"mass (\S+) \+- (\S+) g", text).groups())
    assert abs(mass - 60) < 5 * error < 0.1
    assert "consistent: True" in text


def test_the_cell_is_read(tmp_path, monkeypatch, capsys):
    pytest.importorskip("can", reason="python-can is not installed")
    monkeypatch.chdir(tmp_path)
    # on a busy machine the simulated cell sends less than it states, which the driver says rightly
    monkeypatch.setattr("tactile_resonance.drivers.can_bus.Flow.short", lambda *_: None)
    command = [sys.executable, "-m", "tactile_resonance.cli", "simulate-cell"]
    cell = subprocess.Popen(
        [*command, "--host", HOST, "--port", "0"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        port = int(cell.stdout.readline().rsplit(":", 1)[1])
        content = yaml.safe_load(
            share_path("config/force/can_simulated.yaml").read_text(encoding="utf-8")
        )
        content["bus"].update(host=HOST, port=port)
        content["limits"]["silent_s"] = 1.0
        Path("mine.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        exec(compile(block_with("cell.read()"), str(PAGE), "exec"), {})
    finally:
        cell.terminate()
        cell.communicate(timeout=60.0)
    stamps = [int(ns) for ns in re.findall(r"^(\d+) \(", capsys.readouterr().out, re.MULTILINE)]
    assert len(stamps) > 100  # more than one for each time that the page reads
    assert stamps == sorted(set(stamps))
