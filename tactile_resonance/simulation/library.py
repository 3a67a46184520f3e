# SPDX-License-Identifier: Apache-2.0
"""The library of tissues, read from ``config/tissues.yaml``; gelatine at any concentration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import (
    known_keys,
    number,
    numbers,
    read_dataclass,
    read_yaml,
    require,
    section,
)
from tactile_resonance.simulation.contact import HertzParameters
from tactile_resonance.simulation.tissue import Tissue

GELATINE_PERCENT_RANGE = (8.0, 20.0)  # how far the power law is trusted beyond the tabulated values


@dataclass(frozen=True)
class TissueLibrary:
    """Tissues by name, and the contact they share."""

    contact: HertzParameters
    tissues: Mapping[str, Tissue]

    def __getitem__(self, name: str) -> Tissue:
        """Return the tissue `name`; ``ValueError`` listing the known names otherwise."""
        require(name in self.tissues, "tissue", name, f"one of {sorted(self.tissues)}")
        return self.tissues[name]

    def gelatine(self, percent: float) -> Tissue:
        """Return gelatine of any concentration [% w/w].

        E(1 s) follows a power law of the concentration between neighbouring tabulated values (a
        straight line in log-log), which it reproduces exactly; the outermost segments are
        continued. The Prony ratios are those of all tabulated gelatine.

        Raises
        ------
        ValueError
            If `percent` lies outside 8 to 20, or the library holds fewer than two gelatines, or
            gelatines of different Prony terms.
        """
        low, high = GELATINE_PERCENT_RANGE
        require(low <= percent <= high, "percent", percent, f"{low:g} to {high:g} % w/w")
        table = {t.gelatine_percent: t for t in self.tissues.values() if t.gelatine_percent}
        require(len(table) >= 2, "tissues", len(table), "a library with two or more gelatines")
        first = next(iter(table.values()))
        for t in table.values():
            same = (t.prony_times_s, t.prony_ratios) == (first.prony_times_s, first.prony_ratios)
            require(same, f"{t.name}.prony_ratios", t.prony_ratios, "those of all gelatine")
        concentrations = np.array(sorted(table))
        moduli = np.array([table[c].relaxation_modulus_1s_pa for c in concentrations])
        exponents = np.diff(np.log(moduli)) / np.diff(np.log(concentrations))
        # power law through the tabulated value at or below: exact there, continuous at the next
        start = max(0, int(np.searchsorted(concentrations, percent, side="right")) - 1)
        exponent = exponents[min(start, len(exponents) - 1)]
        modulus = float(moduli[start] * (percent / concentrations[start]) ** exponent)
        return Tissue(
            name=f"gel{percent:g}",
            relaxation_modulus_1s_pa=modulus,
            prony_times_s=first.prony_times_s,
            prony_ratios=first.prony_ratios,
            label=f"gelatine {percent:g} %",
            gelatine_percent=float(percent),
        )


def read_tissues(path: Path | None = None) -> TissueLibrary:
    """Read a tissue library; without a path, ``config/tissues.yaml``.

    Raises
    ------
    ValueError
        If the file cannot be read, or a field is missing, unknown or out of range.
    """
    path = share_path("config/tissues.yaml") if path is None else Path(path)
    where = path.name
    content = read_yaml(path)
    known_keys(content, {"contact", "prony", "tissues"}, where)
    contact = read_dataclass(
        HertzParameters, section(content, "contact", where), f"{where}: contact"
    )
    prony = section(content, "prony", where)
    known_keys(prony, {"fast_times_s", "slow_times_s"}, f"{where}: prony")
    fast = numbers(prony.get("fast_times_s"), f"{where}: prony.fast_times_s")
    slow = numbers(prony.get("slow_times_s"), f"{where}: prony.slow_times_s")
    entries = section(content, "tissues", where)
    tissues = {
        str(name): _read_tissue(str(name), section(entries, name, f"{where}: tissues"), fast, slow)
        for name in entries
    }
    return TissueLibrary(contact, MappingProxyType(tissues))


def _read_tissue(
    name: str, entry: Mapping[str, Any], fast: tuple[float, ...], slow: tuple[float, ...]
) -> Tissue:
    keys = {"label", "gelatine_percent", "relaxation_modulus_1s_pa", "fast_ratios", "slow_ratios"}
    where = f"tissues.{name}"
    known_keys(entry, keys, where)
    percent = entry.get("gelatine_percent")
    ratios = numbers(entry.get("fast_ratios"), f"{where}.fast_ratios", len(fast)) + numbers(
        entry.get("slow_ratios"), f"{where}.slow_ratios", len(slow)
    )
    modulus = number(entry.get("relaxation_modulus_1s_pa"), f"{where}.relaxation_modulus_1s_pa")
    try:
        return Tissue(
            name=name,
            relaxation_modulus_1s_pa=modulus,
            prony_times_s=fast + slow,
            prony_ratios=ratios,
            label=str(entry.get("label", name)),
            gelatine_percent=(
                None if percent is None else number(percent, f"{where}.gelatine_percent")
            ),
        )
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from error
