# SPDX-License-Identifier: Apache-2.0
"""Every FRF gets an answer, whatever is in it."""

import array
import os

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy

from tactile_resonance import msg
from tactile_resonance.frf.result import FRF
from tactile_resonance.nodes.conversions import frf_to_message
from tactile_resonance.nodes.poles_node import PolesNode
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Origin

LINES_HZ = np.arange(200.0, 300.1, 2.5)
SPECTRA = ("sensor_real", "sensor_imag", "actuator_real", "actuator_imag")


@pytest.fixture
def node(monkeypatch):
    with rclpy.init(domain_id=free_domain_id(os.environ)):
        node = PolesNode()
        node.trigger_configure()
        node.trigger_activate()
        node.published = []
        monkeypatch.setattr(node._publisher, "publish", node.published.append)
        yield node
        node.destroy_node()


def good():
    s, w0 = 2j * np.pi * LINES_HZ, 2 * np.pi * 250
    g = 0.02 + 100 * s / (s**2 + 0.06 * w0 * s + w0**2)
    frf = FRF(LINES_HZ, g, variance_noise=np.full(g.size, 1e-10), noise_dof=20)
    return frf_to_message(frf, Origin(measurement_id=7, label="here"), 1.0, False)


def shorten(message, name):
    setattr(message, name, array.array("d", list(getattr(message, name))[:-1] or [1.0]))


BROKEN = {
    "unknown status": lambda m: setattr(m, "status", 200),
    "imag short": lambda m: shorten(m, "imag"),
    "lines short": lambda m: shorten(m, "frequency_hz"),
    "variance short": lambda m: shorten(m, "variance_noise"),
    "one spectrum": lambda m: m.sensor_real.extend([1.0] * LINES_HZ.size),
    "one variance": lambda m: m.sensor_variance.extend([1.0] * LINES_HZ.size),
    "nothing": lambda m: [
        setattr(m, n, array.array("d")) for n in ("frequency_hz", "real", "imag", "variance_noise")
    ],
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_frf_gets_a_failure_with_a_reason(node, case):
    message = good()
    BROKEN[case](message)
    node._on_frf(message)
    node._on_frf(good())
    failed, after = node.published
    assert failed.status in (msg.Poles.STATUS_FAILED, msg.Poles.STATUS_TOO_FEW_LINES)
    assert failed.measurement_id == 7
    assert len(failed.f0_hz) == 0
    assert after.status == msg.Poles.STATUS_OK
    assert after.f0_hz[0] == pytest.approx(250, rel=1e-6)
