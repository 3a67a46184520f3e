# SPDX-License-Identifier: Apache-2.0
"""The simulated load cell, byte by byte against the tables of the manual, and its errors against theory."""

import math
import struct

import numpy as np
import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.simulation.cell.transducer import (
    FILTERS_HZ,
    RATES_HZ,
    CellParameters,
    LoadCell,
    Transducer,
)

QUIET = CellParameters("quiet", 5000.0, 100000.0, 0.0, 0.0, 5.0, 0.3)
FIRST, SECOND = 0x001, 0x002


def cell_at(parameters=QUIET, wrench=(0.0,) * 6):
    cell = LoadCell(parameters)
    cell.step(np.array(wrench), 0.0)
    cell.step(np.array(wrench), 0.001)
    return cell


def answer(cell, *command):
    """The 16 bytes D1 to D16 of a response."""
    first, second = cell.receive(0x64, bytes(command))
    assert (first.can_id, second.can_id) == (FIRST, SECOND)
    assert len(first.data) == len(second.data) == 8
    return first.data + second.data


def test_a_wrench_has_the_bytes_of_the_manual():
    # D2-3 Fx ... D12-13 Tz as signed 16 bit, high byte first, counts = value * divisor; D14 overload
    wrench = [0.1, -0.2, 1.0, 0.01, -0.02, 0.1]
    data = answer(cell_at(wrench=wrench), 0x0A)
    assert data[:14] == bytes.fromhex("0A 01F4 FC18 1388 03E8 F830 2710 00")


def test_the_shipped_rft40_counts_50_per_newton_and_2000_per_newton_metre():
    shipped = CellParameters.from_yaml(share_path("config/load_cells/rft40.yaml"))
    assert (shipped.force_divisor, shipped.torque_divisor) == (50.0, 2000.0)
    assert 1 / shipped.force_divisor == 0.020  # one count [N]


@pytest.mark.parametrize("axis", range(6))
def test_overload_bits_5_to_0_are_fx_to_tz(axis):
    wrench = np.zeros(6)
    wrench[axis] = 5.1 if axis < 3 else 0.31
    cell = cell_at(wrench=wrench)
    assert answer(cell, 0x0A)[13] == 1 << (5 - axis)
    counts = answer(cell, 0x12)
    assert list(counts[1:7]) == [int(i == axis) for i in range(6)]


def test_overloads_are_counted_when_they_begin():
    cell = LoadCell(QUIET)
    for i, force in enumerate([0, 6, 6, 0, 6, 0]):
        cell.step(np.array([force, 0, 0, 0, 0, 0.0]), 0.001 * i)
    assert answer(cell, 0x12)[1] == 2


def test_commands_answer_as_documented():
    cell = cell_at()
    assert answer(cell, 0x01)[:6] == b"\x01quiet"
    assert answer(cell, 0x05)[:4] == bytes([0x05, 0x64, 0x01, 0x02])
    assert answer(cell, 0x04, 0x65, 0x03, 0x04)[:3] == bytes([0x04, 1, 0])
    # valid from the next power-up: both are told
    assert answer(cell, 0x05)[:7] == bytes([0x05, 0x64, 1, 2, 0x65, 3, 4])
    assert answer(cell, 0x10)[:2] == bytes([0x10, 0])  # 200 Hz after power-up
    assert answer(cell, 0x0F, 9)[:3] == bytes([0x0F, 0, 2])  # out of range
    assert answer(cell, 0x08, 2, 0)[:3] == bytes([0x08, 0, 2])
    assert answer(cell, 0x08, 1, 15)[:3] == bytes([0x08, 0, 2])
    assert answer(cell, 0x0E)[:3] == bytes([0x0E, 0, 1])  # unsupported
    for quiet in (0x0B, 0x0C, 0x11):
        assert cell.receive(0x64, bytes([quiet, 0])) == []
    assert cell.receive(0x65, bytes([0x01])) == []  # not its identifier


@pytest.mark.parametrize("code", range(9))
def test_rates(code):
    cell = cell_at()
    assert answer(cell, 0x0F, code)[:3] == bytes([0x0F, 1, 0])
    assert answer(cell, 0x10)[1] == code
    cell.receive(0x64, b"\x0b")
    frames = []
    for i in range(2, 1002):
        frames += cell.step(np.zeros(6), 0.001 * i)
    assert len(frames) == 2 * RATES_HZ[code]
    assert {f.data[0] for f in frames[::2]} == {0x0B}
    period_s = np.diff([f.time_s for f in frames[::2]])
    np.testing.assert_allclose(period_s, round(1e3 / RATES_HZ[code]) * 1e-3, atol=1e-9)


