# SPDX-License-Identifier: Apache-2.0
"""What an identification holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from tactile_resonance.identification.rational_fit import RationalFit
from tactile_resonance.identification.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


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
        Residue of G at each pole [rad/s].
    covariance : (n, 2, 2) float or None
        Of (f0_hz, damping_ratio), from noise.
    total_covariance : (n, 2, 2) float or None
        From noise, distortion and model error, where they can be told.
    pole_covariance : (n, 2, 2) float or None
        Of (Re, Im) of each pole [rad^2/s^2], from noise.
    structure : ModelStructure
    band_hz : (float, float)
    lines : int
        Lines used.
    cost, expected_cost : float
        Weighted squared residuals, and their expectation if there were nothing but noise; NaN where
        the variance is unknown.
    condition_number : float
        Of the column-scaled Jacobian; NaN where there is none.
    variance_model : str
        What was assumed of the variance over the lines: flat, sloped, or per line.
    fit : RationalFit or None
        The model itself; ``fit.response(frequency_hz)`` is its frequency response.
    method : str
    status : PolesStatus
    message : str
        A sentence for people.
    """

    poles_rad_s: ComplexArray = field(default_factory=lambda: np.empty(0, complex))
    f0_hz: FloatArray = field(default_factory=lambda: np.empty(0))
    damping_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    residues: ComplexArray = field(default_factory=lambda: np.empty(0, complex))
    covariance: FloatArray | None = None
    total_covariance: FloatArray | None = None
    pole_covariance: FloatArray | None = None
    structure: ModelStructure = field(default_factory=ModelStructure)
    band_hz: tuple[float, float] = (float("nan"), float("nan"))
    lines: int = 0
    cost: float = float("nan")
    expected_cost: float = float("nan")
    condition_number: float = float("nan")
    variance_model: str = ""
    fit: RationalFit | None = None
    method: str = ""
    status: PolesStatus = PolesStatus.FAILED
    message: str = ""


def natural_frequency_and_damping(pole: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """f0 [Hz] and damping ratio of poles [rad/s], elementwise."""
    magnitude = np.abs(pole)
    return magnitude / (2 * np.pi), -pole.real / magnitude


def natural_frequency_and_damping_jacobian(pole: ComplexArray) -> FloatArray:
    """(..., 2, 2) derivative of (f0_hz, damping_ratio) by (Re, Im) of the pole [rad/s]."""
    re, im, mag = pole.real, pole.imag, np.abs(pole)
    rows = [
        [re / (2 * np.pi * mag), im / (2 * np.pi * mag)],
        [-(im**2) / mag**3, re * im / mag**3],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
