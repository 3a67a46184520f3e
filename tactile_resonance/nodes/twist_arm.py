# SPDX-License-Identifier: Apache-2.0
"""An arm that somebody else's controller moves by geometry_msgs/TwistStamped, also in step with simulated time.

See docs/twist.md.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage

from tactile_resonance.clock import Clock, Demand, WallClock
from tactile_resonance.contact.interfaces import (
    ArmError,
    ArmFault,
    Cell,
    LoopClock,
    check_acceleration,
    checked_twist,
)
from tactile_resonance.contact.samples import ArmSample
from tactile_resonance.contact.vectors import (
    ZERO,
    cross,
    difference,
    nearer,
    rotated,
    turn_from_quaternion,
    turn_product,
    vector,
    vector_from_turn,
)
from tactile_resonance.drivers.twist import (
    REST,
    Following,
    ToolPose,
    TwistConfig,
    velocity_of,
)
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import COMMANDS, PLACES, SERIES, STEADY, RCLError
from tactile_resonance.nodes.topic_wrench import EARLIEST_S, Arrivals, TopicWrench
from tactile_resonance.recording.messages import time_from_message, write_header

CLOSE_WITHIN_S = 2.0
COMMANDS_END_NS = 200_000_000
"""Without a command for so long no contact is under way: in one a stop is repeated sooner [ns]."""
KEPT_POSES = 64
POLL_S = 0.1
LOST_S = 1.0
"""What a step has not brought by then, on the machine's clock, is lost and no longer waited for [s]."""


