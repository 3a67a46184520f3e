# SPDX-License-Identifier: Apache-2.0
"""A knock of the table or the robot: the mode begins to ring at an instant of the record.

What rings freely from an instant t on has the spectrum ``exp(-s t) C / A``: that of a transient, turned. Near
the start of a record the terms of the transient follow that in part, with another mode; later on it passes
for noise. So the instant is searched for in what a fit leaves, by a matched filter, and a second transient
from there on is fitted too (`JointPlan.knocks_s`).
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy import special

from tactile_resonance._typing import ComplexArray
from tactile_resonance.poles.data import BinData, with_noise
from tactile_resonance.poles.fit import Linearised
from tactile_resonance.poles.joint import JointPlan
from tactile_resonance.poles.noise_level import ROUNDED
from tactile_resonance.poles.result import PolesBatch, PolesStatus

# How often noise passes for a knock, and how many are fitted at most: more are noise that comes and goes.
FALSE_ALARM = 1e-5
MOST_KNOCKS = 3
# Instants tried, per inverse of the bandwidth. Terms of a transient follow what lies between.
FINER = 4
# Part of the square of a direction that a fit must leave for it to be tried.
LEAST_LEFT = 1e-3
# A knock near the end looks like a mode that grows.
FOUND = (
    *(PolesStatus.OK, PolesStatus.MODEL_ERROR),
    *(PolesStatus.NO_RESONANCE, PolesStatus.UNSTABLE_POLE),
)


@np.errstate(all="ignore")
def instant_of_knock(
    plan: JointPlan, u: ComplexArray, y: ComplexArray, fit: PolesBatch
) -> float | None:
    """Instant [s] from which on more rings than noise makes, in what the fit (shape ()) to bins (K,) leaves.

    At each instant as many directions as the model has poles, ``exp(-s t) s^k / A``, less what the terms of
    the transients take up of them; what the cost falls by along all has an F test of as many degrees.
    """
    exact = not fit.noise_variance[0] > ROUNDED * np.mean(np.abs(y) ** 2)
    # a further transient would leave no noise
    few = plan.others_at.size < 2 * plan.problem.sizes[2]
    if exact or few or fit.status() not in FOUND or len(plan.knocks_s) == MOST_KNOCKS:
        return None
    at = linearised_at(plan, u, y, fit)
    root, s = 1 / np.sqrt(at.variance), plan.x[plan.order]
    weight = root / (plan.problem.denominator @ fit.fit.denominator)
    terms = (plan.problem.transient * weight[:, None]).T  # (c, K)
    poles = plan.structure.order
    own, rings = orthonormal(terms), orthonormal(weight * s ** np.arange(poles)[:, None])
    residual = at.error[0] * root
    residual = residual - (own.conj() @ residual).real @ own
    size = scipy.fft.next_fast_len(FINER * plan.bins.size)
    products = np.zeros((poles, 1 + len(own), size), complex)
    products[..., plan.bins[plan.order] % size] = rings.conj()[:, None] * np.vstack([residual, own])
    products = scipy.fft.ifft(products, norm="forward").real
    score, crossed = products[:, 0], products[:, 1:]  # (poles, instants), (poles, c, instants)
    left = np.eye(poles)[..., None] - np.einsum("pci,qci->pqi", crossed, crossed)
    fall, determinant = np.zeros(size), np.ones(size)
    for k in range(poles):  # Gauss elimination, at all instants together
        factor = left[k + 1 :, k] / left[k, k]
        fall += score[k] ** 2 / left[k, k]
        determinant *= left[k, k]
        score[k + 1 :] -= factor * score[k]
        left[k + 1 :, k + 1 :] -= factor[:, None] * left[k, k + 1 :]
    fall[~(determinant > LEAST_LEFT ** (poles / 2))] = 0.0
    best, dof = int(np.argmax(fall)), plan.bins.size - at.variance_slope.shape[1] / 2
    share = min(fall[best] / np.sum(np.abs(residual) ** 2), 1.0)
    if not size * special.betainc(dof - poles / 2, poles / 2, 1 - share) <= FALSE_ALARM:
        return None
    return float(best / (size * plan.resolution_hz))


def linearised_at(plan: JointPlan, u: ComplexArray, y: ComplexArray, fit: PolesBatch) -> Linearised:
    """Errors of bins (K,) at a fit to them of shape (), with the variances of the noise that they show."""
    model = fit.fit
    theta = np.concatenate([model.denominator[:-1], model.numerator, model.transient])
    data = BinData.of(y[None, None], u[None, None], plan.order, plan.others_at.size)
    return Linearised.of(plan.problem, with_noise(plan, data, theta[None, None])[0], theta)


def orthonormal(rows: ComplexArray) -> ComplexArray:
    """Rows (c, K) that span the same with real factors, the real part of each product 0, of each square 1."""
    parts = np.ascontiguousarray(rows).view(float)
    return np.ascontiguousarray(np.linalg.qr(parts.T)[0].T).view(complex)
