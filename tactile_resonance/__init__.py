# SPDX-License-Identifier: Apache-2.0
"""Tactile resonance sensing: excitation, frequency response and poles of what a vibrating sensor touches.

The names below are loaded when they are first used.

>>> import tactile_resonance as tr
>>> tr.design_multisine(band_hz=(100.0, 500.0)).harmonics.size
161
"""

from importlib import import_module
from typing import Any

# the source tree finds the messages generated into an installed tree
__path__ = __import__("pkgutil").extend_path(__path__, __name__)

_HOMES = {
    "front": ("estimate_frf", "identify_poles", "read_record", "read_run"),
    "analysis": ("Analysis", "analyse"),
    "contact_analysis": ("estimate_contact",),
    "multisine": ("Excitation", "Grid", "design_multisine"),
    "frf.result": ("FRF", "FrfStatus"),
    "poles.identify": ("identify_batch", "identify_spectra"),
    "poles.joint": ("PoleEstimator",),
    "poles.result": ("Poles", "PolesBatch", "PolesStatus"),
    "poles.structure": ("ModelStructure",),
    "recording.recording": ("Recording", "make_recording"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__file__", "__name__", "__path__"]
