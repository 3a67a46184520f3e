# SPDX-License-Identifier: Apache-2.0
"""All nodes of a scan as processes on the wall clock, and what each of them takes of a processor."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from tactile_resonance.action import MakeContact, Scan

from benchmarks.processor import children, cpu_s
from tactile_resonance import msg
from tactile_resonance.commands.bench_scan import NODES, Job, node_parameters
from tactile_resonance.contact.vectors import quaternion_from_vector
from tactile_resonance.nodes.client import NoAnswer, ScanClient
from tactile_resonance.nodes.goals import Goals
from tactile_resonance.nodes.running import NEWEST
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.report.run_tables import repeats_sentence
from tactile_resonance.scan.failures import NodeAway
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.simulation.plant.defaults import TABLE_IN_BASE

if TYPE_CHECKING:
    from typing_extensions import Self

FORCE_N = 0.01
UP_WITHIN_S = 120.0
CONTACT_WITHIN_S = 30.0
SCAN_WITHIN_S = 600.0
HOLD_TRIES = 5
RETRACT_TRIES, RETRACT_S = 20, 1.0
SETTLED_S = 12.0
LOOK_EVERY_S = 0.5
CHILDREN = {"contact_node": "ur_client", "fake_hardware_node": "simulate-ur"}
"""The process that a node starts."""

Shares = Mapping[str, float]
"""Of one core, by process."""


@dataclass(frozen=True)
class LiveScan:
    """One scan.

    Attributes
    ----------
    shares : mapping
        Of one core, by process, from the first point's beginning to the scan's end.
    duration_s : float
        Of that.
    points, done, stalls : int
        Points of the plan; those with poles; how often the simulation stood still for more than 10 ms.
    repeats : str
        How often points were repeated, and why.
    """

    shares: Shares
    duration_s: float
    points: int
    done: int
    stalls: int
    repeats: str


class LiveClient(ScanClient):
    """A client that asks for contacts, too."""

    def join(self) -> None:
        """Action and service of contact_node, and what it tells."""
        super().join()
        contact = ActionClient(self._node, MakeContact, "make_contact")
        self._contact = Goals(contact, "make_contact", self.spin)
        self._retract = self._node.create_client(Trigger, "retract")
        self._node.create_subscription(msg.ContactState, "contact_state", self._on_contact, NEWEST)
        self.contact_state = ""

    def press(self) -> bool:
        """Make a contact at the table's origin; whether it is held."""
        try:
            handle = self._contact.send(_goal(), self._check)
            return bool(self._contact.follow(handle, self._check).reached)
        except NodeAway:  # it has lost the robot or the cell, and is made anew
            return False

    def draw_back(self) -> None:
        """End a contact, however it stands: again where that is disturbed, too."""
        fault = msg.ContactState.STATE_FAULT
        for _ in range(RETRACT_TRIES):
            self.wait(self._retract.service_is_ready, CONTACT_WITHIN_S, "retract")
            future = self._retract.call_async(Trigger.Request())
            self.wait(future.done, CONTACT_WITHIN_S, "an answer to retract")
            end_s = time.monotonic() + RETRACT_S
            while time.monotonic() < end_s:
                self.spin(0.1)
            if self.contact_state != fault:
                break
        self.rest()

    def rest(self) -> None:
        """Wait until contact_node tells that nothing is under way."""
        self.contact_state = ""  # what was told last may be of a node that is away now
        idle = msg.ContactState.STATE_IDLE
        self.wait(lambda: self.contact_state == idle, CONTACT_WITHIN_S, "contact_node to rest")

    def _on_contact(self, message: msg.ContactState) -> None:
        self.contact_state = message.state


