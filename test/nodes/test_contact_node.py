# SPDX-License-Identifier: Apache-2.0
"""Limits of contact_node by parameter: as launched or stricter, never laxer; what ends its life."""

import os
import threading
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.task import Future

from tactile_resonance.contact.goal import Cause, ContactResult, State
from tactile_resonance.contact.parameters import (
    ContactParameters,
    Limits,
    Workspace,
    ranges_of,
    read_contact,
)
from tactile_resonance.nodes import contact_node
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id

LIMITS = read_contact()[1]
LAXER_ABOVE = [
    *("abort_force_n", "hard_force_n", "pull_force_n", "lateral_force_n", "force_rate_n_per_s"),
    *("depth_m", "near_speed_m_s", "contact_speed_m_s", "lateral_speed_m_s", "free_speed_m_s"),
    *("angular_speed_rad_s", "tilt_rad", "misalignment_rad", "force_age_s", "arm_age_s"),
    *("stuck_samples", "contact.search_m", "contact.early_m"),
    *("contact.tare_std_n", "contact.tare_drift_n_per_s", "contact.tare_offset_n"),
    "contact.cell_noise_n",
]


@pytest.fixture
def launch():
    """A contact_node, not configured, with parameters as a launch passes them."""
    with ExitStack() as stack:

        def make(**launched):
            args = ["--ros-args"]
            for name, value in launched.items():
                args += ["-p", f"limits.{name.replace('__', '.')}:={value}"]
            stack.enter_context(initialised(args=args, domain_id=free_domain_id(os.environ)))
            node = contact_node.ContactNode()
            stack.callback(node.destroy_node)
            return node

        yield make


def full(name):
    """Name of a limit's parameter, or of one that names its group."""
    return name if name.startswith("contact.") else f"limits.{name.replace('__', '.')}"


def ask(node, **limits):
    """Set limits; why it is refused, empty where not."""
    asked = [Parameter(full(name), value=value) for name, value in limits.items()]
    return node.set_parameters_atomically(asked).reason


@pytest.mark.parametrize("name", LAXER_ABOVE)
def test_a_limit_that_protects_the_tissue_is_made_stricter_and_never_laxer(launch, name):
    node = launch()
    limit = node.get_parameter(full(name)).value
    short = name.removeprefix("contact.")
    above = min((ranges_of(ContactParameters) | ranges_of(Limits))[short][1], 2 * limit)
    below = limit - 1 if isinstance(limit, int) else 0.9 * limit
    if name in ("near_speed_m_s", "contact_speed_m_s"):
        below = limit  # the parameters ask for it
    reason = ask(node, **{name: above})
    assert reason.startswith(f"{full(name)}: got {above}; accepted is at most {limit}, as launched")
    assert node.get_parameter(full(name)).value == limit
    assert ask(node, **{name: below}) == ""
    assert node.get_parameter(full(name)).value == below
    assert ask(node, **{name: limit}) == ""  # back to what the launch set


def test_result_of_a_contact_that_pressed_too_hard_has_its_largest_force(launch):
    node, given_up = launch(), ContactResult(False, Cause.FORCE_ABORT, "", 1.0, 0.03)
    controller = SimpleNamespace(state=State.RETRACT, result=given_up, settled=False)
    clock = SimpleNamespace(simulated=True)
    node._thread = SimpleNamespace(error=None, controller=controller, clock=clock)
    node._teller = SimpleNamespace(is_canceled=lambda: False)
    node._goal, node._finished = SimpleNamespace(is_cancel_requested=False), Future()
    node._test, node._dead = None, False
    node._look()
    assert not node._finished.done()
    controller.result, controller.settled = replace(given_up, peak_force_n=0.15), True
    node._look()
    assert node._finished.result().peak_force_n == 0.15
    node._thread = None


def test_a_cell_that_carries_nothing_at_the_launch_carries_nothing_later(launch):
    name = "contact.carried_kg"
    assert ask(launch(), **{name: 0.1}).startswith(f"{name}: got 0.1; accepted is at most 0.0")


