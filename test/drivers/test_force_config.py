# SPDX-License-Identifier: Apache-2.0
"""Force sources by configuration: what ships is read, what is wrong is named."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import Mount
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.simulation.cell.transducer import CellParameters


def test_the_simulated_cell_serves_1_cn():
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    assert config.info.resolution_n == pytest.approx(2e-4)
    assert config.info.mount is Mount.TABLE
    assert config.bus["tcp_tune"] is True
    np.testing.assert_allclose(np.diag(config.scale), [2e-4] * 3 + [1e-5] * 3)


@pytest.mark.parametrize(
    ("force", "cell"), [("can_simulated.yaml", "fine.yaml"), ("can_rft40.yaml", "rft40.yaml")]
)
def test_driver_and_simulation_agree_on_the_cell(force, cell):
    config = read_force_config(Path(force))
    simulated = CellParameters.from_yaml(share_path(f"config/load_cells/{cell}"))
    assert config.info.resolution_n == pytest.approx(1 / simulated.force_divisor)
    assert config.info.noise_rms_n == simulated.force_noise_rms_n
    assert config.info.range_n == simulated.force_range_n
    assert config.range_nm == simulated.torque_range_nm


def test_the_shipped_robotous_is_refused_for_1_cn_and_serves_newtons():
    with pytest.raises(
        ValueError, match="RFT40 cannot control 10 mN: .*its smallest step is 20 mN"
    ):
        read_force_config(Path("can_rft40.yaml"), force_n=0.01)
    config = read_force_config(Path("can_rft40.yaml"), force_n=2.0)
    assert config.mounting.payload.mass_kg == 0.05


def test_a_topic_is_read():
    assert read_force_config(Path("topic.yaml"), force_n=0.01).topic == "wrench_raw"


# Fx is shown as Fy
BLIND = [[0.0] * 5 + [1e-3]] * 2 + [[float(i == j) for j in range(6)] for i in range(4)]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"kind": "usb"}, "kind: got 'usb'; accepted is one of can, rtde, topic"),
        ({"kind": ["can"]}, r"kind: got \['can'\]; accepted is one of can, rtde, topic"),
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
