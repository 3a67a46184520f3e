# SPDX-License-Identifier: Apache-2.0
"""The NI driver on a stand-in of nidaqmx; nothing here has seen hardware."""

import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tactile_resonance.clock import WallClock
from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.acquisition import DeviceError
from tactile_resonance.drivers.nidaq import CountScale, NiDaqConfig, NiDaqDevice
from tactile_resonance.fields import read_file
from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import BetweenSamples, InputKind

sys.path.insert(0, str(Path(__file__).parent))
import fake_nidaqmx

EXAMPLE = share_path("config/devices/nidaqmx.yaml")
CONFIG = read_file(NiDaqConfig, EXAMPLE)
RATE_HZ = 50e3
EXCITATION = design_multisine(
    sample_rate_hz=RATE_HZ, samples_per_period=500, band_hz=(100.0, 10e3), periods=4, seed=1
)


@pytest.fixture
def hardware(monkeypatch):
    return fake_nidaqmx.install(monkeypatch)


def playing(config=CONFIG, excitation=EXCITATION):
    device = NiDaqDevice(config)
    (planned,) = device.plan([excitation])
    device.configure(planned.sample_rate_hz)
    device.play(planned)
    return device


def test_where_the_machines_time_is_set_blocks_keep_to_the_clock_of_the_forces(hardware, monkeypatch):
    """contact_node finds the forces of a block by its stamp, on its own relation of the clocks."""
    forces = WallClock()
    begun_ns = forces.now_ns()
    device = playing()
    ahead_ns = time.time_ns() - time.monotonic_ns()
    for set_s in (0.0, 3600.0, -3600.0):
        shifted_ns = ahead_ns + round(set_s * 1e9)
        monkeypatch.setattr(time, "time_ns", lambda by_ns=shifted_ns: time.monotonic_ns() + by_ns)
        block = device.read_block(1.0)
        block_ns = begun_ns + round(block.block_index * EXCITATION.period_s * 1e9)
        assert forces.own_ns(block.origin.time_ns) == pytest.approx(block_ns, abs=60e9)
    device.stop()


def test_periods_come_whole_from_rest_and_in_order(hardware):
    device = playing()
    blocks = [device.read_block(1.0) for _ in range(4)]
    device.stop()
    assert [block.block_index for block in blocks] == [0, 1, 2, 3]
    period_ns = round(EXCITATION.period_s * 1e9)
    assert np.all(np.diff([block.origin.time_ns for block in blocks]) == period_ns)
    half_count_v = hardware.coefficients[1] / 2
    for block in blocks:
        assert block.actuator.samples.dtype == np.int32
        assert not block.origin.simulated
        assert block.input_kind is InputKind.MEASURED
        assert block.between_samples is BetweenSamples.BAND_LIMITED
        assert np.isnan(block.channel_delay_s)
        for channel, gain in ((block.actuator, 1.0), (block.sensor, 0.5)):
            error = channel.volts() - gain * EXCITATION.period()
            assert np.max(np.abs(error)) <= half_count_v * (1 + 1e-9)
            assert not channel.saturated


def test_clock_trigger_and_order_of_calls(hardware):
    device = playing()
    names = hardware.names()
    assert names.index("output.start") < names.index("input.start")
    for committed in ("output.TASK_COMMIT", "input.TASK_COMMIT"):
        assert names.index(committed) < names.index("output.start")
    clocks = [call for call in hardware.calls if call[0].endswith(".clock")]
    continuous = fake_nidaqmx.Constants.AcquisitionType.CONTINUOUS
    assert ("input.clock", RATE_HZ, "", continuous) in clocks
    assert ("output.clock", RATE_HZ, "/Dev1/ai/SampleClock", continuous) in clocks
    assert ("output.trigger", "/Dev1/ai/StartTrigger") in hardware.calls
    diff = fake_nidaqmx.Constants.TerminalConfiguration.DIFF
    assert ("input.channel", "Dev1/ai0", diff, -5.0, 5.0) in hardware.calls
    assert ("input.channel", "Dev1/ai1", diff, -1.0, 1.0) in hardware.calls
    assert ("output.channel", "Dev1/ao0", -5.0, 5.0) in hardware.calls
    (output,) = (t for t in hardware.open_tasks if t.kind == "output")
    (source,) = (t for t in hardware.open_tasks if t.kind == "input")
    constants = fake_nidaqmx.Constants
    assert output.out_stream.regen_mode is constants.RegenerationMode.ALLOW_REGENERATION
    assert output.out_stream.output_buf_size == 500
    keep = constants.OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
    assert source.in_stream.overwrite is keep
    assert source.in_stream.input_buf_size == 500_000
    device.close()