@pytest.mark.parametrize("name", ["near_m", "clearance_m"])
def test_a_distance_that_is_kept_is_made_larger_and_never_smaller(launch, name):
    node, limit = launch(), getattr(LIMITS, name)
    reason = ask(node, **{name: limit / 2})
    assert f"limits.{name}: got {limit / 2}; accepted is at least {limit}" in reason
    assert ask(node, **{name: 2 * limit}) == ""


def test_what_counts_is_the_launch_and_not_the_file_of_the_package(launch):
    node = launch(abort_force_n=0.02, depth_m=0.005)
    assert "accepted is at most 0.02" in ask(node, abort_force_n=LIMITS.abort_force_n)
    assert ask(node, depth_m=0.005) == ""
    assert ask(node, depth_m=0.003) == ""
    assert ask(node, depth_m=0.0045) == "", "what the launch allows, not the last value"


def test_several_limits_at_once_are_refused_for_the_one_that_is_laxer(launch):
    node = launch()
    assert "hard_force_n: got 0.06" in ask(node, abort_force_n=0.02, hard_force_n=0.06)
    assert node.get_parameter("limits.abort_force_n").value == LIMITS.abort_force_n


def test_the_workspace_of_a_launch_is_made_smaller_and_never_larger(launch):
    node = launch(workspace__low_m="[-0.3, -0.2, 0.0]", workspace__high_m="[0.3, 0.2, 0.5]")
    node._settings.read()
    assert node._settings.limits.workspace == Workspace((-0.3, -0.2, 0.0), (0.3, 0.2, 0.5))
    reason = ask(node, workspace__high_m=[0.3, 0.2, 0.6])
    assert "limits.workspace.high_m: got [0.3, 0.2, 0.6]; accepted is at most [0.3, 0.2" in reason
    assert "accepted is at least" in ask(node, workspace__low_m=[-0.3, -0.21, 0.0])
    assert ask(node, workspace__low_m=[-0.1, -0.2, 0.1]) == ""
    assert "above low_m" in ask(node, workspace__high_m=[-0.2, 0.2, 0.5])
    assert "limits.workspace.low_m" in ask(node, workspace__low_m=[0.0, 0.0])


def test_other_requests_are_served_while_the_program_of_an_arm_is_started_again(launch):
    node, begun, go_on, asked = launch(), threading.Event(), threading.Event(), []

    def make_ready():
        begun.set()
        asked.append(go_on.wait(5.0))

    controller = SimpleNamespace(state=State.FAULT)
    node._thread = SimpleNamespace(
        controller=controller, make_ready=make_ready, retract=lambda: asked.append("retract")
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    task = executor.create_task(node._on_retract)
    while not begun.is_set():
        executor.spin_once(0.1)
    go_on.set()  # only an executor that is free comes to this before the wait has ended
    while not task.done():
        executor.spin_once(0.1)
    executor.remove_node(node)
    assert asked == [True, "retract"]
    assert task.result().startswith("asked")


@pytest.mark.parametrize(
    ("active", "another", "stopped", "message"),
    [
        (False, None, False, "contact_node is not active"),
        (True, "a goal", False, "goal: refused while another one is under way"),
        (True, None, True, "goal: refused while the tip is stopped"),
    ],
)
def test_an_accepted_goal_that_has_to_wait_is_busy_and_not_wrong(
    launch, active, another, stopped, message
):
    """What comes between its acceptance and its begin: a scan repeats its point."""
    node = launch()
    node._thread, node._goal, node._stop.stopped = object() if active else None, another, stopped
    with pytest.raises(StopIteration) as ended:
        node._outcome_of(SimpleNamespace(request=None)).send(None)
    result, _ = ended.value.value
    assert (result.reached, result.cause, result.message) == (False, Cause.BUSY, message)
    node._thread = None


@pytest.mark.parametrize("ends", [True, False])
def test_a_node_whose_loop_does_not_end_is_made_anew(launch, ends):
    node, finished = launch(), []
    controller = SimpleNamespace(result="what became of the goal")
    node._thread = SimpleNamespace(close=lambda: ends, controller=controller)
    node._finish = finished.append
    node.active = True
    answer = node.on_deactivate(None)
    want = TransitionCallbackReturn.SUCCESS if ends else TransitionCallbackReturn.ERROR
    assert answer is want
    assert node._thread is None
    assert finished == ["what became of the goal"], "nobody waits for it"
