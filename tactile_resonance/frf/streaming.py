# SPDX-License-Identifier: Apache-2.0
"""The FRF while periods come in one at a time."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.band_spectrum import BandSpectrum
from tactile_resonance.frf.fast import fast_frf
from tactile_resonance.frf.local_polynomial import LocalPolynomialPlan
from tactile_resonance.frf.result import FRF
from tactile_resonance.frf.robust import RobustFrf, robust_frf
from tactile_resonance.frf.spectra import (
    IntArray,
    PeriodicSpectra,
    averaged_spectra,
    checked_harmonics,
    stacked_spectra,
)


class FrfStream:
    """FRF of the periods so far, by the fast local polynomial method.

    After each period the result equals that of the whole record so far (1e-9 relative). Without a
    band the record is kept and transformed anew; in a band each period is transformed once, alone,
    and only the spectrum around the band is kept.

    Parameters
    ----------
    harmonics : (F,) int
        Excited lines.
    samples_per_period : int
    sample_rate_hz : float
    band_hz : (low, high), optional
        Only lines in this band are computed.
    order, dof : int
        See `local_polynomial.LocalPolynomialPlan`.
    max_periods : int
        Most periods of one realisation: bounds the memory.

    Attributes
    ----------
    harmonics : (F,) int
        Lines computed.
    periods : int
        Of the present realisation.

    Raises
    ------
    ValueError
        If the band holds no line, or the method is impossible at two periods.

    Examples
    --------
    >>> stream = FrfStream(lines, 20000, sample_rate_hz=50e3, band_hz=(200.0, 300.0))
    >>> for u, y in blocks:
    ...     frf = stream.add_period(u, y)
    """

    def __init__(
        self,
        harmonics: npt.ArrayLike,
        samples_per_period: int,
        *,
        sample_rate_hz: float,
        band_hz: tuple[float, float] | None = None,
        order: int = 2,
        dof: int = 6,
        max_periods: int = 64,
    ) -> None:
        lines = checked_harmonics(harmonics, samples_per_period)
        if max_periods < 1:
            raise ValueError(f"max_periods: {max_periods}, expected at least 1")
        if band_hz is not None:
            frequency = lines * (sample_rate_hz / samples_per_period)
            lines = lines[(frequency >= band_hz[0]) & (frequency <= band_hz[1])]
            if lines.size == 0:
                raise ValueError(
                    f"band_hz: {band_hz[0]:g}..{band_hz[1]:g} holds no excited line, they reach "
                    f"from {frequency[0]:g} to {frequency[-1]:g} Hz"
                )
        self.harmonics: IntArray = lines
        self.sample_rate_hz = sample_rate_hz
        self.samples_per_period = samples_per_period
        self.max_periods = max_periods
        self._order, self._dof = order, dof
        self._record = np.empty((2, 1, samples_per_period))  # (2, room, N), rows [Y; U]
        self._finished: list[PeriodicSpectra] = []
        self._band: BandSpectrum | None = None
        self._spectra: PeriodicSpectra | None = None
        self.periods = 0
        widest = self._plan(2)  # neighbours spread furthest where fewest lie between harmonics
        if band_hz is not None:
            edges = [
                (group.centre_bins[end] + edge(group.offsets)) / 2
                for group in widest.groups
                for end, edge in ((0, np.min), (-1, np.max))
            ]
            self._band = BandSpectrum(samples_per_period, min(edges), max(edges))

    def add_period(self, u: npt.NDArray[np.floating], y: npt.NDArray[np.floating]) -> FRF:
        """FRF of the present realisation with its next period.

        Parameters
        ----------
        u, y : (N,) float
            Actuator and sensor [V], without a gap to the period before.

        Returns
        -------
        FRF
            Without covariance, status NO_COVARIANCE, after the first period.

        Raises
        ------
        ValueError
            For another number of samples, samples that are not finite (the period is then not
            taken), or more than `max_periods`.
        """
        period = np.stack([np.asarray(y, float), np.asarray(u, float)])  # (2, N), rows [Y; U]
        if period.shape != (2, self.samples_per_period):
            raise ValueError(
                f"u, y: shape {period.shape[1:]}, expected ({self.samples_per_period},)"
            )
        if not np.all(np.isfinite(period)):
            raise ValueError("u, y: samples are not finite, expected a complete period")
        if self.periods >= self.max_periods:
            raise ValueError(
                f"periods: already {self.periods}, the most that max_periods allows; start the "
                "next realisation"
            )
        self._spectra = self._with_next(period)
        return fast_frf(self._spectra, sample_rate_hz=self.sample_rate_hz)

    def next_realisation(self) -> None:
        """Put the present realisation aside; the next period starts another.

        Raises
        ------
        ValueError
            If no period has come in.
        """
        if self._spectra is None:
            raise ValueError("periods: 0 in this realisation, expected at least 1")
        self._finished.append(self._spectra)
        self._spectra = None
        self.periods = 0
        if self._band is not None:
            self._band.clear()

    def robust(self) -> RobustFrf:
        """Best linear approximation from all realisations so far, the present one included.

        Raises
        ------
        ValueError
            If there are fewer than two.
        """
        realisations = [*self._finished, *([] if self._spectra is None else [self._spectra])]
        if len(realisations) < 2:
            raise ValueError(
                f"realisations: {len(realisations)}, expected at least 2; one cannot tell "
                "distortion from the system"
            )
        return robust_frf(stacked_spectra(realisations), sample_rate_hz=self.sample_rate_hz)

    def _plan(self, periods: int) -> LocalPolynomialPlan:
        return _plan(
            self.harmonics.tobytes(), self.samples_per_period, periods, self._order, self._dof
        )

    def _with_next(self, period: npt.NDArray[np.float64]) -> PeriodicSpectra:
        self.periods += 1
        if self._band is not None:
            self._band.add(period)
        else:
            self._keep(period)
        if self.periods == 1:
            return averaged_spectra(period[1, None], period[0, None], self.harmonics)
        plan = self._plan(self.periods)
        if self._band is None:
            return plan(*self._record[::-1, : self.periods])
        return plan.from_bins(self._band.bins(group) for group in plan.groups)

    def _keep(self, period: npt.NDArray[np.float64]) -> None:
        """Append to the record, doubling its room where needed."""
        room = self._record.shape[1]
        if self.periods > room:
            larger = np.empty((2, min(2 * room, self.max_periods), self.samples_per_period))
            larger[:, :room] = self._record
            self._record = larger
        self._record[:, self.periods - 1] = period


@lru_cache(maxsize=16)
def _plan(
    harmonics: bytes, samples_per_period: int, periods: int, order: int, dof: int
) -> LocalPolynomialPlan:
    """Plans of the latest kinds: one measurement is like the next."""
    lines = np.frombuffer(harmonics, np.int64)
    return LocalPolynomialPlan(lines, samples_per_period, periods, order, dof)
