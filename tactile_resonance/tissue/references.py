# SPDX-License-Identifier: Apache-2.0
"""Tissue classes, and the contact to which they refer, from and to files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import dump_yaml
from tactile_resonance.fields import (
    AboveZero,
    BelowOne,
    Checked,
    NotNegative,
    Range,
    build,
    cut,
    join,
    known_keys,
    read,
    read_dataclass,
    read_file_name,
    read_yaml,
    require,
)
from tactile_resonance.tissue.classify import TissueClass, class_from_samples, predictive_class
from tactile_resonance.tissue.nominal_contact import (
    ForceSensitivity,
    NominalContact,
    sensitivity_of_preloads,
)
from tactile_resonance.tissue.spread import (
    DEGREES_DIGITS,
    FEWEST_DEGREES,
    LEVELS,
    SpreadSource,
    TissueSpread,
)

Correlation = Annotated[float, Range(-1, 1)]


@dataclass(frozen=True, kw_only=True)
class _Point(Checked):
    """Part of a file: f0 and damping ratio, and their spread."""

    f0_hz: AboveZero
    damping_ratio: BelowOne
    f0_std_hz: NotNegative
    damping_ratio_std: NotNegative
    correlation: Correlation = 0.0

    @property
    def estimate(self) -> FloatArray:
        """(2,) f0 [Hz] and damping ratio."""
        return np.array([self.f0_hz, self.damping_ratio])

    @property
    def covariance(self) -> FloatArray:
        """(2, 2)."""
        return _covariance(self.f0_std_hz, self.damping_ratio_std, self.correlation)


@dataclass(frozen=True, kw_only=True)
class _Class(_Point):
    """Part of a file: a class by its mean and spread."""

    prior: float = 1.0
    degrees_of_freedom: float = math.inf

    def named(self, name: str) -> TissueClass:
        degrees = self.degrees_of_freedom
        return predictive_class(name, self.estimate, self.covariance, degrees, self.prior)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Samples:
    """Part of a file: a class by points that were measured."""

    points: FloatArray
    prior: float = 1.0

    def named(self, name: str) -> TissueClass:
        return class_from_samples(name, self.points, self.prior)


@dataclass(frozen=True, kw_only=True)
class _Source(Checked):
    """Part of a file: the spread of a class from one source."""

    f0_std_hz: NotNegative
    damping_ratio_std: NotNegative
    correlation: Correlation = 0.0
    degrees_of_freedom: Annotated[int, Range(1, math.inf, "above 0")]
    holds: tuple[str, ...] = ()

    def named(self, name: str) -> SpreadSource:
        std = self.f0_std_hz, self.damping_ratio_std
        covariance = _covariance(*std, self.correlation)
        return SpreadSource(name, covariance, self.degrees_of_freedom, self.holds)


@dataclass(frozen=True, kw_only=True)
class _Preload(_Point):
    """Part of a file: a point that was measured under a force."""

    force_n: AboveZero
    force_std_n: NotNegative


@dataclass(frozen=True, kw_only=True)
class _Sensitivity(Checked):
    """Part of a file: how poles change with the force."""

    f0_hz_per_n: float
    damping_ratio_per_n: float
    f0_std_hz_per_n: NotNegative
    damping_ratio_std_per_n: NotNegative
    correlation: Correlation = 0.0

    def sensitivity(self) -> ForceSensitivity:
        stds = self.f0_std_hz_per_n, self.damping_ratio_std_per_n
        per_n = np.array([self.f0_hz_per_n, self.damping_ratio_per_n])
        return ForceSensitivity(per_n, _covariance(*stds, self.correlation))


def read_classes(path: Path) -> tuple[tuple[TissueClass, ...], NominalContact | None]:
    """Sections ``tissue_classes`` and, where it is there, ``nominal_contact`` of a YAML file.

    Raises
    ------
    ValueError
        If the file, a field of it, or a library that it names is wrong.
    """
    content, where = with_library(read_yaml(Path(path)), Path(path)), f"{Path(path).name}:"
    classes = parse_classes(content.get("tissue_classes"), f"{where} tissue_classes")
    return classes, parse_nominal_contact(content, where)


def with_library(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Content of a file, with the classes of another file that it names under ``tissue_classes`` in place.

    Parameters
    ----------
    content : mapping
    path : Path
        Of the file; the other one lies beside it.

    Raises
    ------
    ValueError
        If the other file is wrong, or there is a ``nominal_contact`` beside its name, which belongs to the
        classes.
    """
    name, where = content.get("tissue_classes"), f"{path.name}:"
    if not isinstance(name, str):
        return dict(content)
    read_file_name(name, f"{where} tissue_classes")
    alone, accepted = "nominal_contact" not in content, f"none: it belongs to the classes, in {name}"
    require(alone, f"{where} nominal_contact", "one", accepted)
    library = read_yaml(path.parent / name)
    for tissue in parse_classes(library.get("tissue_classes"), f"{name}: tissue_classes"):
        degrees = tissue.degrees_of_freedom + 1  # of the estimate: see `predictive_class`
        accepted = f"{FEWEST_DEGREES} or more: made by `references build` of more preparations, or pooled"
        require(degrees >= FEWEST_DEGREES, f"{name}: {tissue.name}.degrees_of_freedom", degrees, accepted)
    parse_nominal_contact(library, f"{name}:")
    sections = ("tissue_classes", "nominal_contact")
    return {**content, **{key: library[key] for key in sections if key in library}}


