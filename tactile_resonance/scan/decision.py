# SPDX-License-Identifier: Apache-2.0
"""Enough? After each block: one more, or stop; and which measurements count, where the force must be quiet."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import AboveZero, Checked, Range, require
from tactile_resonance.poles.result import Poles
from tactile_resonance.record import Contact
from tactile_resonance.scan.failures import PointFailed
from tactile_resonance.tissue.classify import UNKNOWN, TissueClass, classify, log_density
from tactile_resonance.tissue.nominal_contact import ContactLoad, NominalContact, refer_to_nominal

# Poles outside of both classes by this much are of neither, and no block more will change it.
NEITHER_LEVEL = 1e-4
# How far beyond what was asked the prediction for the last block must lie to give up before it: estimated
# standard deviations scatter themselves.
HOPELESS_FACTOR = 1.5
# Likewise of a likelihood ratio: by how many standard deviations of what the blocks left will move it.
HOPELESS_STDS = 3.0


class Verdict(str, Enum):
    """What to do after a block; all but CONTINUE end the measurement."""

    CONTINUE = "continue"
    PRECISE = "precision reached"
    SEPARATED = "classes separated"
    NEITHER = "neither of the classes"
    MOST_BLOCKS = "most blocks reached"
    HOPELESS = "precision out of reach"


@dataclass(frozen=True)
class BlockLimits:
    """Fewest and most blocks at a point."""

    least: int = 3
    most: int = 8

    def __post_init__(self) -> None:
        require(self.least >= 1, "least", self.least, "1 or above")
        require(self.most >= self.least, "most", self.most, f"at least least = {self.least}")


@dataclass(frozen=True)
class Precise(Checked):
    """Standard deviations asked for; None: as it comes.

    They are those of the total covariance where it is known, else of that from noise.
    """

    f0_std_hz: AboveZero | None = None
    damping_ratio_std: AboveZero | None = None

    def verdict(
        self, estimate: FloatArray, covariance: FloatArray, noise: FloatArray, blocks: int, limits: BlockLimits
    ) -> tuple[Verdict, str]:
        """Whether it is reached, or out of reach: noise falls with the number of blocks, other errors stay."""
        stds = (self.f0_std_hz, self.damping_ratio_std)
        asked = np.array([math.inf if std is None else std for std in stds])
        variance = np.diag(covariance)
        if np.all(np.sqrt(variance) <= asked):
            return Verdict.PRECISE, ""
        falling = np.fmin(np.diag(noise), variance)  # all of it where its noise is unknown
        last = np.sqrt(variance - falling + falling * blocks / limits.most)
        missing = np.sqrt(variance) > asked
        if blocks < limits.most and np.any(missing & (last > HOPELESS_FACTOR * asked)):
            return Verdict.HOPELESS, ""
        return Verdict.CONTINUE, ""


@dataclass(frozen=True)
class Separate:
    """Distinguish two tissues: each kind of error happens with at most ``1 - probability``."""

    first: TissueClass
    second: TissueClass
    probability: float

    def __post_init__(self) -> None:
        require(0.5 < self.probability < 1, "probability", self.probability, "between 0.5 and 1")
        names = (self.first.name, self.second.name)
        require(names[0] != names[1], "separate", names, "two classes")

    def verdict(
        self, estimate: FloatArray, covariance: FloatArray, noise: FloatArray, blocks: int, limits: BlockLimits
    ) -> tuple[Verdict, str]:
        """Verdict and class, by Wald's sequential test with equal errors (Ann. Math. Stat. 16 (1945) 117).

        A likelihood ratio of all that was seen is a martingale under the class in its denominator, whatever the
        blocks have in common, so that its bound holds whenever the test stops (Ville). It gives up where the
        blocks left will not take it to either bound, which causes no errors.
        """
        classes = [self.first, self.second]
        if classify(estimate, covariance, classes, NEITHER_LEVEL).name == UNKNOWN:
            return Verdict.NEITHER, ""
        threshold = math.log(self.probability / (1 - self.probability))
        ratio = self.log_likelihood_ratio(estimate, covariance)
        if abs(ratio) >= threshold:
            return Verdict.SEPARATED, classes[0 if ratio > 0 else 1].name
        left = 1 - blocks / limits.most
        if left > 0 and self._highest(estimate, covariance, noise, left) < threshold:
            return Verdict.HOPELESS, ""
        return Verdict.CONTINUE, ""

    def log_likelihood_ratio(self, estimates: FloatArray, covariance: FloatArray) -> FloatArray:
        """(...) logarithm of p(estimate | first) / p(estimate | second) of (..., 2), class spread included.

        For poles of all blocks together, with covariance C / n, it equals the sum over n independent blocks
        of covariance C where the classes have no spread: Wald's statistic. With spread it is still the
        likelihood ratio of all that was seen.
        """
        first = log_density(estimates, covariance, self.first)
        return first - log_density(estimates, covariance, self.second)

    def _highest(
        self, estimate: FloatArray, covariance: FloatArray, noise: FloatArray, left: float
    ) -> float:
        """How high the ratio may yet rise, or its negative, where this share of all blocks is left.

        The estimate of all blocks differs from the present one by the noise that goes; the ratio is all but
        linear in it.
        """
        known = np.all(np.diag(noise) <= np.diag(covariance))  # not where it is NaN
        going = left * (noise if known else covariance)
        last = covariance - going
        unit = np.sqrt(np.diag(going))
        values, vectors = np.linalg.eigh(going / np.outer(unit, unit))
        steps = (vectors * np.sqrt(np.maximum(values, 0))).T * unit
        beside = estimate + np.stack([steps, -steps])
        ratio, *moved = self.log_likelihood_ratio(np.vstack([estimate, *beside]), last)
        more, less = np.reshape(moved, (2, -1))
        return abs(ratio) + HOPELESS_STDS * float(np.linalg.norm(more - less)) / 2


@dataclass(frozen=True)
class Decision:
    """What to do after a block.

    Attributes
    ----------
    verdict : Verdict
    blocks : int
        Measured so far.
    blocks_saved : int
        Allowed and not needed; 0 while it goes on.
    saved_s : float
        Time of those.
    called : str
        Class that was decided for; empty where none was.
    """

    verdict: Verdict
    blocks: int
    blocks_saved: int = 0
    saved_s: float = 0.0
    called: str = ""

    @property
    def stop(self) -> bool:
        """Whether the measurement ends."""
        return self.verdict is not Verdict.CONTINUE


def decide(
    poles: Poles,
    pressed: ContactLoad,
    nominal: NominalContact | None,
    blocks: int,
    wanted: Precise | Separate | None,
    limits: BlockLimits,
    block_s: float,
) -> Decision:
    """Whether the poles of all blocks so far are enough.

    Two tissues are distinguished by the main pole at the nominal contact. Otherwise the main modes of all bands
    are to be as precise as wanted, and the first that is not decides: one for which more blocks are of use
    comes before one for which they are not.

    Parameters
    ----------
    poles : Poles
        Of all blocks so far, as measured.
    pressed : ContactLoad
        Force and age of the contact while they were.
    nominal : NominalContact or None
        To which the classes refer.
    blocks : int
        Measured so far, 1 or above.
    wanted : Precise, Separate or None
        None: measure until the most blocks.
    limits : BlockLimits
    block_s : float
        Duration of one block [s].
    """
    if isinstance(wanted, Separate):
        mode = poles.main
        at = refer_to_nominal(mode.estimate, mode.covariance, pressed, nominal)
        noise = mode.noise if np.all(np.isfinite(mode.noise)) else mode.covariance
        modes = [(at.compared, at.covariance, noise)]
    else:
        mains = (band.main for band in poles.bands)
        modes = [(mode.estimate, mode.covariance, mode.noise) for mode in mains]
    found = []
    for estimate, covariance, noise in modes:
        verdict, called = Verdict.CONTINUE, ""
        known = np.all(np.isfinite(covariance)) and np.all(np.isfinite(estimate))
        if blocks >= limits.least and wanted is not None and known:
            verdict, called = wanted.verdict(estimate, covariance, noise, blocks, limits)
        if verdict is Verdict.CONTINUE and blocks >= limits.most:
            verdict = Verdict.MOST_BLOCKS
        found.append((verdict, called))
    imprecise = [each for each in found if each[0] is not Verdict.PRECISE] or found
    undecided = (each for each in imprecise if each[0] is Verdict.CONTINUE)
    verdict, called = next(undecided, imprecise[0])
    saved = 0 if verdict is Verdict.CONTINUE else max(0, limits.most - blocks)
    return Decision(verdict, blocks, saved, saved * block_s, called)


@dataclass(frozen=True)
class Gate(Checked):
    """How quiet the force must be while a point is measured.

    The blocks of a measurement are one record from rest, whose transient is estimated along: none can be left
    out of it. So a measurement during which the force moved too much, as with a breath, is ended and repeated
    in the same contact.

    Attributes
    ----------
    force_rms_n : float
        Most that it may move by over the whole of a measurement: `ForceSpread.rms_n` [N].
    force_error_n : float
        Most that its mean may differ from the scene's force [N].
    measurements : int
        Most that are begun in one contact.
    """

    force_rms_n: AboveZero
    force_error_n: Annotated[float, Range(math.ulp(0.0), math.inf, "a number above 0")] = math.inf
    measurements: Annotated[int, Range(1, 100)] = 20


class GateKeeper:
    """Which measurements of one contact count.

    Parameters
    ----------
    gate : Gate or None
        None: every one.
    force_n : float
        Asked for.

    Attributes
    ----------
    left_out : list of (float, float)
        Of each measurement that does not count, mean of the force and rms of its motion [N].
    """

    def __init__(self, gate: Gate | None, force_n: float) -> None:
        self._gate, self._force_n = gate, force_n
        self.left_out: list[tuple[float, float]] = []
        self._shut = False

    def shuts(self, contact: Contact) -> bool:
        """Whether the measurement under way is to be ended: the force has moved too much, or is another.

        Raises
        ------
        PointFailed
            If it is not known how the force moved.
        """
        if self._gate is None:
            return False
        if math.isnan(contact.spread.rms_n):
            reason = contact.reason or "too few forces were measured"
            raise PointFailed(f"gate: how the force moved is unknown: {reason}")
        off_n = abs(contact.force_n - self._force_n)
        loud = contact.spread.rms_n > self._gate.force_rms_n or off_n > self._gate.force_error_n
        self._shut = self._shut or loud
        return self._shut

    def counts(self, contact: Contact) -> bool:
        """Whether a measurement that has ended counts.

        Raises
        ------
        PointFailed
            If it does not, and no other may be begun.
        """
        if not self.shuts(contact):
            return True
        assert self._gate is not None
        self.left_out.append((contact.force_n, contact.spread.rms_n))
        self._shut = False
        if len(self.left_out) < self._gate.measurements:
            return False
        raise PointFailed(f"gate: the force was never quiet: {self}")

    def __str__(self) -> str:
        """What was left out, for people; empty: nothing."""
        gate = self._gate
        if gate is None or not self.left_out:
            return ""
        each = ", ".join(f"{1e3 * mean:.2f} (rms {1e3 * rms:.2f})" for mean, rms in self.left_out)
        accepted = f"rms up to {1e3 * gate.force_rms_n:g} mN"
        if gate.force_error_n < math.inf:
            low, high = (1e3 * (self._force_n + s * gate.force_error_n) for s in (-1, 1))
            accepted = f"{low:g} to {high:g} mN, {accepted}"
        return f"measurements left out: {len(self.left_out)}, with a force of {each} mN; accepted is {accepted}"
