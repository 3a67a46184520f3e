# SPDX-License-Identifier: Apache-2.0
"""Parameters of a sensor from responses in air, with known masses or springs at the tip, and of a loop-back.

One weighted least-squares fit of all records, with the closed form of `SensorModel`. In air ``1 / (1 - G)``
is a sum over the modes (but for the leak), whose peaks start the fit; how far a mass or a spring moves them
starts the mode shapes at the tip. A known mass or stiffness has a standard deviation of its own, and is
estimated along.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from tactile_resonance._typing import ComplexArray, FloatArray
from tactile_resonance.calibration.model import PER_MODE, Calibration, SensorModel
from tactile_resonance.calibration.records import (
    CalibrationRecord,
    Load,
    one_above,
    start_channel,
    start_in_air,
    start_tip,
)
from tactile_resonance.fields import require

UNDETERMINED = 0.25
"""Relative standard deviation from which records do not determine a parameter."""
FEEDTHROUGH_STD, DELAY_STD_S = 0.01, 2e-5
"""Likewise of those that may be zero."""
LOOSE = 1e3
"""Times that, as a prior: keeps the normal matrix regular where nothing determines a parameter."""
WORTH_A_MODE = 50.0
"""By so much the squares in air fall where a mode above the band shows; by chance they fall by 3."""
MOST_STEPS, STEPS_ABOVE = 200, 20
"""Of the fit; of that with a mode above the band, which needs many where there is none."""
NOTABLE = 2.0
"""Mean square of residuals over that of noise from which on the result carries a note."""
CONTRADICT = 4.0
"""Deviations by which known loads may differ from what the records say of each other."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A calibration beside the records that it is of.

    Attributes
    ----------
    calibration : Calibration
    records : tuple of CalibrationRecord
    residuals : tuple of (F,) complex
        Of each record, over the root of its variance.
    """

    calibration: Calibration
    records: tuple[CalibrationRecord, ...]
    residuals: tuple[ComplexArray, ...]


def calibrate(records: Sequence[CalibrationRecord], modes: int | None = None) -> Fitted:
    """Parameters of the sensor from all records together.

    Parameters
    ----------
    records : sequence of CalibrationRecord
        One or more in air; of masses, springs and loop-backs as many as there are. Without a loop-back the gain
        is taken as 1; without a mass or spring nothing is known of the tip.
    modes : int, optional
        How many; as many as show in air when absent.

    Raises
    ------
    ValueError
        If there is no record in air, it shows fewer modes, or the first load moves the modes the wrong way.
    """
    records = tuple(records)
    air = [record for record in records if record.load is Load.AIR]
    require(bool(air), "records", [record.load.value for record in records], "one in air or more")
    loopback = [record for record in records if record.load is Load.LOOPBACK]
    loaded = [record for record in records if record.load in (Load.MASS, Load.SPRING)]
    gain, delay = start_channel(loopback)
    start = start_in_air(air[0], gain, delay, modes)

    def without_loads(start: SensorModel, steps: int) -> tuple[SensorModel, float]:
        solved = _Records([*air, *loopback], start.modes).solved(start, steps)
        return SensorModel.of_values(solved.values), float(np.sum(solved.residual**2))

    first, squares = without_loads(start, MOST_STEPS)
    shown = first.modes
    above = one_above(first, air[0].frf.frequency_hz[-1])
    further, fewer = without_loads(above, STEPS_ABOVE)
    if squares - fewer > WORTH_A_MODE:
        first = further
    if loaded:
        first = replace(first, tip_deflection=start_tip(loaded, first, shown))
    problem = _Records(records, first.modes)
    begun = problem.solved(first)
    # what repeats in every period, as the steps of a converter do, no variance over periods shows
    squares_of = [np.mean(part**2) for part in problem.parts(begun.residual)]
    excess = np.maximum(1.0, squares_of)
    problem.widen(excess)
    contradiction = problem.widen_loads(begun)
    solved = problem.solved(SensorModel.of_values(begun.values))
    return _fitted(problem, solved, excess, contradiction)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Natural values of all parameters, their covariance, and internal residuals."""

    values: FloatArray
    covariance: FloatArray
    residual: FloatArray


