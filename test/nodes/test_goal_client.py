# SPDX-License-Identifier: Apache-2.0
"""Goals asked for from a thread beside the executor's: no answer is lost, however soon it comes."""

import os
import threading
import time

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from tactile_resonance.action import Measure
from unique_identifier_msgs.msg import UUID

from tactile_resonance.nodes.goals import GoalClient, Goals
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from tactile_resonance.scan.failures import Interrupted

PREEMPTED_S = 0.2
WITHIN_S = 60.0


class Preempted:
    """rclpy's handle of a client in a thread that the machine stops right after each question is sent."""

    def __init__(self, handle):
        self._handle = handle

    def __getattr__(self, name):
        found = getattr(self._handle, name)
        if not name.startswith("send_"):
            return found

        def send(request):
            sequence_number = found(request)
            time.sleep(PREEMPTED_S)
            return sequence_number

        return send


@pytest.fixture
def client():
    """Client of a server that keeps its goals until they are cancelled; an executor spins both."""
    with initialised(domain_id=free_domain_id(os.environ)):
        node = rclpy.create_node("client_and_server")
        cancelled = Future()

        async def keep(handle):
            await cancelled
            handle.canceled()
            return Measure.Result(message="cancelled")

        def cancel(_):
            if not cancelled.done():
                cancelled.set_result(None)
            return CancelResponse.ACCEPT

        server = ActionServer(node, Measure, "measure", keep, cancel_callback=cancel)
        client = GoalClient(node, Measure, "measure")
        client._client_handle = Preempted(client._client_handle)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        spinning = threading.Thread(target=executor.spin)
        spinning.start()
        try:
            assert client.wait_for_server(30.0)
            yield client
        finally:
            executor.shutdown()
            spinning.join()
            client.destroy()
            server.destroy()
            node.destroy_node()


def comes(future):
    """Wait for an answer."""
    deadline_s = time.monotonic() + WITHIN_S
    while not future.done() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return future.done()


def test_answers_that_come_before_the_question_is_noted(client):
    goal = client.send_goal_async(Measure.Goal())
    assert comes(goal)
    cancel = goal.result().cancel_goal_async()
    assert comes(cancel)
    assert cancel.result().goals_canceling
    result = goal.result().get_result_async()
    assert comes(result)
    assert result.result().result.message == "cancelled"


def test_server_takes_a_goal_that_is_asked_for_twice_once(client):
    """What `Goals` builds on: the second question is refused, and its result is that of the goal."""
    goal_id = UUID(uuid=list(range(16)))
    first = client.send_goal_async(Measure.Goal(), goal_uuid=goal_id)
    second = client.send_goal_async(Measure.Goal(), goal_uuid=goal_id)
    assert comes(first)
    assert comes(second)
    assert [first.result().accepted, second.result().accepted] == [True, False]
    result = second.result().get_result_async()
    other = client.send_goal_async(Measure.Goal())  # answered after what is asked before it
    assert comes(other)
    assert not result.done()
    # cancelled by its id alone
    cancel = ClientGoalHandle(client, goal_id, None).cancel_goal_async()
    assert comes(cancel)
    assert comes(result)
    assert result.result().result.message == "cancelled"


def test_a_goal_that_is_left_is_cancelled_at_its_server(client):
    goals = Goals(client, "measure")

    def check():
        raise Interrupted("enough")

    handle = goals.send(Measure.Goal(), lambda: None)
    with pytest.raises(Interrupted):
        goals.follow(handle, check)
    result = handle.get_result_async()
    assert comes(result)
    assert result.result().result.message == "cancelled"
