# SPDX-License-Identifier: Apache-2.0
"""Records of a bench on a contact, from rest, as the calibrated estimator takes them."""

import numpy as np

from tactile_resonance.calibration.contact_record import ContactRecord, Start
from tactile_resonance.multisine import design_multisine
from tactile_resonance.simulation.sensor.acquisition import BenchEffects
from tactile_resonance.simulation.sensor.bench import BenchRun
from tactile_resonance.simulation.sensor.bimorph import couple

RATE_HZ, SKEW_S = 50e3, 3e-6
BAND_HZ = (200.0, 620.0)


def excitation(duration_s, band_hz=BAND_HZ):
    """Lines of a sweep, each as high as if all from 10 Hz to 10 kHz were excited with 1 V rms."""
    low, high = band_hz
    lines = np.floor(high * duration_s + 1e-9) - np.ceil(low * duration_s - 1e-9) + 1
    return design_multisine(
        sample_rate_hz=RATE_HZ,
        samples_per_period=round(RATE_HZ * duration_s),
        band_hz=band_hz,
        level_v=float(np.sqrt(lines / (9990 * duration_s + 1))),
        sweep=True,
    )


def played(bench, contact, duration_s=0.02, *, seed, periods=1, skew_s=0.0, settled=0, **effects):
    """Record of a contact; after `settled` periods its state at the start is not known."""
    signal = excitation(duration_s)
    effects = BenchEffects(channel_skew_s=skew_s, **effects)
    run = BenchRun(bench.sensor, couple(bench.sensor, contact), seed, effects, False)
    if settled:
        run.block(signal, settled)
    block = run.block(signal, periods)
    return ContactRecord.of_samples(
        block.actuator.volts().reshape(periods, -1),
        block.sensor.volts().reshape(periods, -1),
        sample_rate_hz=RATE_HZ,
        harmonics=signal.harmonics,
        band_hz=BAND_HZ,
        start=Start.UNKNOWN if settled else Start.REST,
    )
