# SPDX-License-Identifier: Apache-2.0
"""Wrong configurations of the NI driver, each named."""

import pytest
import yaml

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.nidaq_config import NiDaqConfig
from tactile_resonance.fields import read_file

EXAMPLE = share_path("config/devices/nidaqmx.yaml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"output": {"channel": "Dev1/ao0"}},
            "output.max_voltage_v: got None; accepted is a number .it is missing.",
        ),
        ({"between_samples": "linear"}, "between_samples: got 'linear'; accepted is one of"),
        ({"channel_delay_s": "1 us"}, "channel_delay_s: got '1 us'; accepted is a finite number"),
        ({"buffer_s": 0}, "buffer_s: got 0.0; accepted is a number above 0"),
        ({"gain": 3}, "gain: got 3; accepted is one of"),
        ({"sensor": {"channel": 3}}, "sensor.channel: got 3; accepted is text"),
        ({"sensor": None}, "sensor: got None; accepted is a mapping"),
        (
            {"sensor": {"channel": "Dev1/ai0", "range_v": 1.0, "terminals": "rse"}},
            "sensor.channel: got 'Dev1/ai0'; accepted is another",
        ),
        (
            {"actuator": {"source": "commanded", "channel": "Dev1/ai0"}},
            "actuator.channel: got 'Dev1/ai0'; accepted is one of source",
        ),
    ],
)
def test_wrong_configuration_is_named(tmp_path, change, message):
    content = yaml.safe_load(EXAMPLE.read_text()) | change
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as raised:
        read_file(NiDaqConfig, path)
    assert str(raised.value).startswith("mine.yaml: ")
