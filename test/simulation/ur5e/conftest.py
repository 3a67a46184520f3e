# SPDX-License-Identifier: Apache-2.0
"""A controller, and a client that talks through its registers as an RTDE client does."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tactile_resonance.simulation.ur5e.controller import UrController
from tactile_resonance.simulation.ur5e.machine import MachineConfig, TrackingParameters

PROGRAM = """
def rtde_control():
    global reg_offset_float = # float register offset
{offset}
    global reg_offset_int = # int register offset
{offset}
end
"""


class Client:
    """Sends commands and waits for their end; robot time passes by its steps alone."""

    def __init__(self, controller: UrController, offset: int = 0) -> None:
        self.controller = controller
        self.offset = offset
        controller.start_program(PROGRAM.format(offset=offset))
        controller.step()

    def output(self, name: str) -> np.ndarray:
        return np.array(self.controller.outputs(name))

    @property
    def status(self) -> int:
        return self.controller.registers.output_int[self.offset]

    @property
    def answer(self) -> int:
        return self.controller.registers.output_int[1 + self.offset]

    @property
    def answers(self) -> np.ndarray:
        return np.array(self.controller.registers.output_double[self.offset : self.offset + 6])

    @property
    def progress(self) -> int:
        return self.controller.registers.output_int[2 + self.offset]

    def write(self, command: int, doubles: Sequence[float] = (), ints: Sequence[int] = ()) -> None:
        values: dict[str, float] = {f"input_int_register_{self.offset}": command}
        for number, value in enumerate(doubles):
            values[f"input_double_register_{self.offset + number}"] = float(value)
        for number, value in enumerate(ints):
            values[f"input_int_register_{self.offset + 1 + number}"] = int(value)
        self.controller.write_inputs(values)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.002)):
            self.controller.step()

    def until(self, status: int, limit_s: float) -> None:
        steps = 0
        while self.status != status:
            assert self.controller.program is not None, self.controller.log[-1]
            assert steps * 0.002 < limit_s, f"status {self.status}, waited for {status}"
            self.controller.step()
            steps += 1

    def stream(self, command: int, doubles: Sequence[float] = (), ints: Sequence[int] = ()) -> None:
        """Send a command that stays in its register and is done in every cycle."""
        self.until(1, 3.0)
        self.write(command, doubles, ints)

    def call(self, command: int, doubles: Sequence[float] = (), ints: Sequence[int] = ()) -> None:
        """Send a command, wait for its end, take it away."""
        self.until(1, 3.0)
        self.write(command, doubles, ints)
        self.until(2, 60.0)
        self.write(0)


@pytest.fixture
def make_client() -> Callable[..., Client]:
    """Return a maker of clients with controllers of their own, without noise where not asked for."""

    def make(environment=None, *, offset=0, seed=1, machine=None, **machine_fields) -> Client:
        fields = {"ft_errors": 0.0, "tracking": TrackingParameters(jitter_rms_m=0.0)}
        machine = MachineConfig(**{**fields, **machine_fields}) if machine is None else machine
        return Client(UrController(machine, environment, seed), offset)

    return make


@pytest.fixture
def client(make_client) -> Client:
    return make_client()


@pytest.fixture(params=[0, 24], ids=["lower", "upper"])
def any_client(request, make_client):
    """On the lower and on the upper registers."""
    return make_client(offset=request.param)
