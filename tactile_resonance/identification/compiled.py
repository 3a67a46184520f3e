# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels, where numba is installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def kernel(name: str) -> Any:
    """A module of compiled code, by name.

    Raises
    ------
    ImportError
        Without numba, with what to install.
    """
    try:
        return import_module(f"tactile_resonance.identification.{name}")
    except ImportError as error:
        raise ImportError(
            f"{error}: the compiled estimator needs numba (pip install tactile_resonance[compiled])"
        ) from error
