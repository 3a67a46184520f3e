# SPDX-License-Identifier: Apache-2.0
"""The compiled estimators against the plain ones: same answers, whatever the point."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.poles_methods import local_polynomial_spectra
from benchmarks.poles_plant import BAND_HZ, HARMONICS, SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, Plant
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.spectra import ratio_variance
from tactile_resonance.identification.identify import identify_batch
from tactile_resonance.identification.joint import JointPlan
from tactile_resonance.identification.joint_compiled import CompiledJointPlan
from tactile_resonance.identification.lines_fit import LinesPlan
from tactile_resonance.identification.result import PolesBatch, PolesStatus
from tactile_resonance.identification.structure import ModelStructure

pytest.importorskip("numba", reason="the compiled estimator needs numba, which is optional")

BARE = ModelStructure(2, 2)
POINTS = 30


def plans(periods: int, structure: ModelStructure) -> tuple[JointPlan, CompiledJointPlan]:
    kind = (SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, periods, HARMONICS, BAND_HZ, structure)
    return JointPlan(*kind), CompiledJointPlan(*kind)


def points(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    return plant.noisy(np.random.default_rng(3), POINTS, plant.bins())


def assert_same(compiled: PolesBatch, plain: PolesBatch) -> None:
    np.testing.assert_array_equal(compiled.status_code, plain.status_code)
    np.testing.assert_array_equal(compiled.variance_model, plain.variance_model)
    np.testing.assert_array_equal(compiled.lines, plain.lines)
    std = np.sqrt(np.diagonal(plain.covariance, axis1=-2, axis2=-1))
    for k, name in enumerate(("f0_hz", "damping_ratio")):
        difference = (getattr(compiled, name) - getattr(plain, name)) / std[..., k]
        assert np.nanmax(np.abs(difference)) < 1e-8, name
    for field in dataclasses.fields(plain):
        expected, found = getattr(plain, field.name), getattr(compiled, field.name)
        if isinstance(expected, np.ndarray) and expected.dtype.kind in "fc":
            assert found.shape == expected.shape, field.name
            assert found.dtype == expected.dtype, field.name
            largest = np.max(np.abs(expected[np.isfinite(expected)]), initial=0.0)
            np.testing.assert_allclose(
                found, expected, rtol=1e-5, atol=1e-9 * largest, err_msg=field.name
            )
    hz = np.linspace(*BAND_HZ, 11)
    np.testing.assert_allclose(compiled.fit.response(hz), plain.fit.response(hz), rtol=1e-6)


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
@pytest.mark.parametrize("periods", [2, 8])
@pytest.mark.parametrize(("damping", "snr_db"), [(0.005, 10.0), (0.02, 40.0), (0.1, 80.0)])
def test_ordinary_points(structure, periods, damping, snr_db):
    plain, compiled = plans(periods, structure)
    u, y = points(Plant(damping, snr_db, periods))
    assert_same(compiled.from_bins(u, y), plain.from_bins(u, y))


def test_one_point_and_more_axes():
    plain, compiled = plans(8, BARE)
    u, y = points(Plant(0.02, 40.0, 8))
    assert_same(compiled.from_bins(u[0], y[0]), plain.from_bins(u[0], y[0]))
    shape = (2, POINTS // 2, -1)
    assert_same(
        compiled.from_bins(u.reshape(shape), y.reshape(shape)),
        plain.from_bins(u.reshape(shape), y.reshape(shape)),
    )


def test_no_points_and_lists():
    plain, compiled = plans(8, BARE)
    u, y = points(Plant(0.02, 40.0, 8))
    assert compiled.from_bins(u[:0], y[:0]).f0_hz.shape == plain.from_bins(u[:0], y[:0]).f0_hz.shape
    assert_same(compiled.from_bins(u[:2].tolist(), y[:2].tolist()), plain.from_bins(u[:2], y[:2]))


@pytest.mark.parametrize("terms", [1, 3, 4, 5])
@pytest.mark.parametrize("numerator_order", [0, 1, 3, 4])
def test_every_length_of_numerators(terms, numerator_order):
    """Odd ones and even ones: the kernel takes terms in pairs."""
    kind = (SAMPLE_RATE_HZ, SAMPLES_PER_PERIOD, 8, HARMONICS, BAND_HZ)
    structure = ModelStructure(2, numerator_order)
    plain, compiled = (
        kind_of(*kind, structure, transient_terms=terms)
        for kind_of in (JointPlan, CompiledJointPlan)
    )
    u, y = points(Plant(0.02, 10.0, 8))
    assert_same(compiled.from_bins(u, y), plain.from_bins(u, y))


def test_one_input_for_many_outputs_and_wrong_shapes():
    plain, compiled = plans(8, BARE)
    u, y = points(Plant(0.02, 40.0, 8))
    u = np.broadcast_to(u[0], y.shape)
    assert_same(compiled.from_bins(u[0], y), plain.from_bins(u, y))
    with pytest.raises(ValueError, match="y: shape"):
        compiled.from_bins(u, y[:, :-1])


def test_points_that_are_not_ordinary_come_out_as_ever():
    plant = Plant(0.02, 40.0, 8)
    plain, compiled = plans(8, BARE)
    u, y = points(plant)
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((POINTS, 2 * y.shape[1])).view(complex) * np.sqrt(plant.noise[0])
    others = np.isin(plain.bins, plain.other_bins)
    y[1, 100] += 300 * noise[1, 100]  # a wild bin
    u[2, 7] = np.nan
    y[3] += noise[3] * np.linspace(0, 5, y.shape[1])  # sloped noise
    y[4] += np.where(others, 3 * noise[4], 0)  # a disturbance of both channels alike
    u[4] += np.where(others, noise[4], 0)
    y[5] *= np.linspace(1, 1.5, y.shape[1])  # no second-order system
    y[6] = noise[6]  # no resonance
    y[7] = u[7] = 0.0
    found = compiled.from_bins(u, y)
    assert_same(found, plain.from_bins(u, y))
    assert found.variance_model[3] != "flat"
    assert found.status(5) is PolesStatus.MODEL_ERROR
    assert np.isfinite(found.total_covariance[5]).all()
    assert np.isnan(found.f0_hz[2])


def test_noise_free_records():
    plant = Plant(0.02, 80.0, 8)
    plain, compiled = plans(8, BARE)
    u, y = plant.input(plant.bins()), plant.output(plant.bins())
    found = compiled.from_bins(u, y)
    assert found.f0_hz[0] == pytest.approx(250.0, rel=1e-9)
    assert found.damping_ratio[0] == pytest.approx(0.02, rel=1e-7)
    assert found.status() is plain.from_bins(u, y).status()


def test_what_is_not_compiled_is_refused():
    with pytest.raises(ValueError, match="structure: order 4 in s, compiled is order 2 in s"):
        plans(8, ModelStructure(4, 4))
    with pytest.raises(ValueError, match="periods: 1 without bins between harmonics"):
        plans(1, BARE)
    with pytest.raises(ValueError, match="periods: 120 make 4760 bins between harmonics"):
        plans(120, BARE)


@pytest.mark.parametrize("longer", [0, 1, 7])
def test_spread_of_pieces_of_which_the_last_is_longer(longer):
    """By its definition, of bins in the order of the kernel."""
    from tactile_resonance.identification import kernel_memory, kernel_undriven
    from tactile_resonance.identification.kernel_tables import interleaved

    counts = np.array([8, 8, 8, 8, 8 + longer])
    rng = np.random.default_rng(longer)
    values = rng.standard_normal((counts.sum(), 2)).view(complex)[:, 0]
    starts = np.cumsum(counts) - counts
    values *= np.repeat([1, 2, 0.5, 1, 3], counts)
    means = np.add.reduceat(np.abs(values) ** 2, starts) / counts
    row = kernel_memory.E_ROW
    memory = np.full((kernel_memory.ROWS, kernel_memory.STRIDE), np.nan)
    turned = values[interleaved(counts)]
    memory[row, : turned.size], memory[row + 1, : turned.size] = turned.real, turned.imag
    found = kernel_undriven.spread_of_pieces(memory, row, counts, np.mean(np.abs(values) ** 2))
    assert found == pytest.approx(np.log(means.mean()) - np.log(means).mean(), rel=1e-12)


def test_without_numba_it_says_what_to_install():
    code = (
        "import sys; sys.modules['numba'] = None\n"
        "import numpy as np\n"
        "from tactile_resonance.identification.joint_compiled import CompiledJointPlan\n"
        "CompiledJointPlan(50e3, 20000, 8, np.arange(4, 4001), (200.0, 300.0))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode != 0
    assert "needs numba (pip install tactile_resonance[compiled])" in run.stderr


def frfs(rng, count=200):
    """Noisy FRFs of one mode, by the local polynomial method, with a variance of each line."""
    plant = Plant(0.02, 40.0, 8)
    wide = plant.bins(150.0, 350.0)
    u, y = plant.noisy(rng, count, wide)
    frequency_hz, spectra, covariance, dof = local_polynomial_spectra(plant, u, y, wide)
    variance = ratio_variance(spectra, covariance)
    return FRF(frequency_hz, spectra[:, 0] / spectra[:, 1], variance_noise=variance, noise_dof=dof)


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
def test_frfs(structure):
    frf = frfs(np.random.default_rng(2))
    assert_same(
        identify_batch(frf, structure=structure, compiled=True),
        identify_batch(frf, structure=structure),
    )


def test_frfs_that_are_not_ordinary_come_out_as_ever():
    rng = np.random.default_rng(4)
    frf = frfs(rng, 12)
    frf.g[1, 7] = np.nan
    frf.g[2, 20] += 1.0  # a wild line
    frf.variance_noise[3] *= np.geomspace(1, 1e4, frf.g.shape[1])
    frf.variance_noise[4, 5] = 0.0
    frf.g[5] = rng.standard_normal(82).view(complex)  # no resonance
    frf.g[6] = 0.0
    frf.g[7] *= np.linspace(1, 1.5, frf.g.shape[1])  # no second-order system
    frf.g[8] = np.nan
    found = identify_batch(frf, structure=BARE, compiled=True)
    assert_same(found, identify_batch(frf, structure=BARE))
    assert found.status(7) is PolesStatus.MODEL_ERROR
    with pytest.raises(ValueError, match="structure: .* compiled is order 2 in s without delay"):
        identify_batch(frf, structure=ModelStructure(4, 4), compiled=True)


def not_called(*_):
    raise AssertionError("an ordinary point was left to the plain estimator")


@pytest.mark.parametrize("structure", [BARE, ModelStructure()], ids=["bare", "default"])
def test_ordinary_points_are_fitted_by_compiled_code_alone(structure, monkeypatch):
    """Else all that is compared above would be the plain estimator with itself."""
    _, compiled = plans(8, structure)
    u, y = points(Plant(0.02, 40.0, 8))
    frf = frfs(np.random.default_rng(2), 20)
    monkeypatch.setattr(JointPlan, "from_bins", not_called)
    monkeypatch.setattr(LinesPlan, "fit", not_called)
    assert compiled.from_bins(u, y).has_status(PolesStatus.OK).all()
    result = identify_batch(frf, structure=structure, compiled=True)
    assert result.has_status(PolesStatus.OK).all()
