# SPDX-License-Identifier: Apache-2.0
"""From a record to the complex stiffness of the contact, through a sensor whose parameters are known.

A record of P periods from rest has the discrete Fourier transform::

    Y(k) = G(k) U(k) - sum_p x_p h_p(k),    h_p(k) = (1 - exp(p T)) / (L (1 - exp((p - j w_k) / fs)))

over its L samples, with the poles p of the sensor on the contact and the steady state x_p that their states
would have had at the first sample: exact for a periodic input that begins at rest. So nothing is waited for,
and a transient carries information as the rest does. Where the state at the start is unknown, the x_p of
poles about the band are estimated along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.calibration.contact import (
    ContactPrior,
    ContactStatus,
    Law,
    TissueContact,
    slope_of,
)
from tactile_resonance.calibration.model import Calibration, ContactStiffness, SensorModel
from tactile_resonance.fields import require
from tactile_resonance.frf.result import FRF, BandBins, FrfStatus
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.poles.estimator import poles_of_bands
from tactile_resonance.poles.result import (
    Poles,
    PolesStatus,
    natural_frequency_and_damping,
    natural_frequency_and_damping_jacobian,
)
from tactile_resonance.poles.structure import PoleBand

CONTRADICTED = 1e-4
"""Probability of so large residuals by chance, below which data contradict a calibration."""
FEWEST_BETWEEN = 30
"""Bins between lines from which the level of the noise is estimated."""
LOUDEST = 9.0
"""Of the noise of the calibration, as power: what is more than that between lines is a transient that does not
fit, as of another sensor, and must not widen the deviations until nothing contradicts the calibration."""
_STEPS, _FIRST_STEP = 300, 0.2
"""Of the fit; longest first step, in logarithms and an exponent: a longer one overshoots, and a power law that
leaves its exponents stays there."""
_ENOUGH = 1e-7  # part of the weighted squares by which the last step lowers them
_NEAR = (0.2, 5.0)
"""Of the ends of the band: poles between them have a state of their own where that at the start is unknown."""
FEWEST_LINES = 3
"""Excited in the band."""
IN_AIR_N_PER_M = 1.0
"""Stiffness below which the tip is in air; tissue at 1 cN has tens."""


@dataclass(frozen=True, eq=False)
class ContactRecord:
    """Bins of a band of one record, and all lines that were excited.

    Attributes
    ----------
    bins : (K,) int
        Multiples of the sample rate over the samples.
    y : (K,) complex
        Sensor [V], scaled by one over the samples.
    lines : (F,) int
        Of them and others.
    u : (F,) complex
        Actuator [V] at the lines.
    samples : int
    sample_rate_hz : float
    from_rest : bool
        Whether the sensor was at rest at the first sample; otherwise its state there is unknown.
    """

    bins: IntArray
    y: ComplexArray
    lines: IntArray
    u: ComplexArray
    samples: int
    sample_rate_hz: float
    from_rest: bool = True

    @classmethod
    def of_bins(cls, band: BandBins) -> ContactRecord:
        """Of the bins of one realisation from rest that hold all lines that were excited."""
        require(band.u.shape[0] == 1, "bins", band.u.shape, "one realisation")
        bins, lines = band.first_bin + np.arange(band.count), band.harmonics * band.periods
        samples = band.samples_per_period * band.periods
        u = band.u[0, lines - band.first_bin]
        return cls(bins, band.y[0], lines, u, samples, band.sample_rate_hz)

    @classmethod
    def of_samples(
        cls,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        *,
        sample_rate_hz: float,
        harmonics: npt.ArrayLike,
        band_hz: tuple[float, float],
        from_rest: bool = True,
    ) -> ContactRecord:
        """Of whole periods (P, N) of actuator and sensor [V]."""
        record = Spectrum.of(u, y)
        samples = record.periods * record.samples_per_period
        lines = np.asarray(harmonics) * record.periods
        low, high = np.array(band_hz) / (sample_rate_hz / samples)
        first, last = int(np.ceil(low - 1e-9)), int(np.floor(high + 1e-9))
        bins = np.arange(max(1, first), min(samples // 2 - 1, last) + 1)
        y_at, u_at = record.bins[0, bins], record.bins[1, lines]
        return cls(bins, y_at, lines, u_at, samples, sample_rate_hz, from_rest)

    @property
    def resolution_hz(self) -> float:
        """Distance of neighbouring bins."""
        return self.sample_rate_hz / self.samples

    @property
    def frequency_hz(self) -> FloatArray:
        """(K,) of the bins."""
        return np.asarray(self.bins * self.resolution_hz, float)

    @property
    def excited(self) -> BoolArray:
        """(K,) bins that are lines."""
        return np.isin(self.bins, self.lines)


@dataclass(frozen=True, eq=False)
class CalibratedEstimator:
    """Records to contacts, through one known sensor.

    Attributes
    ----------
    calibration : Calibration
        Whose mode shapes at the tip are known.
    tip_radius_m : float
    law : Law
    """

    calibration: Calibration
    tip_radius_m: float
    law: Law = Law.STANDARD_LINEAR_SOLID

    def __post_init__(self) -> None:
        known, accepted = self.calibration.knows_tip(), "one with a mass or spring at the tip"
        require(known, "calibration", self.calibration.message, accepted)
        require(self.tip_radius_m > 0, "tip_radius_m", self.tip_radius_m, "above 0")
        noise = self.calibration.noise_v_per_root_hz
        require(0 < noise < np.inf, "noise_v_per_root_hz", noise, "of a calibration, a number above 0")

    def __call__(
        self,
        record: ContactRecord,
        force_n: float = float("nan"),
        force_std_n: float = 0.0,
    ) -> TissueContact:
        """Contact and pole of a record.

        Parameters
        ----------
        record : ContactRecord
        force_n, force_std_n : float
            Of the contact; NaN where unknown.
        """
        # the mode that lies in the band in air, or nearest to it
        f = self.calibration.model.natural_rad_s / (2 * np.pi)
        low, high = record.frequency_hz[0], record.frequency_hz[-1]
        air_hz = float(f[np.argmin(np.maximum(0, np.maximum(low - f, f - high)))])
        prior = ContactPrior(self.law, self.tip_radius_m, air_hz, force_n, force_std_n)
        fit = _Fit(self.calibration, record, prior)
        return fit.result(*fit.solved(prior.start))


class _Fit:
    """Weighted residuals of one record by parameters of its contact, and by those of the sensor."""

    def __init__(
        self, calibration: Calibration, record: ContactRecord, prior: ContactPrior
    ) -> None:
        self.calibration, self.record, self.prior = calibration, record, prior
        self.noise = calibration.noise_v_per_root_hz
        self._excited = record.excited
        self._s = np.asarray(2j * np.pi * record.frequency_hz, complex)  # (K,)
        self._lines = 2j * np.pi * (record.lines * record.resolution_hz)  # (F,)
        self._u = np.zeros(record.bins.size, complex)
        _, into, of = np.intersect1d(record.bins, record.lines, return_indices=True)
        self._u[into] = record.u[of]
        self.directions = 0  # of the unknown state at the start

    @property
    def _std(self) -> float:
        """Of real and imaginary part of a bin [V]."""
        variance = self.noise**2 * self.record.sample_rate_hz / 2 / self.record.samples
        return float(np.sqrt(variance / 2))

    def predicted(
        self, sensor: SensorModel, contact: ContactStiffness
    ) -> tuple[ComplexArray, ComplexArray]:
        """(..., K) bins of the sensor channel, and the poles (..., N)."""
        record = self.record
        stacked = (*np.shape(contact.elastic_n_per_m), self._s.size)
        k = contact.at(np.broadcast_to(self._s, stacked))
        steady = sensor.response(self._s, k) * self._u
        poles = sensor.poles(contact)
        if not record.from_rest:
            return steady, poles
        residues = sensor.residues(poles, contact)
        gain, delay = (np.asarray(x)[..., None] for x in (sensor.gain, sensor.delay_s))
        # steady state of each pole's state at the first sample, positive and negative lines
        upper = self._lines - poles[..., None]  # (..., N, F)
        lower = self._lines.conj() - poles[..., None]
        at_start = (record.u / upper).sum(axis=-1) + (record.u.conj() / lower).sum(axis=-1)
        amplitude = gain * residues * at_start * np.exp(-poles * delay)
        moving = steady - (amplitude[..., None] * self._decay(poles)).sum(axis=-2)
        return moving - self._before(sensor), poles

    def _decay(self, poles: ComplexArray) -> ComplexArray:
        """(..., N, K) transforms of the decay of each pole over the record."""
        rate_hz, samples = self.record.sample_rate_hz, self.record.samples
        z = np.exp((poles[..., None] - self._s) / rate_hz)
        left = 1 - np.exp(poles[..., None] * (samples / rate_hz))
        return np.asarray(left / (1 - z) / samples)

    def _before(self, sensor: SensorModel) -> ComplexArray:
        """(..., K) feed-through of the input before it began, in samples that a delay leaves empty."""
        rate_hz, samples = self.record.sample_rate_hz, self.record.samples
        delay = np.asarray(sensor.delay_s)
        longest = int(np.ceil(float(delay.max(initial=0.0)) * rate_hz - 1e-9))
        out = np.zeros((*delay.shape, self._s.size), complex)
        for n in range(max(0, longest)):
            time = n / rate_hz - delay  # (...)
            value = 2 * (self.record.u * np.exp(self._lines * time[..., None])).sum(axis=-1).real
            value = np.where(time < 0, value * sensor.gain * sensor.feedthrough, 0.0)
            out += value[..., None] * np.exp(-self._s * n / rate_hz) / samples
        return out

    def residual(self, p: FloatArray, sensor: SensorModel | None = None) -> FloatArray:
        """(..., R) over standard deviations, priors last."""
        sensor = self.calibration.model if sensor is None else sensor
        gap, poles = self.predicted(sensor, self.prior.stiffness(p))
        gap = (gap - self.record.y) / self._std
        real = np.concatenate([gap.real, gap.imag], axis=-1)
        if not self.record.from_rest:
            real = self._less_start(real, poles)
        deviations = self.prior.deviations(p)
        shape = (*real.shape[:-1], deviations.shape[-1])
        return np.concatenate([real, np.broadcast_to(deviations, shape)], axis=-1)

    def _less_start(self, real: FloatArray, poles: ComplexArray) -> FloatArray:
        """Residuals without what any state of the poles about the band at the start would add."""
        low, high = self.record.frequency_hz[[0, -1]] * 2 * np.pi * np.array(_NEAR)
        out = np.empty_like(real)
        for index in np.ndindex(real.shape[:-1]):
            at, size = poles[index], np.abs(poles[index])
            near = at[(at.imag > 0) & (size > low) & (size < high)]
            h, conjugate = self._decay(near), self._decay(near.conj())
            columns = np.concatenate([h + conjugate, 1j * (h - conjugate)])
            columns = np.concatenate([columns.real, columns.imag], axis=-1).T
            q, _ = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))
            out[index] = real[index] - q @ (q.T @ real[index])
            self.directions = q.shape[1]
        return out

    def solved(self, p: FloatArray) -> tuple[FloatArray, bool]:
        """Least squares; the level of the noise from bins between lines where there are enough."""
        p, converged = self._descend(p)
        between = ~self._excited
        if np.count_nonzero(between) - self.directions / 2 < FEWEST_BETWEEN:
            return p, converged
        count = self._excited.size
        real = self.residual(p)[: 2 * count].reshape(2, count)[:, between]
        level = np.sum(real**2) / (2 * np.count_nonzero(between) - self.directions)
        self.noise *= float(np.sqrt(min(level, LOUDEST)))
        return self._descend(p)

    def _descend(self, p: FloatArray) -> tuple[FloatArray, bool]:
        found = scipy.optimize.least_squares(  # dogbox begins with steps of `x_scale` only where its start is 0
            lambda way: self.residual(p + way),
            np.zeros(p.size),
            lambda way: slope_of(self.residual, p + way),
            method="dogbox",
            x_scale=_FIRST_STEP,
            ftol=_ENOUGH,
            max_nfev=_STEPS,
        )
        return p + found.x, found.status > 0

    def result(self, p: FloatArray, converged: bool) -> TissueContact:
        """Covariances, pole, judgement."""
        residual, jacobian = self.residual(p), slope_of(self.residual, p)
        covariance = np.asarray(np.linalg.inv(jacobian.T @ jacobian), float)
        sensor = self.calibration.model
        stack, correlation = self.calibration.one_moved_each()
        stacked = np.tile(p, (len(correlation), 1))
        change = (self.residual(stacked, stack) - residual).T  # (R, free)
        by_sensor = -covariance @ jacobian.T @ change  # (4, free), per deviation
        total = covariance + by_sensor @ correlation @ by_sensor.T
        # of the mode that is meant: nearest to that of the band in air, which tissue moves by a tenth
        poles = sensor.poles(self.prior.stiffness(p))
        poles = poles[poles.imag > 0]
        away = np.abs(np.abs(poles) / (2 * np.pi) - self.prior.frequency_hz)
        pole = poles[np.argmin(away)]

        def of_mode(q: FloatArray, of: SensorModel) -> FloatArray:
            """Pole and stiffness there, real and imaginary parts (..., 4)."""
            contact = self.prior.stiffness(q)
            poles = of.poles(contact)
            near = np.argmin(np.abs(poles - pole), axis=-1)[..., None]
            at = np.take_along_axis(poles, near, axis=-1)
            k = contact.at(1j * np.abs(at))[..., 0]
            return np.stack([at[..., 0].real, at[..., 0].imag, k.real, k.imag], axis=-1)

        value = of_mode(p, sensor)
        slope = slope_of(lambda q: of_mode(q, sensor), p)
        direct = (of_mode(stacked, stack) - value).T  # (4, free)
        whole = direct + slope @ by_sensor
        noise = slope @ covariance @ slope.T
        with_sensor = noise + whole @ correlation @ whole.T
        squares = float(residual @ residual)
        dof = residual.size - p.size - self.directions
        status, of_poles, message = ContactStatus.OK, PolesStatus.OK, ""
        if not converged:
            status, of_poles = ContactStatus.NOT_CONVERGED, PolesStatus.NOT_CONVERGED
            message = f"not converged in {_STEPS} steps"
        elif (size := abs(complex(value[2], value[3]))) < IN_AIR_N_PER_M:
            status, of_poles = ContactStatus.NO_CONTACT, PolesStatus.MODEL_ERROR
            message = f"nothing is touched: {size:.2g} N/m, tissue has more than {IN_AIR_N_PER_M:g}"
        elif special.chdtrc(dof, squares) < CONTRADICTED:
            status, of_poles = ContactStatus.CONTRADICTED, PolesStatus.MODEL_ERROR
            worst = int(np.argmax(np.abs(residual[-3:])))
            message = (
                f"residuals contradict the calibration: {squares:.0f}, {dof} expected (sensor changed, "
                "something else on the tip, or a tissue unlike the law)"
            )
            if abs(residual[-3 + worst]) > 4:
                message += f"; {self.prior.expected[worst]} beyond what any tissue has"
        at = np.array([complex(value[0], value[1])])
        f0_hz, damping = natural_frequency_and_damping(at)
        turn = natural_frequency_and_damping_jacobian(at)[0]
        channels = sensor.gain * np.exp(-at * sensor.delay_s)  # of G; residues of the model are without
        found = Poles(
            poles_rad_s=at,
            f0_hz=f0_hz,
            damping_ratio=damping,
            residues=channels * sensor.residues(at, self.prior.stiffness(p)),
            covariance=(turn @ noise[:2, :2] @ turn.T)[None],
            total_covariance=(turn @ with_sensor[:2, :2] @ turn.T)[None],
            pole_covariance=noise[None, :2, :2],
            band_hz=(float(self.record.frequency_hz[0]), float(self.record.frequency_hz[-1])),
            lines=int(np.count_nonzero(self._excited)),
            cost=squares,
            expected_cost=float(dof),
            variance_model="flat",
            method=f"calibrated sensor, {self.prior.law.value}",
            status=of_poles,
            message=message,
        )
        return TissueContact(
            prior=self.prior,
            parameters=p,
            total_covariance=total,
            stiffness_n_per_m=complex(value[2], value[3]),
            stiffness_covariance=noise[2:, 2:],
            stiffness_total=with_sensor[2:, 2:],
            poles=found,
            status=status,
        )


def calibrated_poles(
    frf: FRF,
    bands: Sequence[PoleBand],
    estimator: CalibratedEstimator,
    force_n: float = float("nan"),
    force_std_n: float = 0.0,
    method: str = "auto",
) -> Poles:
    """Poles in all bands, those of the first one through the calibrated sensor.

    The records begin at rest. Where something stands against it the poles are those of `poles_of_bands`, and
    the message says what.

    Parameters
    ----------
    frf : FRF
        With the bins of the bands.
    bands : sequence of PoleBand
        One or more.
    estimator : CalibratedEstimator
    force_n, force_std_n : float
        Of the contact; NaN: unknown.
    method : str
        Of the black-box fit.
    """
    reason, found = _impossible(frf), None
    if not reason:
        assert frf.bins is not None  # see `_impossible`
        try:
            found = estimator(ContactRecord.of_bins(frf.bins), force_n, force_std_n)
        except np.linalg.LinAlgError:  # its parameters ran away: no contact explains such a record
            reason = "the fit through it does not converge: the data contradict the calibration"
    if found is not None and abs(found.stiffness_n_per_m) < IN_AIR_N_PER_M:
        # a pole in air is to show whether the sensor is as calibrated, so that it must not be taken from it
        reason = "nothing is touched"
    elif found is not None and found.status is ContactStatus.OK:
        further = poles_of_bands(frf, bands, method).further if len(bands) > 1 else ()
        return replace(found.poles, further=further)
    elif found is not None:
        reason = found.poles.message
    note = f"without the calibrated sensor: {reason}"
    return poles_of_bands(frf, bands, method).noting(note)


def _impossible(frf: FRF) -> str:
    """Why there can be no calibrated estimate; empty where there can."""
    bins = frf.bins
    if frf.status is FrfStatus.FAILED or bins is None:
        return "the FRF brings no bins"
    if bins.u.shape[0] > 1:
        return f"{bins.u.shape[0]} realisations, of which one alone begins at rest"
    if bins.harmonics.size < FEWEST_LINES:
        return f"the band holds {bins.harmonics.size} excited lines, {FEWEST_LINES} are needed"
    lines = frf.frequency_hz.size
    held = sum(each.harmonics.size for each in (bins, *frf.further_bins))
    if held < lines:
        return f"{lines - held} excited lines lie outside of the bands"
    if frf.further_bins:
        return "lines of further bands are excited"
    known = np.isfinite(bins.u).all() and np.isfinite(bins.y).all()
    return "" if known else "bins are missing"
