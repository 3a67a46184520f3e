# SPDX-License-Identifier: Apache-2.0
"""The sampled actuator and sensor voltages of one block, with what a later reader needs."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import cast

import numpy as np
import numpy.typing as npt

SIMULATED = "simulated, not measured"
"""How pages, figures and notes say it."""


class InputKind(Enum):
    """How the actuator channel was obtained."""

    MEASURED = "measured"
    COMMANDED = "commanded"


class BetweenSamples(Enum):
    """What the input does between samples."""

    BAND_LIMITED = "band_limited"
    ZERO_ORDER_HOLD = "zoh"


@dataclass(frozen=True)
class Channel:
    """Samples of one channel.

    Attributes
    ----------
    samples : (n,) int32 or float
        Integer counts where the device counts, else volts.
    scale_v, offset_v : float
        ``volts = offset_v + scale_v * samples``; 1 and 0 for samples in volts.
    saturated : bool
        A sample stands at the end of the range.
    """

    samples: npt.NDArray[np.int32] | npt.NDArray[np.floating]
    scale_v: float = 1.0
    offset_v: float = 0.0
    saturated: bool = False

    @property
    def is_counts(self) -> bool:
        """True for integer counts."""
        return self.samples.dtype.kind == "i"

    def volts(self) -> npt.NDArray[np.floating]:
        """(n,) samples [V]; floating samples come back as they are, without a copy."""
        if self.is_counts:
            return self.samples * self.scale_v + self.offset_v
        return cast("npt.NDArray[np.floating]", self.samples)


@dataclass(frozen=True)
class ForceSpread:
    """How a force moved over an interval; NaN where not known.

    Attributes
    ----------
    rms_n : float
        Root mean square about the mean [N], the sensor's noise taken off, and with it what is as quick: 3 %
        of a motion of 5 Hz, 12 % of one of 10 Hz. 0: noise explains all of it. Noise of 1 mN at 1 kHz
        leaves an uncertainty of about 0.1 mN after 0.4 s where the force does not move.
    min_n, max_n : float
        Smallest and largest mean over 20 ms [N], with their noise.
    """

    rms_n: float = float("nan")
    min_n: float = float("nan")
    max_n: float = float("nan")


@dataclass(frozen=True)
class Contact:
    """Where the tip was and how hard it pressed.

    Attributes
    ----------
    force_n, force_std_n : float
        Mean normal force on the tissue over what it belongs to, positive in compression, and the standard
        deviation of that mean [N]; NaN where unknown.
    position_m : (3,) tuple or None
        Position of the tip; None where unknown.
    orientation_xyzw : (4,) tuple
        Unit quaternion of the frame `tip`.
    frame_id : str
        Frame of position and orientation.
    time_ns : int
        When the pose was taken (ROS time) [ns].
    coverage : float
        Fraction of that time in which forces were measured; NaN where unknown.
    reason : str
        Why the force is unknown; empty where it is known.
    spread : ForceSpread
        How the force moved over that time.
    """

    force_n: float = float("nan")
    force_std_n: float = float("nan")
    position_m: tuple[float, float, float] | None = None
    orientation_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    frame_id: str = ""
    time_ns: int = 0
    coverage: float = float("nan")
    reason: str = ""
    spread: ForceSpread = field(default_factory=ForceSpread)


@dataclass(frozen=True)
class Origin:
    """Which measurement something belongs to; travels from the record to the poles.

    Attributes
    ----------
    measurement_id, excitation_id : int
        Measurement at one point, and the (latest) realisation played in it.
    time_ns : int
        First sample of a record; middle of the acquisition for what is estimated (UNIX time) [ns].
    final : bool
        Nothing more of this measurement follows.
    frame_id : str
        Sensor tip frame.
    label : str
        What is measured, for people.
    simulated : bool
        From the simulated bench, not a measurement.
    contact : Contact
    """

    measurement_id: int = 0
    excitation_id: int = 0
    time_ns: int = 0
    final: bool = False
    frame_id: str = "tip"
    label: str = ""
    simulated: bool = False
    contact: Contact = field(default_factory=Contact)


@dataclass(frozen=True)
class Record:
    """One block: one or more whole periods, or a short burst.

    Attributes
    ----------
    actuator, sensor : Channel
        Both of n samples, taken together.
    sample_rate_hz : float
    samples_per_period : int
    realisation : int
        From 0.
    block_index : int
        From 0 within the realisation, without gaps: a gap is a lost block.
    input_kind, between_samples
        How the actuator channel was obtained and what the input does between samples.
    channel_delay_s : float
        Delay of the sensor channel behind the actuator channel [s]; NaN where unknown.
    anti_alias_filter : str
        For people; empty where unknown.
    origin : Origin
        Its ``final`` marks the last block of the last realisation.
    """

    actuator: Channel
    sensor: Channel
    sample_rate_hz: float
    samples_per_period: int
    realisation: int = 0
    block_index: int = 0
    input_kind: InputKind = InputKind.MEASURED
    between_samples: BetweenSamples = BetweenSamples.BAND_LIMITED
    channel_delay_s: float = float("nan")
    anti_alias_filter: str = ""
    origin: Origin = field(default_factory=Origin)

    @property
    def duration_s(self) -> float:
        """Length of the block [s]."""
        return self.actuator.samples.size / self.sample_rate_hz
