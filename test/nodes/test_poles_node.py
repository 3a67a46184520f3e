# SPDX-License-Identifier: Apache-2.0
"""Every FRF gets an answer, whatever is in it."""

import array
import os

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")

import rclpy

from tactile_resonance import msg
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.multisine import design_multisine
from tactile_resonance.nodes.frf_node import FrfNode
from tactile_resonance.nodes.messages import (
    excitation_to_message,
    frf_to_message,
    record_to_message,
)
from tactile_resonance.nodes.poles_node import PolesNode
from tactile_resonance.nodes.running import initialised
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.processes import free_domain_id
from tactile_resonance.record import Channel, Origin, Record

LINES_HZ = np.arange(200.0, 300.1, 2.5)
BINS = ("actuator_real", "actuator_imag", "sensor_real", "sensor_imag")


@pytest.fixture
def node(monkeypatch):
    with initialised(domain_id=free_domain_id(os.environ)):
        node = PolesNode()
        node.trigger_configure()
        node.trigger_activate()
        node.published = []
        monkeypatch.setattr(node._publisher, "publish", node.published.append)
        yield node
        node.destroy_node()


def good():
    s, w0 = 2j * np.pi * LINES_HZ, 2 * np.pi * 250
    g = 0.02 + 100 * s / (s**2 + 0.06 * w0 * s + w0**2)
    frf = FRF(LINES_HZ, g, variance_noise=np.full(g.size, 1e-10), noise_dof=20)
    return frf_to_message(frf, Origin(measurement_id=7, label="here"), 1.0, False)


def shorten(message, name):
    setattr(message, name, array.array("d", list(getattr(message, name))[:-1] or [1.0]))


