# SPDX-License-Identifier: Apache-2.0
"""The sensor, read from ``config/sensors/bimorph.yaml``: its geometry, and what it is simulated by.

Sources and honesty marks of the default values stand beside them in that file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import (
    check_above_zero,
    check_not_negative,
    check_within,
    read_file,
    require,
)

MAX_LEVEL_V = 4.0
"""Drive that the sensor bears [V rms]; excitation_node refuses more where its parameter says nothing else."""


@dataclass(frozen=True)
class BeamParameters:
    """Symmetric three-layer cantilever (piezo, shim, piezo); one layer drives, the other senses."""

    free_length_m: float
    width_m: float
    piezo_thickness_m: float
    shim_thickness_m: float
    piezo_modulus_pa: float
    shim_modulus_pa: float
    piezo_density_kg_per_m3: float
    shim_density_kg_per_m3: float
    d31_m_per_v: float
    relative_permittivity_t33: float
    modal_damping_ratio: float
    mode_count: int

    def __post_init__(self) -> None:
        check_above_zero(
            self, "free_length_m", "width_m", "piezo_thickness_m", "shim_thickness_m",
            "piezo_modulus_pa", "shim_modulus_pa", "piezo_density_kg_per_m3",
            "shim_density_kg_per_m3", "relative_permittivity_t33",
        )  # fmt: skip
        require(self.d31_m_per_v != 0.0, "d31_m_per_v", self.d31_m_per_v, "a number other than 0")
        zeta = self.modal_damping_ratio
        require(0.0 < zeta < 1.0, "modal_damping_ratio", zeta, "above 0 and below 1")
        check_within(self, mode_count=(1, 40))


@dataclass(frozen=True)
class TipParameters:
    """Spherical tip at the free end; `mass_kg` may be 0 for a bare cantilever."""

    radius_m: float
    mass_kg: float

    def __post_init__(self) -> None:
        check_above_zero(self, "radius_m")
        check_not_negative(self, "mass_kg")


@dataclass(frozen=True)
class ElectricParameters:
    """Load of the sensing layer and capacitive feedthrough ``gamma = Cs / (Cp + Cs)``."""

    input_resistance_ohm: float
    feedthrough: float

    def __post_init__(self) -> None:
        check_above_zero(self, "input_resistance_ohm")
        require(0.0 < self.feedthrough < 1.0, "feedthrough", self.feedthrough, "above 0, below 1")


@dataclass(frozen=True)
class NonlinearParameters:
    """Static nonlinearity ``u + a2 u^2 + a3 u^3 + g2 s^2 + g3 s^3``, s the strain voltage."""

    actuator_cubic_per_v2: float
    strain_cubic_per_v2: float
    actuator_quadratic_per_v: float = 0.0
    strain_quadratic_per_v: float = 0.0


@dataclass(frozen=True)
class AcquisitionParameters:
    """Noise and converters.

    Noise is white: its rms scales with the square root of half the sample rate over
    `sensor_noise_bandwidth_hz`. The drive passes `actuator_divider` before its converter.
    """

    sensor_noise_v: float
    sensor_noise_bandwidth_hz: float
    adc_bits: int
    adc_range_v: float
    actuator_divider: float = 1.0

    def __post_init__(self) -> None:
        check_not_negative(self, "sensor_noise_v")
        check_above_zero(self, "sensor_noise_bandwidth_hz", "adc_range_v", "actuator_divider")
        check_within(self, adc_bits=(8, 31))

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
