# SPDX-License-Identifier: Apache-2.0
"""The stand-in of nidaqmx against the package that it stands for."""

import inspect
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import fake_nidaqmx


def test_stand_in_agrees_with_the_real_package():
    """Every name, argument and constant of the stand-in exists in the package itself."""
    pytest.importorskip("nidaqmx", reason="nidaqmx is not installed")
    from nidaqmx import Task, constants, error_codes, stream_readers, system
    from nidaqmx.task import InStream, OutStream, Timing
    from nidaqmx.task.channels import AIChannel
    from nidaqmx.task.collections import AIChannelCollection, AOChannelCollection
    from nidaqmx.task.triggering import StartTrigger

    pairs = [
        (fake_nidaqmx.Task, Task, ("__init__", "write", "control", "start", "is_task_done")),
        (fake_nidaqmx.Task, Task, ("close",)),
        (fake_nidaqmx.Timing, Timing, ("cfg_samp_clk_timing",)),
        (fake_nidaqmx.StartTrigger, StartTrigger, ("cfg_dig_edge_start_trig",)),
        (fake_nidaqmx.AIChannelCollection, AIChannelCollection, ("add_ai_voltage_chan",)),
        (fake_nidaqmx.AOChannelCollection, AOChannelCollection, ("add_ao_voltage_chan",)),
        (
            fake_nidaqmx.AnalogUnscaledReader,
            stream_readers.AnalogUnscaledReader,
            ("__init__", "read_int16", "read_int32"),
        ),
    ]
    for ours, theirs, names in pairs:
        for name in names:
            mine = list(inspect.signature(getattr(ours, name)).parameters)
            real = list(inspect.signature(getattr(theirs, name)).parameters)
            assert real[: len(mine)] == mine, name
    for name, ours in vars(fake_nidaqmx.Constants).items():
        for member in ours if isinstance(ours, type) else ():
            assert getattr(constants, name)[member.name].value == member.value
    for owner, names in (
        (Timing, ("samp_clk_rate",)),
        (InStream, ("input_buf_size", "overwrite")),
        (OutStream, ("output_buf_size", "regen_mode")),
        (AIChannel, ("ai_dev_scaling_coeff", "ai_raw_samp_size", "ai_rng_low", "ai_rng_high")),
        (
            system.Device,
            ("product_type", "ai_simultaneous_sampling_supported", "ao_voltage_rngs"),
        ),
        (Task, ("in_stream", "out_stream", "timing", "triggers", "ai_channels", "ao_channels")),
    ):
        for name in names:
            assert isinstance(getattr(owner, name), property), name
    codes = {code.value for code in error_codes.DAQmxErrors}
    assert {-200279, -200222, -200283, -200361, -200010, -200284, -200018} <= codes
