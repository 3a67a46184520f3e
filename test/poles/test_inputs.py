# SPDX-License-Identifier: Apache-2.0
"""What users hand over: any form of the same numbers, or a message that names what is wrong."""

import numpy as np
import pytest
from poles.mode_at_250_hz import (
    BARE,
    HARMONICS,
    LINES_HZ,
    NOISY,
    PERIODS,
    RATE_HZ,
    SAMPLES,
    frf,
    from_record,
    record,
    spectra,
)

from tactile_resonance.frf.result import FRF, BandBins
from tactile_resonance.poles.estimator import (
    choose_among,
    identify_poles_from_bins,
    poles_of_frf,
)
from tactile_resonance.poles.identify import (
    identify_batch,
    identify_frf,
    identify_spectra,
)
from tactile_resonance.poles.joint import JointPlan, PoleEstimator
from tactile_resonance.poles.result import PolesStatus
from tactile_resonance.poles.structure import ModelStructure


def with_entry(row, column, value):
    changed = spectra()["covariance"].copy()
    changed[row, column] = value
    return changed


@pytest.mark.parametrize(
    ("changes", "band_hz", "said"),
    [
        ({"frequency_hz": LINES_HZ[::-1]}, None, "frf.frequency_hz: 297.5 Hz after 300"),
        ({"frequency_hz": np.repeat(LINES_HZ, 2)[:41]}, None, "frf.frequency_hz: 200 Hz after 200"),
        ({"frequency_hz": LINES_HZ - 250}, None, "frf.frequency_hz: -50 Hz"),
        ({"frequency_hz": np.append(np.nan, LINES_HZ[1:])}, None, "frf.frequency_hz: nan"),
        ({"frequency_hz": LINES_HZ[:30]}, None, "frf.g: shape"),
        ({"frequency_hz": LINES_HZ[:, None]}, None, "frf.frequency_hz: shape"),
        ({"variance_noise": np.ones(30)}, None, "frf.variance_noise: shape"),
        ({"variance_noise": -1e-6}, None, "frf.variance_noise: -1e-06, expected variances above 0"),
        ({"variance_noise": 1e-6j}, None, "frf.variance_noise: got .*; accepted is an array of real numbers"),
        ({"noise_dof": -1}, None, "frf.noise_dof: got -1"),
        ({}, (300, 200), "band_hz: "),
        ({}, (np.nan, 200), "band_hz: "),
        ({}, (200,), "band_hz: "),
        ({}, "ab", "band_hz: "),
    ],
)
def test_a_bad_frf_is_named(changes, band_hz, said):
    with pytest.raises(ValueError, match=said):
        identify_frf(frf(**changes), band_hz, BARE)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"spectra": spectra()["spectra"].T}, "spectra, covariance: shapes"),
        ({"covariance": spectra()["covariance"][..., :30]}, "spectra, covariance: shapes"),
        ({"covariance": np.ones((3, 2, 2, 41))}, "covariance: shape"),
        ({"frequency_hz": LINES_HZ[::-1]}, "frequency_hz: 297.5 Hz after 300"),
        ({"dof": -1}, "dof: got -1"),
        ({"band_hz": (300, 200)}, "band_hz: "),
        # one triangle alone, a symmetric matrix, more covariance than variances allow, none below 0
        ({"covariance": with_entry(0, 1, 5e-7)}, "200 Hz, expected a Hermitian matrix"),
        ({"covariance": with_entry((0, 1), (1, 0), 5e-7j)}, "expected a Hermitian matrix"),
        ({"covariance": with_entry((0, 1), (1, 0), 5e-6)}, "expected a Hermitian matrix"),
        ({"covariance": with_entry(1, 1, -1e-6)}, "expected a Hermitian matrix"),
    ],
)
def test_bad_spectra_are_named(changes, said):
    with pytest.raises(ValueError, match=said):
        identify_spectra(**spectra(**changes))


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"order": 2.0}, "order: 2.0"),
        ({"order": "2"}, "order: '2'"),
        ({"order": True}, "order: True"),
        ({"numerator_order": 1.5}, "numerator_order: 1.5"),
        ({"domain": "z", "sample_rate_hz": np.inf}, "sample_rate_hz: inf"),
    ],
)
def test_a_bad_structure_is_named(options, field):
    with pytest.raises(ValueError, match=field):
        ModelStructure(**options)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"harmonics": HARMONICS + 0.5}, r"harmonics: \[4.5"),
        ({"harmonics": np.where(HARMONICS == 5, np.nan, HARMONICS)}, "harmonics: .*nan"),
        ({"harmonics": np.where(HARMONICS == 5, np.inf, HARMONICS)}, "harmonics: .*inf"),
        ({"harmonics": HARMONICS > 0}, "harmonics: .*bool"),
        ({"harmonics": ["80", "81"]}, "harmonics: "),
        ({"sample_rate_hz": np.inf}, "sample_rate_hz: got inf"),
        ({"sample_rate_hz": "5000"}, "sample_rate_hz: got '5000'"),
        ({"sample_rate_hz": None}, "sample_rate_hz: got None"),
        ({"band_hz": (200.0, 3000.0)}, "band_hz: .*2500, half the sample rate"),
        ({"band_hz": (200.0, np.inf)}, "band_hz: "),
        ({"band_hz": (-5.0, 300.0)}, "band_hz: "),
        ({"band_hz": None}, "band_hz: got None"),
        ({"input_noise_ratio": np.inf}, "input_noise_ratio: got inf"),
        ({"input_noise_ratio": "1"}, "input_noise_ratio: got '1'"),
        ({"structure": "bare"}, "structure: got a str"),
        (
            {"structure": ModelStructure(2, 2, domain="z", sample_rate_hz=1e4)},
            "structure.sample_rate_hz: got 10000.0; .*5000",
        ),
        ({"u": record()[0].astype(complex)}, "u: values of type complex128"),
        ({"y": record()[1].astype(str)}, "y: values of type"),
    ],
)
@pytest.mark.filterwarnings("error")  # one line says what is wrong
def test_a_bad_record_is_named(changes, said):
    with pytest.raises(ValueError, match=said):
        from_record(**changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"periods": 2.5}, "periods: got 2.5"),
        ({"samples_per_period": 2000.5}, "samples_per_period: got 2000.5"),
    ],
)
def test_a_bad_plan_is_named(changes, said):
    good = {"sample_rate_hz": RATE_HZ, "samples_per_period": SAMPLES, "periods": PERIODS}
    with pytest.raises(ValueError, match=said):
        JointPlan(**{**good, "harmonics": HARMONICS, "band_hz": (200, 300), **changes})


