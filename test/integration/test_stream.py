# SPDX-License-Identifier: Apache-2.0
"""The stream of nodes, seen by a program of its own that only listens."""

import time
from dataclasses import asdict

import numpy as np
import pytest
from geometry_msgs.msg import Point
from robot_at_hand import own_time
from tactile_resonance.action import Measure

from benchmarks.scan_session import ScanSession
from tactile_resonance import msg
from tactile_resonance.configuration import share_path
from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.nodes.client import HANGS_S, NoAnswer, NodeClient
from tactile_resonance.nodes.messages import frf_from_message
from tactile_resonance.nodes.running import EXCITATIONS, RESULTS
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.recording.messages import (
    excitation_from_message,
    poles_from_message,
    record_from_message,
)
from tactile_resonance.scan.measurement import design_measurement
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.tissue.library import read_tissues

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")
TIME = own_time(14)
GEL_10 = (0.0, 0.0, 0.0)
GEL_16 = (0.18, 0.0, 0.0)


class Listener(NodeClient):
    """Collects what is published, as a user's own node would."""

    def join(self):
        self.heard = {"excitation": [], "record": [], "frf": [], "poles": []}
        types = (msg.Excitation, msg.Record, msg.FRF, msg.Poles)
        for (topic, list_), kind in zip(self.heard.items(), types, strict=False):
            qos = EXCITATIONS if topic == "excitation" else RESULTS
            self._node.create_subscription(kind, topic, list_.append, qos)

    def why(self):
        return str({topic: len(list_) for topic, list_ in self.heard.items()})

    def meet(self, session):
        """Measure until a whole measurement has been heard: only then has everybody found the listener."""
        for attempt in range(10):
            key = session.warm_up(GEL_10, HANGS_S).origin.measurement_id
            deadline = time.monotonic() + 2.0 * (1 + attempt)
            while time.monotonic() < deadline:
                self.spin(0.05)
                if [len(self.of(topic, key)) for topic in self.heard] == [1, 3, 3, 3]:
                    return
        raise AssertionError("the listener does not hear the nodes")

    def of(self, topic, measurement_id):
        return [m for m in self.heard[topic] if m.measurement_id == measurement_id]


@pytest.fixture(scope="module")
def session(module_domain, tmp_path_factory):
    """Nodes that run, and a client of theirs."""
    with NodeProcesses(tmp_path_factory.mktemp("log")) as nodes:
        parameters = {
            "fake_hardware_node": {"time_server": TIME},
            "excitation_node": {
                "record_folder": tmp_path_factory.mktemp("records"),
                "time_server": TIME,
            },
        }
        nodes.bring_up(NODES, parameters)
        with ScanSession(nodes.check) as session:
            session.wait_for_nodes(HANGS_S)
            session.warm_up(GEL_10, HANGS_S)
            yield session


def quiet(done, planned):
    pass


