# SPDX-License-Identifier: Apache-2.0
"""The simulated robot with tissue and load cell, as a process that ends with its owner."""

from __future__ import annotations

import select
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.processes import end_with_parent, may_take_priority
from tactile_resonance.simulation.plant.defaults import PRIORITY, READY
from tactile_resonance.simulation.plant.simulated_robot import order
from tactile_resonance.simulation.sensor.changing_contact import ContactState

START_WITHIN_S = 90.0
ANSWER_WITHIN_S = 10.0
END_WITHIN_S = 3.0


@dataclass(frozen=True)
class TrueContact:
    """What the plant knows of the tip at one moment.

    Attributes
    ----------
    tip_m : (3,) array
        In the robot's base.
    site_m : (3,) array
        Where the tissue under the tip was looked up; `tip_m` where none was yet.
    force_n : float
        Along the normal; 0 out of contact.
    contact_radius_m, depth_m : float
        0 out of contact.
    since_s : float
        How long the contact has lasted.
    time_s : float
        Of the plant.
    stalls : int
        How often the simulation has stood still on the wall clock for more than 10 ms.
    """

    tip_m: FloatArray
    site_m: FloatArray
    force_n: float
    contact_radius_m: float
    depth_m: float
    since_s: float
    time_s: float
    stalls: int


class PlantChild:
    """Starts `tactile_resonance simulate-ur` and asks it for the truth.

    Parameters
    ----------
    host : str
        Address of the robot, 127.x.y.z.
    scene : Path
    table_in_base : six numbers
    seed : int
    simulated_time : bool
        Its time goes on as those who take part in it let it; else that of the wall clock.

    Raises
    ------
    ValueError
        If it does not come up; with what it printed.
    """

    def __init__(
        self,
        host: str,
        scene: Path,
        table_in_base: Sequence[float],
        seed: int,
        simulated_time: bool,
    ) -> None:
        self._host = host
        pace = ["--priority", str(PRIORITY if may_take_priority(PRIORITY) else 0)]
        self._process = subprocess.Popen(
            [
                *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", host),
                *("--scene", str(scene), "--seed", str(seed % 2**31), "--table"),
                *(str(float(value)) for value in table_in_base),
                *(["--simulated-time"] if simulated_time else pace),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
        assert self._process.stdout is not None
        deadline = time.monotonic() + START_WITHIN_S
        said = []
        while time.monotonic() < deadline:
            ready, _, _ = select.select([self._process.stdout], [], [], 0.1)
            line = self._process.stdout.readline() if ready else ""
            if line.startswith(READY):
                return
            if line.strip():
                said.append(line.strip())
            elif self._process.poll() is not None:
                break
        self.close()
        raise ValueError(
            f"robot_host: no simulated robot at {host}: {' '.join(said) or 'no output'}"
        )

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def truth(self) -> TrueContact:
        """What is true now.

        Raises
        ------
        OSError
            If the plant does not answer.
        """
        answer = order(self._host, "truth", timeout_s=ANSWER_WITHIN_S)
        return TrueContact(
            np.array(answer["tip_m"]),
            np.array(answer["site_m"] or answer["tip_m"]),
            float(answer["normal_force_n"]),
            float(answer["contact_radius_m"]),
            float(answer["depth_m"]),
            float(answer["contact_s"]),
            float(answer["time_s"]),
            int(answer["stalls"]),
        )

    def contact_over(self, after_s: float, until_s: float, parts: int) -> list[ContactState | None]:
        """The contact between two times of the plant, in equal parts; None where the plant stood still.

        Raises
        ------
        OSError
            If the plant does not answer.
        """
        answer = order(
            self._host,
            "contact_over",
            timeout_s=ANSWER_WITHIN_S,
            after_s=after_s,
            until_s=until_s,
            parts=parts,
        )
        names = ("normal_force_n", "contact_radius_m", "depth_m")
        rows = zip(*(answer[name] for name in names), strict=True)
        return [None if row[0] is None else row for row in rows]

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        try:
            self._process.wait(END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
