# SPDX-License-Identifier: Apache-2.0
"""Records of a bench on a contact, from rest, as the calibrated estimator takes them."""

from benchmarks.calibrate_benches import BAND_HZ, RATE_HZ, excitation
from tactile_resonance.calibration.estimator import ContactRecord
from tactile_resonance.simulation.sensor.bench import BenchEffects, BenchRun
from tactile_resonance.simulation.sensor.bimorph import couple

SKEW_S = 3e-6


def played(bench, contact, duration_s=0.02, *, seed, periods=1, skew_s=0.0, settled=0, **effects):
    """Record of a contact; after `settled` periods its state at the start is not known."""
    signal = excitation(duration_s)
    effects = BenchEffects(channel_skew_s=skew_s, **effects)
    run = BenchRun(bench.sensor, couple(bench.sensor, contact), seed, effects)
    if settled:
        run.block(signal, settled)
    block = run.block(signal, periods)
    return ContactRecord.of_samples(
        block.actuator.volts().reshape(periods, -1),
        block.sensor.volts().reshape(periods, -1),
        sample_rate_hz=RATE_HZ,
        harmonics=signal.harmonics,
        band_hz=BAND_HZ,
        from_rest=not settled,
    )
