# SPDX-License-Identifier: Apache-2.0
"""From wrenches and heights to what is known: bias, touch, the model of the contact, held force."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from tactile_resonance.contact.contact_filter import ContactFilter
from tactile_resonance.contact.estimator import TouchDetector
from tactile_resonance.contact.force_watch import ForceWatch
from tactile_resonance.contact.parameters import ContactParameters, Limits
from tactile_resonance.contact.result import Breach, Cause
from tactile_resonance.contact.samples import WrenchSample
from tactile_resonance.contact.tare import TareError, Zero, tare
from tactile_resonance.contact.vectors import vector


class ArmModel:
    """Acceleration limit, dead time and lag of the arm along the normal, one period at a time.

    The law needs from it the way that is still to come; the estimator the acceleration, whose
    force on a tool-mounted cell is not one of contact.

    Attributes
    ----------
    set_speed_m_s : float
        Commanded to the arm, after the acceleration limit.
    speed_m_s, acceleration_m_s2 : float
        Of the tip, as far as the model knows.
    """

    def __init__(self, parameters: ContactParameters) -> None:
        self._period_s = period_s = parameters.period_s
        self._lag_s = lag_s = parameters.arm_lag_s
        self._line: deque[float] = deque([0.0] * max(1, round(parameters.arm_dead_time_s / period_s)))
        self._keep = math.exp(-period_s / lag_s) if lag_s > 0 else 0.0
        self.set_speed_m_s = 0.0
        self.speed_m_s = 0.0
        self.acceleration_m_s2 = 0.0

    def step(self, speed_m_s: float, acceleration_m_s2: float) -> None:
        """Advance one period, commanded to a speed under an acceleration limit."""
        most = acceleration_m_s2 * self._period_s
        self.set_speed_m_s += min(most, max(-most, speed_m_s - self.set_speed_m_s))
        self._line.append(self.set_speed_m_s)
        delayed = self._line.popleft()
        before = self.speed_m_s
        self.speed_m_s = delayed + self._keep * (before - delayed)
        self.acceleration_m_s2 = (self.speed_m_s - before) / self._period_s

    @property
    def pending_m(self) -> float:
        """Way that the arm goes on if its set speed became zero now [m]."""
        return sum(self._line) * self._period_s + self.speed_m_s * self._lag_s


WINDOW_SAMPLES = 220
"""Forces kept for the first estimate of the contact: 440 ms at 500 Hz, 1.8 mm at 4 mm/s."""

LEAST_NOISE_N = 2e-5
"""The filter takes a force for no more certain than this [N]."""

QUIETEST_SHARE = 0.1
"""A sensor with less than this of the noise it states does not measure any more."""

LONGEST_GUESS_S = 0.02
"""So far beyond the newest state of the arm its height is continued [s]."""


class Observer:
    """Takes every force once, at the height at which it was measured.

    Attributes
    ----------
    parameters, limits : ContactParameters, Limits
        Of this contact.
    watch : ForceWatch
    arm_model : ArmModel
    model : ContactFilter or None
        From the touch on.
    taring : bool
        Whether forces are collected for a tare.
    sound : bool
        Whether no force of this contact was bad.
    touched_m : float or None
        Height of the surface as the first touch showed it.
    zero : Zero or None
        The bias, once there is one.
    noise_n, bias_std_n : float
        Of one force and of the bias, from the last tare [N].
    """

    def __init__(self, parameters: ContactParameters, limits: Limits) -> None:
        p = self.parameters = parameters
        self.limits = limits
        self.watch = ForceWatch(limits.stuck_samples, limits.lost_s)
        self.arm_model = ArmModel(p)
        self.model: ContactFilter | None = None
        self.taring = False
        self.sound = True
        self.touched_m: float | None = None
        self._unloaded: list[WrenchSample] = []
        self.zero: Zero | None = None
        self.noise_n = self.bias_std_n = 0.0
        self._heights: deque[tuple[int, float]] = deque(maxlen=50)  # time, height
        self._accelerations: deque[tuple[int, float]] = deque(maxlen=50)  # middle of period, m/s2
        self._carried_kg = p.carried_kg
        self._half_period_ns = round(0.5e9 * p.period_s)
        self._cell_lag_ns = round(1e9 * p.cell_lag_s)
        self._window: deque[tuple[float, float]] = deque(maxlen=WINDOW_SAMPLES)
        self._detector: TouchDetector | None = None
        self._model_ns = 0
        self._inflation = 1.0
        self._sum_n, self._count = 0.0, 0

    def begin_tare(self) -> None:
        """Collect forces for the bias from now on."""
        self.taring = True
        self._unloaded.clear()

    def end_tare(self, now_ns: int, before: Zero | None = None) -> Breach | None:
        """Take the bias and look for the touch from now on; what is wrong with it is returned.

        Parameters
        ----------
        now_ns : int
        before : Zero, optional
            What is known from the contact before: the forces are one more look at it. Then what does not
            agree with it, or leaves it too uncertain, is wrong too.
        """
        self.taring = False
        p = self.parameters
        try:
            look, noise = tare(self._unloaded, p, now_ns)
        except TareError as error:
            return Breach(Cause.TARE, str(error))
        if noise < QUIETEST_SHARE * p.cell_noise_n:
            text = f"tare: noise of {1e3 * noise:.2g} mN rms, the source states"
            return Breach(Cause.TARE, f"{text} {1e3 * p.cell_noise_n:g} mN: does it still measure?")
        zero: Zero | None = look
        if before is not None:
            zero = before.with_look(look, p.zero_walk_n_per_sqrt_s)
            if zero is not None and zero.std_n.max() > p.zero_std_n:
                zero = None
        if zero is None:
            return Breach(Cause.TARE, "tare: the zero is not known from the contact before")
        self.zero = zero
        self.watch.set_bias(vector(zero.force_n))
        self.noise_n = max(LEAST_NOISE_N, noise)
        self.bias_std_n = float(zero.std_n[2])
        # neighbouring forces that are alike make means less certain than white noise would
        inflation = float(look.std_n[2]) * math.sqrt(len(self._unloaded)) / noise
        self._inflation = max(1.0, inflation)
        self.seek_touch()
        return None

    def seek_touch(self) -> None:
        """Forget the contact and look for a touch."""
        self.model = self.touched_m = None
        self._window.clear()
        self._detector = TouchDetector(self._inflation * self.noise_n, self.bias_std_n)

    def begin_mean(self) -> None:
        """Average the force from now on."""
        self._sum_n, self._count = 0.0, 0

    def mean_force(self) -> tuple[float, float] | None:
        """Mean force since `begin_mean` and its deviation from noise and tare [N]; None if none."""
        if self._count == 0:
            return None
        std = math.hypot(self.noise_n / math.sqrt(self._count), self.bias_std_n)
        return self._sum_n / self._count, std

    def take(self, wrenches: Sequence[WrenchSample], arm_ns: int, height_m: float) -> Breach | None:
        """Take a state of the arm and the forces that came; stop at the first that is bad."""
        self._heights.append((arm_ns, height_m))
        carried_kg, inertia = self._carried_kg, 0.0
        if carried_kg > 0:
            middle = arm_ns - self._half_period_ns
            self._accelerations.append((middle, self.arm_model.acceleration_m_s2))
        watch, model, speed_m_s = self.watch, self.model, self.arm_model.speed_m_s
        for sample in wrenches:
            time_ns = sample[0]
            if carried_kg > 0:
                # a cell on the tool feels the contact less mass times acceleration
                then = time_ns - self._cell_lag_ns
                inertia = -carried_kg * _between(self._accelerations, then, 0.0)
            breach = watch.add(sample, inertia)
            if breach is not None:
                self.sound = False
                return breach
            if self.taring:
                self._unloaded.append(sample)
            elif self._detector is not None:
                force, height = watch.force_n[2], _between(self._heights, time_ns, speed_m_s)
                self._window.append((height, force))
                if model is not None:
                    model.follow((time_ns - self._model_ns) * 1e-9, height, force)
                    self._model_ns = time_ns
                    self._sum_n += force
                    self._count += 1
                elif self._detector.add(force):
                    model = self._touch(time_ns)
        return None

    def look_again(self) -> None:
        """Estimate the contact anew from all that was kept: what was detected may have been noise."""
        self._touch(self._model_ns)

    def _touch(self, time_ns: int) -> ContactFilter:
        heights, forces = zip(*self._window, strict=True)
        self.model = ContactFilter(
            heights,
            forces,
            noise_n=self.noise_n,
            beam_n_per_m=self.parameters.beam_n_per_m,
            vibration_m=self.parameters.arm_vibration_m,
            inflation=self._inflation,
        )
        if self.touched_m is None:
            self.touched_m = self.model.surface_m
        self._model_ns = time_ns
        return self.model


def _between(history: deque[tuple[int, float]], time_ns: int, rate_per_s: float) -> float:
    """Value at a time, linear between those known; beyond the newest it goes on at a rate."""
    after: tuple[int, float] | None = None
    for before in reversed(history):
        then_ns, value = before
        if then_ns > time_ns:
            after = before
        elif after is None:
            return value + rate_per_s * min(LONGEST_GUESS_S, (time_ns - then_ns) * 1e-9)
        else:
            share = (time_ns - then_ns) / (after[0] - then_ns)
            return value + share * (after[1] - value)
    return history[0][1]
