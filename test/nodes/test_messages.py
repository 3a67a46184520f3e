# SPDX-License-Identifier: Apache-2.0
"""Objects survive the way through messages and their serialisation bit by bit."""

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not here")
serialization = pytest.importorskip("rclpy.serialization")
msg = pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

from tactile_resonance.frf.result import (  # noqa: E402
    FRF,
    BandBins,
    BandDistortion,
    FrfStatus,
)
from tactile_resonance.multisine import Grid, design_multisine  # noqa: E402
from tactile_resonance.nodes import messages  # noqa: E402
from tactile_resonance.poles.result import Poles, PolesStatus  # noqa: E402
from tactile_resonance.poles.structure import PoleBand  # noqa: E402
from tactile_resonance.processes import free_domain_id  # noqa: E402
from tactile_resonance.record import (  # noqa: E402
    BetweenSamples,
    Channel,
    Contact,
    ForceSpread,
    InputKind,
    Origin,
    Record,
)
from tactile_resonance.recording import messages as stored  # noqa: E402

RNG = np.random.default_rng(0)
CONTACT = Contact(
    *(0.0101, 2e-4, (0.1, -0.2, 0.3), (0.0, 0.6, 0.0, 0.8), "table", 1_700_000_000_123_456_789),
    spread=ForceSpread(3e-4, 0.0093, 0.0112),
)
ORIGIN = Origin(
    measurement_id=2**50 + 1,
    excitation_id=2**51 + 3,
    time_ns=1_700_000_000_987_654_321,
    final=True,
    frame_id="sensor_2/tip",
    label="gelatine 12 %, point 3",
    simulated=True,
    contact=CONTACT,
)


def through_the_wire(message):
    data = serialization.serialize_message(message)
    return serialization.deserialize_message(data, type(message))


def assert_equal(a, b):
    """Field by field, arrays element by element, NaN equal to NaN."""
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            assert_equal(x, y)
        elif isinstance(x, tuple) and x and dataclasses.is_dataclass(x[0]):
            assert len(x) == len(y)
            for one, other in zip(x, y, strict=True):
                assert_equal(one, other)
        elif x is None or y is None:
            assert x is y, field.name
        else:
            np.testing.assert_array_equal(x, y, err_msg=field.name)


def test_excitation():
    excitation = design_multisine(
        grid=Grid.ODD_RANDOM,
        seed=2**40,
        realisation=2,
        realisations=5,
        periods=3,
        measurement_id=7,
        excitation_id=9,
        label="x",
    )
    message = messages.excitation_to_message(excitation, 1_500_000_000, "tip")
    assert message.header.frame_id == "tip"
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert message.level_v == excitation.level_v
    assert_equal(stored.excitation_from_message(through_the_wire(message)), excitation)


@pytest.mark.parametrize(
    "channel",
    [
        Channel(RNG.integers(-(2**15), 2**15, 1000, dtype=np.int32), 3e-4, 0.01, True),
        Channel(RNG.standard_normal(1000)),
    ],
    ids=["counts", "volts"],
)
def test_record(channel):
    record = Record(
        actuator=channel,
        sensor=Channel(RNG.standard_normal(1000)),
        sample_rate_hz=50e3,
        samples_per_period=500,
        realisation=3,
        block_index=17,
        input_kind=InputKind.COMMANDED,
        between_samples=BetweenSamples.ZERO_ORDER_HOLD,
        channel_delay_s=1e-6,
        anti_alias_filter="none",
        origin=ORIGIN,
    )
    message = through_the_wire(messages.record_to_message(record))
    assert message.simulated
    assert_equal(stored.record_from_message(message), record)


def test_record_with_two_or_no_representations_is_refused():
    message = messages.record_to_message(Record(Channel(np.ones(4)), Channel(np.ones(4)), 1.0, 4))
    message.sensor_v = []
    with pytest.raises(ValueError, match="sensor: 0 counts and 0 voltages"):
        stored.record_from_message(message)


def complex_normal(*shape):
    return RNG.standard_normal(shape) + 1j * RNG.standard_normal(shape)


@pytest.mark.parametrize("complete", [True, False])
def test_frf(complete):
    bins = BandBins(17, complex_normal(2, 12), complex_normal(2, 12), np.arange(5, 8), 1e3, 64, 4)
    further = BandBins(90, complex_normal(2, 5), complex_normal(2, 5), np.array([23]), 1e3, 64, 4)
    frf = FRF(
        frequency_hz=np.sort(RNG.uniform(1, 100, 30)),
        g=complex_normal(30),
        variance_noise=RNG.uniform(size=30) if complete else None,
        variance_total=RNG.uniform(size=30) if complete else None,
        noise_dof=7,
        total_dof=3,
        actuator_amplitude=RNG.uniform(size=30) if complete else None,
        sensor_variance_given_actuator=RNG.uniform(size=30) if complete else None,
        bins=bins if complete else None,
        further_bins=(further,) if complete else (),
        bands=(PoleBand(60.0, 110.0), PoleBand(350.0, 370.0, 0, 8)) if complete else (),
        distortion=(BandDistortion(60.0, 110.0, even_db=-70.0, even_above_noise=True),)
        if complete
        else (),
        periods=4,
        realisations=2,
        method="m",
        status=FrfStatus.SUSPECT,
        message="why",
    )
    message = through_the_wire(messages.frf_to_message(frf, ORIGIN, 1.5, True))
    assert (message.level_v, message.saturated) == (1.5, True)
    back, origin = messages.frf_from_message(message)
    assert_equal(back, frf)
    assert_equal(origin, ORIGIN)


