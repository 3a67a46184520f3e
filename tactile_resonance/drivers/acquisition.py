# SPDX-License-Identifier: Apache-2.0
"""What every acquisition device promises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from tactile_resonance.multisine import Excitation
from tactile_resonance.record import Record


class DeviceError(RuntimeError):
    """The device refuses or failed; the message says why, and the hardware is left stopped."""


@dataclass(frozen=True)
class DeviceInfo:
    """What who plays with it must know of the device.

    Attributes
    ----------
    name : str
    output_peak_v : float
        Largest voltage it can put out.
    recorded : bool
        Its blocks are those of a recording, with their contact and frame.
    """

    name: str
    output_peak_v: float
    recorded: bool = False


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

    def read_block(self, timeout_s: float) -> Record:
        """The next period, with what the device knows of it. No block is skipped: one that lost one raises."""
        ...

    def interrupt(self) -> None:
        """Let a `read_block` that waits raise soon, where that can be done; from any thread. Else nothing."""

    def stop(self) -> None:
        """Output to zero, inputs off; harmless when nothing plays."""
        ...

    def close(self) -> None:
        """Stop and let the hardware go; whatever is called afterwards plays nothing."""
        ...
