# SPDX-License-Identifier: Apache-2.0
"""The FRF of one measurement, while its records come in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tactile_resonance.frf.averaging import average_periods
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Contact, Origin, Record


class MeasurementFrf:
    """Collects the records of one measurement; after each, the FRF so far.

    Parameters
    ----------
    measurement_id : int
    """

    def __init__(self, measurement_id: int) -> None:
        self.measurement_id = measurement_id
        self._excitations: dict[int, Excitation] = {}
        self._periods: dict[int, list[tuple[npt.NDArray, npt.NDArray]]] = {}
        self._records: list[Record] = []
        self._notes: list[str] = []

    def add(self, record: Record, excitation: Excitation) -> None:
        """Take in the next record, played as `excitation`.

        A gap in the block indices is noted; what follows it in that realisation is not used, because the
        periods would no longer be consecutive.

        Raises
        ------
        ValueError
            If the record does not fit the excitation.
        """
        n = excitation.samples_per_period
        u, y = record.actuator.volts(), record.sensor.volts()
        if u.shape != y.shape or u.size == 0 or u.size % n or record.samples_per_period != n:
            raise ValueError(
                f"record: {u.size} and {y.size} samples, expected whole periods of {n} on both channels"
            )
        self._records.append(record)
        periods = self._periods.setdefault(record.realisation, [])
        self._excitations[record.realisation] = excitation
        for channel, name in ((record.actuator, "actuator"), (record.sensor, "sensor")):
            if channel.saturated:
                self._note(f"{name} saturated")
        if record.block_index * (u.size // n) != len(periods):
            self._note(
                f"realisation {record.realisation}: blocks lost before block {record.block_index}, "
                "not used from there on"
            )
            return
        periods += zip(u.reshape(-1, n), y.reshape(-1, n))

    def frf(self) -> FRF:
        """FRF from all realisations that have as many periods as the longest; those under way wait.

        The first period of each realisation is left out as unsettled where two others remain.
        """
        longest = max(len(periods) for periods in self._periods.values())
        if longest == 0:
            empty = np.empty(0)
            return FRF(empty, empty.astype(complex), status=FrfStatus.FAILED, message=self._message())
        complete = [k for k, periods in self._periods.items() if len(periods) == longest]
        u, y = (
            np.stack([[period[i] for period in self._periods[k]] for k in complete])
            for i in (0, 1)
        )  # (M, P, N)
        excitation = self._excitations[complete[0]]
        frf = average_periods(
            u,
            y,
            sample_rate_hz=excitation.sample_rate_hz,
            harmonics=excitation.harmonics,
            unsettled_periods=1 if longest > 2 else 0,
        )
        if self._notes:
            frf = replace(
                frf,
                status=FrfStatus.SUSPECT,
                message="; ".join(filter(None, [frf.message, self._message()])),
            )
        return frf

    def origin(self) -> Origin:
        """Where the FRF comes from: middle of the acquisition, last pose, mean force."""
        first, last = self._records[0], self._records[-1]
        end_ns = last.origin.time_ns + round(last.duration_s * 1e9)
        forces = np.array([record.origin.contact.force_n for record in self._records])
        contact: Contact = replace(last.origin.contact, force_n=float(forces.mean()))
        return replace(
            last.origin, time_ns=(first.origin.time_ns + end_ns) // 2, contact=contact
        )

    @property
    def saturated(self) -> bool:
        """A channel of any record stood at the end of its range."""
        return any(r.actuator.saturated or r.sensor.saturated for r in self._records)

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.append(text)

    def _message(self) -> str:
        return "; ".join(self._notes)