def parse_classes(content: object, where: str) -> tuple[TissueClass, ...]:
    """Classes of a mapping from name to mean and spread, or to measured points.

    Each is ``{f0_hz, damping_ratio, f0_std_hz, damping_ratio_std}`` with ``correlation`` (0), ``prior`` (1)
    and, where the deviations are estimated, their ``degrees_of_freedom`` at will, or
    ``{points: [[f0_hz, damping_ratio], ...]}`` of four points or more.

    Raises
    ------
    ValueError
        If a field is missing or wrong.
    """
    entries: dict[str, Any] = read(dict[str, Any], content, where)
    require(bool(entries), where, content, "a mapping of class names")
    return tuple(_read_class(name, entries[name], join(where, name)) for name in entries)


def parse_nominal_contact(content: Mapping[str, Any], where: str) -> NominalContact | None:
    """Section ``nominal_contact`` of a file's content; None where there is none.

    Its fields are those of `NominalContact`, the sensitivity as ``f0_hz_per_n``, ``f0_std_hz_per_n``,
    ``damping_ratio_per_n``, ``damping_ratio_std_per_n`` and ``correlation`` (0), or as ``preloads``: two points
    measured at one place, ``{force_n, force_std_n, f0_hz, f0_std_hz, damping_ratio, damping_ratio_std}`` with
    ``correlation`` (0) at will.

    Raises
    ------
    ValueError
        If a field is missing or wrong.
    """
    if "nominal_contact" not in content:
        return None
    where = f"{where} nominal_contact"
    entries = read(dict[str, Any], content["nominal_contact"], where)
    own, direct = ({item.name for item in fields(kind)} for kind in (NominalContact, _Sensitivity))
    known_keys(entries, own - {"sensitivity"} | direct | {"preloads"}, where)
    rest = {key: value for key, value in entries.items() if key in own}
    how = {key: value for key, value in entries.items() if key in direct}
    if "preloads" in entries:
        require(not how, where, sorted(how), "none of these beside preloads")
        nominal_n = read(float, entries.get("force_n"), f"{where}.force_n")
        at = f"{where}.preloads"
        sensitivity = build(
            _between, at, read(tuple[_Preload, _Preload], entries["preloads"], at), nominal_n
        )
    else:
        sensitivity = build(read_dataclass(_Sensitivity, how, where).sensitivity, where)
    return read_dataclass(NominalContact, rest, where, sensitivity=sensitivity)


