# SPDX-License-Identifier: Apache-2.0
"""What an identification holds: of one point, with a sentence for people, or of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray, IntArray
from tactile_resonance.poles.structure import ModelStructure

if TYPE_CHECKING:  # compiled, which nodes that only pass poles on need not wait for
    from tactile_resonance.poles.model import RationalModel

# Of the variance of a delay by what is not known of other coefficients: beyond it, its deviation means little.
MOST_INFLATION = 100.0


class PolesStatus(Enum):
    """Whether poles can be relied on."""

    OK = "ok"
    MODEL_ERROR = "model error"
    NOT_CONVERGED = "not converged"
    TOO_FEW_LINES = "too few lines"
    ILL_CONDITIONED = "ill conditioned"
    UNSTABLE_POLE = "unstable pole"
    NO_COVARIANCE = "no covariance"
    NO_RESONANCE = "no resonance"
    FAILED = "failed"
    TRUTH = "truth"


@dataclass(frozen=True, eq=False)
class MainMode:
    """The mode that is meant where one is asked for: see `Poles.main`.

    Attributes
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio; NaN where no pole was found.
    covariance, noise : (2, 2) float
        Of the estimate: of `Poles.best_covariance`, and from noise alone; NaN where unknown.
    pole_rad_s : complex
        With positive imaginary part.
    drift, drift_std : (2,) float
        What f0 [Hz/s] and damping ratio [1/s] change by, and its deviation; NaN where no change shows.
    """

    estimate: FloatArray
    covariance: FloatArray
    noise: FloatArray
    pole_rad_s: complex
    drift: FloatArray
    drift_std: FloatArray

    @property
    def f0_hz(self) -> float:
        """Undamped natural frequency."""
        return float(self.estimate[0])

    @property
    def damping_ratio(self) -> float:
        """Damping ratio."""
        return float(self.estimate[1])

    @property
    def std(self) -> FloatArray:
        """(2,) standard deviations of f0 [Hz] and damping ratio; NaN where unknown."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def found(self) -> bool:
        """Whether there is a pole."""
        return bool(np.isfinite(self.estimate[0]))


