# SPDX-License-Identifier: Apache-2.0
"""A contact as a known sensor sees it: the law of its stiffness, what is expected of it, and Hertz's moduli.

A small vibration about a Hertz contact sees the flat punch of its radius a, ``2 a E*(s) / (1 - nu^2)``, and
waves that carry energy away, ``2 rho c_s pi a^2 s + 1.257 rho a^3 s^2`` (cone of Lysmer and Wolf, nu -> 1/2),
with ``c_s^2 = |E*| / (2 (1 + nu) rho)``. The modulus over a band is that of a standard linear solid, or a power
law. One band determines two or three of the four parameters; for the others there are priors, wide enough for
gel and brain alike: how far the modulus rises over the band, where, and how much it has relaxed when Hertz's
law makes the radius of the force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
import scipy  # its parts are loaded where they are used first: scipy.optimize takes a node 0.15 s

from tactile_resonance._typing import FloatArray
from tactile_resonance.calibration.model import ContactStiffness
from tactile_resonance.poles.result import Poles

POISSON_RATIO, DENSITY_KG_PER_M3 = 0.49, 1050.0
LOG_RELAXED, LOG_RELAXED_STD = 0.5, 0.5
"""Logarithm of the modulus in the band over that under the force for a second; each thrice in the radius."""
LOG_RADIUS_STD = 0.5
"""Of the contact radius where no force is known."""
STRICT_HERTZ = 0.4
"""Contact over ball radius up to which Hertz's force is within 7 % of a rigid sphere's (Sneddon 1965)."""
_SMALL = 1e-6
_TIMES_S = 1 / (2 * np.pi * np.geomspace(5.0, 1e5, 9))


class Law(str, Enum):
    """Of the modulus over frequency."""

    STANDARD_LINEAR_SOLID = "standard linear solid"
    POWER_LAW = "power law"


@dataclass(frozen=True)
class ContactPrior:
    """What is known of a contact before it is measured.

    Attributes
    ----------
    law : Law
    tip_radius_m : float
    frequency_hz : float
        Of the mode: where the law's time constant is expected, and to which a power law refers.
    force_n, force_std_n : float
        NaN where unknown.
    """

    law: Law
    tip_radius_m: float
    frequency_hz: float
    force_n: float = float("nan")
    force_std_n: float = 0.0

    @property
    def expected(self) -> tuple[str, str, str]:
        """What there are expectations of, in the order of `deviations`."""
        if self.law is Law.POWER_LAW:
            return ("exponent", "contact radius", "radiation")
        return ("rise of the modulus", "time constant", "contact radius")

    @property
    def start(self) -> FloatArray:
        """(4,) parameters from which a fit begins, for a stiffness of 50 N/m."""
        log_radius = np.log(0.4 * self.tip_radius_m)
        log_modulus = np.log(50 * (1 - POISSON_RATIO**2) / 2) - log_radius
        if self.law is Law.POWER_LAW:
            return np.array([log_modulus, 0.2, log_radius, 0.0])
        return np.array([log_modulus, -0.5, -np.log(2 * np.pi * self.frequency_hz), log_radius])

    def deviations(self, p: FloatArray) -> FloatArray:
        """(..., 3) of parameters (..., 4) from what is expected, in standard deviations."""
        radius = p[..., 2 if self.law is Law.POWER_LAW else 3]
        expected, std = np.log(0.4 * self.tip_radius_m), LOG_RADIUS_STD
        if np.isfinite(self.force_n):
            # Hertz: a^3 = 3 F R (1 - nu^2) / (4 E), E relaxed
            of_force = 0.75 * self.force_n * self.tip_radius_m * (1 - POISSON_RATIO**2)
            expected = (np.log(of_force) - p[..., 0] + LOG_RELAXED) / 3
            std = np.hypot(LOG_RELAXED_STD, self.force_std_n / self.force_n) / 3
        of_radius = (radius - expected) / std
        if self.law is Law.POWER_LAW:
            # what a power law leaves, the radiated part takes up
            return np.stack([(p[..., 1] - 0.2) / 0.3, of_radius, p[..., 3] / 0.5], axis=-1)
        time = p[..., 2] + np.log(2 * np.pi * self.frequency_hz)
        return np.stack([(p[..., 1] + 0.5) / 1.5, time / 1.0, of_radius], axis=-1)

    def stiffness(self, p: FloatArray) -> ContactStiffness:
        """Of parameters (..., 4)."""
        if self.law is Law.POWER_LAW:
            modulus, radius = np.exp(p[..., 0]), np.exp(p[..., 2])
            elastic, relaxing = _power(np.clip(p[..., 1], 0.01, 0.9))
            scale, louder = 2 * radius / (1 - POISSON_RATIO**2) * modulus, np.exp(p[..., 3])
            # of s / (2 pi 250 rad/s): brought to the mode
            shift = (250.0 / self.frequency_hz) ** np.clip(p[..., 1], 0.01, 0.9)
            damping, mass = _radiated(modulus, radius)
            return ContactStiffness(
                scale * shift * elastic,
                (scale * shift)[..., None] * relaxing,
                _TIMES_S,
                damping * louder,
                mass,
            )
        modulus, rise = np.exp(p[..., 0]), np.exp(np.minimum(p[..., 0] + p[..., 1], 40.0))
        radius = np.exp(p[..., 3])
        scale = 2 * radius / (1 - POISSON_RATIO**2)
        damping, mass = _radiated(modulus + rise / 2, radius)
        time = np.exp(p[..., 2:3])
        return ContactStiffness(scale * modulus, (scale * rise)[..., None], time, damping, mass)


def _radiated(modulus: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Damping [N s/m] and mass [kg]."""
    speed = np.sqrt(modulus / (2 * (1 + POISSON_RATIO) * DENSITY_KG_PER_M3))
    damping = 2 * DENSITY_KG_PER_M3 * speed * np.pi * radius**2
    return damping, 1.257 * DENSITY_KG_PER_M3 * radius**3


