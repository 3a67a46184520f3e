# SPDX-License-Identifier: Apache-2.0
"""Enough? After each block: one more, or stop, and why."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from tactile_resonance._typing import FloatArray
from tactile_resonance.fields import check_above_zero, counted, require
from tactile_resonance.poles.result import MainMode, Poles
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
class Precise:
    """Standard deviations asked for; None: as it comes.

    They are those of the total covariance where it is known, else of that from noise.
    """

    f0_std_hz: float | None = None
    damping_ratio_std: float | None = None

    def __post_init__(self) -> None:
        check_above_zero(self, "f0_std_hz", "damping_ratio_std")


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


@dataclass(frozen=True)
class BlockLimits:
    """Fewest and most blocks at a point."""

    least: int = 3
    most: int = 8

    def __post_init__(self) -> None:
        require(self.least >= 1, "least", self.least, "1 or above")
        require(self.most >= self.least, "most", self.most, f"at least least = {self.least}")


@dataclass(frozen=True)
class Decision:
    """What to do after a block.

    Attributes
    ----------
    verdict : Verdict
    reason : str
        A sentence for people.
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
    reason: str
    blocks: int
    blocks_saved: int = 0
    saved_s: float = 0.0
    called: str = ""

    @property
    def stop(self) -> bool:
        """Whether the measurement ends."""
        return self.verdict is not Verdict.CONTINUE


def decide(
    estimate: npt.ArrayLike,
    covariance: npt.ArrayLike,
    noise: npt.ArrayLike,
    blocks: int,
    wanted: Precise | Separate | None,
    limits: BlockLimits,
    block_s: float,
) -> Decision:
    """Whether the poles of all blocks so far are enough.

    Parameters
    ----------
    estimate : (2,) float
        f0 [Hz] and damping ratio from all blocks so far; NaN where there is none yet.
    covariance, noise : (2, 2) float
        Of the estimate, as of `Poles.main`: the best one known, and what of it is noise; NaN where unknown.
    blocks : int
        Measured so far, 1 or above.
    wanted : Precise, Separate or None
        None: measure until the most blocks.
    limits : BlockLimits
    block_s : float
        Duration of one block [s].
    """
    x, best, of_noise = (np.asarray(each, float) for each in (estimate, covariance, noise))
    verdict, reason, called = Verdict.CONTINUE, "fewer blocks than required at least", ""
    if blocks >= limits.least and wanted is not None:
        if not (np.all(np.isfinite(best)) and np.all(np.isfinite(x))):
            reason = "no pole with a covariance yet"
        elif isinstance(wanted, Separate):
            verdict, reason, called = _separated(x, best, of_noise, blocks, wanted, limits)
        else:
            verdict, reason = _precise(best, of_noise, blocks, wanted, limits)
    elif wanted is None:
        reason = "no precision requested"
    if verdict is Verdict.CONTINUE and blocks >= limits.most:
        verdict, reason = Verdict.MOST_BLOCKS, f"{counted(blocks, 'block')}; {reason}"
    saved = 0 if verdict is Verdict.CONTINUE else max(0, limits.most - blocks)
    return Decision(verdict, reason, blocks, saved, saved * block_s, called)


def decide_bands(
    poles: Poles,
    blocks: int,
    wanted: Precise | None,
    limits: BlockLimits,
    block_s: float,
) -> Decision:
    """Whether the main modes of all bands are as precise as wanted; the first that is not decides.

    One for which more blocks are of use comes before one for which they are not.

    Parameters
    ----------
    poles : Poles
        Of all blocks so far.
    blocks, wanted, limits, block_s
        As `decide`.
    """
    of_bands = [
        decide(mode.estimate, mode.covariance, mode.noise, blocks, wanted, limits, block_s)
        for mode in (band.main for band in poles.bands)
    ]
    imprecise = [each for each in of_bands if each.verdict is not Verdict.PRECISE] or of_bands
    return next((each for each in imprecise if not each.stop), imprecise[0])


def decide_tissue(
    mode: MainMode,
    pressed: ContactLoad,
    nominal: NominalContact | None,
    blocks: int,
    wanted: Separate,
    limits: BlockLimits,
    block_s: float,
) -> Decision:
    """Whether the pole of all blocks so far tells two tissues apart: the one at the nominal contact.

    Parameters
    ----------
    mode : MainMode
        As measured.
    pressed : ContactLoad
        Force and age of the contact while it was.
    nominal : NominalContact or None
        To which the classes refer.
    blocks, wanted, limits, block_s
        As `decide`.
    """
    at = refer_to_nominal(mode.estimate, mode.covariance, pressed, nominal)
    noise = mode.noise if np.all(np.isfinite(mode.noise)) else mode.covariance
    decision = decide(at.compared, at.covariance, noise, blocks, wanted, limits, block_s)
    if np.isnan(at.compared).any() and at.note:
        return replace(decision, reason=at.note)
    return decision


