# SPDX-License-Identifier: Apache-2.0
"""What a fitted test says of the tissue."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.mechanics.prony import Prony


class Known(str, Enum):
    """Whether a record determines a constant, or why not."""

    DETERMINED = "determined"
    FASTER = "not determined: faster than the ramp"
    SLOWER = "not determined: slower than the hold"
    UNCERTAIN = "not determined: too uncertain"


@dataclass(frozen=True)
class Term:
    """One term of the series.

    Attributes
    ----------
    modulus_pa, time_s : float
    modulus_std, time_std : float
        Relative standard deviations, of the logarithms.
    known : Known
        Of both.
    """

    modulus_pa: float
    time_s: float
    modulus_std: float
    time_std: float
    known: Known


@dataclass(frozen=True, eq=False)
class Fit:
    """What a test says of the tissue.

    Attributes
    ----------
    terms : tuple of Term
        By time.
    equilibrium_pa, equilibrium_std : float
        Einf and its relative deviation.
    equilibrium_known : Known
    surface_m, surface_std_m : float
        Depth of the robot at which the ball touches.
    zero_n, zero_drift_n_per_s : float
        Of the force.
    covariance : (2 n + 1, 2 n + 1) array
        From noise alone, of the logarithms of Einf, E_1.., tau_1..; in the order of `terms`.
    beyond : Prony or None
        The series with one term more; None where it was not found.
    chi_square, dof : float, int
        Of the means, by the noise of the forces: expected chi_square / dof is 1. Where it is more the
        covariance is larger by that.
    bic : tuple of float
        Of one term, two and so on, for comparison: the number of terms is that of an F test, at 5 %.
    begin_s, ramp_s, hold_s : float
        First touch, and durations.
    peak_force_n, relaxed_share : float
        Largest force, and the share of it that is gone at the end of the hold, by the model without noise.
    time_s, force_n, indentation_m : (N,) arrays
        The model at the means: force less its zero, and depth of the ball.
    measured_n, measured_std_n : (N,) arrays
        The means, less the zero.
    contact_ratio : float
        Largest contact radius over that of the ball.
    sphere_share, layer_share : float
        What Hertz's force leaves out, as in `course`: a sphere's over a paraboloid's, a layer's over a
        half-space's (NaN: thickness unknown).
    status : tuple of str
        What limits the result, for people; empty: nothing.
    """

    terms: tuple[Term, ...]
    equilibrium_pa: float
    equilibrium_std: float
    equilibrium_known: Known
    surface_m: float
    surface_std_m: float
    zero_n: float
    zero_drift_n_per_s: float
    covariance: FloatArray
    beyond: Prony | None
    chi_square: float
    dof: int
    bic: tuple[float, ...]
    begin_s: float
    ramp_s: float
    hold_s: float
    peak_force_n: float
    relaxed_share: float
    time_s: FloatArray
    force_n: FloatArray
    indentation_m: FloatArray
    measured_n: FloatArray
    measured_std_n: FloatArray
    contact_ratio: float
    sphere_share: float
    layer_share: float
    status: tuple[str, ...]

    @property
    def prony(self) -> Prony:
        """The series, terms that are not determined included: for interpolation within the record."""
        moduli, times = zip(*((t.modulus_pa, t.time_s) for t in self.terms), strict=True)
        return Prony(self.equilibrium_pa, np.array(moduli), np.array(times))

    def modulus(self, time_s: float) -> tuple[float, float]:
        """E(t) [Pa] at one time after a step and its relative deviation; NaN outside of ramp and hold."""
        if not self.ramp_s <= time_s <= self.hold_s:
            return np.nan, np.nan
        series = self.prony
        value = float(series.relaxation_modulus(time_s))
        decays = np.exp(-time_s / series.times_s)
        slope = np.concatenate(
            [
                [series.equilibrium_pa],
                series.moduli_pa * decays,
                series.moduli_pa * decays * time_s / series.times_s,
            ]
        )
        std = float(np.sqrt(slope @ self.covariance @ slope)) / value
        moved = 0.0
        if self.beyond is not None:
            moved = float(np.log(self.beyond.relaxation_modulus(time_s) / value))
        return value, math.hypot(std, moved)
