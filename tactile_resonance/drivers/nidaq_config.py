# SPDX-License-Identifier: Apache-2.0
"""Which NI channels are used, and how: read from YAML and checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

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


@dataclass(frozen=True)
class NiDaqConfig:
    """What `NiDaqDevice` needs to know; see ``config/devices/nidaqmx.yaml``.

    Attributes
    ----------
    output_channel : str
    max_voltage_v : float
        Largest voltage, positive or negative, that may be put out.
    actuator : InputChannel or None
        None where the drive is not measured.
    sensor : InputChannel
    between_samples : BetweenSamples
    anti_alias_filter : str
    channel_delay_s : float
        Of the sensor channel behind the actuator channel; NaN where not measured.
    clock_device : str
        Whose sample clock and start trigger all use.
    buffer_s : float
        Length of the input buffer [s].
    """

    output_channel: str
    max_voltage_v: float
    actuator: InputChannel | None
    sensor: InputChannel
    between_samples: BetweenSamples
    anti_alias_filter: str
    channel_delay_s: float
    clock_device: str
    buffer_s: float

    @property
    def input_kind(self) -> InputKind:
        """How the actuator channel is obtained."""
        return InputKind.MEASURED if self.actuator else InputKind.COMMANDED

    @property
    def inputs(self) -> list[InputChannel]:
        """In the order in which they are read: actuator, where it is measured, then sensor."""
        return [self.actuator, self.sensor] if self.actuator else [self.sensor]


def read_nidaq_config(path: Path) -> NiDaqConfig:
    """Read and check a configuration.

    Raises
    ------
    ValueError
        Names the field, its value, and what is accepted.
    OSError
        If the file cannot be opened.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name}: no YAML ({' '.join(str(error).split())})") from error
    try:
        return _config(content)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from error


def _config(content: Any) -> NiDaqConfig:
    top = _Fields(content, "")
    output = _Fields(top.take("output"), "output.")
    drive = _Fields(top.take("actuator"), "actuator.")
    sensor = _input(_Fields(top.take("sensor"), "sensor."))
    source = drive.choice("source", [kind.value for kind in InputKind])
    actuator = None
    if source == InputKind.MEASURED.value:
        actuator = _input(drive)
        if actuator.channel == sensor.channel:
            raise ValueError(f"sensor.channel: {sensor.channel}, expected another than actuator's")
    delay = top.take("channel_delay_s", None)
    config = NiDaqConfig(
        output_channel=output.text("channel"),
        max_voltage_v=output.positive("max_voltage_v"),
        actuator=actuator,
        sensor=sensor,
        between_samples=BetweenSamples(
            top.choice("between_samples", [kind.value for kind in BetweenSamples])
        ),
        anti_alias_filter=str(top.take("anti_alias_filter", "")),
        channel_delay_s=float("nan") if delay is None else _number("channel_delay_s", delay),
        clock_device=str(top.take("clock_device", "")) or sensor.channel.split("/")[0],
        buffer_s=top.positive("buffer_s"),
    )
    for fields in (top, output, drive):
        fields.finish()
    return config


def _input(fields: _Fields) -> InputChannel:
    channel = InputChannel(
        fields.text("channel"),
        fields.positive("range_v"),
        fields.choice("terminals", list(TERMINALS)),
    )
    fields.finish()
    return channel


_MISSING = object()


class _Fields:
    """A mapping whose fields are taken out one by one, each with its name for messages."""

    def __init__(self, content: Any, prefix: str) -> None:
        if not isinstance(content, dict):
            name = prefix.rstrip(".") or "configuration"
            raise ValueError(f"{name}: {content!r}, expected fields with values")
        self._content = dict(content)
        self._prefix = prefix

    def take(self, name: str, default: Any = _MISSING) -> Any:
        value = self._content.pop(name, default)
        if value is _MISSING:
            raise ValueError(f"{self._prefix}{name}: missing")
        return value

    def text(self, name: str) -> str:
        value = self.take(name)
        if not isinstance(value, str) or not value:
            raise ValueError(f"{self._prefix}{name}: {value!r}, expected a name such as Dev1/ai0")
        return value

    def positive(self, name: str) -> float:
        value = _number(self._prefix + name, self.take(name))
        if not 0 < value < float("inf"):
            raise ValueError(f"{self._prefix}{name}: {value:g}, expected a positive number")
        return value

    def choice(self, name: str, accepted: list[str]) -> str:
        value = self.take(name)
        if value not in accepted:
            raise ValueError(f"{self._prefix}{name}: {value!r}, accepted are {', '.join(accepted)}")
        return value

    def finish(self) -> None:
        if self._content:
            unknown = ", ".join(f"{self._prefix}{name}" for name in self._content)
            raise ValueError(f"{unknown}: no such field")


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        raise ValueError(f"{name}: {value!r}, expected a number (with a point: 1.0e-6)")
    return float(value)
