# SPDX-License-Identifier: Apache-2.0
"""Force sources by configuration: what ships is read, what is wrong is named; and the force at the tip."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmError, ArmFault, ForceError, ForceFault
from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import six
from tactile_resonance.drivers.force_config import RtdeWrench, force_source, read_force_config
from tactile_resonance.simulation.cell.transducer import CellParameters

sys.path.insert(0, str(Path(__file__).parent))


def test_the_simulated_cell_serves_1_cn():
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    assert config.resolution_n == pytest.approx(2e-4)
    assert config.mount is Mount.TABLE
    assert config.bus["tcp_tune"] is True
    np.testing.assert_allclose(np.diag(config.scale), [2e-4] * 3 + [1e-5] * 3)


@pytest.mark.parametrize(
    ("force", "cell"), [("can_simulated.yaml", "fine.yaml"), ("can_rft40.yaml", "rft40.yaml")]
)
def test_driver_and_simulation_agree_on_the_cell(force, cell):
    config = read_force_config(Path(force))
    simulated = CellParameters.from_yaml(share_path(f"config/load_cells/{cell}"))
    assert config.resolution_n == pytest.approx(1 / simulated.force_divisor)
    assert config.noise_rms_n == simulated.force_noise_rms_n
    assert config.range_n == simulated.force_range_n
    assert config.range_nm == simulated.torque_range_nm


def test_the_shipped_robotous_is_refused_for_1_cn_and_serves_newtons():
    with pytest.raises(
        ValueError, match="RFT40 cannot control 10 mN: .*its smallest step is 20 mN"
    ):
        read_force_config(Path("can_rft40.yaml"), force_n=0.01)
    config = read_force_config(Path("can_rft40.yaml"), force_n=2.0)
    assert config.payload.mass_kg == 0.05


def test_a_topic_is_read():
    assert read_force_config(Path("topic.yaml"), force_n=0.01).topic == "wrench_raw"


# Fx is shown as Fy
BLIND = [[0.0] * 5 + [1e-3]] * 2 + [[float(i == j) for j in range(6)] for i in range(4)]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"kind": "usb"}, "kind: got 'usb'; accepted is one of can, rtde, topic"),
        ({"kind": ["can"]}, r"kind: got \['can'\]; accepted is one of can, rtde, topic"),
        ({"name": 0}, "name: got 0; accepted is text"),
        ({"counts_per_n": "5000"}, "counts_per_n: got '5000'; accepted is a number above 0"),
        ({"counts_per_n": -5}, "counts_per_n: got -5; accepted is a number above 0"),
        ({"counts_per_n": None}, "counts_per_n: got None; .*or a matrix in place of both"),
        ({"rate_hz": 999}, "rate_hz: got 999.0; accepted is one of"),
        ({"rate_hz": "fast"}, "rate_hz: got 'fast'"),
        ({"noise_rms_n": -1}, "noise_rms_n: got -1.0"),
        ({"mount": "wall"}, "mount: got 'wall'"),
        ({"frame": {"position_m": [0, 0]}}, "frame.position_m"),
        ({"payload": {"mass_kg": 0.1, "centre_m": [0, 0, 0]}}, "payload"),
        ({"limits": {"silent_s": 0.001}}, "limits.silent_s: got 0.001"),
        ({"limits": {"jumps": 1}}, "limits.jumps"),
        ({"matrix": BLIND, "resolution_n": 1e-4}, "matrix: .*rows that are independent"),
        ({"limits": {"lost_tolerated": 0.5}}, "limits.lost_tolerated"),
        ({"bus": {"channel": "can0"}}, "bus.interface"),
        ({"bus": {"interface": "socketcand", "port": 29536}}, "bus.host: got None"),
        ({"bus": {"interface": "socketcand", "host": "a", "port": 9}}, "bus.channel: got None"),
        (
            {"bus": {"interface": "socketcand", "host": "a", "channel": "can0", "port": 99999}},
            "bus.port: got 99999",
        ),
        ({"latency_s": 1000.0}, "latency_s: got 1000.0; accepted is 0 to 1"),
        ({"rate_hz": 10**400}, "rate_hz: got 1000"),
        ({"frames": "none.yaml"}, "none.yaml: neither a file here nor one of config/force/frames"),
        ({"stamps": "gps"}, "stamps"),
        ({"frames": None}, "frames"),
        ({"matrix": [[1] * 6] * 5}, "matrix"),
        ({"matrix": np.eye(6).tolist()}, "counts_per_n"),
        ({"topic": "wrench"}, "topic"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, change, reason):
    shipped = share_path("config/force/can_simulated.yaml")
    content = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**content, **change}), encoding="utf-8")
    with pytest.raises(ValueError, match=f"mine.yaml: {reason}"):
        read_force_config(path)


def test_a_description_beside_the_configuration_is_found(tmp_path):
    content = yaml.safe_load(
        share_path("config/force/can_simulated.yaml").read_text(encoding="utf-8")
    )
    frames = share_path("config/force/frames/robotous.yaml").read_text(encoding="utf-8")
    (tmp_path / "other.yaml").write_text(frames.replace("0x001", "0x011"), encoding="utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({**content, "frames": "other.yaml"}), encoding="utf-8")
    assert read_force_config(path).description.frame_ids == (0x11, 0x02)


def test_no_such_file():
    with pytest.raises(ValueError, match=r"nowhere\.yaml: neither a file here nor"):
        read_force_config(Path("nowhere.yaml"))


def test_the_tip_feels_what_presses_on_the_cell_under_the_sample():
    """10 mN down on the cell, through CAN, is +10 mN along the normal at a tilted tip."""
    pytest.importorskip("can", reason="python-can is not installed")
    from cell_bench import CellBench

    # the surface's normal is tilted by 0.1 rad about y; the force on the cell is against it
    state = ArmSample(0, 0.0, (0.3, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0,) * 6)
    normal = state.tip.rotation.apply([0, 0, 1])
    quiet = CellParameters("quiet", 5000.0, 1e5, 1e-3, 5e-5, 5.0, 0.3)
    bench = CellBench(quiet, (*(-0.01 * normal), 0.0, 0.0, 0.0))
    source = force_source(bench.config(), SimpleNamespace(clock=bench.clock))
    try:
        source.start()
        samples = bench.go(source, 1000)
    finally:
        source.close()
        bench.close()
    felt = source.mounting.to_tip(samples, state.position_m, state.tip.turn)
    force = np.array([sample.force_n for sample in felt])
    assert force.shape == (1000, 3)
    np.testing.assert_allclose(force.mean(axis=0), [0, 0, 0.01], atol=5 * 1e-3 / np.sqrt(1000))


def test_a_topic_needs_a_node():
    with pytest.raises(ValueError, match="topic is for nodes only"):
        force_source(read_force_config(Path("topic.yaml")), None)


CONFIG = read_force_config(Path("rtde_ur.yaml"))
PLACE_M, TURNED_RAD, STILL = (0.4, 0.0, 0.3), (np.pi / 2, 0.0, 0.0), (0.0,) * 6


class HandClock:
    """A clock that goes on where the test says so."""

    simulated = True

    def __init__(self):
        self.ns = 5_000_000_000

    def now_ns(self):
        return self.ns


class States:
    """An arm that hands out a state; None: it raises."""

    def __init__(self):
        self.clock = HandClock()
        self.now = self.at(1.0, [0.0] * 6)

    def at(self, time_s, wrench):
        time_ns, wrench = round(time_s * 1e9), None if wrench is None else six(wrench)
        return ArmSample(time_ns, time_s, PLACE_M, TURNED_RAD, STILL, tool_wrench=wrench)

    def recent(self):
        if self.now is None:
            raise ArmError(ArmFault.STALE, "state is 30 ms old")
        return self.now


def test_the_wrench_is_turned_into_the_frame_of_the_tip():
    # the tip is turned by 90 degrees about x: its y axis is the base's z, its z the base's -y
    states = States()
    source = RtdeWrench(CONFIG, states)
    source.start()
    assert source.read() == []
    states.now = states.at(1.002, [1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    (sample,) = source.read()
    np.testing.assert_allclose(sample.wrench, [1, 3, -2, 0.1, 0.3, -0.2], atol=1e-12)
    assert sample.time_ns == 1_002_000_000
    assert source.read() == []  # one state, one wrench


def test_a_wrench_of_the_tip_is_not_taken_for_one_under_the_sample():
    with pytest.raises(ValueError, match="mount, frame, payload: expected tool"):
        RtdeWrench(replace(CONFIG, mount=Mount.TABLE), States())


@pytest.mark.parametrize(
    ("state", "fault"),
    [
        (None, ForceFault.LINK_LOST),
        ([0, 0, 101, 0, 0, 0], ForceFault.OVERLOAD),
        ([0, 0, np.nan, 0, 0, 0], ForceFault.INVALID),
    ],
)
def test_faults_are_named_and_end(state, fault):
    states = States()
    source = RtdeWrench(CONFIG, states)
    source.start()

    def read_five():
        for i in range(1, 6):
            states.now = None if state is None else states.at(1 + 0.002 * i, state)
            source.read()

    with pytest.raises(ForceError) as caught:
        read_five()
    assert caught.value.fault is fault
    states.now = states.at(2.0, [0.0] * 6)
    source.start()
    states.now = states.at(2.002, [0.0] * 6)
    assert len(source.read()) == 1


def test_a_robot_clock_that_stands_still_is_silence():
    states = States()
    config = replace(CONFIG, limits=replace(CONFIG.limits, silent_s=0.004))
    source = RtdeWrench(config, states)
    source.start()
    states.clock.ns += 3_900_000
    assert source.read() == []
    states.clock.ns += 200_000
    with pytest.raises(ForceError, match="no new state") as caught:
        source.read()
    assert caught.value.fault is ForceFault.SILENT


def test_an_arm_without_a_sensor_is_refused():
    states = States()
    states.now = states.at(1.0, None)
    with pytest.raises(ForceError, match="no wrench"):
        RtdeWrench(CONFIG, states).start()


def test_1_cn_is_refused_with_the_figures():
    with pytest.raises(ValueError, match=r"UR e-series cannot control 10 mN: its noise is 100 mN"):
        read_force_config(Path("rtde_ur.yaml"), force_n=0.01)
