# SPDX-License-Identifier: Apache-2.0
"""ManagedNode: what waits while its node is cleaned up ends without an answer, and harms nobody."""

import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future
from std_srvs.srv import Trigger
from tactile_resonance.action import Measure

from tactile_resonance.nodes.managed_node import ManagedNode, end_goal
from tactile_resonance.nodes.running import initialised
from tactile_resonance.processes import free_domain_id
from test.spinning import spin_until


class Slow(ManagedNode):
    """Answers, takes goals, cancels them and ends them only when `let_go` is called."""

    def __init__(self):
        super().__init__("slow", ())
        self.stage, self.waits, self.done = "", False, []

    def configure(self):
        self.serve_trigger("answer", self._answer)
        self.act(Measure, "measure", self._measure, refuses=self._refuses)

    async def _wait(self, stage):
        if stage == self.stage:
            self.future, self.waits = Future(), True
            await self.future
            self.done.append(stage)

    async def _answer(self):
        await self._wait("answer")
        return "late"

    async def _refuses(self, _):
        await self._wait("accept")
        return False

    async def _measure(self, goal):
        await self._wait("execute")
        end_goal(goal, done=True)
        return Measure.Result()


@pytest.fixture
def executor():
    with initialised(domain_id=free_domain_id()):
        yield SingleThreadedExecutor()


@pytest.mark.parametrize("is_up_again", [False, True])
@pytest.mark.parametrize("stage", ["answer", "accept", "execute"])
def test_what_waits_as_the_node_is_cleaned_up_ends_and_the_node_lives_on(
    executor, stage, is_up_again
):
    node, other = Slow(), rclpy.create_node("other")
    for each in (node, other):
        executor.add_node(each)
    ask, measure = other.create_client(Trigger, "answer"), ActionClient(other, Measure, "measure")

    def up():
        node.trigger_configure()
        node.trigger_activate()
        assert spin_until(executor, lambda: ask.service_is_ready() and measure.server_is_ready())

    up()
    node.stage = stage
    if stage == "answer":
        ask.call_async(Trigger.Request())
    else:
        sent = measure.send_goal_async(Measure.Goal())
    assert spin_until(executor, lambda: node.waits)
    if stage == "execute":
        assert spin_until(executor, sent.done)
        sent.result().get_result_async()
        for _ in range(5):  # the request arrives
            executor.spin_once(0.01)
    node.trigger_deactivate()
    node.trigger_cleanup()
    if is_up_again:
        up()
    executor.create_task(node.future.set_result, None)
    assert spin_until(executor, lambda: node.done == [stage])
    for _ in range(5):
        executor.spin_once(0.01)
    # configured again it serves as before
    node.stage = ""
    if not is_up_again:
        up()
    answer, taken = ask.call_async(Trigger.Request()), measure.send_goal_async(Measure.Goal())
    assert spin_until(executor, lambda: answer.done() and taken.done())
    assert answer.result().success
    assert taken.result().accepted
    measure.destroy()
    node.destroy_node()
    other.destroy_node()
