# SPDX-License-Identifier: Apache-2.0
"""One point of a batch for people: its zeros, its modes that are no noise, the sentence that says so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.poles.modes import real_covariance
from tactile_resonance.poles.result import Poles, PolesBatch, PolesStatus
from tactile_resonance.poles.whiteness import SMOOTH_RESIDUAL


def single(batch: PolesBatch, index: tuple[int, ...] = (), notes: Sequence[str] = ()) -> Poles:
    """One point of a batch, with the zeros and the sentence a batch leaves out.

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
    n = batch.structure.order
    zeros = np.empty(0, complex)
    if status is not PolesStatus.TOO_FEW_LINES and np.isfinite(model.numerator).all():
        zeros = model.zeros_rad_s()
    known = bool(np.isfinite(coefficients).all()) and poles.size > 0
    residue = zero = None
    if known:
        with np.errstate(all="ignore"):
            residue = real_covariance(model.residue_sensitivity(poles), coefficients)
            m = model.numerator.size
            zero = real_covariance(
                model.zero_sensitivity(zeros), coefficients[n : n + m, n : n + m]
            )

    real = batch.significant[index][there]
    left_out = [
        f"what the fit took for a mode at {abs(pole) / (2 * np.pi):.4g} Hz is no more than "
        "noise makes"
        for pole in poles[~real]
    ]
    notes = [*left_out, *notes]
    there[there] = real
    poles = poles[real]
    residue = residue[real] if residue is not None and real.any() else None

    def optional(array: FloatArray) -> FloatArray | None:
        values = array[index][there]
        return values if values.size and np.isfinite(values).all() else None

    said = [_sentence(batch, index, status), str(batch.remark[index]), *notes]
    message = "; ".join(filter(None, said))
    return Poles(
        poles_rad_s=poles,
        f0_hz=batch.f0_hz[index][there],
        damping_ratio=batch.damping_ratio[index][there],
        residues=batch.residues[index][there],
        covariance=optional(batch.covariance),
        total_covariance=optional(batch.total_covariance),
        pole_covariance=optional(batch.pole_covariance),
        residue_covariance=residue,
        zeros_rad_s=zeros,
        zero_covariance=zero,
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
