# SPDX-License-Identifier: Apache-2.0
"""Against published implementations and measured data."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.io
from scipy import stats

from tactile_resonance.frf.estimate import frf_of_record
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.estimator import identify_poles_from_records
from tactile_resonance.poles.identify import (
    identify_batch,
    identify_frf,
    identify_spectra,
)
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.significance import SMOOTH_RESIDUAL
from tactile_resonance.poles.structure import ModelStructure

BARE = ModelStructure(2, 2)


@pytest.mark.parametrize("case", ["z1_snr20", "z2_snr40", "z5_snr60"])
@pytest.mark.parametrize("reference", ["mlfdi", "MIMO_ML"])
def test_errors_in_variables_equal_the_reference(shared_data, case, reference):
    data = np.load(shared_data / "oracle" / "ml_2nd_order.npz")
    result = identify_spectra(
        data["freq"], data[f"{case}_Z"], data[f"{case}_CZ"], 7, structure=BARE, pooled=False
    )
    expected = np.array([np.roots(d)[0] for d in data[f"{case}_den_{reference}"]])
    std = np.sqrt(data[f"{case}_ml_polevar"])  # (12, 2)
    f0_hz = np.abs(expected) / (2 * np.pi)
    assert np.all(np.abs(result.f0_hz[:, 0] - f0_hz) < 1e-3 * std[:, 0])
    damping_ratio = -expected.real / np.abs(expected)
    assert np.all(np.abs(result.damping_ratio[:, 0] - damping_ratio) < 1e-3 * std[:, 1])
    assert result.cost == pytest.approx(data[f"{case}_ml_cost"], rel=1e-6)
    assert result.has_status(PolesStatus.OK).all()
    # the reference's covariance, enlarged for the sample variances: nu / (nu - 2); a cost that noise seldom
    # makes counts too
    usual = result.cost < 1.3 * result.expected_cost
    assert np.count_nonzero(usual) >= 11
    assert result.covariance[usual, 0, 0, 0] == pytest.approx(std[usual, 0] ** 2 * 7 / 5, rel=1e-2)


def test_covariance_with_sample_variances_is_honest(shared_data):
    """Per-line weights of 7 degrees of freedom: the plain ellipse would hold the truth 88-90 %."""
    data = np.load(shared_data / "oracle" / "ml_2nd_order.npz")
    f = data["freq"]
    s = 2j * np.pi * f
    b0, b1, b2, a0, a1 = data["z2_snr40_theta_true"]
    g = (b2 * s**2 + b1 * s + b0) / (s**2 + a1 * s + a0)
    rng = np.random.default_rng(1)
    runs, nu, sigma = 3000, 7, 1e-3

    def noise(*shape):
        return sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    spectra = np.stack([g + noise(runs, f.size), np.ones((runs, f.size))], axis=1)
    sample = np.mean(np.abs(noise(runs, nu, f.size)) ** 2, axis=1)
    covariance = np.zeros((runs, 2, 2, f.size), complex)
    covariance[:, 0, 0] = sample
    result = identify_spectra(f, spectra, covariance, nu, structure=BARE, pooled=False)
    errors = np.stack([result.f0_hz[:, 0] - 250, result.damping_ratio[:, 0] - 0.02], -1)
    solved = np.linalg.solve(result.covariance[:, 0], errors[..., None])[..., 0]
    inside = np.sum(np.sum(errors * solved, -1) < -2 * np.log(0.05))
    assert stats.binom.cdf(inside, runs, 0.94) > 0.0005
    assert stats.binom.sf(inside - 1, runs, 0.96) > 0.0005
    # cost: (F - n / 2) nu / (nu - 1), within its Monte Carlo error
    expected = (41 - 2.5) * nu / (nu - 1)
    assert result.cost.mean() == pytest.approx(expected, abs=4 * result.cost.std() / np.sqrt(runs))


@pytest.fixture(scope="module")
def silverbox_records(shared_data):
    data = scipy.io.loadmat(shared_data / "silverbox" / "SNLS80mV.mat")
    ends = [48946, 57646, 66346, 75046, 83746, 92396, 101096, 109796, 118496, 127196]
    return np.stack(
        [[data[name].ravel()[end - 8192 : end] for end in ends] for name in ("V1", "V2")]
    )[:, :, None]


@pytest.fixture(scope="module")
def silverbox(silverbox_records):
    return frf_of_record(
        Spectrum.of(*silverbox_records), sample_rate_hz=1e7 / 2**14, harmonics=np.arange(1, 2684, 2)
    )


@pytest.mark.parametrize("band", [(40, 110), (1, 200)])
def test_silverbox_with_its_transients(silverbox_records, band):
    """Ten realisations of one period; even harmonics carry distortion, no noise."""
    poles = identify_poles_from_records(
        *silverbox_records,
        sample_rate_hz=1e7 / 2**14,
        harmonics=np.arange(1, 2684, 2),
        band_hz=band,
        structure=BARE,
    )
    std = np.sqrt(np.diagonal(poles.total_covariance[0]))
    assert abs(poles.f0_hz[0] - 69.536) < 1.5 * std[0]
    assert abs(poles.damping_ratio[0] - 0.04877) < 1.5 * std[1]
    # published standard deviations of the mean response: 0.012 Hz, 0.00016
    assert std == pytest.approx([0.012, 0.00016], rel=0.3)
    assert poles.status is PolesStatus.OK
    assert poles.cost == pytest.approx(poles.expected_cost, rel=0.15)


def test_silverbox(silverbox):
    poles = identify_frf(silverbox, (40, 110), BARE)
    assert poles.f0_hz[0] == pytest.approx(69.536, abs=1e-3)
    assert poles.damping_ratio[0] == pytest.approx(0.04877, abs=2e-5)
    assert poles.cost == pytest.approx(525.6, abs=0.2)
    assert poles.expected_cost == pytest.approx(525.9, abs=0.1)
    assert poles.status is PolesStatus.OK


def test_silverbox_over_a_wider_band_agrees_within_its_total_covariance(silverbox):
    poles = identify_frf(silverbox, (1, 200), BARE)
    std = np.sqrt(np.diagonal(poles.total_covariance[0]))
    assert abs(poles.f0_hz[0] - 69.536) < 2 * std[0]
    assert abs(poles.damping_ratio[0] - 0.04877) < 2 * std[1]


def test_silverbox_second_order_leaves_nothing_out_that_ten_realisations_show(silverbox):
    """Over 1-200 Hz too: fourteen more terms lower the cost by what chance takes, no more."""
    bare, rich = (identify_frf(silverbox, (1, 200), ModelStructure(2, n)) for n in (2, 16))
    assert bare.status is PolesStatus.OK
    assert abs(bare.whiteness) < SMOOTH_RESIDUAL
    # half a chi-square of 14 degrees of freedom, weights of 9 degrees: mean 7.9
    assert bare.cost - rich.cost < stats.chi2.ppf(0.95, 14) / 2 * 9 / 8


def test_silverbox_one_model_serves_both_parts_of_the_band(silverbox):
    """Chow's test: models of 40-110 Hz and of the rest cost as little less as chance takes."""
    f = silverbox.frequency_hz
    band, middle = (f >= 1) & (f <= 200), (f >= 40) & (f <= 110)

    def cost(lines):
        variance = silverbox.variance_total[lines]
        frf = FRF(f[lines], silverbox.g[lines], variance_total=variance, total_dof=9)
        return identify_frf(frf, structure=BARE).cost

    gain = cost(band) - cost(band & middle) - cost(band & ~middle)
    assert 0 < gain < stats.chi2.ppf(0.95, BARE.parameters) / 2 * 9 / 8