def read_sources(path: Path) -> dict[str, tuple[SpreadSource, ...]]:
    """Section ``spread`` of a file that `library_text` made: sources of spread that are determined, by tissue.

    Raises
    ------
    ValueError
        If it is not there, or a field is missing or wrong.
    """
    where = f"{Path(path).name}: spread"
    entries = read(dict[str, dict[str, _Source]], read_yaml(Path(path)).get("spread"), where)
    for tissue, sources in entries.items():
        known_keys(sources, set(LEVELS), join(where, tissue))
    return {
        tissue: tuple(source.named(name) for name, source in sources.items())
        for tissue, sources in entries.items()
    }


def library_text(
    spreads: Sequence[TissueSpread], nominal: NominalContact | None, comment: Sequence[str]
) -> str:
    """File that scenes name under ``tissue_classes``, and pole_map_node under ``classes_file``.

    Parameters
    ----------
    spreads : sequence of TissueSpread
    nominal : NominalContact or None
        To which they refer.
    comment : sequence of str
        For people, one line each, at the top.

    Raises
    ------
    ValueError
        If a tissue has too few points for a class.
    """
    classes, sources = {}, {}
    for spread in spreads:
        spread.as_class()
        mean = {"f0_hz": _rounded(spread.mean[0]), "damping_ratio": _rounded(spread.mean[1])}
        classes[spread.name] = mean | _entry(spread.covariance)
        if math.isfinite(spread.degrees_of_freedom):
            degrees = round(float(spread.degrees_of_freedom), DEGREES_DIGITS)
            classes[spread.name]["degrees_of_freedom"] = degrees
        sources[spread.name] = {
            source.name: {
                **_entry(source.covariance),
                "degrees_of_freedom": source.degrees_of_freedom,
                "holds": list(source.holds),
            }
            for source in spread.sources
            if source.degrees_of_freedom
        }
    content: dict[str, Any] = {"tissue_classes": classes}
    if nominal is not None:
        own = {item.name: getattr(nominal, item.name) for item in fields(nominal)}
        slope = own.pop("sensitivity")
        per_n = {"f0_hz_per_n": slope.per_n[0], "damping_ratio_per_n": slope.per_n[1]}
        std = {name + "_per_n": value for name, value in _entry(slope.covariance).items()}
        std["correlation"] = std.pop("correlation_per_n")
        own |= {key: float(value) for key, value in {**per_n, **std}.items()}
        content["nominal_contact"] = {k: v for k, v in own.items() if not math.isnan(v)}
    content["spread"] = sources
    head = ["SPDX-License-Identifier: Apache-2.0", *comment]
    return "".join(f"# {cut(line)}\n" for line in head) + dump_yaml(content)


def _entry(covariance: FloatArray) -> dict[str, float]:
    """Standard deviations and correlation, as `_covariance` takes them."""
    std = np.sqrt(np.diag(covariance))
    product = float(np.prod(std))
    correlation = float(covariance[0, 1]) / product if product > 0 else 0.0
    return {
        "f0_std_hz": _rounded(std[0]),
        "damping_ratio_std": _rounded(std[1]),
        "correlation": min(1.0, max(-1.0, round(correlation, 6))),
    }


def _rounded(value: float) -> float:
    """To eight digits."""
    return float(f"{value:.8g}")


def _between(preloads: tuple[_Preload, _Preload], nominal_n: float) -> ForceSensitivity:
    forces_n = [preload.force_n for preload in preloads]
    accepted = f"forces on either side of the nominal one, {nominal_n:g}"
    require(min(forces_n) <= nominal_n <= max(forces_n), "force_n", forces_n, accepted)
    return sensitivity_of_preloads(
        [preload.estimate for preload in preloads],
        [preload.covariance for preload in preloads],
        forces_n,
        [preload.force_std_n for preload in preloads],
    )


def _read_class(name: str, entry: object, where: str) -> TissueClass:
    kind = _Samples if isinstance(entry, Mapping) and "points" in entry else _Class
    return build(read(kind, entry, where).named, where, name)


def _covariance(first_std: float, second_std: float, correlation: float) -> FloatArray:
    std = np.array([first_std, second_std])
    return np.outer(std, std) * np.array([[1, correlation], [correlation, 1]])
