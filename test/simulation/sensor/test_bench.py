# SPDX-License-Identifier: Apache-2.0
"""The bench: reproducible, divisible into blocks at will, every effect as announced."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.simulation.sensor.bench import (
    NEGLIGIBLE_COUNTS,
    BenchEffects,
    SimulatedBench,
    convert,
)
from tactile_resonance.simulation.sensor.response import Lines, ResponseStream, sample_period

IDEAL = BenchEffects.none()


@pytest.fixture
def gel(library):
    return library["gel12"]


def response_at(lines, block):
    """Ratio of the spectra of one period at the excited lines, shape (F,)."""
    output, drive = (
        np.fft.rfft(x.volts())[lines.harmonics] for x in (block.sensor, block.actuator)
    )
    return output / drive


def volts(blocks):
    """Both channels of several blocks, each (samples,)."""
    return (
        np.concatenate([b.actuator.volts() for b in blocks]),
        np.concatenate([b.sensor.volts() for b in blocks]),
    )


@pytest.mark.parametrize("nonlinearity", [False, True])
def test_same_seed_same_samples_however_divided(bench, gel, multisine, nonlinearity):
    effects = BenchEffects(
        nonlinearity=nonlinearity, actuator_noise_v=1e-3, hum_v=1e-3, drift_v_per_s=0.1,
        channel_skew_s=7e-6,
    )  # fmt: skip
    one, two = multisine(1), multisine(2)
    whole = bench.start(gel, seed=5, effects=effects)
    expected = volts([whole.block(one, 4), whole.block(two, 2)])
    pieces = bench.start(gel, seed=5, effects=effects)
    found = volts([*pieces.play(one, 2), pieces.block(one, 2), pieces.block(two), pieces.block(two)])
    np.testing.assert_array_equal(found, expected)
    other = bench.start(gel, seed=6, effects=effects).block(one)
    assert not np.array_equal(other.sensor.volts(), expected[1][:5000])


def test_blocks_tell_where_they_belong(bench, gel, multisine):
    run = bench.start(gel, effects=IDEAL)
    blocks = [run.block(multisine(seed), 2 - seed // 2) for seed in (1, 1, 2)]
    assert [(b.realisation, b.block_index) for b in blocks] == [(0, 0), (0, 2), (1, 0)]
    assert [b.origin.time_ns for b in blocks] == [0, 200_000_000, 400_000_000]
    assert [b.sensor.samples.size for b in blocks] == [10_000, 10_000, 5000]


def test_blocks_are_made_when_asked_for(bench, gel, multisine):
    run = bench.start(gel)
    blocks = run.play(multisine(1), 1_000_000)  # would take minutes and 80 GB
    assert next(blocks).block_index == 0
    assert next(blocks).block_index == 1


def test_ideal_bench_is_the_linear_sensor(bench, gel, multisine):
    excitation = multisine(1)
    run = bench.start(gel, effects=IDEAL)
    *_, last = run.play(excitation, 30)
    lines = Lines.of(excitation)
    np.testing.assert_allclose(last.actuator.volts(), sample_period(lines), atol=1e-12)
    truth = run.coupled.frequency_response(lines.frequency_hz)
    found = response_at(lines, last)
    # what is left after 3 s is the slow relaxation, and the drain of the sensing layer
    np.testing.assert_allclose(found, truth, atol=2e-6)
    assert not last.actuator.is_counts
    assert not last.sensor.saturated


def test_truth_is_consistent(bench, gel):
    frequency = np.array([50.0, 250.0, 4000.0])
    truth = bench.start(gel, force_n=0.02).coupled
    s = 2j * np.pi * frequency[:, None]
    summed = truth.sensor.feedthrough + (truth.residues_rad_s / (s - truth.poles_rad_s)).sum(axis=1)
    np.testing.assert_allclose(summed, truth.frequency_response(frequency), rtol=1e-9)
    contact = truth.contact
    assert contact.force_n == 0.02
    assert contact.indentation_m == pytest.approx(contact.contact_radius_m**2 / 2.5e-3)
    assert truth.mode_near(250).pole_rad_s in truth.poles_rad_s
    assert contact.tissue is gel
    assert bench.start(None).coupled.contact is None


PLAIN = BenchEffects(quantisation=False)


def sensor_volts(run, excitation, periods):
    return run.block(excitation, periods).sensor.volts()


def test_sensor_noise_is_white_and_of_the_stated_size(bench, gel, multisine):
    def noise_of(excitation):
        noisy, clean = (
            sensor_volts(bench.start(gel, effects=effects), excitation, 10) for effects in (PLAIN, IDEAL)
        )
        return noisy - clean

    noise = noise_of(multisine(1))
    count = noise.size
    sigma = bench.sensor.acquisition.sensor_noise_v  # 50 kHz: exactly its bandwidth
    assert noise.std() == pytest.approx(sigma, rel=5 / np.sqrt(2 * count))
    assert abs(noise.mean()) < 5 * sigma / np.sqrt(count)
    for lag in (1, 2, 5000):
        correlation = noise[lag:] @ noise[:-lag] / (count * sigma**2)
        assert abs(correlation) < 5 / np.sqrt(count)
    slow = multisine(1, sample_rate_hz=12.5e3, band_hz=(10, 5e3))
    assert noise_of(slow).std() == pytest.approx(sigma / 2, rel=5 / np.sqrt(2 * count))


def test_effects_add_up_to_the_samples(bench, gel, multisine):
    effects = {
        "noise": True,
        "nonlinearity": True,
        "actuator_noise_v": 1e-3,
        "hum_v": 0.01,
        "offset_v": 0.1,
    }
    excitation = multisine(1, level_v=4)

    def record(**effects):
        block = bench.start(gel, effects=replace(IDEAL, **effects)).block(excitation, 2)
        return np.stack([block.actuator.volts(), block.sensor.volts()])

    clean = record()
    added = [record(**{name: value}) - clean for name, value in effects.items()]
    np.testing.assert_allclose(record(**effects), clean + sum(added), atol=1e-12)
    for name, part in zip(effects, added, strict=True):
        actuator, sensor = (np.any(channel != 0) for channel in part)
        assert (actuator, sensor) == ((True, False) if name == "actuator_noise_v" else (False, True))


def test_quantisation_error_is_at_most_half_a_count(bench, gel, multisine):
    block = bench.start(gel).block(multisine(1), 2)
    volts = bench.start(gel, effects=PLAIN).block(multisine(1), 2)
    error = block.sensor.volts() - volts.sensor.volts()
    half = block.sensor.scale_v / 2
    most = half + NEGLIGIBLE_COUNTS * block.sensor.scale_v  # free decays below that are left out
    assert np.abs(error).max() <= most * (1 + 1e-9)
    assert error.std() == pytest.approx(block.sensor.scale_v / np.sqrt(12), rel=0.02)
    assert block.sensor.scale_v == 20 / 2**16
    assert block.actuator.scale_v == 40 / 2**16
    assert block.sensor.samples.dtype == np.int32
    np.testing.assert_array_equal(block.sensor.volts(), block.sensor.samples * block.sensor.scale_v)
    error = block.actuator.volts() - volts.actuator.volts()
    assert np.abs(error).max() <= block.actuator.scale_v * 0.501


def test_converter_saturates_at_both_ends_and_says_so():
    inside = convert(np.array([-1.27, 1.26]), 0.01, 8)
    assert not inside.saturated
    for value, count in ((1.27, 127), (-1.28, -128), (9.0, 127), (-9.0, -128)):
        samples = convert(np.array([0.0, value]), 0.01, 8)
        assert samples.saturated
        assert samples.samples[1] == count


def test_paper_levels_fit_the_converters_and_higher_ones_are_flagged(bench, gel, multisine):
    fine = bench.start(gel).block(multisine(1, level_v=4.0, samples_per_period=20_000))
    assert not fine.actuator.saturated
    assert not fine.sensor.saturated
    high = bench.start(gel).block(multisine(1, level_v=8.0, samples_per_period=20_000))
    assert high.actuator.saturated


def test_channel_skew_is_a_linear_phase(bench, gel, multisine):
    lines = Lines.of(multisine(1))
    for skew in (3.7e-6, -3.7e-6, 1.0e-3):
        run = bench.start(gel, effects=replace(IDEAL, channel_skew_s=skew))
        *_, last = run.play(lines, 30)
        truth = run.coupled.frequency_response(lines.frequency_hz)
        expected = truth * np.exp(-2j * np.pi * lines.frequency_hz * skew)
        np.testing.assert_allclose(response_at(lines, last), expected, atol=2e-6)


def test_skew_delays_the_nonlinear_response_alike(bench, gel, multisine):
    skew = 3.25 / 50e3  # 13 of the fine samples of the march
    effects = replace(IDEAL, nonlinearity=True)
    lines = Lines.of(multisine(1, level_v=3))
    prompt, late = (
        sensor_volts(bench.start(gel, effects=replace(effects, channel_skew_s=of)), lines, 20)
        - sensor_volts(bench.start(gel, effects=replace(IDEAL, channel_skew_s=of)), lines, 20)
        for of in (0.0, skew)
    )
    # after the transient: shift by a phase
    tail = slice(19 * 5000, 20 * 5000)
    frequency = np.fft.rfftfreq(5000, 1 / 50e3)
    # products near half the sample rate fold back and do not shift as one signal
    keep = frequency < 15e3
    shifted = np.fft.rfft(prompt[tail]) * np.exp(-2j * np.pi * frequency * skew)
    late_spectrum = np.fft.rfft(late[tail])
    scale = np.abs(shifted).max()
    np.testing.assert_allclose(late_spectrum[keep], shifted[keep], atol=1e-4 * scale)


def test_hum_offset_and_drift_are_as_stated(bench, gel, multisine):
    effects = replace(IDEAL, hum_v=0.2, offset_v=0.5, drift_v_per_s=0.25)
    run, clean = bench.start(gel, effects=effects), bench.start(gel, effects=IDEAL)
    for each in (run, clean):
        each.block(multisine(1), 3)
    added = sensor_volts(run, multisine(1), 2) - sensor_volts(clean, multisine(1), 2)  # 0.3 s to 0.5 s
    time = 0.3 + np.arange(10_000) / 50e3
    expected = 0.5 + 0.25 * time
    expected += 0.2 * np.sqrt(2) * np.cos(2 * np.pi * 50 * time + run.hum_phase_rad)
    np.testing.assert_allclose(added, expected, atol=1e-12)


def test_ring_down_is_an_excitation_of_silent_lines(bench, gel, multisine, silence):
    lines, quiet = Lines.of(multisine(1)), silence(50e3, 1000)
    run = bench.start(gel, effects=IDEAL)
    played, rung, again = run.block(lines), run.block(quiet), run.block(lines)
    np.testing.assert_array_equal(rung.actuator.volts(), 0)
    left = np.abs(rung.sensor.volts()[800:]).max()
    assert 0 < left < 0.2 * np.abs(played.sensor.volts()).max()
    assert (again.realisation, again.block_index) == (2, 0)
    assert again.origin.time_ns == (lines.samples_per_period + 1000) * 20_000
    # the excitation begins anew, on what is left of it
    np.testing.assert_allclose(again.actuator.volts(), sample_period(lines), atol=1e-12)
    assert np.abs(again.sensor.volts() - played.sensor.volts()).max() > 1e-3


def test_state_carries_over_to_the_next_realisation(bench, gel, multisine):
    run = bench.start(gel, effects=IDEAL)
    run.block(multisine(1))
    carried = run.block(multisine(2)).sensor.volts()
    rested = bench.start(gel, effects=IDEAL).block(multisine(2)).sensor.volts()
    difference = np.abs(carried - rested)
    assert difference[:100].max() > 1e-2
    # the drain of the sensing layer, 0.3 s, is what remains after 0.1 s
    assert difference[-100:].max() < 1e-2 * difference[:100].max()


@pytest.mark.parametrize(
    ("action", "named"),
    [
        (lambda b, t, e: b.start(t, seed=-1), "seed"),
        (lambda b, t, e: b.start(t, force_n=0.0), "force_n"),
        (lambda b, t, e: b.start(t).block(e, 0), "periods"),
        (lambda b, t, e: ResponseStream(b.coupled(t).modal).play(Lines.of(e), 5001), "samples"),
        (lambda b, t, e: BenchEffects(hum_v=-1.0), "hum_v"),
        (lambda b, t, e: BenchEffects(offset_v=np.nan), "offset_v"),
    ],
)
def test_bad_requests_are_refused_by_name(bench, gel, multisine, action, named):
    with pytest.raises(ValueError, match=f"{named}.*accepted"):
        action(bench, gel, multisine(1))


def test_default_bench_is_that_of_the_configuration(bench):
    assert SimulatedBench.from_configuration() == bench


def test_what_is_left_out_is_smaller_than_a_count(bench, gel, multisine):
    band = multisine(1, band_hz=(200, 300), samples_per_period=20_000)
    counted = replace(IDEAL, quantisation=True)
    left, whole = (bench.start(gel, effects=effects).block(band, 3) for effects in (counted, IDEAL))
    assert np.abs(left.sensor.volts() - whole.sensor.volts()).max() <= (
        0.52 * bench.sensor.acquisition.sensor_scale_v
    )
    # once settled, nothing decays any more: periods repeat
    wide, late = multisine(1), bench.start(gel, effects=counted)
    late.block(wide, 100)
    np.testing.assert_array_equal(late.block(wide).sensor.volts(), late.block(wide).sensor.volts())
