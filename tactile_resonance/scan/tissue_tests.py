# SPDX-License-Identifier: Apache-2.0
"""Mechanical tests in a run: records, fits, and ``mechanics.csv``, which follows from the points' files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_resonance.fields import known
from tactile_resonance.files import csv_text, write_whole
from tactile_resonance.mechanics.fit import MOST_TERMS, Fit, fit_indentation
from tactile_resonance.mechanics.indentation import IndentationRecord
from tactile_resonance.recording.messages import indentation_from_message
from tactile_resonance.scan.point_file import read_messages_of_type
from tactile_resonance.scan.point_result import PointResult
from tactile_resonance.scan.protocols import TYPE
from tactile_resonance.scan.run_content import RunContent, file_of

MECHANICS = "mechanics.csv"
AT_S = (0.5, 1.0, 10.0, 60.0)
"""Times after a step at which moduli are listed [s]."""


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
        return {
            **found,
            "ramp_s": fit.ramp_s,
            "hold_s": fit.hold_s,
            "peak_force_n": fit.peak_force_n,
            "relaxed_share": fit.relaxed_share,
            "modulus_pa": {f"{at:g}": [known(value) for value in fit.modulus(at)] for at in AT_S},
            "equilibrium_pa": [
                fit.equilibrium_pa,
                fit.equilibrium_std,
                fit.equilibrium_known.value,
            ],
            "terms": [
                {
                    "modulus_pa": term.modulus_pa,
                    "modulus_std": term.modulus_std,
                    "time_s": term.time_s,
                    "time_std": term.time_std,
                    "known": term.known.value,
                }
                for term in fit.terms
            ],
            "surface_m": fit.surface_m,
            "surface_std_m": fit.surface_std_m,
            "chi_square": fit.chi_square,
            "dof": fit.dof,
            "bic": list(fit.bic),
            "contact_ratio": fit.contact_ratio,
            "sphere_share": known(fit.sphere_share),
            "layer_share": known(fit.layer_share),
            "status": list(fit.status),
        }


def fitted(
    test: IndentationRecord,
    result: PointResult | None = None,
    *,
    most_terms: int = MOST_TERMS,
    thickness_m: float = math.nan,
) -> TissueTest:
    """A test with its fit, or with the reason why there is none."""
    try:
        fit = fit_indentation(test, most_terms=most_terms, thickness_m=thickness_m)
    except ValueError as error:
        return TissueTest(test, None, str(error), result)
    return TissueTest(test, fit, "", result)


def fits_at(run: RunContent, result: PointResult, **options: Any) -> tuple[TissueTest, ...]:
    """Tests of one attempt at a point in the order in which they were made; options as `fitted`.

    Raises
    ------
    ValueError
        If its file is damaged.
    """
    messages = read_messages_of_type(file_of(run.path, result), TYPE)
    records = [indentation_from_message(message, result.label) for _, _, message in messages]
    return tuple(fitted(record, result, **options) for record in records)


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
    head = ["point", "label", "protocol", "simulated", "ramp_s", "hold_s", "peak_force_n"]
    head += ["relaxed_share"]
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
    row += [fit.ramp_s, fit.hold_s, fit.peak_force_n, fit.relaxed_share]
    for at in AT_S:
        row += fit.modulus(at)
    row += [fit.equilibrium_pa, fit.equilibrium_std, fit.equilibrium_known.value]
    for term in fit.terms:
        row += [term.modulus_pa, term.modulus_std, term.time_s, term.time_std, term.known.value]
    row += [nan] * 5 * (most - len(fit.terms))
    return [*row, "; ".join(fit.status)]
