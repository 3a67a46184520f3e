# SPDX-License-Identifier: Apache-2.0
"""contact_node and its manager as processes on a simulated robot with tissue and load cell; their client.

All of it lives in simulated time, in which the test takes part: what it does at a moment of the contact, it
does at that moment, however slow the machine is. Limits of waits are on this machine's clock and only end a
test that hangs.
"""

import contextlib
import select
import subprocess
import sys
import time

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from robot_at_hand import RobotAtHand, own_host
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from benchmarks import contact_client
from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.clock import Demand, SimulatedClock
from tactile_resonance.nodes.client import HANGS_S, NoAnswer
from tactile_resonance.nodes.running import NEWEST
from tactile_resonance.processes import NodeProcesses, end_with_parent
from tactile_resonance.simulation.plant.defaults import READY, TABLE_IN_BASE

HOST = own_host(13)
STEP_S = 0.002


class ContactClient(contact_client.ContactClient):
    """A client that also supervises the node; of states it hears only the newest."""

    qos = NEWEST

    def __init__(self, check):
        super().__init__(check)
        self.managed = ""  # what the manager reports

    def join(self):
        super().join()
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._stop = self._node.create_client(SetBool, "stop")
        self._stops = self._node.create_publisher(Bool, "stop", 10)
        self._change = self._node.create_client(ChangeState, "contact_node/change_state")
        self._set = self._node.create_client(
            SetParametersAtomically, "contact_node/set_parameters_atomically"
        )

    def _on_diagnostics(self, array):
        for status in array.status:
            if status.name == "/manager_node":
                self.managed = status.message

    def idle(self):
        """Wait until the node is active and nothing is under way, by what it says from now on."""
        self.state = None
        self.until("idle")

    def back(self):
        """Ask for a retraction while a fault stands, until nothing is under way."""
        deadline = time.monotonic() + HANGS_S
        self.state = None
        while self.state is None or self.state.state != "idle":
            assert time.monotonic() < deadline, f"contact_node does not come back ({self.why()})"
            if self.state is not None and self.state.state == "fault":
                with contextlib.suppress(NoAnswer):  # the node may be being made anew
                    self.ask("retract", 5.0)
                self.state = None
            self.spin(0.2)

    def cancel(self, handle):
        future = handle.cancel_goal_async()
        self.wait(future.done, HANGS_S, "an answer to cancel")

    def change_state(self, transition):
        """Ask for a transition of contact_node's life, without waiting for its end."""
        self.wait(self._change.service_is_ready, HANGS_S, "change_state")
        self._change.call_async(ChangeState.Request(transition=Transition(id=transition)))

    def start_all(self):
        """Ask the manager to bring all nodes up."""
        return self.ask("manager_node/start")

    def set(self, **values):
        """Set parameters of contact_node, `limits__depth_m=1e-3`; why it refuses, empty where not."""
        request = SetParametersAtomically.Request()
        for name, value in values.items():
            given = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
            request.parameters.append(Parameter(name=name.replace("__", "."), value=given))
        result = self.answer(self._set, request).result
        return "" if result.successful else result.reason

    def stop(self, stopped):
        """By the service."""
        return self.answer(self._stop, SetBool.Request(data=stopped))

    def publish_stop(self, stopped):
        """By the topic."""
        self.wait(self._stops.get_subscription_count, HANGS_S, "who listens to stop")
        self._stops.publish(Bool(data=stopped))

    def retract(self):
        return self.ask("retract")


class Bench(RobotAtHand):
    """The plant's process and the nodes."""

    def __init__(self, log, tissue="gel10"):
        super().__init__(HOST)
        server = f"{HOST}:{TIME_PORT}"
        self.parameters = {
            "robot_host": HOST,
            "force_host": HOST,
            "time_server": server,
            "publish_rate_hz": 50.0,  # `until_state` looks every 20 ms
        }
        self.plant = subprocess.Popen(
            [
                *(sys.executable, "-m", "tactile_resonance.cli", "simulate-ur", "--host", HOST),
                *("--tissue", tissue, "--simulated-time"),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
        ready, _, _ = select.select([self.plant.stdout], [], [], HANGS_S)
        line = self.plant.stdout.readline() if ready else "nothing"
        assert line.startswith(READY), line
        self.time = SimulatedClock(server, "test")
        self.nodes = NodeProcesses(log)
        self.nodes.bring_up(["contact_node"], {"contact_node": self.parameters})

    def recover(self):
        """End what a test that failed may have left: time and robot that stand, a node that has ended."""
        self.time.free()
        super().recover()
        process = self.nodes._processes.get("contact_node")
        if process is None or process.poll() is not None:
            self.nodes.start("contact_node", self.parameters)

    def let_pass(self, seconds):
        """Let some time pass, as fast as it goes."""
        self.step(seconds)
        self.time.free()

    def step(self, seconds):
        """Let some time pass; it stands then."""
        self.time.wait_until(self.time.ask_ns() + round(1e9 * seconds), Demand.FAST)

    def start_contact(self, client):
        """Send a goal and stop the time at the first touch; its handle, the future result, the time [s] of it.

        The time is None where it ended before.
        """
        # no contact is made in so little time
        self.time.hold(self.time.ask_ns() + 200_000_000, Demand.NONE)
        touches = self.order("truth")["touches"]
        handle = client.start()
        future = handle.get_result_async()
        deadline = time.monotonic() + HANGS_S
        while not future.done():
            assert time.monotonic() < deadline, f"neither touch nor end ({client.why()})"
            self.step(STEP_S)
            true = self.order("truth")
            if true["in_contact"] and true["touches"] > touches:
                return handle, future, true["time_s"]
            client.spin(0.0)
        return handle, future, None

    def until_state(self, client, state):
        """Let time pass until contact_node tells a state; it stands then, within 0.06 s of it."""
        while client.state is None or client.state.state != state:
            self.step(0.02)
            now_ns = self.time.now_ns()
            client.wait(lambda now=now_ns: client.told_ns > now - 60_000_000, HANGS_S, state)

    def history(self, since_s):
        """Time (n,), place of the tip (n, 3) and true force (n,) of all steps after a time."""
        parts, after = [], since_s
        while True:
            part = self.order("history", after_s=after)
            if not part["time_s"]:
                break
            parts.append(part)
            after = part["time_s"][-1]
        return tuple(
            np.concatenate([p[name] for p in parts])
            for name in ("time_s", "tip_m", "normal_force_n")
        )

    def close(self):
        self.time.close()
        self.nodes.stop()
        self.plant.terminate()
        output, _ = self.plant.communicate(timeout=HANGS_S)
        return output


def last_way_down_s(time_s, tip_m, window_s=0.03, way_m=3e-5):
    """Time of the last step from which the tip goes down by more than `way_m` within `window_s`.

    1 mm/s; the vibration of the robot is a tenth of it. The first time where it never does.
    """
    height = tip_m[:, 2]
    later = np.searchsorted(time_s, time_s + window_s)
    later = np.minimum(later, len(time_s) - 1)
    down = height - height[later] > way_m
    return time_s[np.flatnonzero(down)[-1]] if down.any() else time_s[0]


def height_m(bench):
    """Of the tip above its first touch."""
    return bench.order("truth")["tip_m"][2] - TABLE_IN_BASE[2] - 2.5e-3
