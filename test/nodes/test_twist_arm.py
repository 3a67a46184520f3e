# SPDX-License-Identifier: Apache-2.0
"""An arm behind two topics: poses in, twists out, deadlines both ways; through real topics, on a told clock."""

import math
import os
import time
from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import Pose
from tactile_resonance.drivers.twist import TwistConfig
from tactile_resonance.fields import read_file
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import time_message
from tactile_resonance.nodes.running import COMMANDS, PLACES, initialised
from tactile_resonance.nodes.twist_arm import TwistArm
from tactile_resonance.processes import free_domain_id
from tactile_resonance.recording.messages import time_from_message

CONFIG = read_file(TwistConfig, share_path("config/devices/twist.yaml"))
AHEAD_NS = 1_700_000_000 * 10**9  # ROS time less the clock's
PERIOD_NS = 2_000_000
DOWN = (0.0, 0.0, -0.01, 0.0, 0.0, 0.0)
HARD_M_S2 = 2.0


class Controller:
    """A controller: takes commands, publishes poses; the tool moves as the test says."""

    def __init__(self, config):
        self.now_ns = 3_600 * 10**9
        self.place = np.array([0.4, 0.1, 0.3])
        self.turn = Rotation.identity()
        self.heard = []  # stamp and twist
        self.node = ManagedNode("twist_arm_test", ())
        self.other = Node("controller")
        self._executor = SingleThreadedExecutor()
        for node in (self.node, self.other):
            self._executor.add_node(node)
        self._poses = self.other.create_publisher(PoseStamped, config.pose_topic, PLACES)
        self._commands = self.other.create_subscription(
            TwistStamped, config.command_topic, self._on_command, COMMANDS
        )
        self.arm = TwistArm(self.node, config, "base")
        self.arm.clock = SimpleNamespace(
            simulated=False,
            now_ns=lambda: self.now_ns,
            own_ns=lambda ros_ns: ros_ns - AHEAD_NS,
            ros_ns=lambda own_ns: own_ns + AHEAD_NS,
        )
        self.arm.connect()
        self.wait(lambda: self._poses.get_subscription_count() == 1)
        self.wait(self.arm._publisher.get_subscription_count)

    def _on_command(self, message):
        linear, angular = message.twist.linear, message.twist.angular
        twist = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        assert message.header.frame_id == "base"
        self.heard.append((time_from_message(message.header.stamp) - AHEAD_NS, twist))

    def wait(self, holds):
        deadline_s = time.monotonic() + 60.0
        while not holds():
            assert time.monotonic() < deadline_s
            self._executor.spin_once(0.001)  # the arm listens in a thread of its own

    def commanded(self, count=1):
        """The newest of so many more commands than were heard before."""
        self.wait(lambda: len(self.heard) >= count)
        newest = self.heard[-1]
        self.heard.clear()
        return newest

    def pose(self, *, age_ns=0, frame="base", stamp_ns=None, quaternion=None, place=None):
        """Publish where the tool is, and wait until that is known or refused."""
        message = PoseStamped()
        stamp = self.now_ns - age_ns + AHEAD_NS if stamp_ns is None else stamp_ns
        message.header.stamp, message.header.frame_id = time_message(stamp), frame
        at, turn = message.pose.position, message.pose.orientation
        at.x, at.y, at.z = self.place if place is None else place
        turn.x, turn.y, turn.z, turn.w = self.turn.as_quat() if quaternion is None else quaternion
        before, arm = self.arm._arrivals.newest_ns, self.arm
        self._poses.publish(message)
        self.wait(lambda: before < stamp == arm._arrivals.newest_ns or arm._fault is not None)

    def listen_no_more(self):
        self.other.destroy_subscription(self._commands)
        self.wait(lambda: not self.arm._publisher.get_subscription_count())

    def period(self, twist=None, follows=True):
        """A period passes; the tool moves with a twist, and a command is given."""
        self.now_ns += PERIOD_NS
        if twist is not None and follows:
            self.place = self.place + np.array(twist[:3]) * PERIOD_NS * 1e-9
        self.pose()
        sample = self.arm.state()
        if twist is not None:
            self.arm.speed(twist, HARD_M_S2)
            self.wait(lambda: self.heard and self.heard[-1][0] == self.now_ns)
        return sample

    def close(self):
        self._executor.shutdown()
        self.other.destroy_node()
        self.node.destroy_node()


@pytest.fixture
def make():
    with initialised(domain_id=free_domain_id(os.environ)):
        made = []

        def make(**changed):
            made.append(Controller(replace(CONFIG, **changed)))
            return made[-1]

        yield make
        made[0].close()


def fault_of(call):
    with pytest.raises(ArmError) as caught:
        call()
    return caught.value.fault


def why(call):
    """The fault that a call meets; None where there is none."""
    try:
        call()
    except ArmError as error:
        return error
    return None


