# SPDX-License-Identifier: Apache-2.0
"""What every acquisition device promises, and what its blocks hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from tactile_resonance.multisine import Excitation
from tactile_resonance.record import BetweenSamples, Channel, Contact, InputKind


class DeviceError(RuntimeError):
    """The device refuses or failed; the message says why, and the hardware is left stopped."""


@dataclass(frozen=True)
class DeviceInfo:
    """What a reader of the samples must know of the device.

    Attributes
    ----------
    name : str
    simulated : bool
    input_kind : InputKind
        Whether the actuator channel is measured at the sensor's terminals.
    between_samples : BetweenSamples
    output_peak_v : float
        Largest voltage it can put out.
    channel_delay_s : float
        Of the sensor channel behind the actuator channel; NaN where unknown.
    anti_alias_filter : str
        For people; empty where unknown.
    frame_id : str
        Sensor tip frame, where a replay knows it; empty: that of whoever owns the device.
    """

    name: str
    simulated: bool
    input_kind: InputKind
    between_samples: BetweenSamples
    output_peak_v: float
    channel_delay_s: float = float("nan")
    anti_alias_filter: str = ""
    frame_id: str = ""


@dataclass(frozen=True)
class AcquiredBlock:
    """One period of both channels.

    Attributes
    ----------
    index : int
        From 0 since the excitation started, without gaps.
    time_ns : int
        First sample (UNIX time) [ns].
    actuator, sensor : Channel
    contact : Contact or None
        That of a recording; None where the block was taken just now.
    """

    index: int
    time_ns: int
    actuator: Channel
    sensor: Channel
    contact: Contact | None = None


class AcquisitionDevice(Protocol):
    """One output and two inputs on one clock.

    Calls come in the order plan, configure, then for each excitation play, read_block (once a period)
    and stop, for every measurement anew; stop may come at any time, and close, from any thread, is the
    last. All raise `DeviceError`.
    """

    def plan(self, excitations: Sequence[Excitation]) -> list[Excitation]:
        """What the device will really play when asked for this measurement.

        Most return what was asked. A replay returns what was recorded; it takes the next
        measurement, or the one named by a measurement id other than 0. Ids that are 0 in the answer
        are for the caller to give.
        """
        return list(excitations)

    def configure(self, sample_rate_hz: float) -> DeviceInfo:
        """Set the sample clock; say what the device is."""
        ...

    def play(self, excitation: Excitation) -> None:
        """Load the output, make the inputs ready, and start both together, from rest."""
        ...

    def read_block(self, timeout_s: float) -> AcquiredBlock:
        """The next period. No block is skipped: a device that lost one raises."""
        ...

    def interrupt(self) -> None:
        """Let a `read_block` that waits raise soon, where that can be done; from any thread. Else nothing."""

    def stop(self) -> None:
        """Output to zero, inputs off; harmless when nothing plays."""
        ...

    def close(self) -> None:
        """Stop and let the hardware go; whatever is called afterwards plays nothing."""
        ...