def test_device_says_what_it_is(hardware):
    info = NiDaqDevice(CONFIG).configure(RATE_HZ)
    assert "PCIe-6376" in info.name
    assert info.output_peak_v == 5.0
    assert not info.recorded
    assert hardware.open_tasks == []
    assert hardware.pin_v == 0.0


def test_a_commanded_drive_is_what_was_asked(hardware):
    device = playing(replace(CONFIG, actuator=None, channel_delay_s=4e-6))
    block = device.read_block(1.0)
    device.stop()
    assert block.channel_delay_s == 4e-6
    np.testing.assert_array_equal(block.actuator.samples, EXCITATION.period())
    assert block.input_kind is InputKind.COMMANDED


@pytest.mark.parametrize("ended", ["stop", "close"])
def test_output_is_zero_and_free_after_the_end(hardware, ended):
    device = playing()
    device.read_block(1.0)
    assert hardware.pin_v != 0.0
    getattr(device, ended)()
    assert hardware.pin_v == 0.0
    assert hardware.open_tasks == []
    device.stop()  # harmless
    with pytest.raises(DeviceError, match="nothing plays"):
        device.read_block(1.0)


def test_a_closed_device_plays_nothing(hardware):
    device = playing()
    device.close()
    with pytest.raises(DeviceError, match="closed"):
        device.play(EXCITATION)
    assert hardware.open_tasks == []


def test_realisations_follow_each_other(hardware):
    device = playing()
    for level in (1.0, 0.5):
        excitation = replace(EXCITATION, amplitude_v=level * EXCITATION.amplitude_v)
        device.play(excitation)
        first = device.read_block(1.0)
        assert first.block_index == 0
        np.testing.assert_allclose(first.actuator.volts(), excitation.period(), atol=2e-4)
        device.stop()
    assert hardware.pin_v == 0.0


def test_overrun_is_named_and_the_output_zeroed(hardware):
    device = playing()
    device.read_block(1.0)
    hardware.samples_late = 500_001
    with pytest.raises(DeviceError, match="nidaqmx: block 2: overrun, blocks are lost"):
        device.read_block(1.0)
    assert hardware.pin_v == 0.0
    assert hardware.open_tasks == []


def test_an_output_that_ran_dry_is_named(hardware):
    device = playing()
    hardware.output_dies_at = 700
    device.read_block(1.0)
    with pytest.raises(DeviceError, match="block 2: DAC conversion attempted") as raised:
        device.read_block(1.0)
    assert "\n" not in str(raised.value)
    assert hardware.pin_v == 0.0


@pytest.mark.parametrize(
    ("call", "step"),
    [
        ("output.trigger", "play"),
        ("output.write", "play"),
        ("input.TASK_COMMIT", "play"),
        ("output.start", "play"),
        ("input.start", "play"),
        ("input.read", "read"),
    ],
)
def test_any_failure_leaves_zero_volts_and_no_task(hardware, call, step):
    device = NiDaqDevice(CONFIG)
    device.configure(RATE_HZ)
    hardware.fail_on[call] = fake_nidaqmx.DaqError("It broke.", -50000)
    steps = {"play": lambda: device.play(EXCITATION), "read": lambda: device.read_block(1.0)}
    for name, run in steps.items():
        if name == step:
            with pytest.raises(DeviceError, match=r"nidaqmx: .*It broke. Status Code: -50000$"):
                run()
            break
        run()
    hardware.fail_on.clear()
    assert hardware.open_tasks == []
    assert hardware.pin_v == 0.0


def test_an_output_that_cannot_be_zeroed_is_shouted_and_tried_again(hardware):
    device = playing()
    hardware.fail_on["output.write"] = fake_nidaqmx.DaqError("Device removed.", -50405)
    hardware.samples_late = 10**9
    with pytest.raises(DeviceError, match="overrun.*THE OUTPUT MAY NOT BE AT ZERO.*removed"):
        device.read_block(1.0)
    assert hardware.pin_v != 0.0
    with pytest.raises(DeviceError, match="MAY NOT BE AT ZERO"):
        device.stop()
    hardware.fail_on.clear()
    device.stop()
    assert hardware.pin_v == 0.0


