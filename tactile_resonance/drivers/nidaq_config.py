# SPDX-License-Identifier: Apache-2.0
"""Which NI channels are used, and how: read from YAML and checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

from tactile_resonance.fields import (
    check_above_zero,
    known_keys,
    number,
    read,
    read_dataclass,
    require,
)
from tactile_resonance.record import BetweenSamples, InputKind

TERMINALS = {
    "differential": "DIFF",
    "rse": "RSE",
    "nrse": "NRSE",
    "pseudo_differential": "PSEUDO_DIFF",
    "default": "DEFAULT",
}
"""Our names, and those of ``nidaqmx.constants.TerminalConfiguration``."""


@dataclass(frozen=True)
class InputChannel:
    """One analogue input: its name, half its range [V], and a key of `TERMINALS`."""

    channel: str
    range_v: float
    terminals: str

    def __post_init__(self) -> None:
        require(bool(self.channel), "channel", self.channel, "a name such as Dev1/ai0")
        check_above_zero(self, "range_v")
        good = self.terminals in TERMINALS
        require(good, "terminals", self.terminals, f"one of {', '.join(TERMINALS)}")


@dataclass(frozen=True)
class OutputChannel:
    """The analogue output: its name, and the largest voltage of either sign that may be put out."""

    channel: str
    max_voltage_v: float

    def __post_init__(self) -> None:
        require(bool(self.channel), "channel", self.channel, "a name such as Dev1/ao0")
        check_above_zero(self, "max_voltage_v")


def _read_actuator(value: Any, field: str) -> InputChannel | None:
    """None where the drive is taken to be what was asked of the output."""
    source = value.get("source") if isinstance(value, dict) else None
    measured = read(InputKind, source, f"{field}.source") is InputKind.MEASURED
    channel = {key: item for key, item in value.items() if key != "source"}
    if not measured:
        known_keys(channel, {"source"}, field)
    return read_dataclass(InputChannel, channel, field) if measured else None


def _read_delay(value: object, field: str) -> float:
    return math.nan if value is None else number(value, field)


@dataclass(frozen=True)
class NiDaqConfig:
    """What `NiDaqDevice` needs to know; see ``config/devices/nidaqmx.yaml``.

    Attributes
    ----------
    output : OutputChannel
    actuator : InputChannel or None
        None where the drive is not measured.
    sensor : InputChannel
    between_samples : BetweenSamples
    buffer_s : float
        Length of the input buffer [s].
    anti_alias_filter : str
    channel_delay_s : float
        Of the sensor channel behind the actuator channel; NaN where not measured.
    clock_device : str
        Whose sample clock and start trigger all use; empty: that of the sensor.
    """

    output: OutputChannel
    actuator: Annotated[InputChannel | None, _read_actuator]
    sensor: InputChannel
    between_samples: BetweenSamples
    buffer_s: float
    anti_alias_filter: str = ""
    channel_delay_s: Annotated[float, _read_delay] = math.nan
    clock_device: str = ""

    def __post_init__(self) -> None:
        taken = self.actuator is not None and self.actuator.channel == self.sensor.channel
        require(not taken, "sensor.channel", self.sensor.channel, "another than actuator.channel")
        check_above_zero(self, "buffer_s")

    @property
    def inputs(self) -> list[InputChannel]:
        """In the order in which they are read: actuator, where it is measured, then sensor."""
        return [self.actuator, self.sensor] if self.actuator else [self.sensor]
