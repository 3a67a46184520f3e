# SPDX-License-Identifier: Apache-2.0
"""Which rational model is fitted."""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_RESIDUAL_TERMS = 6


@dataclass(frozen=True)
class ModelStructure:
    """Orders of ``G(s) = B(s) / A(s)`` with real coefficients.

    A numerator of order ``order + r - 1`` is the same as ``order / 2`` modes and a residual polynomial
    ``c_0 + c_1 s + ... + c_{r-1} s^{r-1}`` for the modes outside the band (partial fractions).

    Attributes
    ----------
    order : int
        Of the denominator: two poles a mode.
    numerator_order : int

    Notes
    -----
    A bare second-order model (numerator order 2) over 200-300 Hz is biased by several standard deviations
    by the sensor's other modes; six residual terms (the default) bring the bias below half of one.
    """

    order: int = 2
    numerator_order: int = 2 + DEFAULT_RESIDUAL_TERMS - 1

    def __post_init__(self) -> None:
        if self.order < 1:
            raise ValueError(f"order: {self.order}, expected at least 1")
        if self.numerator_order < 0:
            raise ValueError(f"numerator_order: {self.numerator_order}, expected at least 0")

    @classmethod
    def with_residual(
        cls, order: int, residual_terms: int = DEFAULT_RESIDUAL_TERMS
    ) -> ModelStructure:
        """Structure with `residual_terms` real terms beside the modes."""
        return cls(order, order + residual_terms - 1)

    @property
    def parameters(self) -> int:
        """Number of free real parameters."""
        return self.order + self.numerator_order + 1

    @property
    def fewest_lines(self) -> int:
        """Lines for more real equations than parameters."""
        return self.parameters // 2 + 1
