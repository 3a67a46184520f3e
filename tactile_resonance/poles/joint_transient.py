# SPDX-License-Identifier: Apache-2.0
"""The numerator of the transient in the DFT of a whole record."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tactile_resonance.poles.basis import PolynomialBasis
from tactile_resonance.poles.structure import ModelStructure

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]


def default_transient_terms(structure: ModelStructure) -> int:
    """Length of the transient's numerator that suits a structure.

    A transient of the model's own poles alone has `order` terms; every residual term beyond the
    constant stands for modes outside the band, whose transients are as smooth as their responses.
    Several modes have two more at least, for they need not lie where `transient_basis` takes them.
    """
    residual = min(structure.numerator_order - structure.order, 4)
    return structure.order + max(residual, 2 if structure.order > 2 else 0)


def transient_basis(
    frequency_hz: FloatArray,
    terms: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    structure: ModelStructure,
) -> ComplexArray:
    """(K, terms) basis of the transient's numerator.

    Samples of ``exp(p t)`` have the spectrum ``T / (1 - exp((p - s) T))``, aliases of ``1 / (s -
    p)`` included: for n poles a polynomial of order n - 1 in 1/z over ``A(z)``, and ``A(s) / A(z)``
    hardly depends on the poles. It is taken at pairs +-j w spread evenly over the band, one for each
    two poles, and at 0 for a last single one.
    """
    interval_s = 1 / sample_rate_hz
    s = 2j * np.pi * frequency_hz
    basis = PolynomialBasis.on_lines(np.exp(-s * interval_s), terms - 1).values
    if structure.domain == "z":
        return basis * np.exp(s * interval_s * structure.order)[:, None]
    pairs = structure.order // 2
    low, high = band_hz
    w = 2 * np.pi * (low + (high - low) * (np.arange(pairs) + 0.5) / max(pairs, 1))
    factor = np.ones(s.shape, complex)
    for pole in (*(1j * w), *(-1j * w), *[0.0] * (structure.order % 2)):
        step = (s - pole) * interval_s
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = -step / np.expm1(-step)
        factor *= np.where(np.abs(step) < 1e-12, 1.0, ratio)
    return basis * factor[:, None]
