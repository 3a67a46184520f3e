# SPDX-License-Identifier: Apache-2.0
"""Acquisition faults, each injected alone into a good record, and none seen in a good one."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import io, signal, stats

from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.faults import FaultKind, FaultReport, clocks, find_faults
from tactile_resonance.frf.result import FrfStatus
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.multisine import Grid, design_multisine

RATE, SAMPLES, PERIODS = 2000.0, 1000, 6
LINES = np.arange(5, 200, 2)  # 10 to 398 Hz


@pytest.fixture
def record(multisine):
    rng = np.random.default_rng(1)
    u = np.tile(multisine(LINES, SAMPLES, rng, amplitude=0.1), (PERIODS, 1))
    y = 0.5 * np.roll(u, 3, axis=-1)
    return u + 1e-3 * rng.standard_normal(u.shape), y + 1e-3 * rng.standard_normal(u.shape)


def check(u, y):
    return find_faults(Spectrum.of(u, y), sample_rate_hz=RATE, harmonics=LINES)


def kinds(report):
    return {fault.kind for fault in report.faults}


def only(report, kind, channel):
    assert kinds(report) == {kind}, report.message
    (fault,) = report.faults
    assert fault.channel == channel
    return fault


def flat_tops(y):
    """Channels that are saturated, of a sensor that measures y."""
    faults = check(np.random.default_rng(0).standard_normal(y.shape), y).faults
    return [fault.channel for fault in faults if "on flat tops" in fault.message]


def test_good_records_have_none(multisine):
    rng = np.random.default_rng(2)
    u = multisine(LINES, SAMPLES, rng, amplitude=0.1, records=(40, 1))
    u = np.broadcast_to(u, (40, PERIODS, SAMPLES))
    for noise in (1e-3, 0.1):
        noisy = [u + noise * rng.standard_normal(u.shape) for _ in range(2)]
        report = check(*noisy)
        assert report == FaultReport()
    assert not report.suspect


@pytest.mark.parametrize("step", [1e-3, 1e-2, 0.1])
def test_quantised_record_is_not_saturated(record, step):
    assert check(*(np.round(x / step) * step for x in record)) == FaultReport()


def test_quantised_sine_is_not_saturated():
    t = np.arange(4000).reshape(4, 1000) / 1000
    for amplitude in np.linspace(20, 21, 11):
        x = np.round(amplitude * np.sin(2 * np.pi * 7 * t))
        report = find_faults(Spectrum.of(x, x), sample_rate_hz=1000.0, harmonics=np.array([7]))
        assert FaultKind.SATURATION not in kinds(report)


def test_saturation(record):
    u, y = record
    top = 0.9 * y.max()
    fault = only(check(u, np.minimum(y, top)), FaultKind.SATURATION, "sensor")
    assert fault.spoils


def test_missing_samples(record):
    u, y = record
    gap = y.copy()
    gap[2, 100:130] = np.nan
    fault = only(check(u, gap), FaultKind.MISSING_SAMPLES, "sensor")
    assert fault.value == 30
    held = u.copy()
    held[2, 100:130] = held[2, 99]
    fault = only(check(held, y), FaultKind.MISSING_SAMPLES, "actuator")
    assert fault.value == 31
    assert fault.spoils
    assert kinds(check(u, np.zeros_like(y))) == {FaultKind.MISSING_SAMPLES}


def test_a_coarse_converter_may_be_why_a_channel_stands_still(record):
    u, y = record
    step = 1.6 * y.std()
    fault = only(check(u, step * np.round(y / step)), FaultKind.MISSING_SAMPLES, "sensor")
    assert "a converter whose steps are too coarse" in fault.text
    held = y.copy()
    held[2, 100:130] = held[2, 99]
    assert "converter" not in only(check(u, held), FaultKind.MISSING_SAMPLES, "sensor").text


def test_lost_samples(record):
    u, y = record
    lost = np.append(np.delete(u.ravel(), np.arange(3300, 3307)), u.ravel()[:7])
    fault = only(check(lost.reshape(u.shape), y), FaultKind.LOST_SAMPLES, "actuator")
    assert fault.value == 7
    assert fault.spoils


@pytest.mark.parametrize(("lost", "last"), [(1, 200), (2, 170), (2, 200)])
def test_few_samples_lost_between_periods_show(multisine, lost, last):
    """Unshifted periods correlate to sin(x) / x, x = 2 pi lost last / samples: .76, .40, .23 of the most."""
    rng = np.random.default_rng(4)
    lines = np.arange(5, last, 2)
    u = np.tile(multisine(lines, SAMPLES, rng, amplitude=0.1), 4)
    cut = np.append(np.delete(u, np.arange(2500, 2500 + lost)), u[:lost])
    u, cut = (x.reshape(4, SAMPLES) + 1e-4 * rng.standard_normal((4, SAMPLES)) for x in (u, cut))
    report = find_faults(Spectrum.of(cut, u), sample_rate_hz=RATE, harmonics=lines)
    assert FaultKind.LOST_SAMPLES in kinds(report)


@pytest.mark.parametrize("lost", [1, 2, -1])
@pytest.mark.parametrize("place", [2300, 2990, 3450])
def test_few_samples_lost_within_a_period_are_named_with_their_place(multisine, lost, place):
    """Before, in four periods or more: nothing, of a record whose noise is 100 times what it was."""
    rng, lines = np.random.default_rng(6), LINES[:40]
    x = np.tile(multisine(lines, SAMPLES, rng, amplitude=0.1), 5)
    x = np.concatenate([x[:place], x[place + lost :]])[: 4 * SAMPLES].reshape(4, SAMPLES)
    x, y = x + 1e-3 * rng.standard_normal((2, *x.shape))
    report = find_faults(Spectrum.of(x, y), sample_rate_hz=RATE, harmonics=lines)
    assert [(fault.kind, fault.value) for fault in report.faults] == 2 * [(FaultKind.LOST_SAMPLES, abs(lost))]
    for fault in report.faults:
        seconds = float(fault.text.split("about ")[1].split()[0])
        assert seconds == pytest.approx(place / RATE, abs=SAMPLES / 8 / RATE)


def test_of_a_sensor_alone_a_mode_that_rings_up_is_named_too(multisine):
    """It turns neighbouring lines by one angle from period to period: of half of such records, a shift."""
    rng, lines, found = np.random.default_rng(8), np.arange(16, 80), 0
    for _ in range(10):
        u = np.tile(multisine(lines, 2000, rng, amplitude=0.1), 8)
        pole = np.exp(2 * np.pi * (-1e-4 + 1j) * 63 * (1 + 0.003 * rng.standard_normal()) / 5e3)
        y = signal.lfilter([1 - abs(pole)], [1, -2 * pole.real, abs(pole) ** 2], u)
        record = Spectrum.of(u.reshape(8, -1), y.reshape(8, -1))
        for fault in find_faults(record, sample_rate_hz=5e3, harmonics=lines).faults:
            if fault.kind is FaultKind.LOST_SAMPLES:
                found += 1
                assert fault.channel == "sensor"
                assert "or a mode rings through them" in fault.text
    assert found


@pytest.mark.parametrize("samples", [64, 100, 400])
def test_noise_over_short_periods_lost_no_samples(samples):
    """Sums over eighths of a period hold as few independent values as lines."""
    rng, lines = np.random.default_rng(9), np.arange(max(1, samples // 50), samples // 8)
    noise = rng.standard_normal((2, 100, 4 * samples))
    noise[0] = signal.lfilter([1.0], [1.0, -1.9, 0.95], noise[0], axis=-1)
    u, y = noise.reshape(2, 100, 4, samples)
    report = find_faults(Spectrum.of(u, y), sample_rate_hz=RATE, harmonics=lines)
    assert FaultKind.LOST_SAMPLES not in kinds(report)


def test_what_decays_from_rest_is_no_loss(multisine):
    rng, lines = np.random.default_rng(10), np.arange(40, 150)
    for f0_hz in np.linspace(190, 210, 12):
        u = np.tile(multisine(lines, 2000, rng, amplitude=0.1), 8)
        pole = np.exp(2 * np.pi * (-5e-4 + 1j) * f0_hz / 5e3)
        y = signal.lfilter([1 - abs(pole)], [1, -2 * pole.real, abs(pole) ** 2], u)
        y += 0.1 * y.std() / u.std() * u + 1e-3 * y.std() * rng.standard_normal(y.size)
        record = Spectrum.of(u.reshape(8, -1), y.reshape(8, -1))
        report = find_faults(record, sample_rate_hz=5e3, harmonics=lines)
        assert FaultKind.LOST_SAMPLES not in kinds(report), report.message


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_a_knock_is_no_loss(record, size):
    u, y = record
    t = np.arange(y.size) / RATE - 1.7
    knock = size * y.std() * np.exp(-20 * np.maximum(t, 0)) * np.sin(700 * t) * (t > 0)
    assert FaultKind.LOST_SAMPLES not in kinds(check(u, y + knock.reshape(y.shape)))


def test_a_burst_of_noise_is_no_loss(multisine):
    """By chance some shift takes off a little of it."""
    rng, lines = np.random.default_rng(6), np.arange(16, 80)
    for _ in range(30):
        u = np.tile(multisine(lines, 2000, rng, amplitude=0.1), 4)
        y = 0.5 * np.roll(u, 3) + 1e-3 * rng.standard_normal(u.size)
        y[6600:7100] += 4 * y.std() * rng.standard_normal(500)
        record = Spectrum.of(u.reshape(4, -1), y.reshape(4, -1))
        report = find_faults(record, sample_rate_hz=5e3, harmonics=lines)
        assert FaultKind.LOST_SAMPLES not in kinds(report)


@pytest.mark.parametrize("lines", [LINES, LINES[:5]])
def test_noise_is_not_taken_for_lost_samples_and_lost_samples_are_seen_through_it(multisine, lines):
    rng = np.random.default_rng(5)
    u = np.tile(multisine(lines, SAMPLES, rng, amplitude=0.1), (30, 4, 1))
    cut = np.delete(u.reshape(30, -1), np.arange(2500, 2537), axis=-1)
    cut = np.append(cut, u[:, 0, :37], axis=-1).reshape(u.shape)
    rms = 0.1 * np.sqrt(lines.size / 2)
    noise = rms * rng.standard_normal((3, *u.shape))
    coloured = signal.lfilter([1.0], [1.0, -1.6, 0.8], noise[0], axis=-1)

    def seen(y):
        report = find_faults(Spectrum.of(u, y), sample_rate_hz=RATE, harmonics=lines)
        found = [f.text for f in report.faults if f.kind is FaultKind.LOST_SAMPLES]
        return [text.partition("through them ")[2] for text in found]

    for of_noise in (noise[1], coloured, 0.01 * u + noise[2]):
        assert not seen(of_noise)
    # as strong as the signal in the whole band, and where few lines have to say it a tenth of that
    assert seen(cut + (1 if lines is LINES else 0.1) * noise[1]) == ["(in 30 of 30 records)"]


@pytest.mark.parametrize("periods", [2, 8])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("ppm", [0.0, 20.0, -20.0, 200.0])
def test_clocks_that_differ(ppm, noise, periods):
    """A generator that runs so much faster: each period comes early by as much."""
    rng, harmonics = np.random.default_rng(1), np.arange(60, 161)
    turns = harmonics[:, None] * (np.arange(periods * 2000) / 2000 * (1 + 1e-6 * ppm))
    u = np.cos(2 * np.pi * (turns + rng.random((harmonics.size, 1)))).sum(axis=0)
    u += noise * u.std() * rng.standard_normal(u.size)
    u = u.reshape(periods, 2000)
    record = Spectrum.of(u, u + 1e-3 * rng.standard_normal(u.shape))
    report = find_faults(record, sample_rate_hz=5e3, harmonics=harmonics)
    if ppm == 0:
        assert FaultKind.CLOCKS not in kinds(report)
        return
    fault = only(report, FaultKind.CLOCKS, "actuator")
    assert fault.value == pytest.approx(abs(ppm), rel=0.1)
    assert ("early" in fault.text) == (ppm > 0)
    assert "or the period is no whole number of samples" in fault.text  # of 2000.04 the same
    # 20 ppm of one period at 400 Hz are .02 rad, 200 ppm of seven 1.4 rad
    if (abs(ppm), periods) in ((20.0, 2), (200.0, 8)):
        assert fault.spoils == (periods == 8)


@pytest.mark.parametrize("lost", [0.2, 1.0])
def test_a_shift_between_two_periods_is_no_clock(lost):
    """Of a sample or a part of one, too little to be found as such."""
    rng, harmonics = np.random.default_rng(2), np.arange(60, 161)
    samples = np.arange(6 * 2000)
    turns = harmonics[:, None] * (samples + lost * (samples >= 6000)) / 2000
    u = np.cos(2 * np.pi * (turns + rng.random((harmonics.size, 1)))).sum(axis=0).reshape(6, 2000)
    for _ in range(20):
        record = Spectrum.of(u + 1e-3 * rng.standard_normal(u.shape), u)
        report = find_faults(record, sample_rate_hz=5e3, harmonics=harmonics)
        assert FaultKind.CLOCKS not in kinds(report)


@pytest.mark.parametrize("periods", [2, 3])
def test_a_sample_lost_within_a_period_may_look_like_a_clock(periods):
    rng, harmonics = np.random.default_rng(3), np.arange(60, 161)
    samples = np.arange(periods * 2000)
    turns = harmonics[:, None] * (samples + (samples >= 3000)) / 2000
    u = np.cos(2 * np.pi * (turns + rng.random((harmonics.size, 1)))).sum(axis=0).reshape(periods, 2000)
    report = find_faults(Spectrum.of(u, u), sample_rate_hz=5e3, harmonics=harmonics)
    assert "or samples were lost" in report.message
    assert (FaultKind.LOST_SAMPLES in kinds(report)) is (periods == 3)


def test_few_lines_of_noise_are_hardly_ever_of_different_clocks():
    """The deviation of the slope is known from the phases of eight lines; six of it are no rarity then."""
    rng = np.random.default_rng(12)
    runs, harmonics = 15_000, np.arange(8)
    noise = 0.1 * rng.standard_normal((runs, 2, 8, 2)).view(complex)[..., 0]
    channel = SimpleNamespace(name="actuator", periods=2, harmonics=harmonics + 10, fault=lambda *_: True)
    found = 0
    for lines in 1 + noise:
        channel.by_period = np.pad(lines, ((0, 0), (10, 0)))
        found += clocks(channel) is not None
    assert found <= stats.binom.isf(1e-3, runs, 1e-4)


def test_offset_and_drift(record):
    u, y = record
    fault = only(check(u, y + 1), FaultKind.OFFSET, "sensor")
    assert not fault.spoils
    ramp = 0.3 * np.linspace(-1, 1, y.size).reshape(y.shape)
    report = check(u, y + ramp)
    assert FaultKind.DRIFT in kinds(report)
    assert not report.suspect


def test_means_of_noise_over_short_periods_are_no_drift(multisine):
    rng = np.random.default_rng(7)
    harmonics = np.arange(40, 61)
    u = multisine(harmonics, 400, rng, amplitude=0.1)
    u = np.broadcast_to(u, (100, 6, 400))
    y = u + u.std() * rng.standard_normal(u.shape)
    ramp = u.std() * np.linspace(-0.5, 0.5, 6 * 400).reshape(6, 400)
    for more, found in ((0, set()), (ramp, {FaultKind.DRIFT})):
        for of in y + more:
            record = Spectrum.of(u[0], of)
            assert kinds(find_faults(record, sample_rate_hz=RATE, harmonics=harmonics)) == found


# 50 Hz is an excited line, 60 Hz lies six bins from the next
@pytest.mark.parametrize(("mains", "near"), [(50.013, True), (60.02, False)])
def test_hum(record, mains, near):
    u, y = record
    t = np.arange(y.size).reshape(y.shape) / RATE
    fault = only(check(u, y + 0.01 * np.sin(2 * np.pi * mains * t)), FaultKind.HUM, "sensor")
    assert f"{round(mains)} Hz" in fault.message
    assert fault.spoils is near
    assert ("or a mode that rings" in fault.text) is near


@pytest.mark.parametrize("periods", [2, 3, 5])
def test_a_resonance_that_starts_from_rest_is_no_hum(periods, multisine):
    """Blocks of 20 ms, as of a calibrated sensor: before, hum at 100 to 300 Hz."""
    harmonics = np.arange(4, 9)
    u = np.tile(multisine(harmonics, 1000, np.random.default_rng(3), amplitude=0.1), periods)
    pole = np.exp(2 * np.pi * (-0.035 + 1j) * 250 / 50e3)
    y = signal.lfilter([1 - abs(pole)], [1, -2 * pole.real, abs(pole) ** 2], u)
    y = (y + 1e-4 * y.std() * np.random.default_rng(4).standard_normal(y.size)).reshape(periods, 1000)
    report = find_faults(Spectrum.of(u.reshape(y.shape), y), sample_rate_hz=50e3, harmonics=harmonics)
    assert FaultKind.HUM not in kinds(report)


@pytest.mark.parametrize("f0_hz", [45.3, 54.1, 56.7, 58.7, 63.2, 65.0, 114.0, 144.5])
@pytest.mark.parametrize("periods", [1, 2, 4])
def test_a_mode_that_rings_beside_the_mains_is_no_hum(f0_hz, periods, multisine):
    """From rest: before, hum at 50 or 60 Hz in all records of modes that near."""
    harmonics = np.arange(16, 80, 2 if periods == 1 else 1) * (4 // min(periods, 4))
    u = np.tile(multisine(harmonics, 8000 // periods, np.random.default_rng(3), amplitude=0.1), periods)
    for damping in (3e-4, 3e-3, 0.02):
        pole = np.exp(2 * np.pi * (-damping + 1j) * f0_hz / 5e3)
        y = signal.lfilter([1 - abs(pole)], [1, -2 * pole.real, abs(pole) ** 2], u)
        y += 1e-3 * y.std() * np.random.default_rng(4).standard_normal(y.size)
        record = Spectrum.of(u.reshape(periods, -1), y.reshape(periods, -1))
        report = find_faults(record, sample_rate_hz=5e3, harmonics=harmonics)
        assert FaultKind.HUM not in kinds(report), (damping, report.message)


@pytest.mark.parametrize("seed", range(6))
def test_what_rounding_leaves_is_no_hum(seed):
    """Records without noise: before, hum of 1e-17 V."""
    excitation = design_multisine(band_hz=(180.0, 320.0), seed=seed)
    x = np.tile(excitation.period(), (8, 1))
    settings = {"sample_rate_hz": 50e3, "harmonics": excitation.harmonics}
    assert FaultKind.HUM not in kinds(find_faults(Spectrum.of(x, x), **settings))
    t = np.arange(x.size).reshape(x.shape) / 50e3
    hum = 1e-6 * np.sin(2 * np.pi * 50.1 * t)
    fault = only(find_faults(Spectrum.of(x, x + hum), **settings), FaultKind.HUM, "sensor")
    assert "at 50 Hz, at least" in fault.message


def test_hum_of_the_silverbox(shared_data):
    """Single periods: the hum stands out of the harmonics that are not excited."""
    data = io.loadmat(shared_data / "silverbox" / "SNLS80mV.mat")
    end = 48946
    u, y = (data[name][0][end - 8192 : end][None] for name in ("V1", "V2"))
    report = find_faults(
        Spectrum.of(u, y), sample_rate_hz=1e7 / 2**14, harmonics=np.arange(1, 2684, 2)
    )
    assert FaultKind.HUM in kinds(report)
    assert "150" in report.message
    assert "or a mode" not in report.message  # which is at one place


@pytest.mark.parametrize("seed", range(4))
def test_odd_distortion_in_a_single_period_is_not_hum(seed):
    """It stands out of the even harmonics, which hold none of it, on either side of 50 Hz and its multiples."""
    excitation = design_multisine(band_hz=(10.0, 2000.0), grid=Grid.ODD_RANDOM, seed=seed)
    x, rng = excitation.period()[None], np.random.default_rng(seed)
    settings = {"sample_rate_hz": excitation.sample_rate_hz, "harmonics": excitation.harmonics}
    y = x - 0.02 * x**3 + 1e-5 * rng.standard_normal(x.shape)
    report = find_faults(Spectrum.of(6e-4 * np.round(x / 6e-4), y), **settings)  # as a converter rounds it
    assert FaultKind.HUM not in kinds(report)
    t = np.arange(x.size) / excitation.sample_rate_hz
    y = y + 0.02 * np.sin(2 * np.pi * 50.01 * t)
    fault = only(find_faults(Spectrum.of(x, y), **settings), FaultKind.HUM, "sensor")
    assert "at 50" in fault.message


def test_distortion_is_not_hum(shared_data):
    with np.load(shared_data / "oracle" / "nl_odd_random_grid.npz") as data:
        report = find_faults(
            Spectrum.of(data["u"], data["y"]), sample_rate_hz=10e3, harmonics=data["ex"]
        )
    assert report == FaultReport()


def test_a_first_period_that_has_not_settled_is_no_fault(record):
    u, _ = record
    rng = np.random.default_rng(3)
    b, a = [0.02], [1, -2 * 0.99 * np.cos(0.3), 0.99**2]
    y = signal.lfilter(b, a, u.ravel()).reshape(u.shape) + 1e-3 * rng.standard_normal(u.shape)
    assert check(u, y) == FaultReport()


def test_several_records_give_the_worst(record):
    u, y = record
    worse = y.copy()
    worse[2, 100:130] = np.nan
    report = check(np.stack([u, u, u]), np.stack([y, worse, y]))
    fault = only(report, FaultKind.MISSING_SAMPLES, "sensor")
    assert "(in 1 of 3 records)." in fault.message


def test_status_of_the_response(record):
    u, y = record
    frf = frf_of_record(Spectrum.of(u[None], y[None]), LINES, sample_rate_hz=RATE)
    assert FaultReport().marked(frf) is frf
    worth_knowing = check(u, y + 1).marked(frf)
    assert worth_knowing.status is FrfStatus.OK
    assert "offset" in worth_knowing.message
    spoilt = check(u, np.minimum(y, 0.9 * y.max())).marked(frf)
    assert spoilt.status is FrfStatus.SUSPECT
    assert np.array_equal(spoilt.g, frf.g)


def test_shapes_must_fit():
    with pytest.raises(ValueError, match=r"u, y: shapes \(2, 10\), \(3, 10\)"):
        check(np.zeros((2, 10)), np.zeros((3, 10)))


@pytest.mark.parametrize(("seed", "periods"), [(5, 4), (9, 4), (27, 4), (46, 4), (5, 8), (72, 8)])
def test_a_coarse_converter_is_no_saturation(seed, periods):
    # 57 lines around 250 Hz at 0.12 V rms, counts of 0.3 mV, less noise than that: in every period a
    # peak stands on the same count. These seeds have one that more samples reach than the next.
    rng = np.random.default_rng(seed)
    t = np.arange(20000) / 50e3
    phases = rng.uniform(0, 2 * np.pi, 57)
    x = sum(np.cos(2 * np.pi * (180 + 2.5 * k) * t + p) for k, p in enumerate(phases))
    x = np.tile(0.12 * x / x.std(), (periods, 1))
    x = np.round((x + 5e-5 * rng.standard_normal(x.shape)) / 3.05e-4) * 3.05e-4
    assert flat_tops(x) == []
    assert flat_tops(np.clip(x, -0.3, 0.3)) == ["sensor"]


def test_a_repeated_period_without_noise_is_not_saturated():
    # what a generator was told to play: every period has its one peak, on the same sample
    rng = np.random.default_rng(0)
    spectrum = np.zeros(2049, complex)
    spectrum[10:900] = np.exp(2j * np.pi * rng.random(890))
    x = np.tile(np.fft.irfft(spectrum), (6, 1))
    assert flat_tops(x) == []
    assert flat_tops(np.clip(x, -0.6 * x.max(), None)) == ["sensor"]
