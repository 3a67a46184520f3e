# SPDX-License-Identifier: Apache-2.0
"""The bench's service to play an excitation: asked once more, and what it plays on."""

import os
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from spinning import spin_until
from tactile_resonance.srv import Play, Truth

from tactile_resonance import msg
from tactile_resonance.multisine import design_multisine
from tactile_resonance.nodes.fake_hardware_node import EFFECTS, FakeHardwareNode
from tactile_resonance.nodes.messages import excitation_to_message, pose_to_message
from tactile_resonance.nodes.running import RESULTS, initialised
from tactile_resonance.nodes.simulated_tip import Stay
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import record_from_message, time_from_message
from tactile_resonance.simulation.plant.defaults import MOST_STEPS, TABLE_IN_BASE
from tactile_resonance.simulation.plant.plant import Plant
from tactile_resonance.simulation.plant.tabletop import PlantHistory, truth
from tactile_resonance.simulation.plant.tip import Tip
from tactile_resonance.simulation.sensor.bench import (
    BenchEffects,
    BenchRun,
    BenchTip,
    SimulatedBench,
)
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene

PERIODS = 4


@pytest.fixture
def node():
    arguments = ["--ros-args", "-p", "base_frame:=left_base"]
    with initialised(args=arguments, domain_id=free_domain_id(os.environ)):
        node = FakeHardwareNode()
        node.trigger_configure()
        node.trigger_activate()
        yield node
        node.trigger_deactivate()
        node.destroy_node()


@pytest.fixture
def bench(node):
    executor, blocks = SingleThreadedExecutor(), []
    executor.add_node(node)
    node.create_subscription(msg.Record, "bench/block", blocks.append, RESULTS)

    def ask(excitation_id, **changed):
        return asked(node, periods=PERIODS, excitation_id=excitation_id, **changed)

    def all_of(excitation_id):
        def found():
            return [b for b in blocks if b.excitation_id == excitation_id]

        assert spin_until(executor, lambda: any(b.block_index == PERIODS - 1 for b in found()))
        return [b.block_index for b in found()]

    return ask, all_of, node._silence


def asked(node, **design):
    message = excitation_to_message(design_multisine(**design), 0, "tip")
    return node._on_play(Play.Request(excitation=message), Play.Response())


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


class Held:
    """A plant that holds the tip on gelatine, deeper than Hertz has it under this force."""

    STATE = {
        **{"time_s": 5.0, "tip_m": TABLE_IN_BASE[:3], "site_m": TABLE_IN_BASE[:3], "stalls": 0},
        "tissue": "gel10",
        **{"normal_force_n": 0.008, "contact_s": 3.0, "contact_radius_m": 1.1e-3, "depth_m": 4e-4},
    }
    alive = True

    def ask(self, what, **fields):
        if what == "truth":
            return self.STATE
        return PlantHistory(None).contact_over(fields)  # nothing was kept


def test_a_sensor_that_is_not_linear_plays_on_the_contact_whose_truth_is_told(node):
    node.set_parameters([Parameter(name, value=name == "nonlinearity") for name in EFFECTS])
    node._touch.plant = Held()
    truths, blocks = [], []
    node._touch.truths.publish = truths.append
    node._blocks.publish = blocks.append
    assert asked(node, excitation_id=7, measurement_id=3, periods=1, level_v=0.5).accepted
    assert spin_until(SingleThreadedExecutor(), lambda: blocks)
    tissue = read_scene(read_tissues()).tissue_at((0.0, 0.0))
    tip = BenchTip(tissue, 0.008, 3.0, 1.1e-3, 4e-4)
    bench = SimulatedBench.from_configuration()
    effects = BenchEffects(noise=False, quantisation=False, nonlinearity=True)
    run = BenchRun(bench.sensor, tip.coupled(bench), 0, effects)
    want = run.block(design_multisine(periods=1, level_v=0.5)).sensor.volts()
    np.testing.assert_allclose(record_from_message(blocks[0]).sensor.volts(), want, rtol=0, atol=1e-9)
    assert truths[-1].measurement_id == 3
    np.testing.assert_allclose(truths[-1].f0_hz, [mode.f0_hz for mode in run.coupled.modes])


def test_tissue_that_an_order_placed_is_what_the_sensor_is_on(node, monkeypatch):
    plant = Plant(None, None, Tip())
    plant.tissue = read_tissues()["cortex"]
    told = truth(plant)["tissue"]
    monkeypatch.setattr(Held, "STATE", Held.STATE | {"tissue": told})
    node._touch.plant = Held()
    node._touch.take_up()
    assert node._touch.tip.tissue == read_tissues()["cortex"]


def test_an_ideal_contact_has_crept_by_as_much_as_the_age_that_is_told(node, monkeypatch):
    begin = BenchRun.__init__
    monkeypatch.setattr(BenchRun, "__init__", lambda *args: (time.sleep(0.3), begin(*args))[1])  # slow machine
    touch, place = node._touch, Contact(position_m=TABLE_IN_BASE[:3], frame_id="base")
    now_ns = touch.now_ns()
    touched_ns = now_ns - 3 * 10**9
    touch.place(Stay(now_ns, 0.008, pose_to_message(place)), touched_ns)
    truths, blocks = [], []
    touch.truths.publish, node._blocks.publish = truths.append, blocks.append
    assert asked(node, excitation_id=7, measurement_id=3, periods=1).accepted
    touch.place(Stay(touch.now_ns(), 0.0, pose_to_message(place)))  # drawn back: what plays is of the contact
    assert spin_until(SingleThreadedExecutor(), lambda: blocks)
    (truth,) = [each for each in truths if each.measurement_id == 3]
    age_s = (time_from_message(truth.header.stamp) - touched_ns) * 1e-9
    bench, gel = SimulatedBench.from_configuration(), read_tissues()["gel10"]
    old, of_1_s = (
        [m.f0_hz for m in bench.coupled(gel, force_n=0.008, hold_time_s=t).modes] for t in (age_s, 1.0)
    )
    np.testing.assert_allclose(truth.f0_hz, old, rtol=1e-5)
    assert np.abs(np.subtract(truth.f0_hz, of_1_s)).max() > 0.08
    assert truth.contact_force_n == pytest.approx(0.008)


def test_truth_with_a_robot_is_in_the_base_of_that_robot(node):
    node._touch.plant, truths = Held(), []
    node._touch.truths.publish = truths.append
    node._touch.take_up()
    assert truths[-1].tip_pose.header.frame_id == "left_base"


def test_contact_over_a_long_block_is_asked_for_in_as_many_parts_as_are_answered(node):
    node._touch.plant = Held()
    node._touch.take_up()
    second = 10**9
    assert node._touch.contact_over(second, 3 * second) == [None] * 50
    assert node._touch.contact_over(second, 21 * second) == [None] * MOST_STEPS


def test_what_the_bench_refuses_is_answered_by_why(node):
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.trigger_deactivate()
    for kind, name in ((Play, "bench/play"), (Truth, "bench/get_truth")):
        client = node.create_client(kind, name)
        assert spin_until(executor, client.service_is_ready)
        answer = client.call_async(kind.Request())
        assert spin_until(executor, answer.done)
        assert answer.result().message == "fake_hardware_node is inactive"