class LiveBench:
    """The nodes of `tactile_resonance scan --real-time`; a context that ends them.

    Parameters
    ----------
    folder : Path
        Receives runs, records and logs.
    scene : Path
    host : str
        127.x.y.z of the simulated robot.
    domain_id : int
    """

    def __init__(self, folder: Path, scene: Path, host: str, domain_id: int) -> None:
        self._job = Job(scene, folder / "run", host, real_time=True)
        self._domain_id = domain_id
        self._folder = folder

    def __enter__(self) -> Self:
        # processes and contexts take it from the environment as they begin
        os.environ["ROS_DOMAIN_ID"] = str(self._domain_id)
        self._nodes = NodeProcesses(self._folder / "log")
        self._used = _Used(self._nodes)
        self.client = LiveClient(self._check)
        try:
            parameters = node_parameters(self._job, False, self._folder)
            self._nodes.bring_up(NODES, parameters)
            self.client.__enter__()
            self.client.wait_until_up(UP_WITHIN_S)
            self.client.rest()
        except BaseException:
            self._nodes.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.client.__exit__()
        self._nodes.stop()

    def idle(self, seconds: float) -> Shares:
        """Shares while nothing is under way, once all that came up knows each other."""
        self.client.rest()
        self._spin(SETTLED_S)
        return self._over(lambda: self._spin(seconds))

    def holding(self, seconds: float) -> tuple[Shares, int]:
        """Shares while a contact is held, and how many were lost before one was held so long.

        Raises
        ------
        NoAnswer
            If none is held so long.
        """
        for lost in range(HOLD_TRIES):
            held = self.client.press()
            if held:
                shares = self._over(lambda: self._spin(seconds))
                held = self.client.contact_state == msg.ContactState.STATE_HOLD
            self.client.draw_back()
            if held:
                return shares, lost
        raise NoAnswer(f"none of {HOLD_TRIES} contacts was held for {seconds:g} s")

    def scan(self) -> LiveScan:
        """Scan the scene; this process listens to the feedback only."""
        heard: list[Scan.Feedback] = []
        scan = self.client.tactile.scan(
            scene=self._job.scene,
            run_directory=self._job.output,
            seed=1,
            on_feedback=heard.append,
        )
        self.client.wait(lambda: bool(heard), CONTACT_WITHIN_S, "the scan to begin")
        begun_s = time.monotonic()
        shares = self._over(lambda: self.client.wait(scan.done, SCAN_WITHIN_S, "the scan"))
        result = scan.result()
        return LiveScan(
            shares,
            time.monotonic() - begun_s,
            result.points,
            result.done,
            int(self.client.details("fake_hardware_node").get("simulator stalls", 0)),
            repeats_sentence(read_run(self._job.output).latest),
        )

    def _over(self, work: Callable[[], None]) -> Shares:
        before, begun_s = self._used.seconds(), time.monotonic()
        work()
        after, took_s = self._used.seconds(), time.monotonic() - begun_s
        return {name: (after[name] - before.get(name, 0.0)) / took_s for name in after}

    def _check(self) -> None:
        self._nodes.check()
        self._used.look()

    def _spin(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self.client.spin(0.1)
            self._check()


class _Used:
    """Processor time of the nodes and of what they start, which may end and be started anew."""

    def __init__(self, nodes: NodeProcesses) -> None:
        self._nodes = nodes
        self._seen: dict[tuple[str, int], float] = {}  # name and process id
        self._looked_s = 0.0

    def look(self) -> None:
        """Take the time of all that run, twice a second."""
        now_s = time.monotonic()
        if now_s - self._looked_s > LOOK_EVERY_S:
            self._looked_s = now_s
            self._look()

    def seconds(self) -> dict[str, float]:
        """Seconds so far, by name."""
        self._look()
        total: dict[str, float] = {}
        for (name, _), used_s in self._seen.items():
            total[name] = total.get(name, 0.0) + used_s
        return total

    def _look(self) -> None:
        pids = self._nodes.pids
        found = set(pids.items())
        for node, name in CHILDREN.items():
            found |= {(name, pid) for pid in children(pids[node])}
        for name, pid in found:
            with contextlib.suppress(OSError):  # it has ended just now
                self._seen[name, pid] = cpu_s(pid)


def _goal() -> MakeContact.Goal:
    goal = MakeContact.Goal(force_n=FORCE_N, pose=PoseStamped())
    goal.pose.header.frame_id = "base"
    place, turn = goal.pose.pose.position, goal.pose.pose.orientation
    place.x, place.y, place.z = TABLE_IN_BASE[:3]
    turn.x, turn.y, turn.z, turn.w = quaternion_from_vector(TABLE_IN_BASE[3:])
    return goal
