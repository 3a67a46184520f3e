# SPDX-License-Identifier: Apache-2.0
"""Multisines with small peaks: more power within the same range, for linear work only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tactile_resonance.multisine import Excitation

# Clip level over the passes, relative to the present peak: gentle clipping late keeps what was won.
FIRST_CLIP, LAST_CLIP = 0.75, 0.99


def compress_crest_factor(excitation: Excitation, *, passes: int = 300) -> Excitation:
    """The same lines and amplitudes with phases that make the peaks small.

    Parameters
    ----------
    excitation : Excitation
        A single realisation.
    passes : int
        Clipping passes; each costs two FFTs of a period.

    Returns
    -------
    Excitation
        With ``random_phases`` False and the smallest crest factor of all passes.

    Raises
    ------
    ValueError
        If the excitation is one of several realisations: phases are then no longer random, and the
        scatter over realisations says nothing of nonlinear distortion.

    Notes
    -----
    Signal and spectrum are made to fit in turn: the signal is clipped, its spectrum keeps the new phases
    and takes back the amplitudes wanted (Van der Ouderaa, Schoukens, Renneboog, IEEE Trans. Instrum.
    Meas. 37 (1988) 145-147).
    """
    if excitation.realisations > 1:
        raise ValueError(
            f"realisations: {excitation.realisations}, compressed phases are not random, so several "
            "realisations would not show nonlinear distortion; accepted is 1"
        )
    if passes < 1:
        raise ValueError(f"passes: {passes}, expected at least 1")
    n = excitation.samples_per_period
    lines, amplitude = excitation.harmonics, excitation.amplitude_v
    spectrum = np.zeros(n // 2 + 1, complex)
    phasor = np.exp(1j * excitation.phase_rad)
    best, smallest = phasor, np.inf
    for clip in np.linspace(FIRST_CLIP, LAST_CLIP, passes):
        spectrum[lines] = 0.5 * amplitude * phasor
        signal = np.fft.irfft(spectrum, n, norm="forward")
        peak = float(np.max(np.abs(signal)))
        if peak < smallest:
            best, smallest = phasor, peak
        np.clip(signal, -clip * peak, clip * peak, out=signal)
        clipped = np.fft.rfft(signal)[lines]
        size = np.abs(clipped)
        # a line that clipping removed keeps the phase it had
        phasor = np.where(size > 0, clipped / np.where(size > 0, size, 1.0), phasor)
    return replace(excitation, phase_rad=np.angle(best), random_phases=False)
