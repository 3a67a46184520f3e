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
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from tactile_resonance.action import Measure

from tactile_resonance.nodes.goal_client import GoalClient
from tactile_resonance.nodes.goals import is_done
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id

PREEMPTED_S = 0.2


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


def test_answers_that_come_before_the_question_is_noted(client):
    goal = client.send_goal_async(Measure.Goal())
    assert is_done(goal, 10.0)
    cancel = goal.result().cancel_goal_async()
    assert is_done(cancel, 10.0)
    assert cancel.result().goals_canceling
    result = goal.result().get_result_async()
    assert is_done(result, 10.0)
    assert result.result().result.message == "cancelled"