def test_what_the_device_cannot_do_is_refused(hardware):
    device = NiDaqDevice(CONFIG)
    hardware.rate_error = 1e-6
    with pytest.raises(DeviceError, match="sample_rate_hz: 50000, .* at 50000.05"):
        device.configure(RATE_HZ)
    hardware.rate_error = 0.0
    with pytest.raises(DeviceError, match="max_voltage_v: 12, the device reaches 10 V"):
        NiDaqDevice(replace(CONFIG, output=replace(CONFIG.output, max_voltage_v=12.0))).configure(
            RATE_HZ
        )
    hardware.simultaneous = False
    with pytest.raises(DeviceError, match="one channel after the other"):
        device.configure(RATE_HZ)
    NiDaqDevice(replace(CONFIG, channel_delay_s=4e-6)).configure(RATE_HZ)
    hardware.simultaneous = True
    device.configure(RATE_HZ)
    loud = replace(EXCITATION, amplitude_v=10 * EXCITATION.amplitude_v)
    with pytest.raises(DeviceError, match="output.max_voltage_v is 5 V"):
        device.play(loud)
    with pytest.raises(DeviceError, match="sample_rate_hz: 1000, configured was 50000"):
        device.play(replace(EXCITATION, sample_rate_hz=1000.0))
    assert "output.start" not in hardware.names()


def test_saturation_is_flagged(hardware):
    peak_v = np.max(np.abs(EXCITATION.period()))
    hardware.range_v = 0.9 * peak_v
    device = playing()
    block = device.read_block(1.0)
    device.stop()
    assert block.actuator.saturated
    assert not block.sensor.saturated


def scale_of(*coefficients):
    channel = SimpleNamespace(
        ai_dev_scaling_coeff=list(coefficients), ai_rng_low=-10.0, ai_rng_high=10.0
    )
    return CountScale(channel, np.int16)


def test_counts_where_the_converter_is_straight_else_volts():
    counts = np.array([-30000, 0, 12345], np.int16)
    straight = scale_of(0.01, 3e-4, 1e-15)
    channel = straight.channel(counts)
    assert channel.is_counts
    np.testing.assert_allclose(channel.volts(), 0.01 + 3e-4 * counts, rtol=1e-15)
    bent = scale_of(0.01, 3e-4, 1e-12, 1e-16)
    channel = bent.channel(counts)
    assert not channel.is_counts
    x = counts.astype(float)
    np.testing.assert_allclose(channel.volts(), 0.01 + 3e-4 * x + 1e-12 * x**2 + 1e-16 * x**3)
    for end in (-(2**15), 2**15 - 1):
        assert straight.channel(np.array([end], np.int16)).saturated
    with pytest.raises(DeviceError, match="expected a slope"):
        scale_of(0.0, 0.0)


def test_wide_converters_are_read_as_such(hardware):
    hardware.raw_bits, hardware.coefficients = 32, [0.0, 5e-9]
    device = playing()
    block = device.read_block(1.0)
    device.stop()
    np.testing.assert_allclose(block.actuator.volts(), EXCITATION.period(), atol=2.6e-9)
    hardware.raw_bits = 8
    with pytest.raises(DeviceError, match=r"raw samples of \[8\] bits"):
        device.configure(RATE_HZ)


def test_missing_package_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(DeviceError, match="install the package") as raised:
        NiDaqDevice(CONFIG)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"output": {"channel": "Dev1/ao0"}},
            "output.max_voltage_v: got None; accepted is a number .it is missing.",
        ),
        ({"between_samples": "linear"}, "between_samples: got 'linear'; accepted is one of"),
        ({"channel_delay_s": "1 us"}, "channel_delay_s: got '1 us'; accepted is a finite number"),
        ({"buffer_s": 0}, "buffer_s: got 0.0; accepted is a number above 0"),
        ({"gain": 3}, "gain: got 3; accepted is one of"),
        ({"sensor": {"channel": 3}}, "sensor.channel: got 3; accepted is text"),
        ({"sensor": None}, "sensor: got None; accepted is a mapping"),
        (
            {"sensor": {"channel": "Dev1/ai0", "range_v": 1.0, "terminals": "rse"}},
            "sensor.channel: got 'Dev1/ai0'; accepted is another",
        ),
        (
            {"actuator": {"source": "commanded", "channel": "Dev1/ai0"}},
            "actuator.channel: got 'Dev1/ai0'; accepted is one of source",
        ),
    ],
)
def test_wrong_configuration_is_named(tmp_path, change, message):
    content = yaml.safe_load(EXAMPLE.read_text()) | change
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as raised:
        read_file(NiDaqConfig, path)
    assert str(raised.value).startswith("mine.yaml: ")
