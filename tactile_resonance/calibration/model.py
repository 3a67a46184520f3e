# SPDX-License-Identifier: Apache-2.0
"""A bimorph with a tip in modal parameters, in air or on any contact, and what is known of one by calibration.

With ``D_i = s^2 + 2 zeta_i w_i s + w_i^2``, ``A = sum chi_i^2 / D_i``, ``B = sum chi_i phi_i / D_i``,
``C = sum phi_i^2 / D_i`` and the stiffness k(s) of the contact::

    X = A - k B^2 / (1 + k C)
    G = gain exp(-s delay) (gamma + X) / (1 + X + leak / s)

chi is the modal force per volt over the root of the capacitance Ct: voltages alone do not show the two apart.
The tip's receptance is C, so that phi has the scale of a known mass (``k = m s^2``) or spring at the tip.
Modes above those that are listed add a constant to A, which gamma, chi and leak take up, and to B and C,
where it is left out: what is excited must lie below the highest listed mode. Piezoelectric beam equations:
Erturk & Inman, *Piezoelectric Energy Harvesting* (2011), chapter 3.

The file of a `CalibratedSensor` is what `tactile_resonance calibrate` writes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import BoolArray, ComplexArray, FloatArray
from tactile_resonance.configuration import dump_yaml
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    OrUnknown,
    build,
    known,
    number,
    read,
    read_dataclass,
    read_yaml,
    require,
)

PER_MODE = ("natural_rad_s", "damping_ratio", "coupling_rad_s", "tip_deflection")
SINGLE = ("feedthrough", "leak_rad_s", "gain", "delay_s")
FORMAT = "tactile_resonance sensor calibration 1"
T = TypeVar("T")
_HEADER = """\
# A calibrated sensor: `tactile_resonance calibrate` wrote this. Rows of `covariance`, entries of `determined`:
# those of natural_rad_s, damping_ratio, coupling_rad_s, tip_deflection (a mode each), feedthrough,
# leak_rad_s, gain, delay_s. What the records do not determine has a wide deviation, and is no statement.
"""


@dataclass(frozen=True, eq=False)
class ContactStiffness:
    """``k(s) = K + sum_j K_j s tau_j / (1 + s tau_j) + c s + m s^2``; leading axes (...) are a stack.

    Attributes
    ----------
    elastic_n_per_m : (...) float
        K.
    relaxing_n_per_m, times_s : (..., J) float
        K_j, 0 or above, and tau_j.
    viscous_ns_per_m, mass_kg : (...) float
        c and m.
    """

    elastic_n_per_m: FloatArray | float = 0.0
    relaxing_n_per_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    times_s: FloatArray = field(default_factory=lambda: np.ones(0))
    viscous_ns_per_m: FloatArray | float = 0.0
    mass_kg: FloatArray | float = 0.0

    def at(self, s: npt.ArrayLike) -> ComplexArray:
        """(..., S) k at s (..., S) [rad/s]."""
        s = np.asarray(s, complex)
        x = s[..., None] * self.times_s[..., None, :]
        relaxing = (self.relaxing_n_per_m[..., None, :] * x / (1 + x)).sum(axis=-1)
        k, c, m = (
            np.asarray(value)[..., None]
            for value in (self.elastic_n_per_m, self.viscous_ns_per_m, self.mass_kg)
        )
        return np.asarray(k + relaxing + c * s + m * s**2)

    def slope(self, s: npt.ArrayLike) -> ComplexArray:
        """(..., S) derivative of k by s."""
        s = np.asarray(s, complex)
        tau = self.times_s[..., None, :]
        relaxing = self.relaxing_n_per_m[..., None, :] * tau / (1 + s[..., None] * tau) ** 2
        c, m = (np.asarray(x)[..., None] for x in (self.viscous_ns_per_m, self.mass_kg))
        return np.asarray(relaxing.sum(axis=-1) + c + 2 * m * s)


AIR = ContactStiffness()


def _read_single(value: object, field: str) -> FloatArray:
    return np.array(number(value, field))


def _read_flags(value: object, field: str) -> BoolArray:
    return np.array(read(tuple[bool, ...], value, field))


@dataclass(frozen=True, eq=False)
class SensorModel:
    """Parameters of one sensor, or of a stack of them: leading axes (...) of all fields.

    Attributes
    ----------
    natural_rad_s : (..., n) float
        Undamped natural frequencies in air, electrodes short-circuited [rad/s].
    damping_ratio : (..., n) float
    coupling_rad_s : (..., n) float
        ``chi_i / sqrt(Ct)``, positive [rad/s].
    tip_deflection : (..., n) float
        Mass-normalised mode shapes at the tip, with the sign of chi positive [kg^-1/2].
    feedthrough : (...) float
        gamma, the limit of G at infinite frequency over `gain`.
    leak_rad_s : (...) float
        ``1 / (R Ct)`` [rad/s].
    gain : (...) float
        Of the sensor channel over the actuator channel.
    delay_s : (...) float
        Of the sensor channel behind the actuator channel [s].
    """

    natural_rad_s: FloatArray
    damping_ratio: FloatArray
    coupling_rad_s: FloatArray
    tip_deflection: FloatArray
    feedthrough: Annotated[FloatArray, _read_single]
    leak_rad_s: Annotated[FloatArray, _read_single]
    gain: Annotated[FloatArray, _read_single]
    delay_s: Annotated[FloatArray, _read_single]

    @property
    def modes(self) -> int:
        """Number n of modes."""
        return self.natural_rad_s.shape[-1]

    @property
    def names(self) -> tuple[str, ...]:
        """(4 n + 4,) of all parameters."""
        return (*(f"{name}[{i + 1}]" for name in PER_MODE for i in range(self.modes)), *SINGLE)

    @property
    def values(self) -> FloatArray:
        """(..., 4 n + 4) all parameters, in the order of `names`."""
        single = [np.asarray(getattr(self, name))[..., None] for name in SINGLE]
        return np.concatenate([*(getattr(self, name) for name in PER_MODE), *single], axis=-1)

    @classmethod
    def of_values(cls, values: npt.ArrayLike) -> SensorModel:
        """Return the sensor of (..., 4 n + 4) parameters."""
        x = np.asarray(values, float)
        n = (x.shape[-1] - len(SINGLE)) // len(PER_MODE)
        per_mode = (x[..., i * n : (i + 1) * n] for i in range(len(PER_MODE)))
        return cls(*per_mode, *np.moveaxis(x[..., 4 * n :], -1, 0))

    def _sums(self, inverse: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """A, B and C of 1 / D_i (..., S, n), or their slopes of its slope, each (..., S)."""
        chi, phi = self.coupling_rad_s[..., None, :], self.tip_deflection[..., None, :]
        weights = (chi**2, chi * phi, phi**2)
        return tuple((inverse * weight).sum(axis=-1) for weight in weights)

    def response(self, s: ComplexArray, stiffness: ComplexArray | float = 0.0) -> ComplexArray:
        """(..., S) G at s [rad/s] on a contact of this stiffness there [N/m]; 0: in air."""
        a, b, c = self._sums(1 / self._denominators(s)[0])
        x = a - stiffness * b**2 / (1 + stiffness * c)
        gamma, leak, gain, delay = (np.asarray(getattr(self, name))[..., None] for name in SINGLE)
        return gain * np.exp(-s * delay) * (gamma + x) / (1 + x + leak / s)

    def state_space(self, contact: ContactStiffness) -> tuple[FloatArray, FloatArray]:
        """(..., N, N) A and (..., N) B on a contact, from actuator voltage, but for gain and delay.

        States, over the root of Ct: ``w_i q_i``, ``q_i'``, ``sqrt(Ct) v`` and, of each relaxation, ``sqrt(K_j)
        z_j``, whose squares are energies, which keeps the eigenvalue problem well conditioned.
        """
        w, chi, phi = self.natural_rad_s, self.coupling_rad_s, self.tip_deflection
        n, relaxing = self.modes, contact.relaxing_n_per_m
        terms = relaxing.shape[-1]
        size = 2 * n + 1 + terms
        batch = np.broadcast_shapes(w.shape[:-1], relaxing.shape[:-1])
        q, dq, v, z = slice(0, n), slice(n, 2 * n), 2 * n, slice(2 * n + 1, size)
        a = np.zeros((*batch, size, size + 1))  # B behind it: the mass acts on both
        index = np.arange(n)
        a[..., index, n + index] = w
        a[..., n + index, index] = -w
        a[..., n + index, n + index] = -2 * self.damping_ratio * w
        a[..., dq, v] = -chi
        a[..., v, dq] = chi
        a[..., v, v] = -self.leak_rad_s
        a[..., dq, -1] = chi * (1 - np.asarray(self.feedthrough))[..., None]
        a[..., v, -1] = -self.feedthrough * self.leak_rad_s
        root, rate = np.sqrt(np.maximum(relaxing, 0)), 1 / contact.times_s
        glassy = contact.elastic_n_per_m + relaxing.sum(axis=-1)
        outer = phi[..., :, None] * phi[..., None, :]
        a[..., dq, q] -= np.asarray(glassy)[..., None, None] * outer / w[..., None, :]
        a[..., dq, dq] -= np.asarray(contact.viscous_ns_per_m)[..., None, None] * outer
        a[..., dq, z] = phi[..., :, None] * root[..., None, :]
        a[..., z, q] = (rate * root)[..., :, None] * (phi / w)[..., None, :]
        last = 2 * n + 1 + np.arange(terms)
        a[..., last, last] = -rate
        # the mass: (I + m phi phi')^-1 by Sherman and Morrison
        mass = np.asarray(contact.mass_kg)[..., None]
        share = mass * phi / (1 + mass * (phi**2).sum(axis=-1, keepdims=True))
        a[..., dq, :] -= share[..., :, None] * (phi[..., None, :] @ a[..., dq, :])
        return a[..., :-1], a[..., -1]

    def poles(self, contact: ContactStiffness) -> ComplexArray:
        """(..., N) all poles on a contact [rad/s], conjugates included, in no order."""
        return np.linalg.eigvals(self.state_space(contact)[0]).astype(complex)

    def residues(self, poles: ComplexArray, contact: ContactStiffness) -> ComplexArray:
        """(..., N) residues of ``G / (gain exp(-s delay))`` at poles (..., N) [rad/s]."""
        denominator, slope = self._denominators(poles)
        a, b, c = self._sums(1 / denominator)
        da, db, dc = self._sums(-slope / denominator**2)
        gamma, leak = (np.asarray(getattr(self, name))[..., None] for name in SINGLE[:2])
        with np.errstate(divide="ignore", invalid="ignore"):
            k, dk = contact.at(poles), contact.slope(poles)
            loop = 1 + k * c
            dx = da - (2 * k * b * db + dk * b**2) / loop + k * b**2 * (dk * c + k * dc) / loop**2
            residues = (gamma - 1 - leak / poles) / (dx - leak / poles**2)
        # at -1 / tau_j there is nothing: the relaxation is too small to move its own pole
        return np.where(np.isfinite(k), residues, 0.0)

    def _denominators(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """(..., S, n) D_i at s (..., S), and their slopes."""
        s = np.asarray(s)[..., None]  # (..., S, 1)
        w, zeta = self.natural_rad_s[..., None, :], self.damping_ratio[..., None, :]
        return np.asarray(s**2 + 2 * zeta * w * s + w**2), np.asarray(2 * s + 2 * zeta * w)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Parameters of one sensor, with what is known of them.

    Attributes
    ----------
    model : SensorModel
    covariance : (p, p) float
        Of `SensorModel.values`.
    determined : (p,) bool
        Which the records determine; the others keep a value and a wide deviation.
    band_hz : (float, float)
        First and last line in air.
    noise_v_per_root_hz : float
        Of the sensor channel, one-sided; NaN where unknown.
    excess : float
        Mean square of the residuals over that of noise, of the record where it is largest; 1 where none is
        larger.
    message : str
        What a reader should know; empty where there is nothing to say.
    """

    model: SensorModel
    covariance: FloatArray
    determined: Annotated[BoolArray, _read_flags]
    band_hz: tuple[float, float]
    noise_v_per_root_hz: OrUnknown
    excess: float
    message: str = ""

    @property
    def std(self) -> FloatArray:
        """(p,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def one_moved_each(self) -> tuple[SensorModel, FloatArray]:
        """Sensors (f,) with one parameter by its deviation off, and the correlation (f, f) of these."""
        std, free = self.std, np.flatnonzero(self.std > 0)
        moved = np.tile(self.model.values, (free.size, 1))
        moved[np.arange(free.size), free] += std[free]
        scale = np.outer(std[free], std[free])
        return SensorModel.of_values(moved), self.covariance[np.ix_(free, free)] / scale

    def knows_tip(self) -> bool:
        """Whether the first two mode shapes at the tip are determined, without which no contact is."""
        n = self.model.modes
        return bool(self.determined[3 * n : 3 * n + min(2, n)].all())


@dataclass(frozen=True, eq=False)
class CalibratedSensor(Checked):
    """Content of a file.

    Attributes
    ----------
    calibration : Calibration
    tip_radius_m : float
        Of the ball.
    tip_mass_kg, tip_mass_std_kg : float
        NaN where not determined.
    about : dict
        What else a reader should know: sensor, date, records.
    """

    calibration: Calibration
    tip_radius_m: AboveZero
    tip_mass_kg: OrUnknown = math.nan
    tip_mass_std_kg: OrUnknown = math.nan
    about: dict[str, Any] = field(default_factory=dict)

    def as_text(self) -> str:
        """Content of the file."""
        made, model = self.calibration, self.calibration.model
        content = {
            "format": FORMAT,
            **self.about,
            "tip_radius_m": self.tip_radius_m,
            "tip_mass_kg": known(self.tip_mass_kg),
            "tip_mass_std_kg": known(self.tip_mass_std_kg),
            "band_hz": list(made.band_hz),
            "noise_v_per_root_hz": known(made.noise_v_per_root_hz),
            "excess": made.excess,
            "message": made.message,
            **{name: getattr(model, name).tolist() for name in (*PER_MODE, *SINGLE)},
            "determined": made.determined.tolist(),
            "covariance": made.covariance.tolist(),
        }
        return _HEADER + dump_yaml(content)


def read_calibration(path: Path) -> CalibratedSensor:
    """Read a file that `tactile_resonance calibrate` wrote.

    Parameters
    ----------
    path : path

    Raises
    ------
    ValueError
        If it cannot be read, or is something else; names field, value and what is accepted.
    """
    content, where = read_yaml(path), f"{path.name}:"
    form = content.pop("format", None)
    accepted = f"{FORMAT!r}, as tactile_resonance calibrate writes it"
    require(form == FORMAT, f"{path}: format", form, accepted)

    def part(kind: type[T], **given: object) -> T:
        own = {f.name for f in fields(kind)} - given.keys() & content.keys()  # type: ignore[arg-type]
        return read_dataclass(kind, {name: content.pop(name) for name in own}, where, **given)

    calibration = part(Calibration, model=part(SensorModel))
    build(_check_content, where, calibration)
    return part(CalibratedSensor, calibration=calibration, about=content)


def _check_content(made: Calibration) -> None:
    """Raise ``ValueError`` where the numbers of a file are not those of one sensor."""
    model, modes = made.model, made.model.natural_rad_s.size
    require(modes > 0, "natural_rad_s", [], "a list of one mode or more")
    for name in PER_MODE:
        of = getattr(model, name)
        require(of.shape == (modes,), name, of.tolist(), f"a list of {modes} numbers")
        good = name == "tip_deflection" or bool(np.all(of > 0))
        require(good, name, of.tolist(), "numbers above 0")
    rising = bool(np.all(np.diff(model.natural_rad_s) > 0))
    require(rising, "natural_rad_s", model.natural_rad_s.tolist(), "ascending frequencies")
    noise, gain, leak = made.noise_v_per_root_hz, float(model.gain), float(model.leak_rad_s)
    require(not noise <= 0, "noise_v_per_root_hz", noise, "a number above 0")
    require(made.excess > 0, "excess", made.excess, "a number above 0")
    require(gain > 0, "gain", gain, "a number above 0")
    require(leak >= 0, "leak_rad_s", leak, "a number, 0 or above")
    size, shape = 4 * modes + 4, made.covariance.shape
    require(made.determined.size == size, "determined", made.determined.size, f"{size} entries")
    require(shape == (size, size), "covariance", shape, f"{size} rows of {size} numbers")
    variances = np.diag(made.covariance)
    # what is all but uncorrelated differs by the rounding of an inverse
    rounding = 1e-6 * np.sqrt(np.outer(variances, variances))
    good = bool(np.all(variances >= 0))
    good = good and bool(np.all(np.abs(made.covariance - made.covariance.T) <= rounding))
    require(good, "covariance", "another matrix", "a symmetric one with variances, 0 or above")
