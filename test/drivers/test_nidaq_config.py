# SPDX-License-Identifier: Apache-2.0
"""Wrong configurations of the NI driver, each named."""

import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.nidaq_config import read_nidaq_config

EXAMPLE = share_path("config/devices/nidaqmx.yaml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"output": {"channel": "Dev1/ao0"}}, "output.max_voltage_v: missing"),
        ({"between_samples": "linear"}, "between_samples: 'linear', accepted are"),
        ({"channel_delay_s": "1e-6"}, "channel_delay_s: '1e-6', expected a number"),
        ({"buffer_s": 0}, "buffer_s: 0, expected a positive number"),
        ({"gain": 3}, "gain: no such field"),
        ({"sensor": {"channel": 3}}, "sensor.channel: 3, expected a name"),
        ({"sensor": None}, "sensor: None, expected fields"),
        (
            {"sensor": {"channel": "Dev1/ai0", "range_v": 1.0, "terminals": "rse"}},
            "sensor.channel: Dev1/ai0, expected another",
        ),
        (
            {"actuator": {"source": "commanded", "channel": "Dev1/ai0"}},
            "actuator.channel: no such field",
        ),
    ],
)
def test_wrong_configuration_is_named(tmp_path, change, message):
    content = yaml.safe_load(EXAMPLE.read_text()) | change
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as raised:
        read_nidaq_config(path)
    assert str(raised.value).startswith("mine.yaml: ")
