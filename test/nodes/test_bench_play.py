# SPDX-License-Identifier: Apache-2.0
"""The bench's service to play an excitation, asked once more because its answer was lost."""

import os

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from spinning import spin_until
from tactile_resonance.srv import Play

from tactile_resonance import msg
from tactile_resonance.multisine import design_multisine
from tactile_resonance.nodes.fake_hardware_node import FakeHardwareNode
from tactile_resonance.nodes.messages import excitation_to_message
from tactile_resonance.nodes.running import RESULTS, initialised
from tactile_resonance.processes import free_domain_id

PERIODS = 4


@pytest.fixture
def bench():
    with initialised(args=["--ros-args"], domain_id=free_domain_id(os.environ)):
        node, executor = FakeHardwareNode(), SingleThreadedExecutor()
        node.trigger_configure()
        node.trigger_activate()
        executor.add_node(node)
        blocks = []
        node.create_subscription(msg.Record, "bench/block", blocks.append, RESULTS)

        def ask(excitation_id, **changed):
            excitation = design_multisine(periods=PERIODS, excitation_id=excitation_id, **changed)
            message = excitation_to_message(excitation, 0, "tip")
            return node._on_play(Play.Request(excitation=message), Play.Response())

        def all_of(excitation_id):
            def found():
                return [b for b in blocks if b.excitation_id == excitation_id]

            assert spin_until(executor, lambda: any(b.block_index == PERIODS - 1 for b in found()))
            return [b.block_index for b in found()]

        yield ask, all_of, node._silence
        node.trigger_deactivate()
        node.destroy_node()


def test_the_same_excitation_asked_for_again_plays_on(bench):
    ask, all_of, _ = bench
    first, second = ask(7), ask(7)
    assert first.accepted
    assert second.accepted
    assert first.start == second.start
    assert all_of(7) == list(range(PERIODS))


def test_another_one_or_one_after_a_stop_begins_anew(bench):
    ask, all_of, stop = bench
    first = ask(7)
    other = ask(8)
    assert other.start != first.start
    stop()
    again = ask(8)
    assert again.start != other.start
    assert all_of(8)[-PERIODS:] == list(range(PERIODS))


def test_another_excitation_of_the_same_id_is_played(bench):
    ask, all_of, _ = bench
    first, second = ask(7), ask(7, level_v=0.5)
    assert second.accepted
    assert second.start != first.start
    assert all_of(7)[-PERIODS:] == list(range(PERIODS))


def test_excitations_without_an_id_are_never_the_same(bench):
    ask, _, _ = bench
    assert ask(0).start != ask(0).start