BROKEN = {
    "unknown status": lambda m: setattr(m, "status", 200),
    "imag short": lambda m: shorten(m, "imag"),
    "lines short": lambda m: shorten(m, "frequency_hz"),
    "variance short": lambda m: shorten(m, "variance_noise"),
    "amplitudes long": lambda m: m.actuator_amplitude.extend([1.0] * (LINES_HZ.size + 1)),
    "one variance": lambda m: m.sensor_variance_given_actuator.extend([1.0]),
    "bins short": lambda m: m.bins_sensor_imag.extend([1.0]),
    "bins of no whole realisations": lambda m: [
        setattr(m, "realisations", 2),
        *(getattr(m, f"bins_{name}").extend([1.0]) for name in BINS),
    ],
    "bins without a rate": lambda m: [getattr(m, f"bins_{name}").extend([1.0]) for name in BINS],
    "nothing": lambda m: [
        setattr(m, n, array.array("d")) for n in ("frequency_hz", "real", "imag", "variance_noise")
    ],
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_frf_gets_a_failure_with_a_reason(node, case):
    message = good()
    BROKEN[case](message)
    node._on_frf(message)
    node._on_frf(good())
    failed, after = node.published
    assert failed.status in (msg.Poles.STATUS_FAILED, msg.Poles.STATUS_TOO_FEW_LINES)
    assert failed.measurement_id == 7
    assert len(failed.f0_hz) == 0
    assert after.status == msg.Poles.STATUS_OK
    assert after.f0_hz[0] == pytest.approx(250, rel=1e-6)


@pytest.mark.parametrize("modes", [1, 2])
def test_the_data_choose_how_many_modes_there_are(node, modes):
    rng = np.random.default_rng(modes)
    s = 2j * np.pi * LINES_HZ
    g = np.full(LINES_HZ.size, 0.02 + 0j)
    for f0_hz in (240.0, 262.0)[:modes]:
        w0 = 2 * np.pi * f0_hz
        g += 100 * s / (s**2 + 0.04 * w0 * s + w0**2)
    g += 1e-3 * rng.standard_normal((2, g.size)).T @ [1, 1j] / np.sqrt(2)
    frf = FRF(LINES_HZ, g, variance_noise=np.full(g.size, 1e-6), noise_dof=20)
    node.set_parameters([rclpy.Parameter("order", value=0)])
    node._on_frf(frf_to_message(frf, Origin(), 1.0, False))
    (message,) = node.published
    assert (message.order, message.status) == (2 * modes, msg.Poles.STATUS_OK)
    assert list(message.f0_hz) == pytest.approx([240.0, 262.0][:modes], abs=0.1)
    assert f"orders {2 * modes} and" in message.message


@pytest.mark.parametrize("order", [0, 2])
def test_an_frf_that_failed_keeps_its_reason(node, order):
    failed = FRF(
        np.empty(0), np.empty(0, complex), status=FrfStatus.FAILED, message="nothing was played"
    )
    node.set_parameters([rclpy.Parameter("order", value=order)])
    node._on_frf(frf_to_message(failed, Origin(), 0.0, False))
    (message,) = node.published
    assert (message.status, message.message) == (msg.Poles.STATUS_FAILED, "nothing was played")
    assert not node.health._error


def test_a_fit_that_raises_gets_a_failure_with_its_reason(node, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("division by zero")

    with monkeypatch.context() as patched:
        patched.setattr("tactile_resonance.nodes.poles_node.poles_of_bands", broken)
        node._on_frf(good())
    node._on_frf(good())
    failed, after = node.published
    assert failed.status == msg.Poles.STATUS_FAILED
    assert failed.message == "ZeroDivisionError: division by zero"
    assert failed.measurement_id == 7
    assert "ZeroDivisionError" in node.health._error
    assert after.status == msg.Poles.STATUS_OK


def test_bins_give_after_every_block_what_the_whole_record_gives(node, monkeypatch):
    """Through the messages of both nodes: a mode of 2 % at 250 Hz from rest, measured with noise."""
    rng = np.random.default_rng(3)
    excitation = design_multisine(
        sample_rate_hz=5e3, samples_per_period=2000, band_hz=(100, 1000), seed=1, periods=3
    )
    u = np.tile(excitation.period(), 3)
    s = 2j * np.pi * np.fft.rfftfreq(4 * u.size, 1 / 5e3)
    g = 0.02 + 100 * s / (s**2 + 10 * np.pi * s * 2 + (500 * np.pi) ** 2)
    y = np.fft.irfft(np.fft.rfft(u, 4 * u.size) * g)[: u.size]  # from rest
    u, y = (x + 1e-4 * rng.standard_normal(x.size) for x in (u, y))
    frf_node = FrfNode()
    frf_node.trigger_configure()
    frf_node.trigger_activate()
    sent = []
    monkeypatch.setattr(frf_node._publisher, "publish", sent.append)
    frf_node._on_excitation(excitation_to_message(excitation, 0, "tip"))
    for block in range(3):
        here = slice(2000 * block, 2000 * (block + 1))
        record = Record(
            Channel(u[here]), Channel(y[here]), 5e3, 2000, block_index=block,
            origin=Origin(0, excitation.excitation_id, final=block == 2),
        )  # fmt: skip
        frf_node._on_record(record_to_message(record))
        node._on_frf(sent[-1])
        mine = node.published[-1]
        whole = identify_poles_from_records(
            u[: here.stop].reshape(-1, 2000),
            y[: here.stop].reshape(-1, 2000),
            sample_rate_hz=5e3,
            harmonics=excitation.harmonics,
            band_hz=(200.0, 300.0),
        )
        assert mine.method == whole.method == "joint maximum likelihood of poles and transient"
        assert mine.f0_hz[0] == pytest.approx(whole.f0_hz[0], rel=1e-9)
        assert mine.damping_ratio[0] == pytest.approx(whole.damping_ratio[0], rel=1e-8)
        if block == 0:
            assert mine.status == msg.Poles.STATUS_NO_COVARIANCE
        else:
            assert mine.status == msg.Poles.STATUS_OK
            assert np.array(mine.covariance) == pytest.approx(whole.covariance.ravel(), rel=1e-6)
    frf_node.destroy_node()
    # a band that the bins do not cover is fitted to the FRF, and says why
    node.set_parameters([rclpy.Parameter("band_high_hz", value=350.0)])
    node._on_frf(sent[-1])
    assert node.published[-1].method == "weighted least squares"
    assert "bins cover 200 to 300 Hz" in node.published[-1].message
    node.set_parameters([rclpy.Parameter("method", value="joint")])
    node._on_frf(sent[-1])
    assert node.published[-1].status == msg.Poles.STATUS_FAILED
    assert "bins cover 200 to 300 Hz" in node.published[-1].message


def test_bins_of_two_realisations_give_what_their_records_give(node, monkeypatch):
    """Through the messages of both nodes; the second realisation under way leaves the first alone."""
    rng = np.random.default_rng(4)
    frf_node = FrfNode()
    frf_node.trigger_configure()
    frf_node.trigger_activate()
    sent = []
    monkeypatch.setattr(frf_node._publisher, "publish", sent.append)
    records = []
    for m in range(2):
        excitation = design_multisine(
            sample_rate_hz=5e3, samples_per_period=2000, band_hz=(100, 1000), seed=1, periods=2,
            realisation=m, realisations=2,
        )  # fmt: skip
        u = np.tile(excitation.period(), 2)
        s = 2j * np.pi * np.fft.rfftfreq(4 * u.size, 1 / 5e3)
        g = 0.02 + 100 * s / (s**2 + 10 * np.pi * s * 2 + (500 * np.pi) ** 2)
        y = np.fft.irfft(np.fft.rfft(u, 4 * u.size) * g)[: u.size]  # from rest
        u, y = (x + 1e-4 * rng.standard_normal(x.size) for x in (u, y))
        records.append(np.stack([u, y]).reshape(2, 2, 2000))
        frf_node._on_excitation(excitation_to_message(excitation, 0, "tip"))
        for block in range(2):
            record = Record(
                Channel(records[m][0, block]), Channel(records[m][1, block]), 5e3, 2000,
                block_index=block, realisation=m,
                origin=Origin(0, excitation.excitation_id, final=m == block == 1),
            )  # fmt: skip
            frf_node._on_record(record_to_message(record))
            node._on_frf(sent[-1])
    frf_node.destroy_node()
    _, first, under_way, both = node.published
    assert first.method == under_way.method == "joint maximum likelihood of poles and transient"
    assert under_way.f0_hz[0] == first.f0_hz[0]
    u, y = np.stack(records, axis=1)
    expected = identify_poles_from_records(
        u, y, sample_rate_hz=5e3, harmonics=excitation.harmonics, band_hz=(200.0, 300.0)
    )
    assert both.method == expected.method
    assert both.method.endswith("2 realisations")
    assert both.status == msg.Poles.STATUS_OK
    assert both.f0_hz[0] == pytest.approx(expected.f0_hz[0], rel=1e-9)
    assert np.array(both.covariance) == pytest.approx(expected.covariance.ravel(), rel=1e-5)
    total = expected.total_covariance.ravel()
    assert np.array(both.total_covariance) == pytest.approx(total, rel=1e-5)
    error = expected.damping_ratio[0] - 0.02
    assert abs(error) < 4 * np.sqrt(total[3])


def test_a_calibrated_sensor_is_read_and_used(tmp_path, monkeypatch):
    """The pole of a block of 20 ms from rest; a file that is none keeps the node from being configured."""
    from tactile_resonance.calibration.model import CalibratedSensor, Calibration
    from tactile_resonance.frf.measurement import MeasurementFrf
    from tactile_resonance.poles.structure import PoleBand
    from tactile_resonance.simulation.sensor.bench import SimulatedBench
    from tactile_resonance.simulation.sensor.experiments import true_sensor
    from tactile_resonance.simulation.tissue.library import read_tissues

    bench, path = SimulatedBench.from_configuration(), tmp_path / "sensor.yaml"
    model = true_sensor(bench)
    size = model.values.size
    known = Calibration(
        model, np.zeros((size, size)), np.ones(size, bool), (10.0, 12e3), 3.2e-6, 1.0
    )
    path.write_text(CalibratedSensor(known, 0.0025, 7.7e-5, 1e-7, {}).as_text())
    signal = design_multisine(
        samples_per_period=1000,
        band_hz=(200.0, 620.0),
        level_v=0.21,
        sweep=True,
        bands=(PoleBand(200.0, 620.0, 2, 6),),
    )
    tissue = read_tissues()["gel10"]
    frf = MeasurementFrf(0).add(bench.start(tissue, seed=1).block(signal), signal)
    message = frf_to_message(frf, Origin(measurement_id=7), 0.21, False)
    for file, good in ((path, True), (tmp_path / "none.yaml", False)):
        arguments = ["--ros-args", "-p", f"calibration:={file}"]
        with initialised(domain_id=free_domain_id(os.environ), args=arguments):
            node = PolesNode()
            node.trigger_configure()
            if not good:
                assert not hasattr(node, "_publisher")
            else:
                published = []
                monkeypatch.setattr(node._publisher, "publish", published.append)
                node._on_frf(message)
                poles = published[0]
                assert poles.status == msg.Poles.STATUS_OK, poles.message
                mode = bench.coupled(tissue).mode_near(250.0)
                assert abs(poles.f0_hz[0] - mode.f0_hz) < 0.4
                assert "calibrated sensor" in poles.method
            node.destroy_node()
