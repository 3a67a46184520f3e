# SPDX-License-Identifier: Apache-2.0
"""The library of tissues, read from ``config/tissues.yaml``; gelatine at any concentration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import build, read_file, require
from tactile_resonance.simulation.tissue.hertz import HertzParameters, Tissue

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
    file = read_file(_LibraryFile, path)
    tissues = {
        name: build(entry.tissue, f"{path.name}: tissues.{name}", name, file.prony)
        for name, entry in file.tissues.items()
    }
    return TissueLibrary(file.contact, MappingProxyType(tissues))


@dataclass(frozen=True)
class _Prony:
    fast_times_s: tuple[float, ...]
    slow_times_s: tuple[float, ...]


@dataclass(frozen=True)
class _TissueFields:
    relaxation_modulus_1s_pa: float
    fast_ratios: tuple[float, ...]
    slow_ratios: tuple[float, ...]
    label: str | None = None
    gelatine_percent: float | None = None

    def tissue(self, name: str, prony: _Prony) -> Tissue:
        for field, ratios, times in (
            ("fast_ratios", self.fast_ratios, prony.fast_times_s),
            ("slow_ratios", self.slow_ratios, prony.slow_times_s),
        ):
            require(len(ratios) == len(times), field, ratios, f"{len(times)} numbers")
        return Tissue(
            name=name,
            relaxation_modulus_1s_pa=self.relaxation_modulus_1s_pa,
            prony_times_s=prony.fast_times_s + prony.slow_times_s,
            prony_ratios=self.fast_ratios + self.slow_ratios,
            label=name if self.label is None else self.label,
            gelatine_percent=self.gelatine_percent,
        )


@dataclass(frozen=True)
class _LibraryFile:
    contact: HertzParameters
    prony: _Prony
    tissues: Mapping[str, _TissueFields]
