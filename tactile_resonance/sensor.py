# SPDX-License-Identifier: Apache-2.0
"""The sensor, read from ``config/sensors/bimorph.yaml``: its geometry, and what it is simulated by.

Sources and honesty marks of the default values stand beside them in that file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import (
    AboveZero,
    BelowOne,
    Checked,
    NotNegative,
    Range,
    read_file,
    require,
)

MAX_LEVEL_V = 4.0
"""Drive that the sensor bears [V rms]; excitation_node refuses more where its parameter says nothing else."""


@dataclass(frozen=True)
class BeamParameters(Checked):
    """Symmetric three-layer cantilever (piezo, shim, piezo); one layer drives, the other senses."""

    free_length_m: AboveZero
    width_m: AboveZero
    piezo_thickness_m: AboveZero
    shim_thickness_m: AboveZero
    piezo_modulus_pa: AboveZero
    shim_modulus_pa: AboveZero
    piezo_density_kg_per_m3: AboveZero
    shim_density_kg_per_m3: AboveZero
    d31_m_per_v: float
    relative_permittivity_t33: AboveZero
    modal_damping_ratio: BelowOne
    mode_count: Annotated[int, Range(1, 40)]

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.d31_m_per_v != 0.0, "d31_m_per_v", self.d31_m_per_v, "a number other than 0")


@dataclass(frozen=True)
class TipParameters(Checked):
    """Spherical tip at the free end; `mass_kg` may be 0 for a bare cantilever."""

    radius_m: AboveZero
    mass_kg: NotNegative


@dataclass(frozen=True)
class ElectricParameters(Checked):
    """Load of the sensing layer and capacitive feedthrough ``gamma = Cs / (Cp + Cs)``."""

    input_resistance_ohm: AboveZero
    feedthrough: BelowOne


@dataclass(frozen=True)
class NonlinearParameters:
    """Static nonlinearity ``u + a2 u^2 + a3 u^3 + g2 s^2 + g3 s^3``, s the strain voltage."""

    actuator_cubic_per_v2: float
    strain_cubic_per_v2: float
    actuator_quadratic_per_v: float = 0.0
    strain_quadratic_per_v: float = 0.0


@dataclass(frozen=True)
class AcquisitionParameters(Checked):
    """Noise and converters.

    Noise is white: its rms scales with the square root of half the sample rate over
    `sensor_noise_bandwidth_hz`. The drive passes `actuator_divider` before its converter.
    """

    sensor_noise_v: NotNegative
    sensor_noise_bandwidth_hz: AboveZero
    adc_bits: Annotated[int, Range(8, 31)]
    adc_range_v: AboveZero
    actuator_divider: AboveZero = 1.0

    def noise_rms_v(self, sample_rate_hz: float) -> float:
        """Return the rms of the sensor noise [V] in the full band of a sample rate."""
        return self.sensor_noise_v * (sample_rate_hz / 2 / self.sensor_noise_bandwidth_hz) ** 0.5

    @property
    def sensor_scale_v(self) -> float:
        """Volts per count of the sensor channel."""
        return 2 * self.adc_range_v / 2**self.adc_bits

    @property
    def actuator_scale_v(self) -> float:
        """Volts per count of the actuator channel, referred to the sensor's terminals."""
        return self.sensor_scale_v * self.actuator_divider


@dataclass(frozen=True)
class SensorParameters:
    """Everything about the sensor that does not depend on what it touches."""

    beam: BeamParameters
    tip: TipParameters
    electric: ElectricParameters
    nonlinear: NonlinearParameters
    acquisition: AcquisitionParameters


def sensor_named(name: str) -> SensorParameters:
    """Parameters of a sensor of ``config/sensors``."""
    return read_sensor(share_path(f"config/sensors/{name}.yaml"))


def read_sensor(path: Path | None = None) -> SensorParameters:
    """Read sensor parameters; without a path, those of ``config/sensors/bimorph.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or a field is missing, unknown or out of range.
    """
    path = share_path("config/sensors/bimorph.yaml") if path is None else Path(path)
    return read_file(SensorParameters, path)
