# SPDX-License-Identifier: Apache-2.0
"""A load cell that is stepped with the plant: what it sends does not depend on what is stepped together."""

from types import SimpleNamespace

import pytest

from tactile_resonance.contact.payload import Mount
from tactile_resonance.contact.vectors import IDENTITY
from tactile_resonance.simulation.cell.transducer import COMMAND_ID, START, CellParameters, LoadCell
from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.surfaces import PlantSurface
from tactile_resonance.simulation.plant.tabletop import attach_cell
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.tissue.library import Tissue

DT_S, ABOVE_M = 0.002, 2.505e-3


def sent(together: int, mount: Mount, steps: int = 60) -> list:
    """Frames of a tip that waits, comes down until it touches, and waits again."""
    frames: list = []
    bus = SimpleNamespace(send=frames.extend, frames_sent=None)
    time = SimpleNamespace(to_follow=0, simulated=True)
    robot = SimpleNamespace(time=time, after_step=[], orders={})
    rubber = Tissue("rubber", 2e5, (0.1,), (0.5,))
    plant = Plant(PlantSurface.tilted(0.0), lambda _: rubber, Tip(2.5e-3), mount=mount)
    cell = LoadCell(CellParameters.from_yaml())
    cell.receive(COMMAND_ID, bytes([START]))
    attach_cell(robot, plant, cell, bus)
    for step in range(steps):
        time.to_follow = together - 1 - step % together
        down_m = 1e-6 * min(max(step - 20, 0), 20)
        plant.step((IDENTITY[0], (0.0, 0.0, ABOVE_M - down_m)), DT_S)
        robot.after_step[0]()
    assert plant.touches == 1
    return frames


@pytest.mark.parametrize("mount", Mount)
@pytest.mark.parametrize("together", [2, 3, 5])
def test_steps_made_together_send_what_single_ones_do(together, mount):
    frames = sent(1, mount)
    assert len(frames) > 40
    assert sent(together, mount) == frames
