# SPDX-License-Identifier: Apache-2.0
"""How many poles the lines speak for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tactile_resonance.frf.result import FRF
from tactile_resonance.identification.identify import identify_poles
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.identification.structure import ModelStructure


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
    explained : bool
        Whether the cost of the chosen one is what noise explains.
    """

    poles: tuple[Poles, ...]
    mdl: tuple[float, ...]
    chosen: int
    explained: bool

    @property
    def structure(self) -> ModelStructure:
        """The chosen one."""
        return self.poles[self.chosen].structure


def choose_order(
    frf: FRF,
    band_hz: tuple[float, float] | None = None,
    candidates: Sequence[ModelStructure] | None = None,
) -> OrderChoice:
    """Fit several structures and choose by minimum description length.

    Parameters
    ----------
    frf : FRF
        With (F,) arrays and a variance.
    band_hz : (low, high), optional
    candidates : sequence of ModelStructure, optional
        One to three modes with 1 to 8 residual terms when absent.

    Raises
    ------
    ValueError
        If the variance is unknown (the cost then says nothing) or no candidate has a result.

    References
    ----------
    De Ridder, Pintelon, Schoukens & Gillikin, *Modified AIC and MDL model selection criteria for
    short data records*, IEEE Trans. Instrum. Meas. 54 (2005) 144-150.
    """
    if frf.variance is None or frf.dof < 1:
        raise ValueError("frf.variance: None, choosing an order needs the variance of the response")
    if candidates is None:
        candidates = [
            ModelStructure.with_residual(order, terms)
            for order in (2, 4, 6)
            for terms in (1, 2, 4, 6, 8)
        ]
    return choose_among(lambda structure: identify_poles(frf, band_hz, structure), candidates)


def choose_among(
    fit: Callable[[ModelStructure], Poles], candidates: Sequence[ModelStructure]
) -> OrderChoice:
    """As `choose_order`, for any fit of a structure to the same data.

    Parameters
    ----------
    fit : callable
        May raise a `ValueError` where the data are too few for a structure, which is then left out.
    candidates : sequence of ModelStructure
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
    return OrderChoice(poles, mdl, chosen, poles[chosen].status is not PolesStatus.MODEL_ERROR)


def _description_length(poles: Poles) -> float:
    usable = (PolesStatus.OK, PolesStatus.MODEL_ERROR, PolesStatus.NO_RESONANCE)
    data, n = 2 * poles.lines, poles.structure.parameters
    if poles.status not in usable or data <= n + 2 or not np.isfinite(poles.cost):
        return float("inf")
    return poles.cost / poles.lines * float(np.exp(n * np.log(data) / (data - n - 2)))
