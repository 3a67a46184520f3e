# SPDX-License-Identifier: Apache-2.0
"""A contact as a known sensor sees it: its stiffness, and what Hertz's law makes of that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.calibration.law import (
    POISSON_RATIO,
    STRICT_HERTZ,
    ContactPrior,
    ContactStiffness,
)
from tactile_resonance.poles.result import Poles

_SMALL = 1e-6


class ContactStatus(str, Enum):
    """Whether a contact's stiffness can be relied on."""

    OK = "ok"
    CONTRADICTED = "contradicts the calibration"
    NOT_CONVERGED = "not converged"
    BEYOND_HERTZ = "beyond strict Hertz"
    NO_FORCE = "no force"


@dataclass(frozen=True, eq=False)
class TissueContact:
    """A contact, and the pole that follows from it.

    Attributes
    ----------
    prior : ContactPrior
    parameters : (4,) float
        Of the law.
    covariance, total_covariance : (4, 4) float
        Of these: from noise and prior, and with the calibration's own.
    stiffness_n_per_m : complex
        k* at the mode.
    stiffness_covariance, stiffness_total : (2, 2) float
        Of its real and imaginary part.
    poles : Poles
        The mode of the band, as other estimators give it.
    chi_square : float
        Weighted squares of residuals and priors.
    degrees_of_freedom : int
    noise_v_per_root_hz : float
        That was taken.
    residual : (K,) complex
        Over its standard deviation.
    status : ContactStatus
    message : str
    """

    prior: ContactPrior
    parameters: FloatArray
    covariance: FloatArray
    total_covariance: FloatArray
    stiffness_n_per_m: complex
    stiffness_covariance: FloatArray
    stiffness_total: FloatArray
    poles: Poles
    chi_square: float
    degrees_of_freedom: int
    noise_v_per_root_hz: float
    residual: ComplexArray
    status: ContactStatus
    message: str = ""

    @property
    def contact(self) -> ContactStiffness:
        """k*(s)."""
        return self.prior.stiffness(self.parameters)


@dataclass(frozen=True)
class Moduli:
    """What a stiffness says of the tissue, by Hertz's contact.

    Attributes
    ----------
    storage_pa, loss_pa : float
        Of the modulus at the mode, radiation taken off.
    storage_std_pa, loss_std_pa : float
    contact_radius_m : float
    radius_ratio : float
        Over the ball's.
    status : ContactStatus
        OK, BEYOND_HERTZ where the radius is too large for Hertz's law, NO_FORCE where there is no radius.
    message : str
    """

    storage_pa: float
    loss_pa: float
    storage_std_pa: float
    loss_std_pa: float
    contact_radius_m: float
    radius_ratio: float
    status: ContactStatus
    message: str


def moduli(
    estimate: TissueContact, relaxed_ratio: float = 1.0, relaxed_ratio_std: float = 0.0
) -> Moduli:
    """Storage and loss modulus at the mode, the contact radius taken from force and stiffness.

    Parameters
    ----------
    estimate : TissueContact
    relaxed_ratio, relaxed_ratio_std : float
        Storage modulus at the mode over the modulus under the held force, which made the contact's area: 1 of
        an elastic body. Brain: about 4; gelatine: 1.4. The moduli go as one over its root.

    Notes
    -----
    ``k' = 2 a E' / (1 - nu^2)`` and ``a^3 = 3 F R (1 - nu^2) / (4 E' / ratio)`` give
    ``E' = (1 - nu^2) sqrt(k'^3 / (6 F R ratio))``.
    """
    prior, radius_of_tip = estimate.prior, estimate.prior.tip_radius_m
    nan = float("nan")
    if not np.isfinite(prior.force_n):
        status, why = ContactStatus.NO_FORCE, "no force, hence no contact radius and no modulus"
        return Moduli(nan, nan, nan, nan, nan, nan, status, why)
    frequency_hz = float(estimate.poles.f0_hz[0])
    s = 2j * np.pi * frequency_hz

    def parts(p: FloatArray) -> FloatArray:
        contact = prior.stiffness(p)
        k = contact.at(np.full((*p.shape[:-1], 1), s))[..., 0]
        k = k - contact.viscous_ns_per_m * s - contact.mass_kg * s**2
        scale = (1 - POISSON_RATIO**2) * np.sqrt(
            k.real / (6 * prior.force_n * radius_of_tip * relaxed_ratio)
        )
        return np.stack([scale * k.real, scale * k.imag], axis=-1)

    found, slope = parts(estimate.parameters), slope_of(parts, estimate.parameters)
    covariance = slope @ estimate.total_covariance @ slope.T
    relative = np.hypot(prior.force_std_n / prior.force_n, relaxed_ratio_std / relaxed_ratio) / 2
    std = np.sqrt(np.diag(covariance) + (relative * found) ** 2)
    plane = found[0] / relaxed_ratio / (1 - POISSON_RATIO**2)
    radius = float((0.75 * prior.force_n * radius_of_tip / plane) ** (1 / 3))
    ratio = radius / radius_of_tip
    status = ContactStatus.OK if ratio <= STRICT_HERTZ else ContactStatus.BEYOND_HERTZ
    message = (
        ""
        if ratio <= STRICT_HERTZ
        else (f"contact radius {ratio:.2f} of the ball's, strict Hertz reaches {STRICT_HERTZ:g}")
    )
    return Moduli(
        float(found[0]),
        float(found[1]),
        float(std[0]),
        float(std[1]),
        radius,
        ratio,
        status,
        message,
    )


def slope_of(function: Callable[[FloatArray], FloatArray], p: FloatArray) -> FloatArray:
    """(..., 4) central differences of a function of (..., 4) parameters at one point."""
    steps = _SMALL * np.eye(p.size)
    return np.asarray((function(p + steps) - function(p - steps)).T / (2 * _SMALL))