def test_bands_that_touch_share_a_line():
    bins = BandBins(40, complex_normal(1, 13), complex_normal(1, 13), np.arange(10, 14), 1e3, 64, 4)
    further = BandBins(52, complex_normal(1, 9), complex_normal(1, 9), np.arange(13, 16), 1e3, 64, 4)
    for first, second in ((bins, further), (further, bins)):
        frf = FRF(np.arange(3.0), complex_normal(3), bins=first, further_bins=(second,), periods=4)
        back, _ = messages.frf_from_message(
            through_the_wire(messages.frf_to_message(frf, ORIGIN, 1.5, False))
        )
        for one, other in zip((back.bins, *back.further_bins), (first, second), strict=True):
            assert_equal(one, other)


@pytest.mark.parametrize("modes", [0, 1, 3])
def test_poles(modes):
    poles = Poles(
        poles_rad_s=complex_normal(modes),
        f0_hz=RNG.uniform(size=modes),
        damping_ratio=RNG.uniform(size=modes),
        residues=complex_normal(modes),
        covariance=RNG.standard_normal((modes, 2, 2)) if modes else None,
        total_covariance=None,
        f0_drift_hz_per_s=RNG.standard_normal(modes) if modes == 3 else None,
        damping_drift_per_s=RNG.standard_normal(modes) if modes == 3 else None,
        drift_covariance=RNG.standard_normal((modes, 2, 2)) if modes == 3 else None,
        instant_s=0.6 if modes == 3 else None,
        band_hz=(200.0, 300.0),
        lines=41,
        cost=12.0,
        method="m",
        status=PolesStatus.MODEL_ERROR,
        message="why",
    )
    second = dataclasses.replace(poles, band_hz=(600.0, 800.0), status=PolesStatus.OK, message="")
    poles = dataclasses.replace(poles, further=(second,) if modes == 3 else ())
    message = through_the_wire(messages.poles_to_message(poles, ORIGIN))
    back, origin = stored.poles_from_message(message)
    assert_equal(back, poles)
    assert_equal(origin, ORIGIN)


def test_unknown_position_is_an_empty_frame():
    message = messages.poles_to_message(Poles(), Origin())
    assert message.tip_pose.header.frame_id == ""
    assert np.isnan(message.contact_force_n)
    assert np.isnan(message.contact_force_rms_n)
    assert stored.poles_from_message(message)[1].contact.position_m is None


def test_every_status_has_its_constant():
    for table, kind, prefix in (
        (stored.GRIDS, msg.Excitation, "GRID_"),
        (stored.INPUT_KINDS, msg.Record, "INPUT_"),
        (stored.BETWEEN_SAMPLES, msg.Record, ""),
        (messages.FRF_STATUS, msg.FRF, "STATUS_"),
        (stored.POLES_STATUS, msg.Poles, "STATUS_"),
    ):
        assert len(set(table.values())) == len(table) == len(type(next(iter(table))))
        assert all(getattr(kind, prefix + key.name) == number for key, number in table.items())
    message = messages.poles_to_message(Poles(), Origin())
    message.status = 77
    with pytest.raises(ValueError, match="status: 77, accepted are"):
        stored.poles_from_message(message)


def test_reading_makes_no_copy():
    message = through_the_wire(
        messages.record_to_message(Record(Channel(np.ones(4)), Channel(np.ones(4)), 1.0, 4))
    )
    record = stored.record_from_message(message)
    message.sensor_v[2] = 5.0
    assert record.sensor.samples[2] == 5.0


OFFERED = """
import rclpy
from rclpy.action import ActionServer
from tactile_resonance import msg
from tactile_resonance.action import Scan
from tactile_resonance.nodes.running import initialised

with initialised():
    node = rclpy.create_node("offering")
    node.create_publisher(msg.FRF, "frf", 1)
    ActionServer(node, Scan, "scan", lambda goal: None)
"""


def test_all_kinds_of_messages_that_the_middleware_asks_for_were_built():
    """Fast DDS reports those that it misses on stderr, and goes on without them."""
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(free_domain_id(os.environ)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    command = [sys.executable, "-W", "ignore", "-c", OFFERED]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    # a port of shared memory that a node beside these tests took at that moment is reported too
    assert [line for line in done.stderr.splitlines() if "RTPS_TRANSPORT_SHM" not in line] == []
