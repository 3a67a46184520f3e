# SPDX-License-Identifier: Apache-2.0
"""How many poles the lines speak for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import ModelStructure

CANDIDATES = tuple(ModelStructure.with_residual(n, r) for n in (2, 4, 6) for r in (6, 8, 10))
"""One to three modes, with six to ten residual terms."""


@dataclass(frozen=True)
class OrderChoice:
    """Candidates and the one to take.

    Attributes
    ----------
    poles : tuple of Poles
        Of each candidate, in the order given.
    mdl : tuple of float
        ``(cost / F) exp(n log(2 F) / (2 F - n - 2))`` of each: minimum description length, with the
        correction for few lines. Infinite where there is no result.
    chosen : int
        Index of the smallest.
    """

    poles: tuple[Poles, ...]
    mdl: tuple[float, ...]
    chosen: int

    @property
    def best(self) -> Poles:
        """Of the chosen structure; the message says that it was chosen."""
        poles = self.poles[self.chosen]
        orders = f"{poles.structure.order} and {poles.structure.numerator_order}"
        return poles.noting(f"orders {orders} chosen by description length from {len(self.mdl)}")

    @property
    def structure(self) -> ModelStructure:
        """The chosen one."""
        return self.poles[self.chosen].structure


def choose_among(
    fit: Callable[[ModelStructure], Poles], candidates: Sequence[ModelStructure] = CANDIDATES
) -> OrderChoice:
    """Fit several structures to the same data and choose by minimum description length.

    Parameters
    ----------
    fit : callable
        May raise a `ValueError` where the data are too few for a structure, which is then left out.
    candidates : sequence of ModelStructure

    Raises
    ------
    ValueError
        If there is no candidate, or none has a result whose noise is known: the cost then says nothing.

    References
    ----------
    De Ridder, Pintelon, Schoukens & Gillikin, *Modified AIC and MDL model selection criteria for
    short data records*, IEEE Trans. Instrum. Meas. 54 (2005) 144-150.
    """
    if not candidates:
        raise ValueError("candidates: none given, expected one structure at least")
    fits, refused = [], None
    for structure in candidates:
        try:
            fits.append(fit(structure))
        except ValueError as error:
            refused = error
    if not fits:
        assert refused is not None
        raise refused
    poles = tuple(fits)
    mdl = tuple(_description_length(p) for p in poles)
    chosen = int(np.argmin(mdl))
    if not np.isfinite(mdl[chosen]):
        raise ValueError(
            "candidates: none has a result with a known level of noise, more lines or smaller orders "
            "are needed"
        )
    return OrderChoice(poles, mdl, chosen)


def _description_length(poles: Poles) -> float:
    usable = (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_RESONANCE)
    data, n = 2 * poles.lines, poles.structure.parameters
    if poles.status not in usable or data <= n + 2 or not np.isfinite(poles.cost):
        return float("inf")
    return poles.cost / poles.lines * float(np.exp(n * np.log(data) / (data - n - 2)))
