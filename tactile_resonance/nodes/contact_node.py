# SPDX-License-Identifier: Apache-2.0
"""Brings the tip to the tissue, holds the force, draws it back, tests tissue; in a process of its own."""

from __future__ import annotations

import contextlib
import gc
import math

from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from tactile_resonance import msg
from tactile_resonance.action import Indent, MakeContact
from tactile_resonance.contact.cell_checks import require_fit
from tactile_resonance.contact.goal import (
    Cause,
    ContactGoal,
    ContactResult,
    HoldMode,
    NotIdleError,
    State,
    not_reached,
    refusal_cause,
)
from tactile_resonance.contact.interfaces import ArmError, ForceError, ForceInfo, NodeArm
from tactile_resonance.contact.loop import Cycle, IndentationRecorder
from tactile_resonance.contact.machine import PRESSING_CAUSES
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.samples import Pose
from tactile_resonance.fields import require
from tactile_resonance.mechanics.indentation import BallTip, Protocol
from tactile_resonance.nodes import contact_settings
from tactile_resonance.nodes.contact_thread import ContactThread
from tactile_resonance.nodes.contact_topics import (
    ContactTopics,
    ForceService,
    StopInput,
    TouchFromPoles,
)
from tactile_resonance.nodes.frames import BROADCAST_TF, broadcast_fixed
from tactile_resonance.nodes.managed_node import TIME_SERVER, ManagedNode, end_goal, in_thread
from tactile_resonance.nodes.messages import (
    RosTime,
    contact_feedback,
    contact_goal,
    contact_result,
    time_message,
    touch_of,
)
from tactile_resonance.nodes.parameters import Fixed, values
from tactile_resonance.nodes.running import POLES
from tactile_resonance.recording.messages import PROTOCOLS, key_of, write_indentation

PARAMETERS = (
    *contact_settings.PARAMETERS,
    TIME_SERVER,
    Fixed(
        "publish_rate_hz",
        25.0,
        "Rate of pose, wrench and state [Hz], 50 Hz at most while no contact is under way; a change of the "
        "state is published at once. The wrench is the mean since the last one.",
        1.0,
        500.0,
    ),
    Fixed(
        "touch_from_poles",
        False,
        "First contact is detected by poles too, against those in air: the rest of the approach is slow then. "
        "Poles come once a block, so the approach must be slow already: contact.approach_speed_m_s of 2.5e-4 "
        "for blocks of 0.4 s, with limits.approach_s of 20 s or more, and the client has to ask for "
        "measurements of one or two periods all the time; eight of them in air come first.",
    ),
    Fixed("touch_false_alarm", 1e-6, "Probability of a false alarm of one block [-].", 1e-12, 0.1),
    Fixed("frame_id", "tip", "Frame of the sensor's tip."),
    Fixed("base_frame", "base", "Frame of the robot's base, of all poses; of a UR not base_link."),
    Fixed("sensor_frame", "sensor", "Frame in the beam's clamp, +x to the ball."),
    Fixed("tool_frame", "tool", "Frame of the robot's flange or tool."),
    BROADCAST_TF,
)

FEEDBACK_EVERY_S = 0.1
# How long the devices may be dead before the node gives up and is brought up again.
DEAD_NS = 1_000_000_000