def _power(exponent: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(...) and (..., J) of ``(s / (2 pi 250 Hz))^exponent`` in relaxations: between tabulated exponents."""
    grid, table = _power_table()
    at = np.asarray(exponent)
    k = np.clip(np.searchsorted(grid, at) - 1, 0, grid.size - 2)
    share = ((at - grid[k]) / (grid[k + 1] - grid[k]))[..., None]
    found = (1 - share) * table[k] + share * table[k + 1]
    return found[..., 0], found[..., 1:]


@lru_cache(maxsize=1)
def _power_table() -> tuple[FloatArray, FloatArray]:
    """Exponents (n,), and weights (n, 1 + J) of 1 and of each relaxation, from 20 Hz to 20 kHz."""
    s = 2j * np.pi * np.geomspace(20, 2e4, 80)[:, None]
    basis = np.concatenate([np.ones(s.shape), s * _TIMES_S / (1 + s * _TIMES_S)], axis=1)
    grid = np.linspace(0.01, 0.9, 90)
    rows = []
    for exponent in grid:
        # of modulus 1 at 250 Hz
        wanted = (s[:, 0] / (2 * np.pi * 250)) ** exponent
        weight = 1 / np.abs(wanted)
        a, b = basis * weight[:, None], wanted * weight
        real = np.concatenate([a.real, a.imag]), np.concatenate([b.real, b.imag])
        rows.append(scipy.optimize.nnls(*real, maxiter=1000)[0])
    return grid, np.array(rows)


class ContactStatus(str, Enum):
    """Whether a contact's stiffness can be relied on."""

    OK = "ok"
    CONTRADICTED = "contradicts the calibration"
    NOT_CONVERGED = "not converged"
    NO_CONTACT = "nothing is touched"
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
    total_covariance : (4, 4) float
        Of these: from noise and prior, and of the calibration.
    stiffness_n_per_m : complex
        k* at the mode.
    stiffness_covariance, stiffness_total : (2, 2) float
        Of its real and imaginary part.
    poles : Poles
        The mode of the band, as other estimators give it; cost and expected cost are the weighted squares of
        residuals and priors, and their degrees of freedom.
    status : ContactStatus
    """

    prior: ContactPrior
    parameters: FloatArray
    total_covariance: FloatArray
    stiffness_n_per_m: complex
    stiffness_covariance: FloatArray
    stiffness_total: FloatArray
    poles: Poles
    status: ContactStatus


@dataclass(frozen=True)
class Moduli:
    """What a stiffness says of the tissue, by Hertz's contact.

    Attributes
    ----------
    storage_pa, storage_std_pa, loss_pa, loss_std_pa : float
        Of the modulus at the mode, radiation taken off.
    contact_radius_m : float
    radius_ratio : float
        Over the ball's. All six are NaN where there is no radius, or one above the ball's.
    status : ContactStatus
        OK, BEYOND_HERTZ where the radius is too large for Hertz's law, NO_FORCE where there is no radius, else
        that of the contact.
    message : str
    """

    status: ContactStatus
    message: str
    storage_pa: float = float("nan")
    storage_std_pa: float = float("nan")
    loss_pa: float = float("nan")
    loss_std_pa: float = float("nan")
    contact_radius_m: float = float("nan")
    radius_ratio: float = float("nan")


def moduli(estimate: TissueContact, relaxed_ratio: float = 1.0) -> Moduli:
    """Storage and loss modulus at the mode, the contact radius taken from force and stiffness.

    Parameters
    ----------
    estimate : TissueContact
    relaxed_ratio : float
        Storage modulus at the mode over the modulus under the held force, which made the contact's area: 1 of
        an elastic body. Brain: about 4; gelatine: 1.4. The moduli go as one over its root.

    Notes
    -----
    ``k' = 2 a E' / (1 - nu^2)`` and ``a^3 = 3 F R (1 - nu^2) / (4 E' / ratio)`` give
    ``E' = (1 - nu^2) sqrt(k'^3 / (6 F R ratio))``.
    """
    prior, radius_of_tip = estimate.prior, estimate.prior.tip_radius_m
    if estimate.status is ContactStatus.NO_CONTACT:
        return Moduli(estimate.status, "nothing is touched, hence no modulus")
    if not np.isfinite(prior.force_n):
        why = "no force, hence no contact radius and no modulus"
        return Moduli(ContactStatus.NO_FORCE, why)
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
    relative = prior.force_std_n / prior.force_n / 2
    std = np.sqrt(np.diag(covariance) + (relative * found) ** 2)
    plane = found[0] / relaxed_ratio / (1 - POISSON_RATIO**2)
    radius = float((0.75 * prior.force_n * radius_of_tip / plane) ** (1 / 3))
    ratio = radius / radius_of_tip
    if not ratio <= 1:
        why = f"contact radius {ratio:.3g} of the ball's, which no ball has, hence no modulus"
        return Moduli(ContactStatus.BEYOND_HERTZ, why)
    status, message = estimate.status, ""
    if status is not ContactStatus.OK:
        message = f"of a stiffness that is itself no result: {status.value}"
    elif not ratio <= STRICT_HERTZ:
        status = ContactStatus.BEYOND_HERTZ
        message = f"contact radius {ratio:.2f} of the ball's, strict Hertz reaches {STRICT_HERTZ:g}"
    (storage, loss), (storage_std, loss_std) = found.tolist(), std.tolist()
    return Moduli(status, message, storage, storage_std, loss, loss_std, radius, ratio)


def slope_of(function: Callable[[FloatArray], FloatArray], p: FloatArray) -> FloatArray:
    """(..., 4) central differences of a function of (..., 4) parameters at one point."""
    steps = _SMALL * np.eye(p.size)
    return np.asarray((function(p + steps) - function(p - steps)).T / (2 * _SMALL))
