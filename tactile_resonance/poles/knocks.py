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

    At each instant two directions, ``exp(-s t) / A`` and s times that, less what the terms of the transients
    take up of them; what the cost falls by along both has an F test of 2 degrees of freedom.
    """
    exact = not fit.noise_variance[0] > ROUNDED * np.mean(np.abs(y) ** 2)
    # a further transient would leave no noise
    few = plan.others_at.size < 2 * plan.problem.sizes[2]
    if exact or few or fit.status() not in FOUND or len(plan.knocks_s) == MOST_KNOCKS:
        return None
    model = fit.fit
    theta = np.concatenate([model.denominator[:-1], model.numerator, model.transient])
    data = BinData.of(y[None, None], u[None, None], plan.order, plan.others_at.size)
    at = Linearised.of(plan.problem, with_noise(plan, data, theta[None, None])[0], theta)
    root, s = 1 / np.sqrt(at.variance), plan.x[plan.order]
    weight = root / (plan.problem.denominator @ model.denominator)
    terms = np.ascontiguousarray((plan.problem.transient * weight[:, None]).T)  # (c, K)
    own = np.ascontiguousarray(np.linalg.qr(terms.view(float).T)[0].T).view(complex)
    rings = weight * np.stack([s**0, s])
    rings /= np.linalg.norm(rings, axis=-1, keepdims=True)
    residual = at.error[0] * root
    residual = residual - (own.conj() @ residual).real @ own
    size = scipy.fft.next_fast_len(FINER * plan.bins.size)
    products = np.zeros((2, 1 + len(own), size), complex)
    products[..., plan.bins[plan.order] % size] = rings.conj()[:, None] * np.vstack([residual, own])
    products = scipy.fft.ifft(products, norm="forward").real  # (2, 1 + c, instants)
    score, crossed = products[:, 0], products[:, 1:]
    # what the transients leave of the two directions, 2 x 2 at each instant
    whole = (rings.conj() @ rings.T).real
    p, r = np.diagonal(whole)[:, None] - np.sum(crossed**2, axis=1)
    both = whole[0, 1] - np.sum(crossed[0] * crossed[1], axis=0)
    along = r * score[0] ** 2 - 2 * both * score[0] * score[1] + p * score[1] ** 2
    left = p * r - both**2
    fall = np.where(left > LEAST_LEFT, along / left, 0.0)
    best, dof = int(np.argmax(fall)), plan.bins.size - theta.size / 2
    share = min(fall[best] / np.sum(np.abs(residual) ** 2), 1.0)
    if size * np.exp((dof - 1) * np.log1p(-share)) > FALSE_ALARM:
        return None
    return float(best / (size * plan.resolution_hz))