def test_messages_of_a_measurement(session):
    with Listener("listener", lambda: None) as listener:
        listener.meet(session)
        goal = Measure.Goal(label="here", periods=5, realisations=2, seed=3, level_v=0.5)
        result = session.measure(GEL_10, goal, quiet)
        key = result.origin.measurement_id
        listener.wait(
            lambda: (
                all(
                    any(m.final for m in listener.of(topic, key))
                    for topic in ("record", "frf", "poles")
                )
                and len(listener.of("excitation", key)) == goal.realisations
            ),  # no order between topics
            HANGS_S,
            "all messages",
        )
        excitations = [excitation_from_message(m) for m in listener.of("excitation", key)]
        messages = listener.of("record", key)
        frfs, poles = listener.of("frf", key), listener.of("poles", key)

    # every block arrived, in order, none twice
    assert [(m.realisation, m.block_index) for m in messages] == [
        (m, p) for m in range(2) for p in range(5)
    ]
    assert [m.final for m in messages] == [False] * 9 + [True]
    assert len(frfs) == len(poles) == 10
    assert [e.realisation for e in excitations] == [0, 1]
    assert excitations[0].level_v == pytest.approx(0.5)

    # stamps: records lie one period apart; results carry the middle of what they rest on
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in messages]
    assert np.all(np.abs(np.diff(stamps[:5]) - 400_000_000) <= 1)
    assert 0 < stamps[0] < 600_000_000_000  # simulated time
    middle = (stamps[0] + stamps[-1] + 400_000_000) // 2
    last, last_poles = frfs[-1], poles[-1]
    assert abs(last.header.stamp.sec * 10**9 + last.header.stamp.nanosec - middle) <= 1
    assert last_poles.header.stamp == last.header.stamp
    for message in (*messages, *frfs, *poles):
        assert message.header.frame_id == "tip"
        assert message.label == "here"
        assert message.simulated
        assert message.contact_force_n == pytest.approx(0.01)
        assert message.tip_pose.header.frame_id == "table"
        assert message.tip_pose.pose.position.x == 0.0

    # the FRF of the node is that of the same records in process
    records = [record_from_message(m) for m in messages]
    u, y = (
        np.stack([getattr(r, name).volts() for r in records]).reshape(2, 5, -1)
        for name in ("actuator", "sensor")
    )
    frf, _ = frf_from_message(last)
    alone = frf_of_record(
        Spectrum.of(u, y), sample_rate_hz=50e3, harmonics=excitations[0].harmonics
    )
    np.testing.assert_allclose(frf.g, alone.g, rtol=1e-12)
    np.testing.assert_allclose(frf.variance_total, alone.variance_total, rtol=1e-9)
    assert (frf.periods, frf.realisations) == (5, 2)
    assert last.level_v == pytest.approx(0.5)

    # and the poles are those of the tissue under the tip
    estimate, _ = poles_from_message(last_poles)
    truth = min(result.truth.f0_hz, key=lambda f: abs(f - 250))
    std = np.sqrt(estimate.total_covariance[0, 0, 0])
    assert abs(estimate.f0_hz[0] - truth) < 5 * std
    assert 0.001 < std < 0.1


def test_tissue_follows_the_tip_and_noise_repeats(session):
    def poles(position):
        goal = Measure.Goal(periods=4, seed=5)
        return session.measure(position, goal, quiet).poles

    first, second, again = poles(GEL_10), poles(GEL_16), poles(GEL_10)
    assert second.f0_hz[0] - first.f0_hz[0] > 8
    assert second.damping_ratio[0] - first.damping_ratio[0] > 0.008
    np.testing.assert_array_equal(again.poles_rad_s, first.poles_rad_s)


def test_poles_of_two_bands_in_one_measurement(session):
    bands = [
        msg.Band(low_hz=200.0, high_hz=300.0, order=2, residual_terms=6),
        msg.Band(low_hz=600.0, high_hz=800.0, order=2, residual_terms=10),
    ]
    goal = Measure.Goal(periods=4, seed=6, bands=bands)
    goal.excited_low_hz, goal.excited_high_hz = [180.0, 570.0], [320.0, 830.0]
    result = session.measure(GEL_10, goal, quiet)
    (further,) = result.poles.further
    for poles, (low_hz, high_hz) in ((result.poles, (200, 300)), (further, (600, 800))):
        (truth,) = (f for f in result.truth.f0_hz if low_hz < f < high_hz)
        assert poles.band_hz == (low_hz, high_hz)
        assert poles.status is PolesStatus.OK, poles.message
        assert abs(poles.main.f0_hz - truth) < 5 * np.sqrt(poles.best_covariance[0, 0, 0])
        assert np.sqrt(poles.best_covariance[0, 0, 0]) < 0.1


def test_a_pole_from_one_short_block(session):
    design = design_measurement(read_scan_scene(share_path("config/scenes/two_gelatines.yaml")))
    (band,) = design.bands
    goal = Measure.Goal(
        **{"periods": 1, "seed": 6, "sweep": design.sweep, "level_v": design.level_v},
        bands=[msg.Band(**asdict(band))],
        excited_low_hz=[band.low_hz],
        excited_high_hz=[band.high_hz],
        samples_per_period=design.samples,
    )
    result = session.measure(GEL_10, goal, quiet)
    (truth,) = (f for f in result.truth.f0_hz if 200 < f < 300)
    f0_std_hz = result.poles.main.std[0]
    # the level of the noise is from the residuals alone
    assert result.poles.status is PolesStatus.NO_COVARIANCE
    assert abs(result.poles.main.f0_hz - truth) < 5 * f0_std_hz < 0.5


