# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests of tissue: what a scene asks for, and in a run records, fits, and ``mechanics.csv``.

The table follows from the points' files. Fits are loaded where one is made: what is compiled for them takes a
second.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance.fields import AboveZero, Checked, known, require
from tactile_resonance.files import csv_text, write_whole
from tactile_resonance.mechanics.indentation import IndentationRecord, Protocol
from tactile_resonance.recording.messages import indentation_from_message
from tactile_resonance.scan.point_file import read_messages
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.run_content import RunContent, file_of

if TYPE_CHECKING:
    from tactile_resonance.mechanics.fit import Fit

TYPE, TOPIC = "tactile_resonance/msg/Indentation", "indentation"
BESIDE_S = 30.0
"""Of a test beside its hold, at most: way, zero of the force, pressing and drawing back [s]."""
USUAL_UNLOAD_M_S = 5e-4
MECHANICS = "mechanics.csv"
AT_S = (0.5, 1.0, 10.0, 60.0)
"""Times after a step at which moduli are listed [s]."""
REMEMBERS = (
    "follows {} at this place: what the tissue remembers of it is neither in the model nor in the deviations"
)
_OF_COURSE = ("ramp_s", "hold_s", "peak_force_n", "relaxed_share")  # fields of a fit


@dataclass(frozen=True)
class ProtocolRequest(Checked):
    """One test that a scene asks for, after the poles of a point are measured and in a contact of its own.

    Attributes
    ----------
    kind : Protocol
    hold_s : float
        For which place or force is kept [s]; 0 only for an indentation.
    force_n : float or None
        To be reached [N]; None: the scene's.
    press_speed_m_s : float or None
        Towards the tissue and into it, at most [m/s]; None: contact_node's.
    unload_speed_m_s : float or None
        With which the tip is drawn back [m/s]: of an indentation, `USUAL_UNLOAD_M_S` where None.
    points : tuple of int
        Numbers of the points, 1 the first; empty: all.
    """

    kind: Protocol
    hold_s: float = 0.0
    force_n: AboveZero | None = None
    press_speed_m_s: AboveZero | None = None
    unload_speed_m_s: AboveZero | None = None
    points: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        drawn = self.kind is Protocol.INDENTATION
        good = 0 < self.hold_s <= 3600 or (drawn and self.hold_s == 0)
        require(good, "hold_s", self.hold_s, "above 0, at most 3600 (0 only for an indentation)")
        super().__post_init__()
        alone = self.unload_speed_m_s is None or drawn
        require(alone, "unload_speed_m_s", self.unload_speed_m_s, f"none with {self.kind.value}")
        good = all(number >= 1 for number in self.points) and len(set(self.points)) == len(
            self.points
        )
        require(good, "points", list(self.points), "numbers of points, from 1, each once")

    @property
    def draw_back_m_s(self) -> float:
        """Speed with which the tip is drawn back while it presses [m/s]; 0: it only holds."""
        usual_m_s = USUAL_UNLOAD_M_S if self.kind is Protocol.INDENTATION else 0.0
        return self.unload_speed_m_s or usual_m_s

    def concerns(self, index: int) -> bool:
        """Whether it is asked for at the point of an index, which counts from 0."""
        return not self.points or index + 1 in self.points

    @property
    def longest_s(self) -> float:
        """How long it may take [s]."""
        return self.hold_s + BESIDE_S

    def __str__(self) -> str:
        held = f" of {self.hold_s:g} s" if self.hold_s else ""
        where = (
            f" at points {', '.join(map(str, self.points))}" if self.points else " at every point"
        )
        return f"{self.kind.value}{held}{where}"


