# SPDX-License-Identifier: Apache-2.0
"""Reading from configuration: tissue classes, and the contact to which they refer."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tactile_resonance.fields import (
    known_keys,
    number,
    read_dataclass,
    read_yaml,
    require,
    section,
)
from tactile_resonance.tissue.classify import TissueClass, class_from_samples
from tactile_resonance.tissue.nominal_contact import (
    ForceSensitivity,
    NominalContact,
    sensitivity_of_preloads,
)

FloatArray = npt.NDArray[np.float64]
_MEASURED = ("f0_hz", "damping_ratio", "f0_std_hz", "damping_ratio_std")
_CONTACT = {field.name for field in dataclasses.fields(NominalContact)} - {"sensitivity"}
_SENSITIVITY = ("f0_hz_per_n", "damping_ratio_per_n", "f0_std_hz_per_n", "damping_ratio_std_per_n")


def read_classes(path: Path) -> tuple[tuple[TissueClass, ...], NominalContact | None]:
    """Sections ``tissue_classes`` and, where it is there, ``nominal_contact`` of a YAML file.

    Raises
    ------
    ValueError
        If the file or a field of it is wrong.
    """
    content, name = read_yaml(Path(path)), Path(path).name
    classes = parse_classes(content.get("tissue_classes"), f"{name}: tissue_classes")
    return classes, parse_nominal_contact(content, name)


def parse_classes(content: object, where: str) -> tuple[TissueClass, ...]:
    """Classes of a mapping from name to mean and spread, or to measured points.

    Each is ``{f0_hz, damping_ratio, f0_std_hz, damping_ratio_std}`` with ``correlation`` (0) and ``prior``
    (1) at will, or ``{points: [[f0_hz, damping_ratio], ...]}`` of four points or more.

    Raises
    ------
    ValueError
        If a field is missing or wrong.
    """
    good = isinstance(content, Mapping) and len(content) > 0
    require(good, where, content, "a mapping of class names")
    assert isinstance(content, Mapping)
    return tuple(_read_class(str(name), section(content, name, where), where) for name in content)


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
    where = f"{where}: nominal_contact"
    good = isinstance(content["nominal_contact"], Mapping)
    require(good, where, content["nominal_contact"], "a mapping")
    fields = dict(content["nominal_contact"])
    known_keys(fields, {*_CONTACT, *_SENSITIVITY, "correlation", "preloads"}, where)
    try:
        if "preloads" in fields:
            beside = sorted({*_SENSITIVITY, "correlation"} & set(fields))
            require(not beside, where, beside, "none of these beside preloads")
            nominal_n = number(fields.get("force_n"), f"{where}.force_n")
            sensitivity = _preloads(fields.pop("preloads"), nominal_n, where)
        else:
            f0, damping, f0_std, damping_std, correlation = _numbers_of(fields, _SENSITIVITY, where)
            for key in (*_SENSITIVITY, "correlation"):
                fields.pop(key, None)
            spread = _covariance(f0_std, damping_std, correlation)
            sensitivity = ForceSensitivity(np.array([f0, damping]), spread)
        return read_dataclass(NominalContact, fields, where, sensitivity=sensitivity)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}.{text}") from error


def _preloads(rows: object, nominal_n: float, where: str) -> ForceSensitivity:
    where = f"{where}.preloads"
    good = isinstance(rows, list) and len(rows) == 2 and all(isinstance(r, Mapping) for r in rows)
    require(good, where, rows, "a list of two points")
    assert isinstance(rows, list)
    keys = ("force_n", "force_std_n", *_MEASURED)
    values = []
    for index, row in enumerate(rows):
        known_keys(row, {*keys, "correlation"}, f"{where}[{index}]")
        values.append(_numbers_of(row, keys, f"{where}[{index}]"))
    force_n, force_std_n, f0, damping, f0_std, damping_std, correlation = np.transpose(values)
    covariances = [_covariance(*row) for row in zip(f0_std, damping_std, correlation, strict=True)]
    good = 0 < force_n.min() <= nominal_n <= force_n.max()
    accepted = f"forces above 0 on either side of the nominal one, {nominal_n:g}"
    require(good, f"{where}.force_n", force_n.tolist(), accepted)
    estimates = np.transpose([f0, damping])
    try:
        return sensitivity_of_preloads(estimates, covariances, force_n, force_std_n)
    except ValueError as error:
        raise ValueError(f"{where}.{error}") from error


def _numbers_of(fields: Mapping[str, Any], keys: Sequence[str], where: str) -> list[float]:
    """Values of these fields, and of ``correlation``; standard deviations are checked."""
    for key in keys:
        require(key in fields, f"{where}.{key}", None, "a number (it is missing)")
    values = [number(fields[key], f"{where}.{key}") for key in keys]
    for key, value in zip(keys, values, strict=True):
        require("std" not in key or value >= 0, f"{where}.{key}", value, "a number of 0 or above")
        good = key not in ("f0_hz", "damping_ratio") or value > 0
        require(good, f"{where}.{key}", value, "a number above 0")
        require(key != "damping_ratio" or value < 1, f"{where}.{key}", value, "below 1")
    correlation = number(fields.get("correlation", 0.0), f"{where}.correlation")
    require(-1 <= correlation <= 1, f"{where}.correlation", correlation, "-1 to 1")
    return [*values, correlation]


def _covariance(first_std: float, second_std: float, correlation: float) -> FloatArray:
    std = np.array([first_std, second_std])
    return np.outer(std, std) * np.array([[1, correlation], [correlation, 1]])


def _read_class(name: str, fields: Mapping, where: str) -> TissueClass:
    where = f"{where}.{name}"
    prior = number(fields.get("prior", 1.0), f"{where}.prior")
    try:
        if "points" in fields:
            known_keys(fields, {"points", "prior"}, where)
            return class_from_samples(name, np.array(fields["points"], float), prior)
        known_keys(fields, {*_MEASURED, "correlation", "prior"}, where)
        f0, damping, f0_std, damping_std, correlation = _numbers_of(fields, _MEASURED, where)
        spread = _covariance(f0_std, damping_std, correlation)
        return TissueClass(name, np.array([f0, damping]), spread, prior=prior)
    except (ValueError, TypeError) as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}.{text}") from error