class _Records:
    """Residuals and their derivatives by logarithms of what is above 0, and by the others in their units.

    Without a known load the mode shapes at the tip are not free, without a loop-back the gain is not.
    """

    def __init__(self, records: Sequence[CalibrationRecord], modes: int) -> None:
        self.records, self.modes = tuple(records), modes
        self.known = [r for r in self.records if r.load in (Load.MASS, Load.SPRING)]
        self.has_loopback = any(r.load is Load.LOOPBACK for r in self.records)
        count = 4 * modes + 4
        self.free = np.ones(count, bool)
        self.free[3 * modes : 4 * modes] = bool(self.known)
        self.free[4 * modes + 2] = self.has_loopback
        self._log = np.zeros(count, bool)
        self._log[: 3 * modes] = self._log[4 * modes + 1] = self._log[4 * modes + 2] = True
        self._known_stds = np.array([max(r.value_std / r.value, 1e-9) for r in self.known])
        self._s = [record.s_rad_s for record in self.records]
        self._root = [np.sqrt(record.variance / 2) for record in self.records]

    def natural(self, x: FloatArray) -> FloatArray:
        """(4 n + 4,) parameters as `SensorModel` has them."""
        out = x[: self.free.size].copy()
        out[self._log] = np.exp(out[self._log])
        return out

    def solved(self, sensor: SensorModel, steps: int = MOST_STEPS) -> _Solved:
        """Least squares from the parameters of a sensor on."""
        n, x = self.modes, sensor.values.copy()
        tip, limits = np.abs(x[3 * n : 4 * n]), np.full(x.size, UNDETERMINED)
        limits[3 * n : 4 * n] *= np.where(tip > 0, tip, 1.0)
        limits[4 * n], limits[4 * n + 3] = FEEDTHROUGH_STD, DELAY_STD_S
        x[self._log] = np.log(x[self._log])
        start = np.concatenate([x, np.zeros(len(self.known))])
        active = np.concatenate([self.free, np.ones(len(self.known), bool)])
        scale = np.concatenate([limits, np.ones(len(self.known))])[active]

        def whole(z: FloatArray) -> FloatArray:
            x = start.copy()
            x[active] += z * scale
            return x

        def residual(z: FloatArray) -> FloatArray:
            return np.concatenate([self.residual(whole(z)), z[: self.free.sum()] / LOOSE])

        def jacobian(z: FloatArray) -> FloatArray:
            j = self.jacobian(whole(z))[:, active] * scale
            prior = np.eye(int(self.free.sum()), z.size) / LOOSE
            return np.concatenate([j, prior])

        names = [record.name or record.load.value for record in self.records]
        accepted = (
            "responses of sensor over actuator at which a fit can begin: are channels swapped, is the sample "
            "rate right?"
        )
        with np.errstate(invalid="ignore"):
            begins = bool(np.isfinite(self.residual(start)).all())
        require(begins, "records", names, accepted)
        # there are no bounds: a QR of the long Jacobian is enough, "trf" takes its singular values
        found = optimize.least_squares(
            residual, np.zeros(scale.size), jacobian, x_scale="jac", method="lm", max_nfev=steps
        )
        x = whole(found.x)
        of_active = np.linalg.inv(found.jac.T @ found.jac) * np.outer(scale, scale)
        covariance = np.zeros((x.size, x.size))
        covariance[np.ix_(active, active)] = of_active
        values = self.natural(x)
        slope = np.where(self._log, values, 1.0)
        covariance = covariance[: values.size, : values.size] * np.outer(slope, slope)
        return _Solved(values, covariance, self.residual(x))

    def parts(self, residual: FloatArray) -> list[FloatArray]:
        """(2, F) real and imaginary part of a residual, of each record."""
        ends = np.cumsum([2 * record.frf.g.size for record in self.records])
        return [part.reshape(2, -1) for part in np.split(residual, ends)[:-1]]

    def widen(self, excess: FloatArray) -> None:
        """Multiply the variance of each record (R,)."""
        self._root = [root * np.sqrt(e) for root, e in zip(self._root, excess, strict=True)]

    def widen_loads(self, solved: _Solved) -> str:
        """Make known loads that contradict each other as uncertain as they do; a note where they do.

        Birge's ratio: the root of their mean squared deviation, by one less than their number.
        """
        count = len(self.known)
        if count < 2:
            return ""
        off = solved.residual[-count:]
        ratio = math.sqrt(float(np.sum(off**2)) / (count - 1))
        if ratio < CONTRADICT:
            return ""
        fitted = [
            f"{record.value:.6g} of {record.name or record.load.value} fits as "
            f"{record.value * math.exp(part * std):.4g}"
            for record, part, std in zip(self.known, off, self._known_stds, strict=True)
        ]
        self._known_stds = self._known_stds * ratio
        return (
            f"the known loads contradict each other ({', '.join(fitted)}): their deviations are taken "
            f"{ratio:.1f} times as large"
        )

    def residual(self, x: FloatArray) -> FloatArray:
        """(2 F,) real and imaginary parts of all records, then deviations of known loads."""
        sensor = SensorModel.of_values(self.natural(x))
        rows = []
        for record, s, root in zip(self.records, self._s, self._root, strict=True):
            gap = (self._model(sensor, record, s, x) - record.frf.g) / root
            rows += [gap.real, gap.imag]
        return np.concatenate([*rows, x[self.free.size :] / self._known_stds])

    def _load(self, record: CalibrationRecord, s: ComplexArray, x: FloatArray) -> ComplexArray:
        if record not in self.known:
            return np.zeros_like(s)
        factor = np.exp(x[self.free.size + self.known.index(record)])
        return record.value * factor * record.stiffness(s)

    def _model(
        self, sensor: SensorModel, record: CalibrationRecord, s: ComplexArray, x: FloatArray
    ) -> ComplexArray:
        if record.load is Load.LOOPBACK:
            return np.asarray(sensor.gain * np.exp(-s * sensor.delay_s))
        return sensor.response(s, self._load(record, s, x))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(R, 4 n + 4 + loads) derivatives of `residual`."""
        sensor = SensorModel.of_values(self.natural(x))
        count = x.size
        blocks = []
        for record, s, root in zip(self.records, self._s, self._root, strict=True):
            d = np.zeros((s.size, count), complex)
            if record.load is Load.LOOPBACK:
                g = self._model(sensor, record, s, x)
                n = self.modes
                d[:, 4 * n + 2], d[:, 4 * n + 3] = g, -s * g
            else:
                load = self._load(record, s, x)
                d[:, : self.free.size], by_load = derivatives(sensor, s, load)
                if record in self.known:
                    d[:, self.free.size + self.known.index(record)] = by_load * load
            d /= root[:, None]
            blocks += [d.real, d.imag]
        last = np.zeros((len(self.known), count))
        last[:, self.free.size :] = np.diag(1 / self._known_stds)
        return np.concatenate([*blocks, last])


def derivatives(
    sensor: SensorModel, s: ComplexArray, load: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Derivatives of the response by all parameters (F, 4 n + 4), and by the stiffness at the tip (F,).

    By the logarithms of w, zeta, chi, leak and gain; by phi, gamma and the delay themselves.
    """
    n = sensor.modes
    w, zeta, chi, phi = (getattr(sensor, name) for name in PER_MODE)  # (n,) each
    inverse = 1 / (s[:, None] ** 2 + 2 * zeta * w * s[:, None] + w**2)  # (F, n)
    a, b, c = inverse @ chi**2, inverse @ (chi * phi), inverse @ phi**2
    loop = 1 + load * c
    x = a - load * b**2 / loop
    numerator, denominator = sensor.feedthrough + x, 1 + x + sensor.leak_rad_s / s
    channel = sensor.gain * np.exp(-s * sensor.delay_s)
    by_x = channel * (denominator - numerator) / denominator**2
    by_a, by_b, by_c = by_x, -2 * by_x * load * b / loop, by_x * (load * b / loop) ** 2
    # by 1 / D_i: (F, n)
    by_inverse = by_a[:, None] * chi**2 + by_b[:, None] * (chi * phi) + by_c[:, None] * phi**2
    damping = 2 * zeta * w * s[:, None]
    out = np.empty((s.size, 4 * n + 4), complex)
    out[:, :n] = -by_inverse * (damping + 2 * w**2) * inverse**2
    out[:, n : 2 * n] = -by_inverse * damping * inverse**2
    out[:, 2 * n : 3 * n] = (2 * by_a[:, None] * chi**2 + by_b[:, None] * chi * phi) * inverse
    out[:, 3 * n : 4 * n] = (by_b[:, None] * chi + 2 * by_c[:, None] * phi) * inverse
    response = channel * numerator / denominator
    out[:, 4 * n] = channel / denominator
    out[:, 4 * n + 1] = -response / denominator * sensor.leak_rad_s / s
    out[:, 4 * n + 2] = response
    out[:, 4 * n + 3] = -s * response
    return out, -by_x * (b / loop) ** 2


