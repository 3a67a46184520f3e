# SPDX-License-Identifier: Apache-2.0
"""Reading tissue classes from configuration, and from the results of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tactile_resonance.fields import known_keys, number, read_yaml, require, section
from tactile_resonance.tissue.classify import TissueClass, class_from_samples

_KEYS = {"f0_hz", "damping_ratio", "f0_std_hz", "damping_ratio_std", "correlation", "prior"}


def read_classes(path: Path) -> tuple[TissueClass, ...]:
    """Classes of the section ``tissue_classes`` of a YAML file.

    Raises
    ------
    ValueError
        If the file or a field of it is wrong.
    """
    content = read_yaml(Path(path))
    return parse_classes(content.get("tissue_classes"), f"{Path(path).name}: tissue_classes")


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


def _read_class(name: str, fields: Mapping, where: str) -> TissueClass:
    where = f"{where}.{name}"
    prior = number(fields.get("prior", 1.0), f"{where}.prior")
    try:
        if "points" in fields:
            known_keys(fields, {"points", "prior"}, where)
            return class_from_samples(name, np.array(fields["points"], float), prior)
        known_keys(fields, _KEYS, where)
        mean = [number(fields.get(key), f"{where}.{key}") for key in ("f0_hz", "damping_ratio")]
        std = [
            number(fields.get(key), f"{where}.{key}") for key in ("f0_std_hz", "damping_ratio_std")
        ]
        for key, value in zip(("f0_std_hz", "damping_ratio_std"), std, strict=True):
            require(value >= 0, f"{where}.{key}", value, "a number of 0 or above")
        correlation = number(fields.get("correlation", 0.0), f"{where}.correlation")
        require(-1 <= correlation <= 1, f"{where}.correlation", correlation, "-1 to 1")
        spread = np.outer(std, std) * np.array([[1, correlation], [correlation, 1]])
        return TissueClass(name, np.array(mean), spread, prior=prior)
    except (ValueError, TypeError) as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}.{text}") from error
