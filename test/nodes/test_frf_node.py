# SPDX-License-Identifier: Apache-2.0
"""What the FRF node does with messages in the order in which a fast bench sends them."""

import os
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")


from tactile_resonance.multisine import design_multisine
from tactile_resonance.nodes.frf_node import FrfNode
from tactile_resonance.nodes.messages import (
    excitation_to_message,
    frf_from_message,
    record_to_message,
)
from tactile_resonance.nodes.running import initialised
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Channel, Origin, Record

N, RATE_HZ, PERIODS = 200, 1000.0, 3


@pytest.fixture
def node(monkeypatch):
    with initialised(domain_id=free_domain_id(os.environ)):
        node = FrfNode()
        node.trigger_configure()
        node.trigger_activate()
        node.published = []
        monkeypatch.setattr(node._publisher, "publish", node.published.append)
        yield node
        node.destroy_node()


def hear(node, topic, message):
    """As it arrives."""
    (heard,) = (each for each in node.subscriptions if each.topic_name == f"/{topic}")
    heard.callback(message)


def excitation(key):
    return design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=N,
        band_hz=(50, 200),
        seed=key,
        periods=PERIODS,
        measurement_id=key,
        excitation_id=100 + key,
    )


def messages(key):
    made = excitation(key)
    u = made.period()
    records = [
        record_to_message(
            Record(
                Channel(u),
                Channel(0.1 * key * u),
                RATE_HZ,
                N,
                block_index=block,
                origin=Origin(key, 100 + key, final=block == PERIODS - 1),
            )
        )
        for block in range(PERIODS)
    ]
    return excitation_to_message(made, 0, "tip"), records


def finals(node):
    return {m.measurement_id: frf_from_message(m)[0] for m in node.published if m.final}


def test_records_queued_behind_the_next_excitation_are_not_lost(node):
    (first, first_records), (second, second_records) = messages(1), messages(2)
    hear(node, "excitation", first)
    hear(node, "record", first_records[0])
    hear(node, "excitation", second)
    for record in first_records[1:] + second_records:
        hear(node, "record", record)
    assert len(node.published) == 2 * PERIODS
    for key, frf in finals(node).items():
        np.testing.assert_allclose(frf.g, 0.1 * key, rtol=1e-9)
        assert frf.periods == PERIODS


def test_records_may_come_before_their_excitation(node):
    message, records = messages(3)
    for record in records:
        hear(node, "record", record)
    assert node.published == []
    hear(node, "excitation", message)
    assert [m.final for m in node.published] == [False, False, True]


def test_a_measurement_replayed_twice_starts_anew(node):
    message, records = messages(4)
    for _ in range(2):
        hear(node, "excitation", message)
        for record in records:
            hear(node, "record", record)
    assert [m.periods for m in node.published] == [1, 2, 3, 1, 2, 3]
    assert not any("lost" in m.message for m in node.published)


def test_what_does_not_fit_is_refused_and_the_next_is_taken(node):
    message, records = messages(5)
    hear(node, "excitation", message)
    hear(node, "record", records[0])
    records[1].sensor_v.append(0.0)
    hear(node, "record", records[1])
    broken = excitation_to_message(excitation(6), 0, "tip")
    broken.phase_rad.append(1.0)
    hear(node, "excitation", broken)
    assert node.health._error.startswith("excitation: 106: ")
    assert [m.status for m in node.published] == [1, 3]  # no covariance yet; failed
    assert "200 and 201 samples" in node.published[1].message
    message, records = messages(7)
    hear(node, "excitation", message)
    for record in records:
        hear(node, "record", record)
    assert 7 in finals(node)


@pytest.mark.parametrize("rate_hz", [0.0, float("nan"), 1e-15])
def test_a_record_without_a_sample_rate_does_no_harm(node, rate_hz):
    message, records = messages(8)
    records[0].sample_rate_hz = rate_hz
    hear(node, "excitation", message)
    hear(node, "record", records[0])
    assert node.published == []
    assert node.health._error.startswith("record: excitation 108: sample_rate_hz: ")
    records[0].sample_rate_hz = RATE_HZ
    for record in records:
        hear(node, "record", record)
    assert 8 in finals(node)


def test_a_record_that_does_not_fit_may_come_before_its_excitation(node):
    message, records = messages(9)
    records[0].sensor_v.append(0.0)
    hear(node, "record", records[0])
    hear(node, "excitation", message)
    assert [m.status for m in node.published] == [3]


def test_an_estimate_that_raises_gets_a_failure_with_its_reason(node, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("division by zero")

    _, records = messages(10)
    bands = (PoleBand(60.0, 90.0), PoleBand(120.0, 160.0))
    hear(node, "excitation", excitation_to_message(replace(excitation(10), bands=bands), 0, "tip"))
    with monkeypatch.context() as patched:
        patched.setattr("tactile_resonance.frf.measurement.MeasurementFrf.add", broken)
        hear(node, "record", records[0])
    hear(node, "excitation", messages(11)[0])
    hear(node, "record", messages(11)[1][0])
    assert [m.status for m in node.published] == [3, 1]
    assert node.published[0].message == "ZeroDivisionError: division by zero"
    # so that each band has poles that say so
    assert frf_from_message(node.published[0])[0].bands == bands
