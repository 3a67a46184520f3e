# SPDX-License-Identifier: Apache-2.0
"""The silent record of a run, evaluated; apart from other references, for nodes do not need what it loads."""

from __future__ import annotations

import numpy as np

from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.references import SILENT
from tactile_resonance.scan.run_content import RECORDING, RunContent
from tactile_resonance.silent import SilentRecord, silent_record


def read_silent(run: RunContent) -> SilentRecord | None:
    """Tones and noise of a run's silent record; None where it has none.

    Raises
    ------
    ValueError
        If its file is damaged or holds no samples.
    """
    for file in run.files:
        if file.name.endswith(f"-{SILENT}.mcap"):
            for stored in measurements_of_file(run.path / RECORDING / file.name):
                records = stored.records
                if not records or stored.gaps:
                    raise ValueError(f"{file.name}: {len(records)} records, expected some without a gap")
                u, y = (
                    np.stack([getattr(record, channel).volts() for record in records])
                    for channel in ("actuator", "sensor")
                )  # (P, N)
                return silent_record(u, y, sample_rate_hz=records[0].sample_rate_hz)
            raise ValueError(f"{file.name}: no measurement, expected a silent one")
    return None
