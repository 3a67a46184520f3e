# SPDX-License-Identifier: Apache-2.0
"""Poles referred to the force and the age of contact to which tissue classes refer.

A vibrating ball sees the tissue through its contact radius a, and on a linear viscoelastic half-space
a^3 = (3 R / 4 E*) F J(t) / J(t0) under a force F held for t (Hertz; Lee and Radok, J. Appl. Mech. 27 (1960)
438), J the creep compliance. Over the seconds of a measurement J goes as a power c of t, so that a contact of
age t has the poles of one of age t0 at the force F (t / t0)^c: one direction in the plane of f0 and damping
ratio serves force and age. Where the place is held instead of the force, F falls as t^-c and the poles stay, as
they do here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import AboveZero, Checked, NotNegative, require

NAN = float("nan")
_BEND = 1 / 3  # see `refer_to_nominal`
# A force without a deviation that is farther from the nominal one than so many of `unknown_force_std_n` is not
# one that these describe.
_CONTRADICTED = 5.0


@dataclass(frozen=True, eq=False)
class ForceSensitivity:
    """How f0 and damping ratio move with the contact force.

    Attributes
    ----------
    per_n : (2,) float
        d f0 / dF [Hz/N] and d (damping ratio) / dF [1/N].
    covariance : (2, 2) float
        Of `per_n`: uncertainty, and the difference between the tissues for which it is to serve.
    """

    per_n: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class ContactLoad:
    """Force on the tissue and age of contact, as they were measured.

    Attributes
    ----------
    force_n, force_std_n : float
        Mean over the blocks that were measured, and its standard deviation [N]; NaN where unknown.
    age_s : float
        From the first touch until the middle of the measurement [s]; NaN where unknown.
    """

    force_n: float = NAN
    force_std_n: float = NAN
    age_s: float = NAN


@dataclass(frozen=True, eq=False)
class NominalContact(Checked):
    """Force and age of contact to which tissue classes refer, and how poles change beside them.

    Attributes
    ----------
    force_n : float
        Nominal force [N].
    age_s : float
        Nominal age of contact, from the first touch [s].
    sensitivity : ForceSensitivity
        At the nominal force and age.
    creep, creep_std : float
        Power c of the age with which the creep compliance rises, and its standard deviation.
    force_scale_std : float
        Relative standard deviation of the force sensor's scale; 0 where classes were measured with the same
        sensor.
    unknown_force_std_n : float
        Standard deviation of the force about the nominal one where it was not measured [N]; NaN: unknown.
    unknown_age_factor : float
        The age is within this factor of the nominal one (one standard deviation) where it is unknown; NaN:
        unknown.
    """

    force_n: AboveZero
    age_s: AboveZero
    sensitivity: ForceSensitivity
    creep: float = 0.0
    creep_std: NotNegative = 0.0
    force_scale_std: NotNegative = 0.0
    unknown_force_std_n: float = NAN
    unknown_age_factor: float = NAN

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 <= self.creep < 1, "creep", self.creep, "0 or above, below 1")
        value = self.unknown_force_std_n
        require(not value <= 0, "unknown_force_std_n", value, "a number above 0")
        value = self.unknown_age_factor
        require(not value < 1, "unknown_age_factor", value, "a number of 1 or above")


@dataclass(frozen=True, eq=False)
class PoleForTissue:
    """What of a measured pole is compared with tissue classes.

    Attributes
    ----------
    compared : (2,) float
        f0 [Hz] and damping ratio with which classes are compared: the pole at the nominal force and age
        where `referred`, else the measured one; NaN where the force or the age is unknown and nothing states
        how far it may be off.
    covariance : (2, 2) float
        Of `compared`, for statements on tissue.
    referred : bool
        Whether `compared` is at the nominal force and age.
    note : str
        What was taken for granted, or is missing; empty where force and age were measured.
    """

    compared: FloatArray
    covariance: FloatArray
    referred: bool
    note: str = ""


def refer_to_nominal(
    estimate: npt.ArrayLike,
    covariance: npt.ArrayLike,
    contact: ContactLoad,
    nominal: NominalContact | None,
) -> PoleForTissue:
    """Pole at the nominal force and age of contact, with its covariance for tissue.

    Parameters
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio as measured.
    covariance : (2, 2) float
        Of the estimate, total where known.
    contact : ContactLoad
        Under which it was measured.
    nominal : NominalContact or None
        None: nothing is known of the sensitivity. The measured pole is then compared as it is, without a term
        for force and age, and the note says so.

    Notes
    -----
    With the sensitivity s of covariance S, and D the force that is equivalent to force and age, F (t / t0)^c,
    less the nominal force F0, of variance V::

        compared   = estimate - s D
        covariance = covariance of the estimate + s s' V + S (D^2 + V) + b^2 diag(1, 1 / f0^2)

    To V belong noise and scale of the force sensor and the uncertain c. The last term is what curvature may
    leave: b^2 is the mean of (|d pole / dF| D'^2 / (3 F0))^2 over the D' of mean D and variance V that may be,
    in any direction of the complex plane. A shift that goes as a power p
    of the force leaves (1 - p) / 2 of D^2 / F0 times its slope; stiffness goes with the contact radius,
    F^(1/3), radiated waves with its square and cube, so that p is 1/3 or more. A force that is unknown counts
    as the nominal one with the deviation `NominalContact.unknown_force_std_n`, an age likewise.
    """
    x, own = np.array(estimate, float), np.array(covariance, float)
    if nominal is None:
        note = "force and age of contact are not accounted for: no nominal_contact is given"
        return PoleForTissue(x, own, False, note)
    equivalent = _equivalent_force(contact, nominal)
    if isinstance(equivalent, str):
        return PoleForTissue(np.full(2, np.nan), np.full((2, 2), np.nan), False, equivalent)
    off_n, variance, note = equivalent
    per_n, uncertain = nominal.sensitivity.per_n, nominal.sensitivity.covariance
    total = own + np.outer(per_n, per_n) * variance + uncertain * (off_n**2 + variance)
    fourth = off_n**4 + 6 * off_n**2 * variance + 3 * variance**2  # of a Gaussian
    bend_hz = _BEND * np.hypot(per_n[0], x[0] * per_n[1]) * math.sqrt(fourth) / nominal.force_n
    total = total + np.diag([bend_hz, bend_hz / x[0]]) ** 2
    return PoleForTissue(x - per_n * off_n, total, True, note)


def _equivalent_force(
    contact: ContactLoad, nominal: NominalContact
) -> tuple[float, float, str] | str:
    """Equivalent less nominal force [N], its variance and a note; a sentence where it is unknown."""
    notes = []
    force_n, std_n = contact.force_n, contact.force_std_n
    if force_n <= 0:
        return f"the force is {1e3 * force_n:.3g} mN: the tip was not pressed on"
    if math.isfinite(force_n) and math.isfinite(std_n):
        variance = std_n**2 + (nominal.force_scale_std * force_n) ** 2
    else:
        told_n, (force_n, std_n) = force_n, (nominal.force_n, nominal.unknown_force_std_n)
        if math.isnan(std_n):
            return "the force is unknown, and nominal_contact has no unknown_force_std_n"
        if abs(told_n - force_n) > _CONTRADICTED * std_n:
            return (
                f"the force is {1e3 * told_n:.3g} mN, its standard deviation unknown, which "
                f"unknown_force_std_n of nominal_contact contradicts: {1e3 * force_n:g} +- {1e3 * std_n:g} mN"
            )
        variance = std_n**2
        notes.append(f"force unknown, taken as {1e3 * force_n:g} +- {1e3 * std_n:g} mN")
    log_age, log_age_std = 0.0, 0.0
    creeps = nominal.creep > 0 or nominal.creep_std > 0
    if contact.age_s > 0:
        log_age = math.log(contact.age_s / nominal.age_s)
    elif creeps and math.isnan(nominal.unknown_age_factor):
        return "the age of contact is unknown, and nominal_contact has no unknown_age_factor"
    elif creeps:
        factor = nominal.unknown_age_factor
        log_age_std = math.log(factor)
        notes.append(
            f"age of contact unknown, taken as {nominal.age_s:g} s within {factor:g} times"
        )
    grown = math.exp(nominal.creep * log_age)
    equivalent_n = force_n * grown
    off_n = equivalent_n - nominal.force_n
    creep2 = (log_age * nominal.creep_std) ** 2
    creep2 += (nominal.creep**2 + nominal.creep_std**2) * log_age_std**2
    return off_n, grown**2 * variance + equivalent_n**2 * creep2, "; ".join(notes)


def sensitivity_of_preloads(
    estimates: npt.ArrayLike,
    covariances: npt.ArrayLike,
    force_n: npt.ArrayLike,
    force_std_n: npt.ArrayLike,
) -> ForceSensitivity:
    """Sensitivity from two measurements at one place, under two forces and at the same age of contact.

    Choose the forces on either side of the nominal one: it is the slope of the chord between them.

    Parameters
    ----------
    estimates : (2, 2) float
        f0 [Hz] and damping ratio, a row for each force.
    covariances : (2, 2, 2) float
        Of each row.
    force_n, force_std_n : (2,) float
        Forces and their standard deviations, independent of each other [N].

    Raises
    ------
    ValueError
        If the forces are closer than five standard deviations of their difference: the slope would be of no
        use, and its stated covariance wrong.
    """
    x, c = np.asarray(estimates, float), np.asarray(covariances, float)
    force, std = np.asarray(force_n, float), np.asarray(force_std_n, float)
    apart_n, apart_std_n = float(force[1] - force[0]), float(np.hypot(*std))
    good = apart_n != 0 and abs(apart_n) >= 5 * apart_std_n
    accepted = f"forces apart by 5 x {apart_std_n:.2g} N or more, their standard deviation"
    require(good, "force_n", force.tolist(), accepted)
    per_n = (x[1] - x[0]) / apart_n
    covariance = (c.sum(axis=0) + np.outer(per_n, per_n) * apart_std_n**2) / apart_n**2
    return ForceSensitivity(per_n, covariance)
