# SPDX-License-Identifier: Apache-2.0
"""Poles and transient together, from all bins of the band of a whole record.

The DFT of P periods from any initial state is exactly ``Y = (B U + C) / A`` on every bin, excited
or not: the transient is a numerator C over the denominator of the system. Estimating C costs two
parameters a mode where removing the transient beforehand costs a quarter of the information
(Pintelon & Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed. (2012),
sections 6.3.2 and 9.12). The bins between harmonics bring the level of the noise on both channels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy.fft

from tactile_resonance.poles.joint_fit import JointFit, fit_bins
from tactile_resonance.poles.joint_layout import JointLayout
from tactile_resonance.poles.judgement import Evidence, assemble
from tactile_resonance.poles.lines_fit import LinesFit
from tactile_resonance.poles.result import PolesBatch

ComplexArray = npt.NDArray[np.complex128]

METHOD = "joint maximum likelihood of poles and transient"


class JointPlan(JointLayout):
    """Poles from records of one kind; parameters are those of `JointLayout`.

    Examples
    --------
    >>> plan = JointPlan(50e3, 20000, 8, np.arange(4, 4001), (200.0, 300.0))
    >>> poles = plan(u, y)  # u, y: (..., 8, 20000)
    """

    def __call__(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> PolesBatch:
        """Poles of records.

        Parameters
        ----------
        u, y : (..., P, N) float
            Actuator and sensor: P consecutive periods of N samples.

        Returns
        -------
        PolesBatch
            With the leading axes of the records.

        Raises
        ------
        ValueError
            If the shapes do not fit the plan.
        """
        return self.from_bins(*(self.transform(x, name) for x, name in ((u, "u"), (y, "y"))))

    def transform(self, samples: npt.NDArray[np.floating], name: str = "samples") -> ComplexArray:
        """(..., K) bins of the band of records (..., P, N), scaled by 1 / (P N)."""
        samples = np.asarray(samples)
        if samples.dtype.kind not in "iuf":
            raise ValueError(f"{name}: values of type {samples.dtype}, expected real numbers")
        shape = (self.periods, self.samples_per_period)
        if samples.shape[-2:] != shape:
            raise ValueError(
                f"{name}: shape {samples.shape}, expected (..., {shape[0]}, {shape[1]})"
            )
        record = samples.reshape(*samples.shape[:-2], shape[0] * shape[1])
        spectrum = scipy.fft.rfft(record, axis=-1)[..., self.bins[0] : self.bins[-1] + 1]
        with np.errstate(invalid="ignore", over="ignore"):  # the status tells of such samples
            return np.asarray(spectrum / record.shape[-1], dtype=complex)

    def from_bins(self, u: ComplexArray, y: ComplexArray) -> PolesBatch:
        """Poles from the bins of the band of the DFT of whole records.

        Parameters
        ----------
        u, y : (..., K) complex
            At ``bins``.
        """
        u, y = self._checked(u, y)
        shape = y.shape[:-1]
        flat_u, flat_y = u.reshape(-1, self.bins.size), y.reshape(-1, self.bins.size)
        return result_of(self, fit_bins(self, flat_u, flat_y), shape, METHOD, self.level_known)

    def _checked(self, u: ComplexArray, y: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Bins of both channels, of one shape (..., K)."""
        u, y = (np.asarray(values, complex) for values in (u, y))
        for name, values in (("u", u), ("y", y)):
            if values.shape[-1:] != self.bins.shape:
                raise ValueError(
                    f"{name}: shape {values.shape}, expected (..., {self.bins.size}) bins"
                )
        if u.shape == y.shape:
            return u, y
        try:
            shape = np.broadcast_shapes(u.shape[:-1], y.shape[:-1])
        except ValueError:
            raise ValueError(
                f"y: shape {y.shape}, expected leading axes like those of u, {u.shape}"
            ) from None
        whole = (*shape, self.bins.size)
        return np.broadcast_to(u, whole), np.broadcast_to(y, whole)


def result_of(
    layout: JointLayout, fit: JointFit, shape: tuple[int, ...], method: str, level_known: bool
) -> PolesBatch:
    """What a batch of fits is worth.

    Parameters
    ----------
    layout : JointLayout
    fit : JointFit
    shape : tuple of int
        Leading axes, of as many points as the batch has.
    method : str
    level_known : bool
        Whether the level of the noise is told by more than the residuals.
    """
    lines_fit = LinesFit(
        layout.model_of(fit.theta),
        fit.cost,
        fit.covariance,
        fit.condition,
        fit.converged,
        fit.residual,
    )
    evidence = Evidence(
        lines_fit,
        np.where(fit.usable, layout.excited_bins.size, 0),
        fit.usable,
        fit.cost,
        fit.expected,
        fit.suspect,
        fit.covariance,
        fit.total,
        fit.kind,
        level_known,
        fit.noise,
        fit.lacking,
    )
    if evidence.suspect.any():
        known = np.isfinite(fit.total)
        evidence = evidence.with_model_error(np.where(known, fit.total, fit.covariance))
    result = assemble(evidence, layout.structure, layout.band_hz, shape, method)
    if fit.systematic.any():
        total = result.total_covariance
        total += fit.systematic.reshape(total.shape)
    return replace(result, remark=fit.remark.reshape(shape))