class Listener:
    """A second node beside one, spinning on its own; in its namespace.

    Parameters
    ----------
    beside : Node

    Attributes
    ----------
    node : Node
        On which subscriptions, publishers and timers are made.
    """

    def __init__(self, beside: Node) -> None:
        self.node = Node(
            f"{beside.get_name()}_arm",
            context=beside.context,
            namespace=beside.get_namespace(),
            # a name that the command line gives is the other's
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=beside.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="listener", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Spin no more; all that was made on the node ends."""
        self._executor.shutdown()
        # not for ever: where the context is being shut down, that holds what the thread waits for
        self._thread.join(CLOSE_WITHIN_S)
        self.node.destroy_node()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (ExternalShutdownException, RCLError):
            return


class Lockstep(LoopClock):
    """The clock of a loop that a simulated controller leads, and that leads it, as fast as it can.

    The controller publishes what a step brought, then the time of the step on the topic `clock`, and goes on
    only when a command with that stamp has come. So neither is ever late, however slow the machine is.

    Parameters
    ----------
    node : Node
    answer : callable
        Publishes the command that holds, with the stamp that it is given [ns].

    Attributes
    ----------
    awaited : sequence of Arrivals
        What every step brings.
    while_waiting : callable
        Called every tenth of a second of this machine's time while simulated time stands.
    """

    def __init__(self, node: Node, answer: Callable[[int], None]) -> None:
        self.awaited: Sequence[Arrivals] = ()
        self.while_waiting: Callable[[], None] = lambda: None
        self._answer = answer
        self._steps = Arrivals()
        self._now_ns = 0
        node.create_subscription(
            ClockMessage,
            "clock",
            lambda message: self._steps.add(time_from_message(message.clock)),
            PLACES,
        )

    def now_ns(self) -> int:
        """Time of the newest step whose data are here [ns]."""
        return self._now_ns

    def wait_until(self, time_ns: int, demand: Demand = Demand.FAST, /) -> None:
        """Answer step after step until a time is reached and its data are here."""
        while self._now_ns < time_ns:
            self._answer(self._now_ns)
            while not self._steps.wait(self._now_ns + 1, POLL_S):
                self.while_waiting()
                self._answer(self._now_ns)  # a controller that has just come up has not heard it
            step_ns = self._steps.newest_ns
            for arrivals in self.awaited:
                lost_s = time.monotonic() + LOST_S
                while not arrivals.lost and not arrivals.wait(step_ns, POLL_S):
                    self.while_waiting()
                    arrivals.lost = time.monotonic() > lost_s
            self._now_ns = step_ns


class TwistArm:
    """An arm behind two topics (a `contact.interfaces.NodeArm`): poses in, twists out.

    Every fault of a contact stays until `connect` is called, which only a new start of the node and a call of
    `retract` do; until then all that is published is zero. While no contact is under way nothing is published.

    Parameters
    ----------
    node : ManagedNode
        Until it is cleaned up the arm listens and commands, in a thread of its own.
    config : TwistConfig
    base_frame : str
        Frame of poses and twists.

    Attributes
    ----------
    listener : Listener
    """

    waits_for = ""

    def __init__(self, node: ManagedNode, config: TwistConfig, base_frame: str) -> None:
        self.config, self._base_frame = config, base_frame
        self.listener = Listener(node)
        node.resources.callback(self.listener.close)
        self._lockstep = Lockstep(self.listener.node, self._publish) if config.lockstep else None
        self.clock: Clock = self._lockstep or WallClock()
        self._arrivals = Arrivals()
        self.tip_in_tool = config.tip_in_tool
        self._offset_m = vector(config.tip_in_tool.position_m)
        self._offset_turn = config.tip_in_tool.turn
        self._lock = threading.Lock()  # of fault and twist: two threads may set them
        self._fault: ArmError | None = None
        self._tools: deque[ToolPose] = deque(maxlen=KEPT_POSES)
        self._twist = REST  # of the tip, after the limit of acceleration
        self._commanded_ns: int | None = None  # when the last command was given
        self._moving = False
        self._following = Following(config)
        own = self.listener.node
        self._publisher = own.create_publisher(TwistStamped, config.command_topic, COMMANDS)
        own.create_subscription(PoseStamped, config.pose_topic, self._on_pose, SERIES)
        own.create_timer(config.max_command_gap_s / 2, self._watch_commands, clock=STEADY)

    # the contract

    def connect(self) -> None:
        """Forget the fault; nothing moves before the next command."""
        with self._lock:
            self._fault = None
            self._tools = deque(maxlen=KEPT_POSES)  # the listener's thread may be looking at the old ones
            self._twist, self._moving, self._commanded_ns = REST, False, None
        self._following.forget()

    def state(self) -> ArmSample:
        """Newest state, without waiting.

        Raises
        ------
        ArmError
            LINK_LOST where no pose has come yet, or the commands have no subscriber; STALE, LATE, INVALID,
            NOT_FOLLOWED, which stay until `connect`.
        """
        if self._fault is not None:
            raise self._fault
        config, now_ns = self.config, self.clock.now_ns()
        tools = list(self._tools)
        if not tools:
            text = f"no pose has come on {config.pose_topic}"
            raise ArmError(ArmFault.LINK_LOST, text)
        newest = tools[-1]
        age_s = (now_ns - newest.time_ns) * 1e-9
        if age_s > config.max_state_age_s:
            text = (
                f"the newest pose on {config.pose_topic} is {1e3 * age_s:.0f} ms old, accepted are "
            )
            text += f"{1e3 * config.max_state_age_s:g} ms"
            if self._commanded_ns is None or now_ns - self._commanded_ns > COMMANDS_END_NS:
                raise ArmError(ArmFault.STALE, text)  # nothing is under way that it could end
            self._fail(ArmFault.STALE, text)
        if self._moving:
            commanded_m_s = vector(self._twist[:3])
            if text := self._following.contradiction(now_ns, newest.tip_m, commanded_m_s):
                self._fail(ArmFault.NOT_FOLLOWED, text)
        else:  # how hard it slows down is its controller's
            self._following.forget()
        return ArmSample(
            time_ns=newest.time_ns,
            robot_time_s=newest.time_ns * 1e-9,
            position_m=newest.tip_m,
            rotation_rad=vector_from_turn(newest.turn),
            velocity=velocity_of(tools),
        )

    recent = state

    def speed(self, twist: Sequence[float], acceleration_m_s2: float) -> None:
        """Move the tip with a twist (6,) in the base [m/s, rad/s], for one period.

        Raises
        ------
        ArmError
            As `state`; LATE where the last command while it moved is too long ago.
        ValueError
            Where a figure is beyond the limits of the configuration; nothing is sent then.
        """
        wanted = checked_twist(twist, self.config)
        check_acceleration(acceleration_m_s2, self.config)
        if not self._publisher.get_subscription_count():
            self._fail(ArmFault.LINK_LOST, f"no subscriber to {self.config.command_topic}")
        self._watch_commands()
        now_ns, period_s = self.clock.now_ns(), 1 / self.config.rate_hz
        with self._lock:
            if self._fault is not None:
                raise self._fault
            since_s = 0.0 if self._commanded_ns is None else (now_ns - self._commanded_ns) * 1e-9
            step = acceleration_m_s2 * (since_s if self._moving else period_s)
            self._twist, self._moving = nearer(self._twist, wanted, step), True
            self._commanded_ns = now_ns
        self._send()

    def stop(self, deceleration_m_s2: float) -> None:
        """Command zero at once, also after a fault; how hard the arm slows down is its controller's."""
        check_acceleration(deceleration_m_s2, self.config)
        with self._lock:
            self._twist, self._moving = REST, False
            self._commanded_ns = self.clock.now_ns()
        self._send()

    def close(self) -> None:
        """Command zero, where anything was commanded; never raises."""
        if self._commanded_ns is not None:
            self.stop(self.config.max_acceleration_m_s2)
            if self._lockstep is not None:
                self._publish(self.clock.now_ns())

    def led_clock(self, cell: Cell, while_waiting: Callable[[], None]) -> LoopClock | None:
        """Time in step with a simulated controller; None on the wall clock. See `NodeArm`."""
        if self._lockstep is not None:
            wrench = (cell.arrivals,) if isinstance(cell, TopicWrench) else ()
            self._lockstep.awaited = (self._arrivals, *wrench)
            self._lockstep.while_waiting = while_waiting
        return self._lockstep

    # faults

    def _fail(self, fault: ArmFault, text: str) -> None:
        """Command zero, and raise a fault that stays."""
        self._give_up(fault, text)
        raise self._fault

    def _give_up(self, fault: ArmFault, text: str) -> None:
        with self._lock:
            if self._fault is None:
                self._fault = ArmError(fault, text)
            self._twist, self._moving = REST, False
        self._send()

    def _watch_commands(self) -> None:
        """Whether commands come often enough; also called while the loop hangs, by a timer."""
        with self._lock:
            gap_s, most_s = 0.0, self.config.max_command_gap_s
            if self._moving and self._commanded_ns is not None:
                gap_s = (self.clock.now_ns() - self._commanded_ns) * 1e-9
        if gap_s > most_s:
            text = f"no command for {1e3 * gap_s:.0f} ms while the tip moved, accepted are "
            self._give_up(ArmFault.LATE, f"{text}{1e3 * most_s:g} ms")

    # topics

    def _on_pose(self, message: PoseStamped) -> None:
        """Take a pose, in the listener's thread; a fault is raised by the next `state`."""
        if self._fault is not None:
            return
        if text := self._contradiction(message):
            self._give_up(ArmFault.INVALID, text)
            return
        place, quaternion = message.pose.position, message.pose.orientation
        turn = turn_from_quaternion(quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        a, b, c = rotated(turn, self._offset_m)
        tip_m = (place.x + a, place.y + b, place.z + c)
        stamp_ns = time_from_message(message.header.stamp)
        tool = ToolPose(
            self.clock.own_ns(stamp_ns),
            (place.x, place.y, place.z),
            tip_m,
            turn_product(turn, self._offset_turn),
        )
        self._tools.append(tool)
        self._arrivals.add(stamp_ns)

    def _contradiction(self, message: PoseStamped) -> str:
        """Why a pose cannot be taken; empty where it can."""
        topic, frame = self.config.pose_topic, message.header.frame_id
        if frame != self._base_frame:
            return f"poses on {topic} are in {frame!r}, accepted is {self._base_frame!r}"
        stamp_ns = time_from_message(message.header.stamp)
        time_ns = self.clock.own_ns(stamp_ns)
        early_s = (time_ns - self.clock.now_ns()) * 1e-9
        if stamp_ns == 0 or (early_s > EARLIEST_S and not self.clock.simulated):
            text = f"the time stamp of a pose on {topic} is {early_s:.3g} s ahead, accepted are "
            return f"{text}{EARLIEST_S:g} s, and not 0"
        tools = self._tools  # `connect` exchanges them, in another thread
        if tools and time_ns <= tools[-1].time_ns:
            return f"time stamps of poses on {topic} do not increase"
        place, turn = message.pose.position, message.pose.orientation
        if not all(map(math.isfinite, (place.x, place.y, place.z))):
            return f"position on {topic}: {(place.x, place.y, place.z)}, expected finite numbers"
        if not 0.99 < math.hypot(turn.x, turn.y, turn.z, turn.w) < 1.01:
            given = (turn.x, turn.y, turn.z, turn.w)
            return f"orientation on {topic}: {given}, expected a unit quaternion"
        return ""

    def _send(self) -> None:
        """Publish the command that holds; in lockstep the next step is answered with it."""
        if self._lockstep is None:
            self._publish(self.clock.now_ns())

    def _publish(self, time_ns: int) -> None:
        with self._lock:
            x, y, z, *turn = self._twist
            tools, lever_m = self._tools, ZERO
            if tools:
                lever_m = difference(tools[-1].tool_m, tools[-1].tip_m)
            # of the tool's origin
            a, b, c = cross(vector(turn), lever_m)
            message = TwistStamped()
            write_header(message.header, self.clock.ros_ns(time_ns), self._base_frame)
            linear, angular = message.twist.linear, message.twist.angular
            linear.x, linear.y, linear.z = x + a, y + b, z + c
            angular.x, angular.y, angular.z = turn
            try:
                self._publisher.publish(message)
            except RCLError:
                # once ROS has been shut down nobody listens, and the controller's own limit stops the arm
                return
