# SPDX-License-Identifier: Apache-2.0
"""Which sources of force are refused."""

import pytest

from tactile_resonance.contact.admission import require_fit
from tactile_resonance.contact.interfaces import ForceInfo, Mount


def test_the_required_cell_serves_1_cn_and_those_in_the_page_do_not():
    require_fit(ForceInfo("required", 500.0, 1e-3, 3e-4, 5.0, Mount.TABLE), 0.01)
    robotous = ForceInfo("RFT40", 1000.0, 0.17, 0.02, 100.0, Mount.TOOL)
    with pytest.raises(
        ValueError,
        match=r"RFT40 cannot control 10 mN: its noise is 120 mN rms \(at 500 Hz\), at most 1 mN serve; "
        "its smallest step is 20 mN, at most 0.3 mN serve",
    ):
        require_fit(robotous, 0.01)
    e_series = ForceInfo("UR e-series", 500.0, 4.0, 0.1, 100.0, Mount.TOOL)
    with pytest.raises(ValueError, match="its noise is [^;]*; its smallest step is [^;]*$"):
        require_fit(e_series, 0.01)
    require_fit(robotous, 2.0)


def test_noise_is_compared_by_its_density():
    fast = ForceInfo("fast", 2000.0, 2e-3, 1e-4, 1.0, Mount.TABLE)
    slow = ForceInfo("slow", 250.0, 0.8e-3, 1e-4, 1.0, Mount.TABLE)
    require_fit(fast, 0.01)
    with pytest.raises(ValueError, match=r"1\.13 mN rms"):
        require_fit(slow, 0.01)


def test_rate_and_range_are_asked_for_too():
    poor = ForceInfo("poor", 100.0, 1e-5, 1e-5, 0.02, Mount.TABLE)
    reasons = "it gives 100 Hz, at least 200 Hz serve; its range is 20 mN, at least 50 mN serve"
    with pytest.raises(ValueError, match=f"^force source poor cannot control 10 mN: {reasons}$"):
        require_fit(poor, 0.01)
    with pytest.raises(ValueError, match="force_n: 0"):
        require_fit(poor, 0)
