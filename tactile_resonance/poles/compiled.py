# SPDX-License-Identifier: Apache-2.0
"""What fits call in compiled form, and how it is compiled: by numba, into its cache, once per installation.

numba keeps the machine code beside each source, or in its own cache directory (NUMBA_CACHE_DIR). It looks at
the date of that one file: functions that are compiled call none of other files. Its index names the classes
of their arguments by module, and is read before that date: such classes (`data.BinData`, `tables.Tables`) stay
where they are, else an installation that is renewed in place cannot read it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit
from numba.core import event

OPTIONS: dict[str, Any] = {
    "cache": True,
    # Sums may be reordered, else no loop that adds up uses vector instructions; NaN and infinity keep
    # their meaning.
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
    # A division by zero is infinite, as in numpy, and not an exception that every loop would test for.
    "error_model": "numpy",
}

KERNELS: list[Any] = []
"""Those that Python calls."""

inner = njit(**OPTIONS)
"""A function that other compiled ones call."""


def entry(function: Callable) -> Callable:
    """A compiled function that Python calls.

    It sees one kind of arrays, contiguous and writable, whatever it is given, so that it is compiled once. It
    fills arrays and returns none: to return one numba calls Python, which then handles a Ctrl-C that came
    meanwhile, and crashes.
    """
    kernel = inner(function)
    KERNELS.append(kernel)

    @wraps(function)
    def call(*arguments):
        return kernel(*[_plain(x) if type(x) is np.ndarray else x for x in arguments])

    return call


def _plain(array: npt.NDArray) -> npt.NDArray:
    """`numpy.require` takes a microsecond to see that nothing is to be done."""
    return array if array.flags.carray else np.array(array, order="C")


def rehearse() -> None:
    """One fit of each kind, to little data."""
    from tactile_resonance.frf.result import FRF
    from tactile_resonance.poles.identify import identify_frf
    from tactile_resonance.poles.joint import JointPlan, PoleEstimator
    from tactile_resonance.poles.noise_level import two_channels
    from tactile_resonance.poles.structure import ModelStructure

    frequency_hz, rng = np.arange(65) / 128, np.random.default_rng(0)
    s = 2j * np.pi * frequency_hz
    g = np.asarray(1 / (s**2 + 0.1 * s + 2), complex)
    u = rng.standard_normal((2, 128))
    y = np.fft.irfft(g * np.fft.rfft(u)) + 1e-3 * rng.standard_normal(u.shape)
    u, y = u.reshape(2, 2, 64), y.reshape(2, 2, 64)
    kind = (1.0, 64, 2, np.arange(8, 25), (0.1, 0.4), ModelStructure(2, 2))
    JointPlan(*kind)(u[0], y[0])
    PoleEstimator(*kind)(u, y)
    identify_frf(FRF(frequency_hz, g, np.ones(65), noise_dof=2), None, ModelStructure(2, 2))
    two_channels(np.ones((1, 3)), np.ones((1, 3)), np.zeros(1, bool))  # of several realisations alone


_begun: list[bool] = []


def compiled() -> int:
    """How many functions were not in the cache and had to be compiled, of those that fits call.

    About a minute of work, once per installation, which the log says before it begins.
    """
    if not _begun:
        _begun.append(True)  # before, for what is rehearsed asks as well
        with event.install_listener("numba:compile", _Notice()):
            rehearse()
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in KERNELS)


class _Notice(event.Listener):
    """Says on the log that kernels are compiled, as the first of them begins."""

    _said = False

    def on_start(self, event: object) -> None:
        """Say it once."""
        if not self._said:
            logging.getLogger(__name__).warning(
                "compiling the pole fits, once per installation: about a minute; ahead of the first use: "
                "tactile_resonance compile"
            )
        self._said = True

    def on_end(self, event: object) -> None:
        """Nothing to say."""