def stands(controller, fault):
    """The last command was zero, and the fault stays, whatever comes, until it is connected anew."""
    controller.wait(lambda: controller.heard and controller.heard[-1][1] == (0.0,) * 6)
    controller.now_ns += PERIOD_NS
    for call in (controller.arm.state, lambda: controller.arm.speed(DOWN, HARD_M_S2)):
        assert fault_of(call) is fault
    controller.heard.clear()
    controller.arm.stop(1.0)  # works in any state
    assert controller.commanded()[1] == (0.0,) * 6


def test_the_tip_is_where_the_tool_carries_it_and_moves_as_the_tool_does(make):
    offset = Pose(np.array([0.0, 0.02, 0.1]), np.array([0.0, math.pi, 0.0]))
    controller = make(tip_in_tool=offset)
    speed, turn_rad_s = np.array([0.01, 0.0, -0.02]), np.array([0.0, 0.3, 0.1])
    for _ in range(6):
        controller.now_ns += PERIOD_NS
        controller.place = controller.place + speed * 0.002
        controller.turn = Rotation.from_rotvec(turn_rad_s * 0.002) * controller.turn
        controller.pose()
    sample = controller.arm.state()
    assert sample.time_ns == controller.now_ns
    lever = controller.turn.apply(offset.position_m)
    assert sample.position_m == pytest.approx(controller.place + lever, abs=1e-12)
    held = Rotation.from_rotvec(sample.rotation_rad)
    assert (held.inv() * controller.turn * offset.rotation).magnitude() == pytest.approx(
        0, abs=1e-9
    )
    velocity = speed + np.cross(turn_rad_s, lever)
    assert sample.velocity[:3] == pytest.approx(velocity, abs=2e-4)  # it turns within the difference
    assert sample.velocity[3:] == pytest.approx(turn_rad_s, abs=1e-6)
    # what is commanded of the tip is passed on for the tool's origin
    wanted = (*np.array([0.0, 0.001, 0.0]), 0.0, 0.01, 0.0)
    controller.arm.speed(wanted, HARD_M_S2)
    stamp_ns, twist = controller.commanded()
    assert stamp_ns == controller.now_ns
    expected = np.array(wanted[:3]) - np.cross(wanted[3:], lever)
    assert twist[:3] == pytest.approx(expected, abs=1e-12)
    assert twist[3:] == pytest.approx(wanted[3:])


def test_speed_grows_by_the_acceleration_and_a_stop_is_zero_at_once(make):
    controller = make()
    controller.pose()
    wanted = (0.0, 0.0, -0.01, 0.0, 0.0, 0.0)
    speeds = []
    for _ in range(4):
        controller.arm.speed(wanted, 2.0)
        speeds.append(controller.commanded()[1][2])
        controller.now_ns += PERIOD_NS
        controller.pose()
    assert speeds == pytest.approx([-0.004, -0.008, -0.01, -0.01])
    controller.arm.stop(0.1)
    assert controller.commanded()[1] == (0.0,) * 6
    controller.arm.speed(wanted, 2.0)
    assert controller.commanded()[1][2] == pytest.approx(-0.004)


@pytest.mark.parametrize(
    ("twist", "acceleration", "message"),
    [
        ((0.26, 0, 0, 0, 0, 0), 1.0, "speed: 0.26, the configuration allows 0.25"),
        ((0, 0, 0, 0, 1.1, 0), 1.0, "turn: 1.1, the configuration allows 1"),
        ((0, 0, math.nan, 0, 0, 0), 1.0, "twist: .* expected 6 finite numbers"),
        (DOWN, 2.1, "acceleration: 2.1, the configuration allows above 0 to 2"),
        (DOWN, 0.0, "acceleration: 0"),
    ],
)
def test_what_the_configuration_does_not_allow_is_not_sent(make, twist, acceleration, message):
    controller = make()
    controller.pose()
    with pytest.raises(ValueError, match=message):
        controller.arm.speed(twist, acceleration)
    controller.arm.speed(DOWN, 1.0)
    controller.commanded()
    assert controller.arm.state() is not None


def test_before_the_first_pose_there_is_no_state_and_nothing_is_commanded(make):
    controller = make()
    assert fault_of(controller.arm.state) is ArmFault.LINK_LOST
    controller.pose()
    controller.arm.state()
    controller.arm.close()
    assert controller.heard == []


def test_an_old_pose_is_zero_and_a_fault_that_a_new_one_does_not_end(make):
    controller = make()
    for _ in range(5):
        controller.period(DOWN)
    controller.commanded()
    controller.now_ns += round(1e9 * CONFIG.max_state_age_s) - 1
    controller.arm.state()
    controller.now_ns += 2
    with pytest.raises(ArmError, match=r"newest pose on tcp_pose_broadcaster/pose is 20 ms old") as e:
        controller.arm.state()
    assert e.value.fault is ArmFault.STALE
    stands(controller, ArmFault.STALE)
    controller.arm.connect()
    controller.now_ns += PERIOD_NS
    controller.pose()
    controller.arm.state()
    assert controller.heard == []  # nothing moves before the next command
    controller.arm.speed(DOWN, HARD_M_S2)
    assert controller.commanded()[1][2] < 0


