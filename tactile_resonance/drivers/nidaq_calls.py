# SPDX-License-Identifier: Apache-2.0
"""Loading nidaqmx where it is needed, and its errors in words."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType

from tactile_resonance.drivers.acquisition import DeviceError

# Error codes of NI-DAQmx, as listed in nidaqmx.error_codes.DAQmxErrors.
_NOT_YET_AVAILABLE = -200284
_OVERRUN = {
    -200279: "samples were overwritten before they were read",
    -200222: "acquisition stopped before unread samples were overwritten",
    -200283: "the buffer between device and computer overflowed",
    -200361: "the device's own memory overflowed",
    -200010: "the device's own memory overflowed",
}


def load(name: str) -> ModuleType:
    """A module of the optional package; DeviceError where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise DeviceError(
            f"nidaqmx: {_one_line(error)}; install the package with "
            "'pip install \"nidaqmx>=1.0,<2\"' and NI's driver NI-DAQmx"
        ) from error


@contextmanager
def translated(doing: str) -> Iterator[None]:
    """Whatever nidaqmx raises inside becomes a `DeviceError` of one line."""
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:
        raise DeviceError(f"nidaqmx: {doing}: {_reason(error)}") from error


def attempt(doing: str, call: Callable[[], object]) -> list[str]:
    """Call, and return what went wrong instead of raising: what follows must be tried as well."""
    try:
        with translated(doing):
            call()
    except DeviceError as error:
        return [str(error)]
    return []


def _reason(error: Exception) -> str:
    code = getattr(error, "error_code", None)
    if code in _OVERRUN:
        return f"overrun, blocks are lost: {_OVERRUN[code]}"
    if code == _NOT_YET_AVAILABLE:
        return "no samples in time: the clock does not run, or runs slowly"
    return _one_line(error)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
