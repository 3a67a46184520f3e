# SPDX-License-Identifier: Apache-2.0
"""From configuration to the force at the tip."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tactile_resonance.simulation.cell_loop import CellLoop

from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.drivers.force_sources import force_source
from tactile_resonance.simulation.load_cell import LoadCell
from tactile_resonance.simulation.socketcand import SocketcandServer
from tactile_resonance.simulation.transducer import CellParameters


def test_the_tip_feels_what_presses_on_the_cell_under_the_sample():
    """10 mN down on the cell, through CAN, is +10 mN along the normal at a tilted tip."""
    pytest.importorskip("can", reason="python-can is not installed")
    bus = SocketcandServer("127.0.6.4", 0)
    cell = LoadCell(CellParameters("quiet", 5000.0, 1e5, 1e-3, 5e-5, 5.0, 0.3))
    # the surface's normal is tilted by 0.1 rad about y; the force on the cell is against it
    state = ArmSample(0, 0.0, (0.3, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0,) * 6)
    normal = state.tip.rotation.apply([0, 0, 1])
    wrench = np.concatenate([-0.01 * normal, np.zeros(3)])
    ended = threading.Event()
    loop = threading.Thread(target=CellLoop(cell, bus, lambda _: wrench).run, args=(ended.is_set,))
    loop.start()
    config = read_force_config(Path("can_simulated.yaml"), force_n=0.01)
    settings = {**config.can.bus, "host": "127.0.6.4", "port": bus.port}
    config = replace(
        config,
        can=replace(config.can, bus=settings),
        limits=replace(config.limits, silent_s=1.0),
    )
    source = force_source(config, lambda: state)
    samples = []
    try:
        source.start()
        deadline_s = time.monotonic() + 30
        while len(samples) < 1000 and time.monotonic() < deadline_s:
            samples += source.read()
            time.sleep(0.002)
    finally:
        source.close()
        ended.set()
        loop.join()
        bus.close()
    force = np.array([sample.force_n for sample in samples])
    assert len(force) >= 1000
    np.testing.assert_allclose(force.mean(axis=0), [0, 0, 0.01], atol=5 * 1e-3 / np.sqrt(1000))


def test_a_topic_needs_a_node():
    with pytest.raises(ValueError, match="topic is for nodes only"):
        force_source(read_force_config(Path("topic.yaml")), lambda: None)