class IndentConduct:
    """A mechanical test under way: its goal for the controller, and a recorder to be given every cycle.

    ``ValueError`` where the request is wrong.
    """

    def __init__(
        self,
        request: Indent.Goal,
        base_frame: str,
        ball: BallTip,
        force: ForceInfo,
        *,
        simulated: bool,
    ) -> None:
        self._request, self._base_frame = request, base_frame
        protocol = key_of(PROTOCOLS, request.protocol, "protocol")
        for name in ("hold_s", "press_speed_m_s", "unload_speed_m_s"):
            value = getattr(request, name)
            require(0 <= value < math.inf, name, value, "a number, 0 or above")
        if protocol is Protocol.INDENTATION and not request.unload_speed_m_s:
            raise ValueError("unload_speed_m_s: 0, accepted with INDENTATION is a speed above 0")
        hold = HoldMode.FORCE if protocol is Protocol.CREEP else HoldMode.INDENTATION
        self.goal = ContactGoal(
            touch_of(request, base_frame, ball.radius_m),
            request.force_n,
            hold,
            press_speed_m_s=request.press_speed_m_s or math.inf,
            hold_s=request.hold_s,
            unload_speed_m_s=request.unload_speed_m_s,
        )
        self.recorder = IndentationRecorder(
            self.goal, protocol, ball, force.name, simulated=simulated
        )

    def result(self, outcome: ContactResult, ros_ns: RosTime) -> Indent.Result:
        """What became of it; nothing that was recorded is lost where it was not done."""
        done = outcome.reached and outcome.cause is Cause.HOLD_ENDED
        cause = Cause.NONE if done else outcome.cause
        result = Indent.Result(done=done, cause=cause.value, message=outcome.message)
        record = result.record
        with contextlib.suppress(ValueError):  # the tissue was not touched
            write_indentation(record, self.recorder.record(outcome))
            record.header.stamp = time_message(ros_ns(self.recorder.begun_ns))
        record.header.frame_id = self._base_frame
        record.pose, record.hold_s = self._request.pose.pose, self._request.hold_s
        moved_n, std_m = outcome.zero_change_n, outcome.surface_std_m
        record.zero_moved_n = math.nan if moved_n is None else moved_n
        record.depth_std_m = math.nan if std_m is None else std_m
        return result


