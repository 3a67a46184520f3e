# SPDX-License-Identifier: Apache-2.0
"""Which rational model is fitted, and in which band."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from numbers import Integral

from tactile_resonance.fields import require, require_kind

DEFAULT_RESIDUAL_TERMS = 6


@dataclass(frozen=True)
class ModelStructure:
    """Orders of ``G = B / A`` with real coefficients, in s or in z.

    A numerator of order ``order + r - 1`` is the same as ``order / 2`` modes and a residual
    polynomial ``c_0 + c_1 s + ... + c_{r-1} s^{r-1}`` for the modes outside the band (partial
    fractions).

    Attributes
    ----------
    order : int
        Of the denominator: two poles a mode.
    numerator_order : int
    domain : {"s", "z"}
        Laplace variable for band-limited signals, z for a zero-order hold between samples.
    sample_rate_hz : float or None
        Needed in the z-domain.
    delay : bool
        Estimate a pure delay [s] beside the rational function.

    Notes
    -----
    A bare second-order model (numerator order 2) over 200-300 Hz is biased by several standard
    deviations by the sensor's other modes; six residual terms (the default) bring the bias below
    half of one.
    """

    order: int = 2
    numerator_order: int = 2 + DEFAULT_RESIDUAL_TERMS - 1
    domain: str = "s"
    sample_rate_hz: float | None = None
    delay: bool = False

    def __post_init__(self) -> None:
        for name, least in (("order", 1), ("numerator_order", 0)):
            value = getattr(self, name)
            whole = isinstance(value, Integral) and not isinstance(value, bool)
            if not (whole and value >= least):
                raise ValueError(f"{name}: {value!r}, expected a whole number, at least {least}")
        require(isinstance(self.delay, bool), "delay", self.delay, "true or false")
        if self.domain not in ("s", "z"):
            raise ValueError(f"domain: {self.domain!r}, accepted are 's' and 'z'")
        if self.domain == "z" and not (self.sample_rate_hz and 0 < self.sample_rate_hz < inf):
            raise ValueError(
                f"sample_rate_hz: {self.sample_rate_hz}, the z-domain needs a rate above 0"
            )

    @classmethod
    def with_residual(
        cls, order: int, residual_terms: int = DEFAULT_RESIDUAL_TERMS
    ) -> ModelStructure:
        """Structure with `residual_terms` real terms beside the modes."""
        return cls(order, order + residual_terms - 1)

    @property
    def parameters(self) -> int:
        """Number of free real parameters."""
        return self.order + self.numerator_order + 1 + int(self.delay)

    @property
    def fewest_lines(self) -> int:
        """Lines for more real equations than parameters."""
        return self.parameters // 2 + 1

    @property
    def transient_terms(self) -> int:
        """Length of the transient's numerator that suits the structure.

        A transient of the model's own poles alone has `order` terms; every residual term beyond the constant
        stands for modes outside the band, whose transients are as smooth as their responses. Several modes
        have two more at least, for they need not lie where `joint` takes them.
        """
        residual = min(self.numerator_order - self.order, 4)
        return self.order + max(residual, 2 if self.order > 2 else 0)


@dataclass(frozen=True)
class PoleBand:
    """A band in which poles are wanted, and the model of the response there.

    It travels with an excitation and what comes of it, so that every stage works on what was asked for.

    Attributes
    ----------
    low_hz, high_hz : float
    order : int
        Of the denominator, two poles a mode; 0: the data choose one to three modes.
    residual_terms : int
        Real polynomial terms beside the modes.
    """

    low_hz: float
    high_hz: float
    order: int = 2
    residual_terms: int = DEFAULT_RESIDUAL_TERMS

    def __post_init__(self) -> None:
        if not 0 < self.low_hz < self.high_hz < inf:
            raise ValueError(
                f"band: {self.low_hz:g} to {self.high_hz:g} Hz, expected 0 < low < high"
            )

    @property
    def ends_hz(self) -> tuple[float, float]:
        """Both ends."""
        return self.low_hz, self.high_hz


def checked_structure(structure: ModelStructure | None) -> ModelStructure:
    """Return the structure, that of one mode when absent; ``ValueError`` if it is something else."""
    if structure is None:
        return ModelStructure()
    require_kind(structure, "structure", ModelStructure)
    return structure