def test_the_bench_tells_its_truth_on_request(session):
    """Where the tip is, or anywhere; equal to the same question asked in process."""
    bench, library = SimulatedBench.from_configuration(), read_tissues()
    session.measure(GEL_16, Measure.Goal(periods=3), quiet)
    frequency = [100.0, 250.0]
    for request, name in (
        ({"here": True}, "gel16"),
        ({"position": Point(x=0.06)}, "gel12"),
        ({"position": Point(x=0.06), "force_n": 0.02, "hold_time_s": 3.0}, "gel12"),
    ):
        answer = session.truth(frequency_hz=frequency, **request)
        coupled = bench.coupled(
            library[name],
            force_n=request.get("force_n"),
            hold_time_s=request.get("hold_time_s", 1.0),
        )
        assert answer.tissue == name
        assert answer.contact_radius_m == coupled.contact.contact_radius_m
        assert answer.indentation_m == coupled.contact.indentation_m
        assert answer.force_n == request.get("force_n", 0.01)
        assert list(answer.f0_hz) == [mode.f0_hz for mode in coupled.modes]
        np.testing.assert_array_equal(
            np.array(answer.response_real) + 1j * np.array(answer.response_imag),
            coupled.frequency_response(frequency),
        )
        # poles and residues make the same response
        s = 2j * np.pi * np.array(frequency)[:, None]
        poles = np.array(answer.pole_real_rad_s) + 1j * np.array(answer.pole_imag_rad_s)
        residues = np.array(answer.residue_real_rad_s) + 1j * np.array(answer.residue_imag_rad_s)
        summed = answer.feedthrough + (residues / (s - poles)).sum(axis=1)
        np.testing.assert_allclose(summed, coupled.frequency_response(frequency), rtol=1e-9)
        stiffness = np.array(answer.stiffness_real_n_per_m)
        np.testing.assert_allclose(
            stiffness, coupled.contact.dynamic_stiffness(s[:, 0]).real, rtol=1e-12
        )
    air = session.truth(position=Point(x=1.0))
    assert (air.tissue, air.contact_radius_m, len(air.stiffness_real_n_per_m)) == ("", 0.0, 0)
    with pytest.raises(NoAnswer, match="force_n: got -1"):
        session.truth(position=Point(), force_n=-1.0)


def test_level_above_the_sensors_limit_is_refused(session):
    with pytest.raises(NoAnswer, match="level_v: 9, the sensor bears at most 4 V rms"):
        session.measure(GEL_10, Measure.Goal(level_v=9.0), quiet)
    # and the next one is measured as if nothing had happened
    assert session.measure(GEL_10, Measure.Goal(periods=3), quiet).poles.f0_hz.size == 1


def test_a_node_that_refuses_to_come_up_says_why(domain, tmp_path):
    with NodeProcesses(tmp_path) as nodes:
        nodes.bring_up(NODES, {"fake_hardware_node": {"scene": "nowhere.yaml"}})
        refusal = r"fake_hardware_node is unconfigured: .*nowhere.yaml"
        with ScanSession(nodes.check) as session, pytest.raises(NoAnswer, match=refusal):
            session.wait_for_nodes(HANGS_S)


def test_a_node_that_ended_is_named(domain, tmp_path):
    with NodeProcesses(tmp_path) as nodes:
        nodes.start("fake_hardware_node", {"seed": 0})
        with pytest.raises(RuntimeError, match=r"fake_hardware_node ended.*seed"):
            wait_for_an_end(nodes)


def wait_for_an_end(nodes):
    deadline = time.monotonic() + HANGS_S
    while time.monotonic() < deadline:
        nodes.check()
        time.sleep(0.1)