class ContactNode(ManagedNode):
    """Actions `make_contact` and `indent`, services `retract` and `stop`.

    Publishes `wrench`, `tcp_pose`, `contact_state`.

    The executor's thread only takes requests; devices, law and envelope run in the loop's thread. When
    the node is deactivated or ends, the tip is drawn back first, where the link allows it.
    """

    def __init__(self) -> None:
        super().__init__("contact_node", PARAMETERS)
        self._thread: ContactThread | None = None
        self._arm: NodeArm | None = None
        self._stop = StopInput(self)
        self._stop.draw_back = self._draw_back
        self._settings = contact_settings.ContactSettings(self, self._take)

    def configure(self) -> None:
        """Connect arm and force source."""
        names = ("frame_id", "base_frame", "sensor_frame", "tool_frame")
        frame_id, self._base_frame, sensor_frame, tool_frame = values(self, *names)
        self._topics = ContactTopics(self, self._stop)
        self._priority = contact_settings.take_realtime(self)
        self._arm = contact_settings.make_arm(self, self._priority)
        self._settings.read()
        self.resources.callback(self._arm.close)
        self._tip = contact_settings.tip_geometry(self)
        flange = Pose.at_origin().seen_from(self._arm.tip_in_tool)
        broadcast_fixed(self, frame_id, {sensor_frame: self._tip.sensor, tool_frame: flange})
        self._arm.connect()
        # not before: the arm has no clock but the machine's until it is connected
        self._force = contact_settings.make_force_source(self, self._arm)
        self.resources.callback(self._force.close)
        self._force.start()
        self._forces = ForceService(
            self,
            self._force.info.rate_hz,
            self._settings.parameters.period_s,
            lambda: None if self._thread is None else self._thread.clock,
            self._base_frame,
        )
        self._goal: ServerGoalHandle | None = None
        self._test: IndentConduct | None = None  # under way
        self._finished: Future | None = None
        self._fault: ArmError | ForceError | None = None
        self._sound_ns: int | None = None  # of the last cycle without a fault
        self._dead = False
        self._news = self.create_guard_condition(self._look)
        self.resources.callback(self.destroy_guard_condition, self._news)
        self._told: tuple[State, bool] | None = None
        from_poles, false_alarm = values(self, "touch_from_poles", "touch_false_alarm")
        self._touch = None
        if from_poles:
            clock = self._arm.clock
            began_ns = clock.ros_ns(clock.now_ns())
            self._touch = TouchFromPoles(false_alarm, began_ns)
            self.listen(msg.Poles, "poles", self._on_poles, POLES)
        self.serve_trigger("retract", self._on_retract)
        self._teller = self.every(FEEDBACK_EVERY_S, self._tell)
        for kind, name, serve in (
            (MakeContact, "make_contact", self._on_goal),
            (Indent, "indent", self._on_indent),
        ):
            self.act(kind, name, serve, lambda _: self._news.trigger(), self._refuses)

    def activate(self) -> None:
        """Start the loop."""
        # a search through all that was imported would hold the loop up for tens of milliseconds
        gc.collect()
        gc.freeze()
        self._thread = ContactThread(
            self._arm,
            self._force,
            self._settings.parameters,
            self._settings.limits,
            self._tip,
            self._on_cycle,
            self._news.trigger,
            self._topics.period_s,
        )
        self._teller.reset()

    def deactivate(self) -> None:
        """Draw the tip back and end the loop; a node whose loop does not end is rebuilt."""
        thread = self._thread
        if thread is None:
            return
        if not thread.close():
            self.fail(
                "the control loop hangs and was given up; the arm's link is closed, its watchdog stops it"
            )
        self._finish(thread.controller.result)
        self._thread = None

    def working(self) -> bool:
        """The loop moves on, where there is one."""
        return self._thread is None or self._thread.alive

    def waiting_for(self) -> str:
        """What keeps simulated time from going on."""
        return "" if self._thread is None else self._arm.waits_for

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

    def _take(self, parameters: ContactParameters, limits: Limits) -> None:
        if self._arm is not None:
            contact_settings.require_arm_allows(self._arm.config, parameters, limits)
        if self._thread is not None:
            self._thread.configure(parameters, limits)

    def _refuses(self, _: MakeContact.Goal) -> bool:
        """Goals are taken one at a time, while both devices are well and the tip is not stopped."""
        return self._stop.stopped or self._goal is not None or self._fault is not None

    async def _on_goal(self, goal: ServerGoalHandle) -> MakeContact.Result:
        outcome, _ = await self._outcome_of(goal)
        end_goal(goal, outcome.reached and not goal.is_cancel_requested)
        return contact_result(outcome)

    async def _on_indent(self, goal: ServerGoalHandle) -> Indent.Result:
        outcome, test = await self._outcome_of(goal)
        result = Indent.Result(cause=outcome.cause.value, message=outcome.message)
        if test is not None:
            result = test.result(outcome, self._arm.clock.ros_ns)
        end_goal(goal, result.done and not goal.is_cancel_requested)
        return result

    async def _outcome_of(
        self, goal: ServerGoalHandle
    ) -> tuple[ContactResult, IndentConduct | None]:
        """What became of a goal, and its test; None: it has none, was not begun, or the node was stopped."""
        try:
            if self._thread is None:
                raise NotIdleError("contact_node is not active")
            if self._goal is not None:
                raise NotIdleError("goal: refused while another one is under way")
            if self._stop.stopped:
                raise NotIdleError("goal: refused while the tip is stopped")
            limits = self._settings.limits.lowered(
                abort_force_n=goal.request.abort_force_n or None,
                depth_m=goal.request.depth_limit_m or None,
            )
            test = self._test_of(goal.request) if isinstance(goal.request, Indent.Goal) else None
            radius_m = self._tip.ball_radius_m
            asked = contact_goal(goal.request, self._base_frame, radius_m) if test is None else test.goal
            require_fit(self._force.info, asked.force_n)
            self._thread.start(asked, self._settings.parameters, limits)
        except ValueError as error:
            self.health.error(f"refused: {error}")
            return not_reached(refusal_cause(error), str(error)), None
        self._goal, self._finished, self._test = goal, Future(), test
        outcome: ContactResult | None = await self._finished
        self._goal = self._finished = self._test = None
        if outcome is None:
            return not_reached(Cause.STOPPED, "contact_node was stopped"), None
        return outcome, test

    def _test_of(self, request: Indent.Goal) -> IndentConduct:
        stiffness = self._settings.parameters.beam_n_per_m
        return IndentConduct(
            request,
            self._base_frame,
            BallTip(self._tip.ball_radius_m, stiffness_n_per_m=stiffness),
            self._force.info,
            simulated=bool(self.time_server or getattr(self._arm.config, "simulated", False)),
        )

    def _draw_back(self) -> None:
        if self._thread is not None:
            self._thread.retract()

    async def _on_retract(self) -> str:
        thread = self._thread
        if thread is not None and thread.controller.state is State.FAULT:
            await in_thread(self, thread.make_ready, "make_ready")  # other requests are taken
        if thread is None or thread is not self._thread:
            raise ValueError(f"contact_node is {self.state_name()}")
        thread.retract()
        return "asked; contact_state reports when it is idle"

    # what the loop has done, in the executor's thread

    def _tell(self) -> None:
        """Publish what has not changed for a while, and the feedback of a goal."""
        self._look()
        thread = self._thread
        if thread is None:
            return
        self._topics.say_again()
        if self._goal is not None:
            controller = thread.controller
            kind = MakeContact if self._test is None else Indent
            feedback = contact_feedback(kind, controller.state.value, controller.estimate)
            self._goal.publish_feedback(feedback)

    def _look(self) -> None:
        """Whether a goal has ended, or the loop."""
        thread = self._thread
        if thread is None:
            return
        if thread.error is not None:
            self._finish(None)
            text = "the arm was stopped and stands"
            if thread.moves:
                text = f"the arm was NOT seen to stand ({thread.moves}), its link is closed"
            self.fail(f"control loop ended: {thread.error!r}; {text}")
            return
        if self._dead:
            self._finish(thread.controller.result)
            self.fail(f"{self._fault}; reconnecting")
            return
        goal, controller = self._goal, thread.controller
        if goal is None and not thread.clock.simulated:
            self._teller.cancel()  # each call wakes the executor, and the loop tells what changes
        elif self._teller.is_canceled():
            self._teller.reset()
        if goal is None:
            return
        ended = (State.RETRACT, State.FAULT, State.IDLE)
        if goal.is_cancel_requested and controller.state not in ended:
            thread.retract()
        result = controller.result
        over = True
        # until the tip is drawn back the force may rise
        pressed_too_hard = result is not None and result.cause in PRESSING_CAUSES
        if self._test is not None or pressed_too_hard:
            over = controller.settled
        elif goal.is_cancel_requested:
            over = controller.state in (State.IDLE, State.FAULT)
        if result is not None and over:
            self._finish(result)

    def _finish(self, result: ContactResult | None) -> None:
        if self._finished is not None and not self._finished.done():
            self._finished.set_result(result)

    def _on_poles(self, message: msg.Poles) -> None:
        thread = self._thread
        now_ns = thread.clock.ros_ns(thread.clock.now_ns())
        touched = self._touch.hear(message, thread.controller.state, now_ns)
        if touched and thread.tell_touch():
            self.get_logger().info("the resonance detects the first contact")

    # each cycle, in the loop's thread

    def _on_cycle(self, cycle: Cycle) -> None:
        # a force source is started again once the tip has been drawn back; only then its fault counts
        waits = isinstance(cycle.fault, ForceError) and cycle.state is not State.IDLE
        if cycle.fault is None or waits or self._sound_ns is None:
            self._sound_ns = cycle.time_ns
        self._dead = cycle.time_ns - self._sound_ns > DEAD_NS
        self._fault = cycle.fault
        if self._told != (cycle.state, self._dead):
            self._told = cycle.state, self._dead
            self._news.trigger()
        thread = self._thread
        if thread is None:  # it is being made
            return
        if self._touch is not None:
            self._touch.moved(cycle.state, thread.clock.ros_ns(cycle.time_ns))
        test = self._test
        if test is not None:
            test.recorder.take(cycle)
        self._forces.take(cycle)
        self._topics.take(cycle, thread)


main = ContactNode.run