def test_an_old_pose_while_nothing_is_under_way_ends_nothing(make):
    controller = make()
    controller.pose()
    controller.now_ns += 10**9
    assert fault_of(controller.arm.state) is ArmFault.STALE
    controller.pose()
    controller.arm.state()
    # at rest in a contact it does, and it stays
    controller.arm.stop(1.0)
    controller.now_ns += 100_000_000
    assert fault_of(controller.arm.state) is ArmFault.STALE
    controller.pose()
    assert fault_of(controller.arm.state) is ArmFault.STALE
    assert controller.commanded()[1] == (0.0,) * 6


@pytest.mark.parametrize("by_timer", [False, True])
def test_commands_that_come_too_seldom_while_it_moves_are_zero_and_a_fault(make, by_timer):
    controller = make()
    for _ in range(3):
        controller.period(DOWN)
    controller.commanded()
    controller.now_ns += round(1e9 * CONFIG.max_command_gap_s) + 1
    if by_timer:  # the loop hangs: the node's thread stops the arm
        controller.wait(lambda: controller.arm._fault is not None)
    else:
        controller.pose()
        assert fault_of(lambda: controller.arm.speed(DOWN, HARD_M_S2)) is ArmFault.LATE
    stands(controller, ArmFault.LATE)


def test_no_commands_while_it_stands_are_no_fault(make):
    controller = make()
    controller.period(DOWN)
    controller.commanded()
    controller.arm.stop(1.0)
    controller.commanded()
    controller.now_ns += 10**9
    controller.pose()
    controller.arm.speed(DOWN, HARD_M_S2)
    assert controller.commanded()[1][2] == pytest.approx(-0.004)


def test_a_controller_that_listens_no_more_is_a_fault(make):
    controller = make()
    controller.period(DOWN)
    controller.listen_no_more()
    controller.now_ns += PERIOD_NS
    controller.pose()
    assert fault_of(lambda: controller.arm.speed(DOWN, HARD_M_S2)) is ArmFault.LINK_LOST
    assert fault_of(controller.arm.state) is ArmFault.LINK_LOST


def test_a_pose_that_comes_as_the_fault_is_forgotten_is_taken(make):
    """An error in the thread that listens would end it: no further pose would ever be heard."""
    controller = make()
    controller.period()

    class Exchanged(deque):
        def __bool__(self):
            controller.arm.connect()
            return super().__len__() > 0

    controller.arm._tools = Exchanged(controller.arm._tools)
    controller.period()
    assert len(controller.arm._tools) == 1


@pytest.mark.parametrize("speed_m_s", [0.004, 0.05])
def test_a_tip_that_does_not_follow_is_zero_and_a_fault(make, speed_m_s):
    controller = make()
    twist = (0.0, speed_m_s, 0.0, 0.0, 0.0, 0.0)
    for _ in range(200):  # followed, ever so long
        controller.period(twist)
    asked_m = 0.0
    while (fault := why(lambda: controller.period(twist, follows=False))) is None:
        asked_m += speed_m_s * 0.002
        assert asked_m < CONFIG.follow_m + 2 * CONFIG.follow_s * speed_m_s + 1e-4
    assert asked_m > CONFIG.follow_m  # at once is no fault: it may be late
    assert "is the controller active, and the only one" in str(fault)
    stands(controller, ArmFault.NOT_FOLLOWED)


def test_a_tip_that_somebody_else_moves_is_a_fault_only_while_we_move_it(make):
    controller = make()
    sideways = (0.05, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(100):
        controller.now_ns += PERIOD_NS
        controller.place = controller.place + np.array(sideways[:3]) * 0.002
        controller.pose()
        controller.arm.state()
    crept = (0.0, 0.0, -1e-4, 0.0, 0.0, 0.0)
    for _ in range(100):
        controller.place = controller.place + np.array(sideways[:3]) * 0.002
        fault = why(lambda: controller.period(crept))
        if fault is not None:
            break
    assert fault.fault is ArmFault.NOT_FOLLOWED


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"frame": "world"}, "are in 'world', accepted is 'base'"),
        ({"stamp_ns": 0}, "the time stamp of a pose"),
        ({"age_ns": -6_000_000}, r"0\.006 s ahead, accepted are 0\.005 s"),
        ({"age_ns": 2_000_000}, "do not increase"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "expected a unit quaternion"),
        ({"quaternion": (math.nan, 0.0, 0.0, 1.0)}, "expected a unit quaternion"),
        ({"place": (math.nan, 0.0, 0.0)}, "expected finite numbers"),
        ({"place": (0.0, 0.0, math.inf)}, "expected finite numbers"),
    ],
)
def test_poses_that_say_nothing_are_zero_and_a_fault(make, how, message):
    controller = make()
    controller.period(DOWN)
    controller.commanded()
    controller.now_ns += PERIOD_NS
    controller.pose(**how)
    with pytest.raises(ArmError, match=message):
        controller.arm.state()
    stands(controller, ArmFault.INVALID)