@dataclass(frozen=True)
class Poles:
    """Poles of the identified model, one entry per complex pair inside the band.

    Attributes
    ----------
    poles_rad_s : (n,) complex
        Pole of each pair with positive imaginary part [rad/s].
    f0_hz : (n,) float
        Undamped natural frequency ``|pole| / 2 pi``.
    damping_ratio : (n,) float
        ``-Re(pole) / |pole|``.
    residues : (n,) complex
        Residue of G at each pole [rad/s], a delay of the model included.
    covariance : (n, 2, 2) float or None
        Of (f0_hz, damping_ratio), from noise.
    total_covariance : (n, 2, 2) float or None
        From noise, distortion and model error, where they can be estimated.
    pole_covariance : (n, 2, 2) float or None
        Of (Re, Im) of each pole [rad^2/s^2], from noise.
    coefficient_covariance : (p, p) float or None
        Of the free coefficients of ``fit``, as in `PolesBatch`.
    f0_drift_hz_per_s, damping_drift_per_s : (n,) float or None
        What f0 and damping ratio change by over a record, of which poles are then the means: the slope
        of the straight line nearest to the change. None where nothing shows that they do.
    drift_covariance : (n, 2, 2) float or None
        Of these two.
    instant_s : float or None
        When, from the start of the record, poles that change are about those given; None of others.
    structure : ModelStructure
    band_hz : (float, float)
    lines : int
        Lines used.
    cost, expected_cost : float
        Weighted squared residuals, and their expectation if there were nothing but noise; NaN where
        the variance is unknown.
    whiteness : float
        How much smoother the residuals are than those of noise, as a normal score: see
        `significance.whiteness`. NaN where it was not computed.
    condition_number : float
        Of the column-scaled Jacobian, to within a factor of the number of parameters; NaN where
        there is none.
    variance_model : str
        What was assumed of the variance over the lines: flat, sloped, or per line.
    fit : RationalModel or None
        The model itself; ``fit.response(frequency_hz)`` is its frequency response.
    method : str
    status : PolesStatus
    message : str
        A sentence for people.
    further : tuple of Poles
        Of a measurement of several bands, those of the second and so on; all else is of the first.
    """

    poles_rad_s: ComplexArray = field(default_factory=lambda: np.empty(0, complex))
    f0_hz: FloatArray = field(default_factory=lambda: np.empty(0))
    damping_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    residues: ComplexArray = field(default_factory=lambda: np.empty(0, complex))
    covariance: FloatArray | None = None
    total_covariance: FloatArray | None = None
    pole_covariance: FloatArray | None = None
    coefficient_covariance: FloatArray | None = None
    f0_drift_hz_per_s: FloatArray | None = None
    damping_drift_per_s: FloatArray | None = None
    drift_covariance: FloatArray | None = None
    instant_s: float | None = None
    structure: ModelStructure = field(default_factory=ModelStructure)
    band_hz: tuple[float, float] = (float("nan"), float("nan"))
    lines: int = 0
    cost: float = float("nan")
    expected_cost: float = float("nan")
    whiteness: float = float("nan")
    condition_number: float = float("nan")
    variance_model: str = ""
    fit: RationalModel | None = None
    method: str = ""
    status: PolesStatus = PolesStatus.FAILED
    message: str = ""
    further: tuple[Poles, ...] = ()

    @property
    def bands(self) -> tuple[Poles, ...]:
        """Of each band, the first being these."""
        return (self, *self.further)

    @property
    def residue_covariance(self) -> FloatArray | None:
        """(n, 2, 2) of (Re, Im) of each residue [rad^2/s^2], from noise; None where unknown."""
        if self.fit is None or self.coefficient_covariance is None or not self.f0_hz.size:
            return None
        with np.errstate(all="ignore"):
            return self.fit.residue_covariance(self.poles_rad_s, self.coefficient_covariance)

    @property
    def zeros_rad_s(self) -> ComplexArray:
        """(k,) all zeros of the model [rad/s]; those far outside the band mean nothing."""
        if self.fit is None or not np.isfinite(self.fit.numerator).all():
            return np.empty(0, complex)
        return self.fit.zeros_rad_s()

    @property
    def zero_covariance(self) -> FloatArray | None:
        """(k, 2, 2) of (Re, Im) of each zero [rad^2/s^2], from noise; None where unknown."""
        if self.fit is None or self.coefficient_covariance is None:
            return None
        with np.errstate(all="ignore"):
            return self.fit.zero_covariance(self.zeros_rad_s, self.coefficient_covariance)

    def noting(self, *notes: str) -> Poles:
        """Return these poles with notes added to the message; empty notes are left out."""
        return replace(self, message="; ".join(filter(None, [self.message, *notes])))

    @property
    def best_covariance(self) -> FloatArray:
        """(n, 2, 2) of (f0_hz, damping_ratio): in total where known, else from noise; NaN where neither is."""
        best = np.full((self.f0_hz.size, 2, 2), np.nan)
        for known in (self.covariance, self.total_covariance):
            if known is not None:
                finite = np.all(np.isfinite(known), axis=(1, 2))
                best[finite] = known[finite]
        return best

    @property
    def main(self) -> MainMode:
        """The mode with the highest peak, ``|residue| / |Re pole|``; all NaN where no pole was found."""
        nothing, unknown = np.full(2, np.nan), np.full((2, 2), np.nan)
        if not self.f0_hz.size:
            return MainMode(nothing, unknown, unknown, complex("nan+nanj"), nothing, nothing)
        with np.errstate(divide="ignore"):  # a mode without damping
            k = int(np.argmax(np.abs(self.residues) / np.abs(self.poles_rad_s.real)))
        drift, drift_std = nothing, nothing
        f0_drift, damping_drift = self.f0_drift_hz_per_s, self.damping_drift_per_s
        if f0_drift is not None and damping_drift is not None and self.drift_covariance is not None:
            drift = np.array([f0_drift[k], damping_drift[k]])
            drift_std = np.sqrt(np.diag(self.drift_covariance[k]))
        return MainMode(
            estimate=np.array([self.f0_hz[k], self.damping_ratio[k]]),
            covariance=self.best_covariance[k],
            noise=unknown if self.covariance is None else self.covariance[k],
            pole_rad_s=complex(self.poles_rad_s[k]),
            drift=drift,
            drift_std=drift_std,
        )


STATUSES = tuple(PolesStatus)
STATUS_CODE = {status: code for code, status in enumerate(STATUSES)}