@pytest.mark.parametrize("band", [(40, 110), (1, 200)])
def test_silverbox_with_a_neighbouring_mode_is_told(silverbox, band):
    """A mode beyond the band that adds four standard deviations of a line at its end, and less inside."""
    s, w = 2j * np.pi * silverbox.frequency_hz, 2 * np.pi * 1.1 * band[1]
    mode = 1 / (s**2 + 0.02 * w * s + w**2)
    end = int(np.argmin(np.abs(silverbox.frequency_hz - band[1])))
    std = np.sqrt(silverbox.variance_total[end - 20 : end].mean())
    changed = replace(silverbox, g=silverbox.g + 4 * std * mode / np.abs(mode[end]))
    poles = identify_frf(changed, band, BARE)
    assert poles.status is PolesStatus.MODEL_ERROR
    total = np.sqrt(np.diagonal(poles.total_covariance[0]))
    assert abs(poles.f0_hz[0] - 69.536) < 2 * total[0]
    assert abs(poles.damping_ratio[0] - 0.04877) < 2 * total[1]


def test_batch_equals_single_points(silverbox):
    band = silverbox.band(40, 110)
    batch = identify_batch(
        FRF(
            band.frequency_hz,
            np.stack([band.g, 2 * band.g])[:, None],
            variance_noise=np.stack([band.variance, 4 * band.variance])[:, None],
            noise_dof=9,
        ),
        structure=BARE,
    )
    poles = identify_frf(silverbox, (40, 110), BARE)
    assert batch.shape == (2, 1)
    assert batch.f0_hz[:, 0, 0] == pytest.approx(poles.f0_hz[0], rel=1e-8)
    assert batch.covariance[1, 0, 0] == pytest.approx(poles.covariance[0], rel=1e-6)