@dataclass(frozen=True, eq=False)
class TissueTest:
    """One test and what it says.

    Attributes
    ----------
    test : IndentationRecord
    fit : Fit or None
        None: see `reason`.
    reason : str
        Why nothing could be fitted; empty where it was.
    result : PointResult or None
        Of the point; None: of a file.
    """

    test: IndentationRecord
    fit: Fit | None
    reason: str
    result: PointResult | None = None

    def as_json(self) -> dict[str, Any]:
        """What JSON can hold: null for what is not known; constants that are not determined say why."""
        test, fit, result = self.test, self.fit, self.result
        found: dict[str, Any] = {
            "label": test.label,
            "point": None if result is None else result.index + 1,
            "protocol": test.protocol.value,
            "source": test.source,
            "simulated": test.simulated,
            "reason": self.reason,
        }
        if fit is None:
            return found
        plain = ("surface_m", "surface_std_m", "chi_square", "dof", "bic", "contact_ratio")
        return {
            **found,
            **{name: getattr(fit, name) for name in _OF_COURSE},
            "modulus_pa": {f"{at:g}": [known(value) for value in fit.modulus(at)] for at in AT_S},
            "equilibrium_pa": [
                fit.equilibrium_pa,
                fit.equilibrium_std,
                fit.equilibrium_known.value,
            ],
            "terms": [{**asdict(term), "known": term.known.value} for term in fit.terms],
            **{name: getattr(fit, name) for name in plain},
            "sphere_share": known(fit.sphere_share),
            "layer_share": known(fit.layer_share),
            "status": list(fit.status),
        }


def fitted(
    test: IndentationRecord, result: PointResult | None = None, **options: Any
) -> TissueTest:
    """A test with its fit, or with the reason why there is none; options as `fit_indentation`."""
    from tactile_resonance.mechanics.fit import fit_indentation

    try:
        return TissueTest(test, fit_indentation(test, **options), "", result)
    except ValueError as error:
        return TissueTest(test, None, str(error), result)


def fits_at(run: RunContent, result: PointResult, **options: Any) -> tuple[TissueTest, ...]:
    """Tests of one attempt at a point in the order in which they were made; options as `fit_indentation`.

    Raises
    ------
    ValueError
        If its file is damaged.
    """
    messages = read_messages(file_of(run.path, result), TYPE)
    records = [indentation_from_message(message, result.label) for _, _, message in messages]
    found = [fitted(record, result, **options) for record in records]
    for k, one in enumerate(found):
        if one.fit is not None:
            told = REMEMBERS.format("another test" if k else "the contact of the poles")
            found[k] = replace(one, fit=replace(one.fit, status=(*one.fit.status, told)))
    return tuple(found)


def fits_of(run: RunContent, **options: Any) -> Iterator[TissueTest]:
    """Tests of the latest attempt at each point that has some, as the index of the run tells."""
    tested = run.messages_at(TYPE)
    for result in run.latest:
        if result.index in tested:
            yield from fits_at(run, result, **options)


def write_fits(run: Path, tests: Sequence[TissueTest]) -> None:
    """Write ``mechanics.csv`` into the folder of a run."""
    write_whole(run / MECHANICS, as_csv(tests).encode())


def as_csv(tests: Sequence[TissueTest]) -> str:
    """One row each, deviations relative; `known`: whether constants are determined; unknown numbers ``nan``."""
    most = max((len(one.fit.terms) for one in tests if one.fit is not None), default=0)
    head = ["point", "label", "protocol", "simulated", *_OF_COURSE]
    for at in AT_S:
        head += [f"modulus_{at:g}s_pa", f"modulus_{at:g}s_std"]
    head += ["equilibrium_pa", "equilibrium_std", "equilibrium_known"]
    for k in range(1, most + 1):
        names = ("modulus_{}_pa", "modulus_{}_std", "time_{}_s", "time_{}_std", "known_{}")
        head += [name.format(k) for name in names]
    return csv_text([[*head, "status"], *(_row(one, most) for one in tests)])


def _row(one: TissueTest, most: int) -> list[object]:
    test, fit, nan = one.test, one.fit, math.nan
    point = "" if one.result is None else one.result.index + 1
    row: list[object] = [point, test.label, test.protocol.value, test.simulated]
    if fit is None:
        return [*row, *[nan] * (7 + 2 * len(AT_S) + 5 * most), one.reason]
    row += [getattr(fit, name) for name in _OF_COURSE]
    for at in AT_S:
        row += fit.modulus(at)
    row += [fit.equilibrium_pa, fit.equilibrium_std, fit.equilibrium_known.value]
    for term in fit.terms:
        row += [term.modulus_pa, term.modulus_std, term.time_s, term.time_std, term.known.value]
    row += [nan] * 5 * (most - len(fit.terms))
    return [*row, "; ".join(fit.status)]
