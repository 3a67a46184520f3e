# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from tactile_resonance.frf.estimate import frf_of_realisations, frf_of_record
from tactile_resonance.frf.measurement import MeasurementFrf, mean_force
from tactile_resonance.frf.result import PER_LINE, FrfStatus
from tactile_resonance.frf.spectra import Spectrum, mean_spectra
from tactile_resonance.multisine import design_multisine
from tactile_resonance.record import Channel, Contact, Origin, Record

N, RATE_HZ = 200, 1000.0
RNG = np.random.default_rng(0)


def excitation(realisation=0):
    return design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=N,
        band_hz=(50, 200),
        realisation=realisation,
        realisations=2,
        periods=4,
    )


def record(samples_u, samples_y, realisation, index, force_n=0.01, saturated=False):
    return Record(
        actuator=Channel(samples_u.ravel()),
        sensor=Channel(samples_y.ravel(), saturated=saturated),
        sample_rate_hz=RATE_HZ,
        samples_per_period=N,
        realisation=realisation,
        block_index=index,
        origin=Origin(
            time_ns=10**9 * (10 * realisation) + index * 200_000_000,
            contact=Contact(force_n=force_n),
        ),
    )


@pytest.fixture
def channels():
    """(2, 2, 4, N): channel, realisation, period."""
    u = np.stack([np.tile(excitation(m).period(), (4, 1)) for m in range(2)])
    y = 0.5 * np.roll(u, 2, axis=-1)
    return np.stack([u, y]) + 1e-3 * RNG.standard_normal((2, 2, 4, N))


@pytest.mark.parametrize("band_hz", [None, (80.0, 120.0)])
@pytest.mark.parametrize(("order", "dof"), [(2, 6), (0, 1)])
def test_block_by_block_is_all_at_once(channels, band_hz, order, dof):
    u, y = channels
    measurement = MeasurementFrf(1, band_hz=band_hz, order=order, dof=dof)
    lines = excitation().harmonics
    if band_hz is not None:
        lines = lines[(lines * RATE_HZ / N >= band_hz[0]) & (lines * RATE_HZ / N <= band_hz[1])]

    def at_once(u, y):
        spectra = mean_spectra(Spectrum.of(u, y), lines, order=order, dof=dof)
        return frf_of_realisations(spectra, sample_rate_hz=RATE_HZ)

    for m in range(2):
        for p in range(4):
            frf = measurement.add(record(u[m, p], y[m, p], m, p), excitation(m))
            if m == 0 and p > 0:
                so_far = (slice(1), slice(p + 1))
                assert_equal(frf, at_once(u[so_far], y[so_far]))
    assert_equal(frf, at_once(u, y))
    assert (frf.realisations, frf.periods) == (2, 4)


def assert_equal(frf, expected):
    for name in PER_LINE:
        mine, theirs = getattr(frf, name), getattr(expected, name)
        assert (mine is None) == (theirs is None), name
        if mine is not None:
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, err_msg=name)
    assert (frf.noise_dof, frf.total_dof) == (expected.noise_dof, expected.total_dof)
    assert (frf.periods, frf.status) == (expected.periods, expected.status)


