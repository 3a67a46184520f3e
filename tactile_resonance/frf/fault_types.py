# SPDX-License-Identifier: Apache-2.0
"""Kinds of acquisition fault and how they are reported."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum

from tactile_resonance.frf.result import FRF, FrfStatus


class FaultKind(Enum):
    """What is wrong with a record."""

    MISSING_SAMPLES = "missing samples"
    LOST_SAMPLES = "samples lost between periods"
    SATURATION = "saturation"
    OFFSET = "offset"
    DRIFT = "drift"
    HUM = "mains hum"
    UNSETTLED = "first period not settled"
    CHANNEL_SKEW = "channel skew suspected"


@dataclass(frozen=True)
class Fault:
    """One fault of one channel.

    Attributes
    ----------
    kind : FaultKind
    channel : str
        ``actuator``, ``sensor``, or ``both`` where it lies between them.
    value : float
        How bad; the message says in which unit. Larger is worse.
    spoils : bool
        The FRF cannot be trusted because of it; otherwise it is worth knowing only.
    message : str
        A sentence for people.
    """

    kind: FaultKind
    channel: str
    value: float
    spoils: bool
    message: str


@dataclass(frozen=True)
class FaultReport:
    """All faults seen.

    Attributes
    ----------
    faults : tuple of Fault
        One per kind and channel, the worst over all records.
    """

    faults: tuple[Fault, ...] = ()

    @property
    def kinds(self) -> frozenset[FaultKind]:
        """Kinds of fault present."""
        return frozenset(fault.kind for fault in self.faults)

    @property
    def suspect(self) -> bool:
        """True where a fault spoils the FRF."""
        return any(fault.spoils for fault in self.faults)

    @property
    def message(self) -> str:
        """All sentences."""
        return " ".join(fault.message for fault in self.faults)

    def marked(self, frf: FRF) -> FRF:
        """The FRF with what was found in its message, and SUSPECT where a fault spoils it."""
        if not self.faults:
            return frf
        status = frf.status
        if self.suspect and status is not FrfStatus.FAILED:
            status = FrfStatus.SUSPECT
        message = "; ".join(filter(None, [frf.message, self.message]))
        return replace(frf, status=status, message=message)


def worst_of(per_record: Iterable[list[Fault]]) -> FaultReport:
    """One report from the faults of each record: the worst of each kind and channel."""
    records = list(per_record)
    found: dict[tuple[FaultKind, str], list[Fault]] = defaultdict(list)
    for faults in records:
        for fault in faults:
            found[fault.kind, fault.channel].append(fault)
    merged = []
    for same in found.values():
        worst = max(same, key=lambda fault: (fault.spoils, fault.value))
        if len(records) > 1:
            message = f"{worst.message[:-1]} (in {len(same)} of {len(records)} records)."
            worst = replace(worst, message=message)
        merged.append(worst)
    return FaultReport(tuple(merged))