def test_while_streaming_only_stop_and_bias_are_taken():
    cell = cell_at(wrench=[0, 0, 1.0, 0, 0, 0])
    cell.receive(0x64, b"\x0b")
    for command in (0x01, 0x05, 0x08, 0x0F, 0x10, 0x12, 0x0A):
        assert cell.receive(0x64, bytes([command, 1])) == []
    cell.receive(0x64, b"\x11\x01")
    now = np.array([0, 0, 1.0, 0, 0, 0])
    frame = cell.step(now, 0.006)[0]  # 200 Hz
    assert struct.unpack(">3h", frame.data[1:7])[2] == 0
    cell.receive(0x64, b"\x11\x00")
    frame = cell.step(now, 0.011)[0]
    assert struct.unpack(">3h", frame.data[1:7])[2] == 5000
    cell.receive(0x64, b"\x0c")
    assert cell.step(now, 0.2) == []
    assert len(cell.receive(0x64, b"\x01")) == 2


@pytest.mark.parametrize("code", range(1, 15))
def test_the_filter_is_a_first_order_low_pass_of_its_corner(code):
    corner_hz = FILTERS_HZ[code]
    cell = LoadCell(QUIET)
    answer(cell, 0x08, 1, code)
    cell.step(np.zeros(6), 0.0)
    cell.step(np.zeros(6), 0.001)
    for i in range(1, 11):
        cell.step(np.array([4.0, 0, 0, 0, 0, 0]), 0.001 + 1e-9 + 0.001 * i)
    got = struct.unpack(">h", answer(cell, 0x0A)[1:3])[0] / 5000
    assert got == pytest.approx(4 * (1 - math.exp(-2 * math.pi * corner_hz * 0.010)), abs=2e-4)


def test_the_wrench_runs_linearly_between_steps():
    cell = cell_at()
    answer(cell, 0x0F, 8)
    cell.receive(0x64, b"\x0b")
    frames = cell.step(np.array([0, 0, 1.0, 0, 0, 0]), 0.005)
    forces = [struct.unpack(">h", f.data[5:7])[0] / 5000 for f in frames[::2]]
    np.testing.assert_allclose(forces, [0.25, 0.5, 0.75, 1.0], atol=1e-4)
    assert [f.time_s for f in frames[::2]] == pytest.approx([0.002, 0.003, 0.004, 0.005])


def test_noise_and_resolution_are_those_required_of_a_cell():
    fine = CellParameters.from_yaml()
    assert 1 / fine.force_divisor == pytest.approx(0.2e-3)
    transducer = Transducer(fine, seed=3)
    n = 20000
    counts = np.array([transducer.convert_once((0.0,) * 6)[:6] for _ in range(n)])
    force = counts[:, :3] / fine.force_divisor
    drift = fine.force_drift_n_per_s * 0.001 * np.arange(1, n + 1)
    residual = force - np.array(fine.force_bias_n) - drift[:, None]
    # quantisation adds LSB^2/12; standard error of a variance over n samples: sqrt(2/n), here five of them
    variance = fine.force_noise_rms_n**2 + (0.2e-3) ** 2 / 12
    assert residual.var(axis=0) == pytest.approx(variance, rel=5 * math.sqrt(2 / n))
    assert np.abs(residual.mean(axis=0)).max() < 5 * math.sqrt(variance / n)


def test_faults_are_what_they_are_called():
    load = np.array([0.1, 0.2, 0.3, 0, 0, 0])
    cell = cell_at(wrench=load)
    answer(cell, 0x0F, 8)
    cell.receive(0x64, b"\x0b")
    time_s = 0.001

    def wrenches(wrench=load):
        nonlocal time_s
        time_s += 0.004
        frames = cell.step(wrench, time_s)
        return [struct.unpack(">3h", f.data[1:7]) for f in frames if f.can_id == FIRST], frames

    cell.faults.inject("silent", 1)
    assert wrenches()[1] == []
    cell.faults.inject("silent", 0)
    cell.faults.inject("stuck", 1)
    assert wrenches(2 * load)[0] == [(500, 1000, 1500)] * 4
    cell.faults.inject("stuck", 0)
    wrenches()
    cell.faults.inject("flipped", 1)
    assert wrenches()[0] == [(-500, -1000, -1500)] * 4
    cell.faults.inject("flipped", 0)
    cell.faults.inject("bias_step_n", 0.02)
    assert wrenches()[0] == [(500, 1000, 1600)] * 4
    cell.faults.inject("bias_step_n", 0)
    cell.faults.inject("invalid", 1)
    assert wrenches()[0][0][2] == -32768
    cell.faults.inject("invalid", 0)
    cell.faults.inject("saturated", 1)
    assert wrenches()[0][0][2] == 32767
    cell.faults.inject("saturated", 0)
    cell.faults.inject("lose_second_every", 2)
    assert [f.can_id for f in wrenches()[1]].count(SECOND) == 2
    cell.faults.inject("lose_second_every", 0)
    assert wrenches()[0] == [(500, 1000, 1500)] * 4
    with pytest.raises(ValueError, match="tilted"):
        cell.faults.inject("tilted", 1)


def test_a_bad_file_is_refused_with_its_field(tmp_path):
    path = tmp_path / "cell.yaml"
    text = share_path("config/load_cells/fine.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("force_divisor: 5000.0", "force_divisor: 0"), encoding="utf-8")
    with pytest.raises(ValueError, match="force_divisor: got 0"):
        CellParameters.from_yaml(path)
    path.write_text("name: x\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"force_divisor.*missing"):
        CellParameters.from_yaml(path)