def log_likelihood_ratio(estimate: FloatArray, covariance: FloatArray, wanted: Separate) -> float:
    """Logarithm of p(estimate | first) / p(estimate | second), class spread included.

    For poles of all blocks together, with covariance C / n, it equals the sum over n independent blocks
    of covariance C where the classes have no spread: Wald's statistic. With spread it is still the
    likelihood ratio of all that was seen.
    """
    first = log_density(estimate, covariance, wanted.first)
    return first - log_density(estimate, covariance, wanted.second)


def _separated(
    estimate: FloatArray,
    covariance: FloatArray,
    noise: FloatArray,
    blocks: int,
    wanted: Separate,
    limits: BlockLimits,
) -> tuple[Verdict, str, str]:
    """Wald's sequential probability ratio test with equal errors (Ann. Math. Stat. 16 (1945) 117).

    A likelihood ratio of all that was seen is a martingale under the class in its denominator, whatever the
    blocks have in common, so that its bound holds whenever the test stops (Ville). It gives up where the
    blocks left will not take it to either bound, which causes no errors.
    """
    a, b = wanted.first, wanted.second
    if classify(estimate, covariance, [a, b], NEITHER_LEVEL).name == UNKNOWN:
        reason = f"outside of {a.name} and {b.name} ({NEITHER_LEVEL:g} of their members lie there)"
        return Verdict.NEITHER, reason, ""
    threshold = math.log(wanted.probability / (1 - wanted.probability))
    ratio = log_likelihood_ratio(estimate, covariance, wanted)
    text = f"log likelihood ratio {ratio:+.2f}, +-{threshold:.2f} asked for"
    if abs(ratio) < threshold:
        left = 1 - blocks / limits.most
        if left > 0 and _out_of_reach(estimate, covariance, noise, left, wanted, threshold):
            return Verdict.HOPELESS, f"{text}, out of reach of {limits.most} blocks", ""
        return Verdict.CONTINUE, text, ""
    called = a.name if ratio > 0 else b.name
    return Verdict.SEPARATED, f"{called}: {text}", called


def _out_of_reach(
    estimate: FloatArray,
    covariance: FloatArray,
    noise: FloatArray,
    left: float,
    wanted: Separate,
    threshold: float,
) -> bool:
    """Whether the log likelihood ratio will stay within the bounds though this share of all blocks is left.

    The estimate of all blocks differs from the present one by the noise that goes; the ratio is all but
    linear in it.
    """
    known = np.all(np.diag(noise) <= np.diag(covariance))  # not where it is NaN
    going = left * (noise if known else covariance)
    last = covariance - going
    ratio = abs(log_likelihood_ratio(estimate, last, wanted))
    if ratio >= threshold:
        return False
    unit = np.sqrt(np.diag(going))
    values, vectors = np.linalg.eigh(going / np.outer(unit, unit))
    steps = (vectors * np.sqrt(np.maximum(values, 0))).T * unit
    moved = [
        log_likelihood_ratio(estimate + step, last, wanted)
        - log_likelihood_ratio(estimate - step, last, wanted)
        for step in steps
    ]
    return ratio + HOPELESS_STDS * float(np.linalg.norm(moved)) / 2 < threshold


def _precise(
    covariance: FloatArray,
    noise: FloatArray,
    blocks: int,
    wanted: Precise,
    limits: BlockLimits,
) -> tuple[Verdict, str]:
    """Noise falls with the number of blocks, distortion and model error stay."""
    names = (("f0", "Hz", wanted.f0_std_hz), ("damping ratio", "", wanted.damping_ratio_std))
    missing, hopeless = [], []
    for k, (name, unit, asked) in enumerate(names):
        std = math.sqrt(covariance[k, k])
        if asked is None or std <= asked:
            continue
        text = f"std of {name} {std:.2g} {unit}".rstrip() + f", {asked:.2g} asked for"
        missing.append(text)
        falling = np.fmin(noise[k, k], covariance[k, k])  # all of it where its noise is unknown
        staying = covariance[k, k] - falling
        last = math.sqrt(staying + falling * blocks / limits.most)
        if last > HOPELESS_FACTOR * asked:
            hopeless.append(f"{text}, {last:.2g} expected after {counted(limits.most, 'block')}")
    if not missing:
        return Verdict.PRECISE, "standard deviations as asked for"
    if hopeless and blocks < limits.most:
        return Verdict.HOPELESS, "; ".join(hopeless)
    return Verdict.CONTINUE, "; ".join(missing)