def test_leading_axes_that_do_not_fit_are_named():
    plan = JointPlan(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), BARE)
    with pytest.raises(ValueError, match=r"y: shape \(2, .*leading axes"):
        plan.from_bins(np.zeros((3, plan.bins.size)), np.zeros((2, plan.bins.size)))


@pytest.mark.filterwarnings("error")
def test_one_input_of_many_outputs_needs_no_axis():
    plan = JointPlan(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), BARE)
    u, y = plan.transform(*record())
    alone = plan.from_bins(u, y)
    for found in (plan.from_bins(u, y[None]), plan.from_bins(u[None], y)):
        assert found.f0_hz[0] == alone.f0_hz


def test_harmonics_kept_with_bins_are_whole_too():
    plan = JointPlan(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), BARE)
    u, y = (x[None] for x in plan.transform(*record()))
    bins = BandBins(int(plan.bins[0]), u, y, HARMONICS + 0.5, RATE_HZ, SAMPLES, PERIODS)
    with pytest.raises(ValueError, match="harmonics: "):
        identify_poles_from_bins(bins, (200, 300), BARE)


def test_no_candidates_are_named():
    with pytest.raises(ValueError, match="candidates: none given"):
        choose_among(lambda structure: identify_frf(frf(), None, structure), candidates=[])


@pytest.mark.parametrize(
    "form",
    [
        lambda x: np.repeat(np.asarray(x), 2, axis=-1)[..., ::2],
        lambda x: np.asarray(x).astype(np.asarray(x).dtype.newbyteorder()),
        lambda x: np.asarray(x).tolist(),
    ],
    ids=["strided", "other byte order", "lists"],
)
def test_form_of_the_same_numbers_does_not_matter(form):
    one = identify_frf(frf(), structure=BARE)
    changed = {name: form(getattr(frf(), name)) for name in ("frequency_hz", "g")}
    same = identify_frf(frf(**changed, variance_noise=1e-6), structure=BARE)
    assert same.f0_hz == one.f0_hz
    assert same.covariance == pytest.approx(one.covariance)
    arguments = spectra()
    for name in ("frequency_hz", "spectra", "covariance"):
        arguments[name] = form(arguments[name])
    assert identify_spectra(**arguments).f0_hz == identify_spectra(**spectra()).f0_hz
    u, y = record()
    assert from_record(u=form(u), y=form(y), harmonics=form(HARMONICS)).f0_hz == from_record().f0_hz


def test_single_precision_and_read_only_data():
    g = NOISY.copy()
    g[3] = np.nan
    g.flags.writeable = False
    one = identify_frf(frf(g=g), structure=BARE)
    low = identify_frf(frf(g=g.astype(np.complex64)), structure=BARE)
    assert low.f0_hz == pytest.approx(one.f0_hz, rel=1e-7)
    plan = JointPlan(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), BARE)
    u, y = plan.transform(*record())
    result = plan.from_bins(u.astype(np.complex64), y.astype(np.complex64))
    assert result.f0_hz == pytest.approx(plan.from_bins(u, y).f0_hz, rel=1e-6)


@pytest.mark.parametrize("order", [2, 8])
@pytest.mark.parametrize("shape", [(0,), (2, 0)])
def test_no_points_give_no_results(shape, order):
    structure = ModelStructure(order, order)
    empty = FRF(LINES_HZ, np.empty((*shape, 41), complex))
    assert identify_batch(empty, structure=structure).f0_hz.shape == (*shape, order // 2)
    nothing = np.empty((*shape, 2, 41), complex)
    result = identify_spectra(**spectra(spectra=nothing, structure=structure))
    assert result.covariance.shape == (*shape, order // 2, 2, 2)
    plan = JointPlan(RATE_HZ, SAMPLES, PERIODS, HARMONICS, (200, 300), BARE)
    samples = np.empty((*shape, PERIODS, SAMPLES))
    assert plan(samples, samples).f0_hz.shape == (*shape, 1)
    for periods in (1, PERIODS):
        several = PoleEstimator(RATE_HZ, SAMPLES, periods, HARMONICS, (200, 300), BARE)
        samples = np.empty((*shape, 2, periods, SAMPLES))
        assert several(samples, samples).f0_hz.shape == (*shape, 1)


@pytest.mark.parametrize(
    "fit",
    [
        lambda band: identify_frf(frf(), band, BARE),
        lambda band: poles_of_frf(frf(), band, BARE),
        lambda band: identify_frf(FRF(np.empty(0), np.empty(0, complex)), None, BARE),
    ],
)
def test_a_band_without_lines_has_too_few(fit):
    poles = fit((400.0, 500.0))
    assert poles.status is PolesStatus.TOO_FEW_LINES
    assert poles.f0_hz.size == 0
    assert "0 lines" in poles.message