def _fitted(
    problem: _Records, solved: _Solved, excess: FloatArray, contradiction: str
) -> Fitted:
    n = problem.modes
    residuals, notes = [], []
    parts = problem.parts(solved.residual)
    for record, wide, part in zip(problem.records, excess, parts, strict=True):
        real, imaginary = part * np.sqrt(wide / 2)
        residuals.append(real + 1j * imaginary)
        if wide > NOTABLE:
            notes.append(
                f"{record.name or record.load.value}: residuals are {np.sqrt(wide):.2f} times as large "
                "as noise, deviations are so much wider"
            )
    size = np.abs(solved.values)
    limit = UNDETERMINED * size
    limit[4 * n], limit[4 * n + 3] = FEEDTHROUGH_STD, DELAY_STD_S
    determined = problem.free & (np.sqrt(np.diag(solved.covariance)) < limit)
    if not problem.has_loopback:
        notes.append("gain of the channels taken as 1, and their delay not measured: no loop-back")
    if contradiction:
        notes.append(contradiction)
    if not problem.known:
        notes.append("nothing is known of the tip: no record with a mass or spring")
    air = next(record for record in problem.records if record.load is Load.AIR)
    band = air.frf.frequency_hz
    calibration = Calibration(
        SensorModel.of_values(solved.values),
        solved.covariance,
        determined,
        (float(band[0]), float(band[-1])),
        air.noise_v_per_root_hz,
        float(np.max(excess)),
        "; ".join(notes),
    )
    return Fitted(calibration, problem.records, tuple(residuals))
