# SPDX-License-Identifier: Apache-2.0
"""Even and odd nonlinear distortion at the harmonics that an odd multisine leaves out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy import special

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.frf.result import BandDistortion
from tactile_resonance.frf.spectra import PeriodicSpectra, Spectrum, error_variance, mean_spectra
from tactile_resonance.multisine import Grid

DETECTING = (Grid.ODD, Grid.ODD_RANDOM)
"""Grids that leave lines out between those excited: what stands there is distortion."""

FALSE_ALARM = 0.01
"""Probability that noise alone passes for distortion."""


@dataclass(frozen=True, eq=False)
class DetectionLines:
    """What stands at the harmonics of one parity that are not excited.

    Arrays have shape (..., M, L) for M realisations and L lines. Outside the excited band the
    response is not known, hence no correction for the input's own distortion: NaN.

    Attributes
    ----------
    harmonics : (L,) int
    frequency_hz : (L,) float
    output, input : complex
        Mean spectra Y and U [V].
    corrected : complex
        ``Y - G U``: the output without what the input's own distortion causes linearly.
    corrected_variance : float
        Its noise variance; NaN for single periods.
    linear_output_power, excited_input_power : (..., L) float
        Power of output and input at the excited lines around, averaged over realisations: what the
        levels refer to. NaN outside the excited band.
    noise_dof : float
        Degrees of freedom of the variances of one realisation; no more than there are bins between
        harmonics for each line, where lines share these.
    """

    harmonics: IntArray
    frequency_hz: FloatArray
    output: ComplexArray
    input: ComplexArray
    corrected: ComplexArray
    corrected_variance: FloatArray
    linear_output_power: FloatArray
    excited_input_power: FloatArray
    noise_dof: float

    @property
    def in_band(self) -> BoolArray:
        """(L,) lines inside the excited band."""
        return np.all(np.isfinite(self.corrected), axis=tuple(range(self.corrected.ndim - 1)))

    @property
    def power(self) -> FloatArray:
        """(..., L) corrected output power over realisations; distortion and noise together."""
        return np.mean(np.abs(self.corrected) ** 2, axis=-2)

    @property
    def noise_power(self) -> FloatArray:
        """(..., L) noise in `power`; NaN where unknown."""
        return np.mean(self.corrected_variance, axis=-2)

    @property
    def level_db(self) -> FloatArray:
        """(..., L) `power` against the linear output around [dB]; holds the noise too."""
        return decibel(self.power / self.linear_output_power)

    @property
    def rms_level_db(self) -> FloatArray:
        """(...) mean power per in-band line against the mean linear power per line there [dB]."""
        return _rms_ratio_db(self.power, self.linear_output_power, self.in_band)

    @property
    def rms_output_level_db(self) -> FloatArray:
        """(...) the same without correction for the input's own distortion."""
        power = np.mean(np.abs(self.output) ** 2, axis=-2)
        return _rms_ratio_db(power, self.linear_output_power, self.in_band)

    @property
    def rms_noise_level_db(self) -> FloatArray:
        """(...) the same for noise; NaN where unknown."""
        return _rms_ratio_db(self.noise_power, self.linear_output_power, self.in_band)

    @property
    def rms_input_level_db(self) -> FloatArray:
        """(...) the same for the input against its excited lines [dB]."""
        power = np.mean(np.abs(self.input) ** 2, axis=-2)
        return _rms_ratio_db(power, self.excited_input_power, self.in_band)

    @property
    def above_noise(self) -> BoolArray | None:
        """(...) True where the in-band lines hold more than noise, at `FALSE_ALARM`.

        None where it cannot be estimated: single periods, or no line of this parity.

        Notes
        -----
        Of noise alone, of whatever size, the share of the mean in the power of all periods of a line is
        Beta(1, dof) distributed and independent of that power. Of the sum over lines, given these powers, mean
        and variance are known, whether lines are alike or not; its distribution is taken for that Beta which
        has them.
        """
        inside, dof = self.in_band, self.noise_dof
        noise = self.corrected_variance[..., inside]
        if noise.size == 0 or np.any(np.isnan(noise)):
            return None
        noise = dof * noise
        both = np.abs(self.corrected[..., inside]) ** 2 + noise  # (..., M, L)
        whole = both.sum(axis=(-2, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = noise.sum(axis=(-2, -1)) / whole
            shapes = (dof + 2) * whole**2 / np.sum(both**2, axis=(-2, -1)) - 1  # the sum of both shapes
            chance = special.betainc(shapes * dof / (1 + dof), shapes / (1 + dof), rest)
        return np.asarray(chance < FALSE_ALARM)


@dataclass(frozen=True, eq=False)
class Distortion:
    """Nonlinear distortion of a system driven by an odd multisine.

    Attributes
    ----------
    frequency_hz : (F,) float
    output : (..., M, F) complex
        Mean spectra at the excited lines [V].
    even, odd : DetectionLines
        `odd` has no lines for a grid that excites every odd harmonic.
    """

    frequency_hz: FloatArray
    output: ComplexArray
    even: DetectionLines
    odd: DetectionLines

    def summary(self) -> str:
        """A sentence per parity, for people; the worst of all batches."""
        return " ".join(
            _sentence(name, lines) for name, lines in (("even", self.even), ("odd", self.odd))
        )


def estimate_distortion(
    record: Spectrum,
    *,
    sample_rate_hz: float,
    harmonics: npt.ArrayLike,
    method: str = "local polynomial",
) -> Distortion:
    """Even and odd distortion at the lines of the excited band that are not excited.

    Parameters
    ----------
    record : Spectrum
        Of (..., M) realisations.
    sample_rate_hz, harmonics, method
        See `estimate.frf_of_record`.

    Raises
    ------
    ValueError
        If an even line is excited or none is left out.
    """
    excited = np.asarray(harmonics, np.int64)
    spectra = spectra_between(record, excited, excited, method=method)
    return nonlinear_distortion(spectra, excited, sample_rate_hz=sample_rate_hz)


def spectra_between(
    record: Spectrum, lines: IntArray, excited: IntArray, *, method: str = "average"
) -> PeriodicSpectra:
    """Mean spectra at all harmonics from the first to the last of some lines, without what drift puts there.

    While a contact creeps the amplitude of each excited line rises or falls steadily. Within a period that
    is a ramp, the same in all periods: it stands at all harmonics around, as distortion would. Means over
    periods are rid of the ramps that belong to the linear trend of each excited line from period to period;
    of one period the trend is not known. Local polynomials count the trend as noise.

    Parameters
    ----------
    record : Spectrum
    lines : (L,) int
        Ascending.
    excited : (F,) int
        All lines that are excited.
    method : str
        See `estimate.frf_of_record`.

    Notes
    -----
    A line of frequency k that grows by D per period has D / (N (exp(2j pi d / N) - 1)), about
    D / (2j pi d), at harmonic k + d. The trends are as uncertain as white noise of the level found makes them,
    which adds up to a quarter to the variance of two periods, and a tenth to that of three.
    """
    band = np.arange(lines[0], lines[-1] + 1)
    spectra = mean_spectra(record, band, method=method)
    used, n = spectra.periods, record.samples_per_period
    if "local polynomial" in spectra.method or spectra.covariance is None:
        return spectra
    time = np.arange(used) - (used - 1) / 2
    steps = np.sum(time**2)
    trend = np.zeros((*spectra.spectra.shape[:-1], n // 2 + 1), complex)
    trend[..., excited] = time @ record.by_period[..., -used:, excited] / steps
    ramp = (np.arange(n) - (n - 1) / 2) / n
    growing = scipy.fft.irfft(trend, n, norm="forward") * ramp  # (..., 2, N)
    distance = band[:, None] - excited  # (H, F)
    with np.errstate(divide="ignore"):
        leakage = np.where(distance == 0, 0.0, 0.25 / (n * np.sin(np.pi * distance / n)) ** 2).sum(axis=-1)
    return replace(
        spectra,
        spectra=spectra.spectra - scipy.fft.rfft(growing, norm="forward")[..., band],
        covariance=spectra.covariance * (1 + used / steps * leakage),
    )


def nonlinear_distortion(
    spectra: PeriodicSpectra, excited_harmonics: npt.ArrayLike, *, sample_rate_hz: float
) -> Distortion:
    """Even and odd distortion from spectra at excited and detection lines.

    A nonlinearity of even degree sends the energy of odd lines to even lines, one of odd degree to
    odd lines; the lines left out show either. What reaches the output only because the input is
    itself distorted is subtracted, ``Y - G U``, with the response G of each realisation
    interpolated linearly between the excited lines.

    Parameters
    ----------
    spectra : PeriodicSpectra
        At all harmonics of interest, excited or not, (..., M, 2, H): from
        `averaged_spectra` in steady state or `transient_free_spectra` (which
        leaves harmonics alone when it estimates noise).
    excited_harmonics : (F,) int
        Odd harmonics, part of `spectra.harmonics`.
    sample_rate_hz : float

    Raises
    ------
    ValueError
        If an even harmonic is excited (its mixing products do not keep to a parity), or there is no
        detection line.

    Notes
    -----
    The variances of the corrected output hold the noise of Y and U at the detection line; that of
    G, times the small U there, is neglected.

    References
    ----------
    Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
    chapter 4 (fast method, detection lines, correction for the input).
    """
    if spectra.spectra.ndim < 3:
        raise ValueError(
            f"spectra: shape {spectra.spectra.shape}, expected (..., M, 2, H) with realisations M"
        )
    excited = spectra.at(excited_harmonics)
    if np.any(excited.harmonics % 2 == 0):
        raise ValueError(
            "excited_harmonics: even ones are among them, expected an odd or odd random grid: only "
            "there even and odd distortion fall on different lines"
        )
    detection = np.setdiff1d(spectra.harmonics, excited.harmonics)
    if detection.size == 0:
        raise ValueError(
            "spectra: only excited harmonics, expected those between them too: they show the "
            "distortion"
        )
    return Distortion(
        frequency_hz=excited.frequency_hz(sample_rate_hz),
        output=excited.spectra[..., 0, :],
        even=_detection_lines(spectra.at(detection[detection % 2 == 0]), excited, sample_rate_hz),
        odd=_detection_lines(spectra.at(detection[detection % 2 == 1]), excited, sample_rate_hz),
    )


def distortion_in_band(
    spectra: PeriodicSpectra,
    excited_harmonics: npt.ArrayLike,
    band_hz: tuple[float, float],
    *,
    sample_rate_hz: float,
) -> BandDistortion:
    """Levels of even and odd distortion at the detection lines of one band.

    Of single periods those of the output are NaN: a transient stands there like distortion.

    Parameters
    ----------
    spectra : PeriodicSpectra
        (M, 2, H), from the first to the last excited harmonic of the band.
    excited_harmonics : (F,) int
        Of the band.
    band_hz : (low, high)
    sample_rate_hz : float
    """
    found = nonlinear_distortion(spectra, excited_harmonics, sample_rate_hz=sample_rate_hz)
    values: dict[str, Any] = {}
    for name, lines in (("even", found.even), ("odd", found.odd)):
        values[f"{name}_db"] = np.nan if spectra.covariance is None else float(lines.rms_level_db)
        values[f"{name}_noise_db"] = float(lines.rms_noise_level_db)
        values[f"{name}_above_noise"] = bool(lines.above_noise)
        values[f"input_{name}_db"] = float(lines.rms_input_level_db)
    return BandDistortion(*band_hz, **values)


def _detection_lines(
    lines: PeriodicSpectra, excited: PeriodicSpectra, sample_rate_hz: float
) -> DetectionLines:
    y, u = lines.spectra[..., 0, :], lines.spectra[..., 1, :]  # (..., M, L)
    y_excited, u_excited = excited.spectra[..., 0, :], excited.spectra[..., 1, :]  # (..., M, F)

    def at_lines(values: npt.NDArray) -> npt.NDArray:
        """(..., L) linear interpolation of (..., F); NaN outside the excited band."""
        return np.apply_along_axis(
            lambda row: np.interp(lines.harmonics, excited.harmonics, row, np.nan, np.nan), -1, values
        )

    g = at_lines(y_excited / u_excited)  # (..., M, L)
    own_bins = (lines.periods - 1) * np.diff(lines.harmonics).mean() if y.shape[-1] > 1 else np.inf
    return DetectionLines(
        harmonics=lines.harmonics,
        frequency_hz=lines.frequency_hz(sample_rate_hz),
        output=y,
        input=u,
        corrected=y - g * u,
        corrected_variance=np.full(g.shape, np.nan)
        if lines.covariance is None
        else error_variance(g, lines.covariance),
        linear_output_power=at_lines(np.mean(np.abs(y_excited) ** 2, axis=-2)),
        excited_input_power=at_lines(np.mean(np.abs(u_excited) ** 2, axis=-2)),
        noise_dof=min(lines.noise_dof, own_bins),
    )


def _sentence(name: str, lines: DetectionLines) -> str:
    if not np.any(lines.in_band):
        return f"No {name} detection lines in the excited band."
    raw, level = (float(np.max(x)) for x in (lines.rms_output_level_db, lines.rms_level_db))
    text = (
        f"{name.capitalize()} lines: output {raw:.1f} dB against the linear output (rms), "
        f"{level:.1f} dB corrected for the input's own distortion"
    )
    noise = float(np.max(lines.rms_noise_level_db))
    if np.isnan(noise):
        return text + "; noise level unknown (single periods)."
    text += f"; noise {noise:.1f} dB"
    return text + ("." if np.any(lines.above_noise) else ": nothing above noise.")


def decibel(power_ratio: npt.ArrayLike) -> FloatArray:
    """10 lg of a power or a ratio of powers; minus infinity for 0, NaN for what rounding made negative."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return 10 * np.log10(np.asarray(power_ratio, float))


def _rms_ratio_db(power: FloatArray, reference: FloatArray, inside: BoolArray) -> FloatArray:
    if not np.any(inside):
        return np.full(power.shape[:-1], np.nan)
    return decibel(power[..., inside].mean(axis=-1) / reference[..., inside].mean(axis=-1))
