# SPDX-License-Identifier: Apache-2.0
"""Brings the tip to the tissue, holds the force, draws it back; a process and a loop of its own."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future
from scipy.spatial.transform import Rotation
from std_srvs.srv import Trigger

from tactile_resonance import msg
from tactile_resonance.action import MakeContact
from tactile_resonance.contact.geometry import touch_pose
from tactile_resonance.contact.goal import ContactGoal, State
from tactile_resonance.contact.interfaces import ArmError, ForceError
from tactile_resonance.contact.law import Aim, HoldMode
from tactile_resonance.contact.loop import Cycle
from tactile_resonance.contact.parameters import Limits
from tactile_resonance.contact.requirements import require_fit
from tactile_resonance.contact.resonance_touch import PolesTouch
from tactile_resonance.contact.result import ContactResult
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.nodes import contact_devices
from tactile_resonance.nodes.contact_parameters import contact_parameters, read_parameters
from tactile_resonance.nodes.contact_thread import ContactThread
from tactile_resonance.nodes.conversions import (
    poles_from_message,
    time_message,
)
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Parameter, values
from tactile_resonance.nodes.running import POLES, STREAM, RCLError, run_node

PARAMETERS = (
    *contact_devices.PARAMETERS,
    Parameter(
        "publish_every",
        5,
        "Pose, wrench and state are published every so many cycles of the loop; the wrench is the mean since "
        "the last one.",
        1,
        500,
    ),
    Parameter(
        "touch_from_poles",
        False,
        "First contact is told by poles too, against those in air: the rest of the approach is slow then. "
        "Poles come once a block, so the approach must be slow already: contact.approach_speed_m_s of 2.5e-4 "
        "for blocks of 0.4 s.",
        read_only=True,
    ),
    Parameter(
        "touch_false_alarm",
        1e-6,
        "Probability of a false alarm of one block [-].",
        1e-12,
        0.1,
        read_only=True,
    ),
    Parameter("frame_id", "tip", "Frame of the sensor's tip.", read_only=True),
    Parameter("base_frame", "base", "Frame of the robot's base, of all poses.", read_only=True),
    *contact_parameters(),
)

POLL_S = 0.02
FEEDBACK_EVERY = 5  # polls
IN_AIR = (State.IDLE, State.TRAVEL, State.TARE)
# A block whose middle lies so long after the last contact was taken in air as a whole.
IN_AIR_FOR_NS = 1_000_000_000
# How long the devices may be dead before the node gives up and is brought up anew.
DEAD_CYCLES = 500
_HOLDS = {
    MakeContact.Goal.HOLD_FORCE: HoldMode.FORCE,
    MakeContact.Goal.HOLD_INDENTATION: HoldMode.INDENTATION,
}


class ContactNode(ManagedNode):
    """Action `make_contact`, service `retract`; publishes `wrench`, `tcp_pose`, `contact_state`.

    The executor's thread only takes requests; devices, law and envelope run in the loop's thread. When
    the node is deactivated or ends, the tip is drawn back first, where the link allows it.
    """

    def __init__(self) -> None:
        super().__init__("contact_node", PARAMETERS)
        self._thread: ContactThread | None = None
        self.add_on_set_parameters_callback(self._on_parameters)

    def configure(self) -> None:
        """Connect arm and force source."""
        self._frame_id, self._base_frame = values(self, "frame_id", "base_frame")
        (self._publish_every,) = values(self, "publish_every")
        self._settings, self._limits = read_parameters(self)
        self._wrench = self.publish_on(WrenchStamped, "wrench", STREAM)
        self._pose = self.publish_on(PoseStamped, "tcp_pose", STREAM)
        self._state = self.publish_on(msg.ContactState, "contact_state", STREAM)
        self._priority = contact_devices.take_realtime(self)
        self._arm = contact_devices.make_arm(self, self._priority)
        self.resources.callback(self._arm.close)
        self._force = contact_devices.make_force_source(self, self._arm)
        self.resources.callback(self._force.close)
        self._tip = contact_devices.tip_geometry(self)
        self._arm.connect()
        self._force.start()
        self._goal: ServerGoalHandle | None = None
        self._finished: Future | None = None
        self._fault: ArmError | ForceError | None = None
        self._dead = self._polls = self._unpublished = 0
        self._wrenches: list[WrenchSample] = []
        from_poles, false_alarm = values(self, "touch_from_poles", "touch_false_alarm")
        if from_poles:
            self._touch = PolesTouch(false_alarm)
            self._air_since_ns = time.time_ns()
            self.listen(msg.Poles, "poles", self._on_poles, POLES)
        self.serve(Trigger, "retract", self._on_retract)
        self.every(POLL_S, self._poll)
        server = ActionServer(
            self,
            MakeContact,
            "make_contact",
            self._on_goal,
            goal_callback=self._on_request,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self.resources.callback(server.destroy)

    def activate(self) -> None:
        """Start the loop."""
        # a search through all that was imported would hold the loop up for tens of milliseconds
        gc.collect()
        gc.freeze()
        self._thread = ContactThread(
            self._arm, self._force, self._settings, self._limits, self._tip, self._on_cycle
        )

    def deactivate(self) -> None:
        """Draw the tip back and end the loop."""
        if self._thread is not None:
            self._thread.close()
            self._thread = None

    def details(self) -> dict[str, str]:
        """Loop and devices."""
        if self._thread is None:
            return {}
        loop, controller = self._thread.loop, self._thread.controller
        return {
            "contact": controller.state.value,
            "cycles": str(loop.cycles),
            "overruns": str(loop.overruns),
            "force source": self._force.info.name,
            "real-time priority": str(self._priority or "none"),
        }

    # requests, in the executor's thread

    def _on_parameters(self, changes: Sequence) -> SetParametersResult:
        """Take what is in range while nothing moves; in contact nothing is changed."""
        changed = {c.name: c.value for c in changes if c.name.startswith(("contact.", "limits."))}
        if not changed or not self.has_parameter("contact.period_s"):
            return SetParametersResult(successful=True)
        try:
            parameters, limits = read_parameters(self, **changed)
            if self._thread is not None:
                self._thread.configure(parameters, limits)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._settings, self._limits = parameters, limits
        return SetParametersResult(successful=True)

    def _on_request(self, _: MakeContact.Goal) -> GoalResponse:
        """Goals are taken one at a time, and only while both devices are well."""
        ready = self.active and self._goal is None and self._fault is None
        return GoalResponse.ACCEPT if ready else GoalResponse.REJECT

    async def _on_goal(self, goal: ServerGoalHandle) -> MakeContact.Result:
        result = MakeContact.Result(cause="refused")
        try:
            if self._thread is None:
                raise ValueError("contact_node is not active")
            limits = self._goal_limits(goal.request)
            self._thread.start(self._contact_goal(goal.request), self._settings, limits)
        except ValueError as error:
            result.message = str(error)
            self.health.error(f"refused: {error}")
            goal.abort()
            return result
        self._goal, self._finished = goal, Future()
        outcome: ContactResult | None = await self._finished
        self._goal = self._finished = None
        if outcome is None:
            result.cause, result.message = "stopped", "contact_node was stopped"
            goal.abort()
            return result
        result = _result_message(outcome)
        if goal.is_cancel_requested:
            goal.canceled()
        elif outcome.reached:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _on_retract(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._thread is None:
            response.message = f"contact_node is {self.state_name()}"
            return response
        try:
            self._thread.make_ready()
        except ArmError as error:
            response.message = str(error)
            return response
        self._thread.retract()
        response.success = True
        response.message = "asked; contact_state tells when it is idle"
        return response

    def _contact_goal(self, request: MakeContact.Goal) -> ContactGoal:
        frame = request.pose.header.frame_id
        if frame != self._base_frame:
            raise ValueError(f"pose: in frame {frame!r}, accepted is {self._base_frame!r}")
        if request.hold not in _HOLDS:
            raise ValueError(f"hold: {request.hold}, accepted are {sorted(_HOLDS)}")
        require_fit(self._force.info, request.force_n)
        point, turn = request.pose.pose.position, request.pose.pose.orientation
        quaternion = [turn.x, turn.y, turn.z, turn.w]
        if not 0.99 < math.hypot(*quaternion) < 1.01:
            raise ValueError(f"pose: orientation {quaternion}, expected a unit quaternion")
        axes = Rotation.from_quat(quaternion).as_matrix()
        given = np.array([request.normal.x, request.normal.y, request.normal.z])
        normal = given if given.any() else axes[:, 2]
        touch = touch_pose([point.x, point.y, point.z], normal, axes[:, 0], self._tip.ball_radius_m)
        return ContactGoal(touch, Aim(request.force_n, _HOLDS[request.hold]))

    def _goal_limits(self, request: MakeContact.Goal) -> Limits:
        """The node's limits, lowered where the goal asks for it."""
        return self._limits.lowered(
            abort_force_n=request.abort_force_n or None, depth_m=request.depth_limit_m or None
        )

    # what the loop has done, in the executor's thread

    def _poll(self) -> None:
        thread = self._thread
        if thread is None:
            return
        if thread.error is not None:
            self._finish(None)
            self.fail(f"control loop ended: {thread.error!r}")
            return
        if self._dead > DEAD_CYCLES:
            self._finish(thread.controller.result)
            self.fail(f"{self._fault}; connecting anew")
            return
        goal, controller = self._goal, thread.controller
        if goal is None:
            return
        if goal.is_cancel_requested and controller.state not in (State.RETRACT, State.IDLE):
            thread.retract()
        result = controller.result
        over = controller.state in (State.IDLE, State.FAULT) if goal.is_cancel_requested else True
        if result is not None and over:
            self._finish(result)
            return
        self._polls += 1
        if self._polls % FEEDBACK_EVERY == 0:
            force_n, depth_m, _ = self._estimate()
            goal.publish_feedback(
                MakeContact.Feedback(state=controller.state.value, force_n=force_n, depth_m=depth_m)
            )

    def _finish(self, result: ContactResult | None) -> None:
        if self._finished is not None and not self._finished.done():
            self._finished.set_result(result)

    def _on_poles(self, message: msg.Poles) -> None:
        """Poles of a block taken in air are the reference, those of an approach are tested against it."""
        thread, (poles, origin) = self._thread, poles_from_message(message)
        if thread is None or not len(poles.f0_hz) or poles.covariance is None:
            return
        strongest = int(np.argmax(np.abs(poles.residues)))
        pole = [poles.f0_hz[strongest], poles.damping_ratio[strongest]]
        covariance, state = poles.covariance[strongest], thread.controller.state
        try:
            if state in IN_AIR and origin.time_ns > self._air_since_ns + IN_AIR_FOR_NS:
                self._touch.add_air(pole, covariance)
            elif state is not State.APPROACH or not self._touch.ready:
                return
            elif self._touch.touched(pole, covariance) and thread.tell_touch():
                self.get_logger().info("the resonance tells the first contact")
        except ValueError as error:
            self.health.error(f"poles: {error}")

    # each cycle, in the loop's thread

    def _on_cycle(self, cycle: Cycle) -> None:
        self._dead = self._dead + 1 if cycle.fault is not None else 0
        self._fault = cycle.fault
        if cycle.state not in IN_AIR:
            self._air_since_ns = cycle.time_ns
        self._wrenches += cycle.wrenches
        self._unpublished += 1
        if self._unpublished < self._publish_every:
            return
        self._unpublished = 0
        wrenches, self._wrenches = self._wrenches, []
        try:
            self._publish(wrenches, cycle)
        except RCLError:
            # once ROS has been shut down nobody listens, but the tip is still to be drawn back
            if self.context.ok():
                raise

    def _publish(self, wrenches: list[WrenchSample], cycle: Cycle) -> None:
        if cycle.arm is not None and self._pose.get_subscription_count():
            self._pose.publish(self._pose_message(cycle))
        if wrenches and self._wrench.get_subscription_count():
            self._wrench.publish(self._wrench_message(wrenches, cycle))
        if self._state.get_subscription_count():
            self._state.publish(self._state_message(cycle))

    def _wrench_message(self, wrenches: list[WrenchSample], cycle: Cycle) -> WrenchStamped:
        """Mean of these, less the tare, at the middle of their times."""
        wrench = WrenchStamped()
        wrench.header.stamp = time_message((wrenches[0].time_ns + wrenches[-1].time_ns) // 2)
        wrench.header.frame_id = self._frame_id
        count, parts = len(wrenches), wrench.wrench
        force_n = sum(sample.force_n for sample in wrenches) / count - cycle.bias_n
        torque_nm = sum(sample.torque_nm for sample in wrenches) / count
        parts.force.x, parts.force.y, parts.force.z = force_n.tolist()
        parts.torque.x, parts.torque.y, parts.torque.z = torque_nm.tolist()
        return wrench

    def _pose_message(self, cycle: Cycle) -> PoseStamped:
        pose = PoseStamped()
        pose.header.stamp = time_message(cycle.arm.time_ns)
        pose.header.frame_id = self._base_frame
        place, turn = pose.pose.position, pose.pose.orientation
        place.x, place.y, place.z = cycle.arm.tip.position_m.tolist()
        turn.x, turn.y, turn.z, turn.w = cycle.arm.tip.rotation.as_quat().tolist()
        return pose

    def _state_message(self, cycle: Cycle) -> msg.ContactState:
        thread = self._thread
        state = msg.ContactState(state=cycle.state.value)
        state.header.stamp = time_message(cycle.time_ns)
        state.header.frame_id = self._frame_id
        state.force_n, state.depth_m, state.stiffness_n_per_m = self._estimate()
        if thread is not None:
            state.cycles, state.overruns = thread.loop.cycles, thread.loop.overruns
            result = thread.controller.result
            if result is not None:
                state.cause, state.message = result.cause.value, result.message
        return state

    def _estimate(self) -> tuple[float, float, float]:
        """Force, depth and stiffness; NaN where there is no contact."""
        estimate = self._thread.controller.estimate if self._thread is not None else None
        if estimate is None:
            return math.nan, math.nan, math.nan
        return estimate.force_n, estimate.depth_m, estimate.stiffness_n_per_m


def _result_message(result: ContactResult) -> MakeContact.Result:
    message = MakeContact.Result(
        reached=result.reached, cause=result.cause.value, message=result.message
    )
    for name in (
        *("force_n", "force_std_n", "depth_m", "stiffness_n_per_m"),
        *("surface_m", "surface_std_m"),
        *("contact_s", "total_s", "peak_force_n"),
    ):
        value = getattr(result, name)
        setattr(message, name, math.nan if value is None else float(value))
    return message


def main() -> None:
    """Console script."""
    run_node(ContactNode)


if __name__ == "__main__":
    main()
