# SPDX-License-Identifier: Apache-2.0
"""Contacts of a bench, and records on them from rest, as the calibrated estimator takes them."""

from benchmarks.calibrate_benches import BAND_HZ, RATE_HZ, excitation
from tactile_resonance.calibration.estimator import ContactRecord
from tactile_resonance.simulation.sensor.bench import BenchEffects, BenchRun
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph, sensor_model
from tactile_resonance.simulation.tissue.library import hertz_contact

SKEW_S = 3e-6


def contact_of(bench, tissue, **options):
    return hertz_contact(tissue, bench.sensor.tip.radius_m, bench.contact, **options)


def run_on(bench, contact, seed, skew_s=SKEW_S, **effects):
    effects = BenchEffects(channel_skew_s=skew_s, **effects)
    return BenchRun(bench.sensor, CoupledBimorph(sensor_model(bench.sensor), contact), seed, effects)


def played(bench, contact, duration_s=0.02, *, seed, periods=1, skew_s=0.0, settled=0, **effects):
    """Record of a contact; after `settled` periods its state at the start is not known."""
    signal, run = excitation(duration_s), run_on(bench, contact, seed, skew_s, **effects)
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