def test_the_first_period_has_no_covariance(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    frf = measurement.add(record(u[0, 0], y[0, 0], 0, 0), excitation(0))
    assert (frf.status, frf.variance_noise, frf.periods) == (FrfStatus.NO_COVARIANCE, None, 1)
    lines = excitation().harmonics
    g = np.fft.rfft(y[0, 0])[lines] / np.fft.rfft(u[0, 0])[lines]
    np.testing.assert_allclose(frf.g, g, rtol=1e-12)
    # single periods of two realisations tell the total variance only
    frf = measurement.add(record(u[1, 0], y[1, 0], 1, 0), excitation(1))
    assert frf.variance_noise is None
    assert frf.variance_total is not None


def test_a_realisation_that_lost_blocks_does_not_shorten_the_others():
    """One of its four periods is left: with it all counted as records of one period, without covariance."""
    rng = np.random.default_rng(3)
    u = np.stack([np.tile(excitation(m).period(), (4, 1)) for m in range(3)])
    y = 0.5 * np.roll(u, 2, axis=-1) + 1e-3 * rng.standard_normal(u.shape)
    measurement = MeasurementFrf(1, bins_band_hz=(80.0, 120.0))
    for m in range(3):
        for p in range(4):
            if (m, p) != (0, 1):
                frf = measurement.add(record(u[m, p], y[m, p], m, p), excitation(m))
    options = {"sample_rate_hz": RATE_HZ, "harmonics": excitation().harmonics}
    expected = frf_of_record(Spectrum.of(u[1:], y[1:]), **options)
    assert_equal(replace(frf, status=FrfStatus.OK), expected)
    assert (frf.realisations, frf.periods, frf.status) == (2, 4, FrfStatus.SUSPECT)
    assert frf.bins.u.shape[0] == 2
    assert "realisation 1: blocks lost" in frf.message
    assert "realisation 1: left out, shorter than the others" in frf.message


def test_a_realisation_that_was_lost_is_no_failure(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    measurement.add(record(u[0, 1], y[0, 1], 0, 1), excitation(0))
    for p in range(2):
        frf = measurement.add(record(u[1, p], y[1, p], 1, p), excitation(1))
    assert (frf.realisations, frf.periods, frf.status) == (1, 2, FrfStatus.SUSPECT)
    assert "blocks lost" in frf.message


def test_a_bad_block_is_not_taken(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    measurement.add(record(u[0, 0], y[0, 0], 0, 0), excitation(0))
    bad = y[0, 1].copy()
    bad[10] = np.nan
    with pytest.raises(ValueError, match="record: samples are not finite"):
        measurement.add(record(u[0, 1], bad, 0, 1), excitation(0))
    frf = measurement.add(record(u[0, 1], y[0, 1], 0, 1), excitation(0))
    assert frf.periods == 2
    assert frf.status is FrfStatus.SUSPECT  # the sensor had missing samples


def test_a_record_too_short_for_the_noise_wanted_counts_once_it_is_longer(channels):
    u, y = channels
    measurement = MeasurementFrf(1, dof=120)
    measurement.add(record(u[0, 0], y[0, 0], 0, 0), excitation(0))
    with pytest.raises(ValueError, match="order, dof: 2, 120 need 124 bins between harmonics"):
        measurement.add(record(u[0, 1], y[0, 1], 0, 1), excitation(0))
    frf = measurement.add(record(u[0, 2], y[0, 2], 0, 2), excitation(0))
    assert (frf.periods, frf.status, frf.message) == (3, FrfStatus.OK, "")


def test_what_is_too_much_is_refused(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(4):
        measurement.add(record(u[0, p], y[0, p], 0, p), excitation(0))
    with pytest.raises(ValueError, match="record: 5 periods of realisation 1, at most 4"):
        measurement.add(record(u[0, 0], y[0, 0], 0, 4), excitation(0))
    with pytest.raises(ValueError, match=r"band_hz: 300\.\.400 holds no excited line"):
        MeasurementFrf(1, band_hz=(300.0, 400.0)).add(record(u[0, 0], y[0, 0], 0, 0), excitation(0))
    many = replace(excitation(0), periods=1000)
    with pytest.raises(
        ValueError, match="bins: 99 to 200 Hz are 20200 bins after 1000 periods, at"
    ):
        MeasurementFrf(1, bins_band_hz=(99.0, 200.0)).add(record(u[0, 0], y[0, 0], 0, 0), many)


def test_a_realisation_under_way_waits(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(4):
        measurement.add(record(u[0, p], y[0, p], 0, p), excitation(0))
    before = measurement.frf()
    measurement.add(record(u[1, 0], y[1, 0], 1, 0), excitation(1))
    np.testing.assert_array_equal(measurement.frf().g, before.g)


def test_blocks_of_several_periods(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for block in range(2):
        part = slice(2 * block, 2 * block + 2)
        measurement.add(record(u[0, part], y[0, part], 0, block), excitation(0))
    assert measurement.frf().periods == 4
    assert measurement.frf().status is FrfStatus.OK


def test_a_lost_block_is_said_and_what_follows_left_out(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in (0, 1, 3):
        measurement.add(record(u[0, p], y[0, p], 0, p), excitation(0))
    frf = measurement.frf()
    assert frf.status is FrfStatus.SUSPECT
    assert "blocks lost before block 4" in frf.message
    assert frf.periods == 2


def test_a_block_that_comes_twice_changes_nothing(channels):
    u, y = channels
    once, twice = MeasurementFrf(1), MeasurementFrf(1)
    for p in range(3):
        block = record(u[0, p], y[0, p], 0, p, force_n=0.01 + 0.001 * p)
        once.add(block, excitation(0))
        for _ in range(2 if p == 1 else 1):
            twice.add(block, excitation(0))
    assert (twice.frf().status, twice.frf().message) == (FrfStatus.OK, once.frf().message)
    np.testing.assert_array_equal(twice.frf().g, once.frf().g)
    assert twice.origin().contact.force_n == once.origin().contact.force_n


def test_nothing_but_later_blocks_is_a_failure_with_a_reason(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    measurement.add(record(u[0, 1], y[0, 1], 0, 1), excitation(0))
    frf = measurement.frf()
    assert frf.status is FrfStatus.FAILED
    assert "blocks lost" in frf.message


def test_of_a_silent_record_there_is_no_frf(channels):
    played = excitation()
    silent = replace(played, amplitude_v=np.zeros(played.harmonics.size))
    frf = MeasurementFrf(1).add(record(*channels[:, 0, :1], 0, 0), silent)
    assert (frf.status, frf.message) == (FrfStatus.FAILED, "nothing was played")
    assert frf.g.size == 0


def test_saturation_is_said(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(3):
        measurement.add(record(u[0, p], y[0, p], 0, p, saturated=p == 1), excitation(0))
    assert measurement.saturated
    assert "sensor saturated" in measurement.frf().message


def test_a_stated_channel_delay_is_taken_out(channels):
    """The sensor lags by two samples; told so, the response has no phase."""
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(4):
        taken = record(u[0, p], y[0, p], 0, p)
        frf = measurement.add(replace(taken, channel_delay_s=2 / RATE_HZ), excitation(0))
    np.testing.assert_allclose(np.angle(frf.g), 0, atol=0.05)
    np.testing.assert_allclose(np.abs(frf.g), 0.5, rtol=0.05)


def test_faults_of_a_block_are_named(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(3):
        clipped = np.clip(y[0, p], -0.6, 0.6) if p == 1 else y[0, p]
        frf = measurement.add(record(u[0, p], clipped, 0, p), excitation(0))
    assert frf.status is FrfStatus.SUSPECT
    assert "sensor" in frf.message
    assert "saturat" in frf.message or "clip" in frf.message


def test_origin_is_the_middle_and_the_mean(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    for p in range(4):
        measurement.add(record(u[0, p], y[0, p], 0, p, force_n=0.01 + 0.001 * p), excitation(0))
    origin = measurement.origin()
    assert origin.time_ns == 400_000_000
    assert origin.contact.force_n == pytest.approx(0.0115)


def test_a_record_that_does_not_fit_is_refused(channels):
    u, y = channels
    with pytest.raises(ValueError, match="199 and 200 samples, expected whole periods of 200"):
        MeasurementFrf(1).add(record(u[0, 0, :-1], y[0, 0], 0, 0), excitation(0))


def test_realisations_on_other_lines_are_refused(channels):
    u, y = channels
    measurement = MeasurementFrf(1)
    measurement.add(record(u[0, 0], y[0, 0], 0, 0), excitation(0))
    other = excitation(1)
    few = {name: getattr(other, name)[1:] for name in ("harmonics", "amplitude_v", "phase_rad")}
    said = "realisation: 2 was played at another rate, with another period or on other lines"
    for changed in (replace(other, **few), replace(other, sample_rate_hz=2 * RATE_HZ)):
        with pytest.raises(ValueError, match=said):
            measurement.add(record(u[1, 0], y[1, 0], 1, 0), changed)
    twice = replace(record(u[1, :2], y[1, :2], 1, 0), samples_per_period=2 * N)
    with pytest.raises(ValueError, match=said):
        measurement.add(twice, replace(other, samples_per_period=2 * N))
    assert measurement.add(record(u[1, 0], y[1, 0], 1, 0), other).realisations == 2


@pytest.mark.parametrize("periods", [(4, 4), (4, 3)])
def test_bins_of_all_realisations_come_along_where_they_are_alike(channels, periods):
    u, y = channels
    measurement = MeasurementFrf(1, bins_band_hz=(80.0, 120.0))
    for m in range(2):
        for p in range(periods[m]):
            measurement.add(record(u[m, p], y[m, p], m, p), excitation(m))
            now = measurement.frf().bins
            # the first realisation alone, until the second one has as many periods
            assert now.u.shape[0] == (2 if (m, p) == (1, 3) else 1)
    bins = measurement.frf().bins
    for m in range(bins.u.shape[0]):
        for channel, found in ((u, bins.u), (y, bins.y)):
            whole = np.fft.rfft(channel[m].ravel()) / channel[m].size
            here = slice(bins.first_bin, bins.first_bin + bins.count)
            np.testing.assert_allclose(found[m], whole[here], atol=1e-12)


def test_the_zero_that_blocks_share_is_not_averaged_away():
    """Blocks of a contact: noise of their own 3e-5 N, one zero known to 4e-5 N; sqrt(3^2 + 4^2) = 5 each."""
    random = np.random.default_rng(3)
    zero, noise = 4e-5 * random.standard_normal((4000, 1)), 3e-5 * random.standard_normal((4000, 6))
    means = np.array(
        [mean_force([(f, 5e-5, 0.4) for f in row])[0] for row in (0.01 + zero + noise).tolist()]
    )
    _, stated_n = mean_force([(0.01, 5e-5, 0.4)] * 6)
    # never less than what it is, and no more than one block's; 4000 means tell it to 1.1 %
    assert stated_n >= np.std(means) * (1 - 3 * 0.011)
    assert stated_n == pytest.approx(5e-5)
    assert np.isnan(mean_force([(0.01, np.nan, 0.4), (0.01, 5e-5, 0.4)])[1])