@dataclass(frozen=True, eq=False)
class PolesBatch:
    """Poles of many points, as arrays with the points' axes (...) leading.

    Every point has ``structure.order // 2`` places for modes inside the band, by natural frequency;
    places without a mode hold NaN. NaN in a covariance means that it could not be estimated.

    Attributes
    ----------
    poles_rad_s, residues : (..., n) complex
    f0_hz, damping_ratio : (..., n) float
    covariance, total_covariance, pole_covariance : (..., n, 2, 2) float
        As in `Poles`; the total one is NaN where nothing but noise is known.
    coefficient_covariance : (..., p, p) float
        Of the free coefficients of ``fit``: denominator, numerator, transient (from noise); without
        the transients where these are of several records.
    cost, expected_cost, condition_number : (...) float
    residual : (..., F) complex
        Weighted residuals on the (excited) lines; 0 on those left out. Those of spectra are turned
        by the phase of the input, to be as smooth as an error of the response.
    lines : (...) int
    significant : (..., n) bool
        Modes that noise alone would not make (one in ten thousand); the status speaks of these. Those
        whose covariance is not known count.
    status_code : (...) uint8
        Index into `STATUSES`.
    noise_variance : (..., 2) float
        Estimated variance of a bin of Y and of U [V^2]; NaN where the data brought their own.
    lacking : (..., 3) float
        Chi-square of what the model lacks, how many parameters that has, and f0 [Hz] of the mode it is,
        NaN for residual terms; all NaN where a test finds nothing, or was not made.
    fit : RationalModel
        Its coefficients have the same leading axes.
    structure : ModelStructure
    band_hz : (float, float)
    variance_model : (...) str array
    method : str
    remark : (...) object array of str
        A further note for people; empty: none.
    """

    poles_rad_s: ComplexArray
    f0_hz: FloatArray
    damping_ratio: FloatArray
    residues: ComplexArray
    covariance: FloatArray
    total_covariance: FloatArray
    pole_covariance: FloatArray
    coefficient_covariance: FloatArray
    cost: FloatArray
    expected_cost: FloatArray
    condition_number: FloatArray
    residual: ComplexArray
    lines: IntArray
    significant: BoolArray
    status_code: npt.NDArray[np.uint8]
    noise_variance: FloatArray
    lacking: FloatArray
    fit: RationalModel
    structure: ModelStructure
    band_hz: tuple[float, float]
    variance_model: npt.NDArray[np.str_]
    method: str
    remark: npt.NDArray[np.object_]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the batch."""
        return self.cost.shape

    @property
    def whiteness(self) -> FloatArray:
        """(...) how much smoother the residuals are than white ones; see `significance.whiteness`."""
        from tactile_resonance.poles.significance import whiteness  # compiled, too

        return whiteness(self.residual, self.structure.parameters)

    def has_status(self, status: PolesStatus) -> BoolArray:
        """(...) which points have a status."""
        return self.status_code == STATUS_CODE[status]

    def status(self, index: tuple[int, ...] | int = ()) -> PolesStatus:
        """Status of one point."""
        return STATUSES[int(self.status_code[index])]


def single(batch: PolesBatch, index: tuple[int, ...] = (), notes: Sequence[str] = ()) -> Poles:
    """One point of a batch, with the sentence a batch leaves out.

    Parameters
    ----------
    batch : PolesBatch
    index : tuple of int
        Into its leading axes.
    notes : sequence of str
        Added to the message.
    """
    model = batch.fit.at(index)
    status = batch.status(index)
    there = np.isfinite(batch.poles_rad_s[index])
    poles = batch.poles_rad_s[index][there]
    coefficients = batch.coefficient_covariance[index]
    real = batch.significant[index][there]
    left_out = [
        f"what the fit took for a mode at {abs(pole) / (2 * np.pi):.4g} Hz is no more than "
        "noise makes"
        for pole in poles[~real]
    ]
    there[there] = real
    terms = batch.structure.numerator_order - batch.structure.order + 1
    from_what = f"{terms} residual terms" if terms > 1 else "the numerator"
    not_told = f"the delay is not told from {from_what}: its own value and deviation mean little"
    untold = batch.structure.delay and there.any() and (terms > 1 or _inflation(coefficients) > MOST_INFLATION)
    of_delay = [not_told] if untold else []
    notes = [*left_out, *of_delay, *notes]

    def optional(array: FloatArray) -> FloatArray | None:
        values = array[index][there]
        return values if values.size and np.isfinite(values).all() else None

    said = [_sentence(batch, index, status), *notes, str(batch.remark[index])]
    message = "; ".join(filter(None, said))
    return Poles(
        poles_rad_s=poles[real],
        f0_hz=batch.f0_hz[index][there],
        damping_ratio=batch.damping_ratio[index][there],
        residues=batch.residues[index][there],
        covariance=optional(batch.covariance),
        total_covariance=optional(batch.total_covariance),
        pole_covariance=optional(batch.pole_covariance),
        coefficient_covariance=coefficients if np.isfinite(coefficients).all() else None,
        structure=batch.structure,
        band_hz=batch.band_hz,
        lines=int(batch.lines[index]),
        cost=float(batch.cost[index]),
        expected_cost=float(batch.expected_cost[index]),
        whiteness=float(batch.whiteness[index]),
        condition_number=float(batch.condition_number[index]),
        variance_model=str(batch.variance_model[index]),
        fit=None if status is PolesStatus.TOO_FEW_LINES else model,
        method=batch.method,
        status=status,
        message=message,
    )


def _inflation(covariance: FloatArray) -> float:
    """Variance of the last coefficient over what it would be if the others (n, n) were known; NaN: unknown."""
    if not np.isfinite(covariance).all():
        return float("nan")
    std = np.sqrt(np.diagonal(covariance))
    return float(np.linalg.pinv(covariance / np.outer(std, std), hermitian=True)[-1, -1])


def _sentence(batch: PolesBatch, index: tuple[int, ...], status: PolesStatus) -> str:
    if status is PolesStatus.OK:
        return ""
    low_hz, high_hz = batch.band_hz
    structure = batch.structure
    sentences = {
        PolesStatus.TOO_FEW_LINES: f"{int(batch.lines[index])} lines with finite values in "
        f"{low_hz:g}-{high_hz:g} Hz, "
        f"{structure.parameters} parameters need at least {structure.fewest_lines}",
        PolesStatus.NOT_CONVERGED: "the iterations found no minimum",
        PolesStatus.ILL_CONDITIONED: f"condition number {batch.condition_number[index]:.2g}: the "
        "lines do not determine the model",
        PolesStatus.NO_RESONANCE: f"no complex pole pair in {low_hz:g}-{high_hz:g} Hz",
        PolesStatus.UNSTABLE_POLE: "a pole in the right half plane: the sensor is passive, so the "
        "model is wrong",
        PolesStatus.NO_COVARIANCE: _without_covariance(batch, index),
        PolesStatus.MODEL_ERROR: f"{_contradiction(batch, index)}: the model leaves something out"
        + (", rely on the total covariance" if _has_total(batch, index) else ""),
    }
    return sentences.get(status, "")


def _has_total(batch: PolesBatch, index: tuple[int, ...]) -> bool:
    return bool(np.isfinite(batch.total_covariance[index]).any())


def _without_covariance(batch: PolesBatch, index: tuple[int, ...]) -> str:
    """Why there is none."""
    if np.isfinite(batch.cost[index]):
        if _has_total(batch, index):
            return "no line has a finite variance of the noise alone: the total covariance is known"
        return (
            "the variance of each line has too few degrees of freedom to estimate the uncertainty: "
            "record more periods or realisations"
        )
    if not _has_total(batch, index):
        return (
            "the fit leaves too few degrees of freedom to estimate the noise: take a wider band, more "
            "periods or a smaller order"
        )
    return (
        "the variance is not known independently of the fit: a model error would not show unless it "
        "is smooth"
    )


def _contradiction(batch: PolesBatch, index: tuple[int, ...]) -> str:
    """What noise alone would not make."""
    from tactile_resonance.poles.significance import SMOOTH_RESIDUAL  # compiled, too

    found = []
    chi_square, parameters, f0_hz = batch.lacking[index]
    if np.isfinite(chi_square):
        what = (
            f"one mode more near {f0_hz:.4g} Hz fits"
            if np.isfinite(f0_hz)
            else ("two residual terms more fit")
        )
        found.append(f"{what} better: chi-square {chi_square:.0f} for {parameters:.0f} parameters")
    if batch.cost[index] > batch.expected_cost[index]:
        found.append(
            f"cost {batch.cost[index]:.4g} where the variance explains "
            f"{batch.expected_cost[index]:.4g}"
        )
    if batch.whiteness[index] > SMOOTH_RESIDUAL:
        found.append(
            f"residuals smooth over the lines (whiteness {batch.whiteness[index]:.1f} where "
            f"noise makes {SMOOTH_RESIDUAL} at most)"
        )
    return ", ".join(found) or "realisations contradict each other"


def natural_frequency_and_damping(pole: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """f0 [Hz] and damping ratio of poles [rad/s], elementwise."""
    magnitude = np.abs(pole)
    with np.errstate(divide="ignore", invalid="ignore"):
        return magnitude / (2 * np.pi), -pole.real / magnitude


def natural_frequency_and_damping_jacobian(pole: ComplexArray) -> FloatArray:
    """(..., 2, 2) derivative of (f0_hz, damping_ratio) by (Re, Im) of the pole [rad/s]."""
    re, im, mag = pole.real, pole.imag, np.abs(pole)
    out = np.empty((*np.shape(pole), 2, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        out[..., 0, 0] = re / (2 * np.pi * mag)
        out[..., 0, 1] = im / (2 * np.pi * mag)
        out[..., 1, 0] = -(im**2) / mag**3
        out[..., 1, 1] = re * im / mag**3
    return out


def ellipse(covariance: FloatArray, points: int, probability: float) -> FloatArray:
    """(..., 2, points) about 0, that holds a Gaussian error of covariance (..., 2, 2) with a probability."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0, 2 * np.pi, points)
    circle = ellipse_radius(probability) * np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(vectors @ (np.sqrt(np.maximum(values, 0))[..., None] * circle))


def ellipse_radius(probability: float) -> float:
    """Of such an ellipse, in standard deviations."""
    return float(np.sqrt(-2 * np.log1p(-probability)))  # chi-square, two degrees of freedom
