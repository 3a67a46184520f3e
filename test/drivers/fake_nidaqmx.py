# SPDX-License-Identifier: Apache-2.0
"""A stand-in for nidaqmx 1.x: as much of it as the driver uses, on a simulated device.

The device behaves as documented: an output waits for its start trigger, which the inputs give when
they start; both run on the inputs' clock; a reader later than the buffer gets error -200279. Input
``ai0`` sees the output, ``ai1`` half of it.
"""

import sys
from enum import Enum
from types import ModuleType, SimpleNamespace

import numpy as np


class Constants:
    class TerminalConfiguration(Enum):
        RSE = 10083
        NRSE = 10078
        DIFF = 10106
        PSEUDO_DIFF = 12529
        DEFAULT = -1

    class AcquisitionType(Enum):
        FINITE = 10178
        CONTINUOUS = 10123

    class RegenerationMode(Enum):
        ALLOW_REGENERATION = 10097
        DONT_ALLOW_REGENERATION = 10158

    class OverwriteMode(Enum):
        OVERWRITE_UNREAD_SAMPLES = 10252
        DO_NOT_OVERWRITE_UNREAD_SAMPLES = 10159

    class TaskMode(Enum):
        TASK_VERIFY = 2
        TASK_COMMIT = 3

    class Edge(Enum):
        RISING = 10280


class DaqError(Exception):
    def __init__(self, message, error_code, task_name=""):
        super().__init__(f"{message}\n\nStatus Code: {error_code}")
        self.error_code = error_code


class FakeHardware:
    """State of the one device, and what is to go wrong."""

    def __init__(self):
        self.calls = []
        self.pin_v = 0.0  # what stands at the output
        self.coefficients = [1e-4, 3.2e-4]
        self.raw_bits = 16
        self.range_v = 10.0
        self.simultaneous = True
        self.rate_error = 0.0
        self.samples_late = 0  # how far the clock is ahead of the reader
        self.output_dies_at = None  # sample
        self.fail_on = {}  # call -> error
        self.open_tasks = []

    def call(self, name, *details):
        self.calls.append((name, *details))
        if name in self.fail_on:
            raise self.fail_on[name]

    def names(self):
        return [call[0] for call in self.calls]


class Timing:
    def __init__(self, task):
        self._task = task

    def cfg_samp_clk_timing(
        self, rate, source="", active_edge=None, sample_mode=None, samps_per_chan=1000
    ):
        self._task.hardware.call(f"{self._task.kind}.clock", rate, source, sample_mode)
        self._task.rate, self._task.clock_source = rate, source

    @property
    def samp_clk_rate(self):
        return self._task.rate * (1 + self._task.hardware.rate_error)


class StartTrigger:
    def __init__(self, task):
        self._task = task

    def cfg_dig_edge_start_trig(self, trigger_source, trigger_edge=None):
        self._task.hardware.call(f"{self._task.kind}.trigger", trigger_source)
        self._task.trigger_source = trigger_source


class AIChannelCollection:
    def __init__(self, task):
        self._task = task

    def add_ai_voltage_chan(
        self,
        physical_channel,
        name_to_assign_to_channel="",
        terminal_config=None,
        min_val=-5.0,
        max_val=5.0,
    ):
        task = self._task
        task.kind = "input"
        task.hardware.call("input.channel", physical_channel, terminal_config, min_val, max_val)
        task.channels.append(physical_channel)
        return SimpleNamespace(
            ai_dev_scaling_coeff=task.hardware.coefficients,
            ai_raw_samp_size=task.hardware.raw_bits,
            ai_rng_low=-task.hardware.range_v,
            ai_rng_high=task.hardware.range_v,
        )


class AOChannelCollection:
    def __init__(self, task):
        self._task = task

    def add_ao_voltage_chan(
        self, physical_channel, name_to_assign_to_channel="", min_val=-10.0, max_val=10.0
    ):
        self._task.kind = "output"
        self._task.hardware.call("output.channel", physical_channel, min_val, max_val)


class Task:
    hardware: FakeHardware

    def __init__(self, new_task_name=""):
        self.kind = "empty"
        self.hardware.call("task")
        self.channels = []
        self.clock_source = self.trigger_source = None
        self.data = None
        self.started = self.running = False
        self.position = 0
        self.timing = Timing(self)
        self.triggers = SimpleNamespace(start_trigger=StartTrigger(self))
        self.ai_channels = AIChannelCollection(self)
        self.ao_channels = AOChannelCollection(self)
        self.in_stream = SimpleNamespace(_task=self, input_buf_size=0, overwrite=None)
        self.out_stream = SimpleNamespace(output_buf_size=0, regen_mode=None)
        self.hardware.open_tasks.append(self)

    def write(self, data, auto_start=False, timeout=10.0):
        self.hardware.call("output.write", np.size(data), auto_start)
        self.data = np.asarray(data, float)
        if self.clock_source is None:  # on demand
            assert auto_start
            assert not any(t.running for t in self.hardware.open_tasks if t.kind == "output")
            self.hardware.pin_v = float(self.data)
        return int(np.size(data))

    def control(self, action):
        self.hardware.call(f"{self.kind}.{action.name}")

    def start(self):
        self.hardware.call(f"{self.kind}.start")
        self.started = True
        if self.kind == "input":
            self.running = True
            for task in self.hardware.open_tasks:
                # only an output that waits already sees the trigger
                if task.started and task.trigger_source == "/Dev1/ai/StartTrigger":
                    assert task.clock_source == "/Dev1/ai/SampleClock"
                    task.running = True
                    self.hardware.pin_v = task.data[-1]

    def is_task_done(self):
        self.hardware.call(f"{self.kind}.is_task_done")
        dies = self.hardware.output_dies_at
        source = next(t for t in self.hardware.open_tasks if t.kind == "input")
        if dies is not None and source.position >= dies:
            raise DaqError("DAC conversion attempted before data was available.", -200018)
        return False

    def close(self):
        self.hardware.call(f"{self.kind}.close")
        self.running = False
        self.hardware.open_tasks.remove(self)


class AnalogUnscaledReader:
    def __init__(self, task_in_stream):
        self._task = task_in_stream._task

    def read_int16(self, data, number_of_samples_per_channel=-1, timeout=10.0):
        return self._read(data, np.int16, number_of_samples_per_channel)

    def read_int32(self, data, number_of_samples_per_channel=-1, timeout=10.0):
        return self._read(data, np.int32, number_of_samples_per_channel)

    def _read(self, data, dtype, n):
        task, hardware = self._task, self._task.hardware
        hardware.call("input.read", n)
        assert data.dtype == dtype
        assert data.shape == (len(task.channels), n)
        if not task.running:
            raise DaqError("no samples", -200284)
        if hardware.samples_late > task.in_stream.input_buf_size:
            raise DaqError("The application is not able to keep up.", -200279)
        index = np.arange(task.position, task.position + n)
        outputs = [t for t in hardware.open_tasks if t.kind == "output" and t.running]
        volts = outputs[0].data[index % outputs[0].data.size] if outputs else np.zeros(n)
        ends = np.iinfo(dtype)
        for row, channel in zip(data, task.channels, strict=True):
            seen = volts if channel.endswith("ai0") else 0.5 * volts
            counts = np.rint((seen - hardware.coefficients[0]) / hardware.coefficients[1])
            row[:] = np.clip(counts, ends.min, ends.max)
        task.position += n
        return n


def install(monkeypatch):
    """Put the stand-in where nidaqmx would be; the hardware behind it."""
    hardware = FakeHardware()
    task = type("Task", (Task,), {"hardware": hardware})

    class Device:
        def __init__(self, name):
            hardware.call("device", name)
            self.product_type = "PCIe-6376 (fake)"
            self.ai_simultaneous_sampling_supported = hardware.simultaneous
            self.ao_voltage_rngs = [-10.0, 10.0]

    modules = {
        "nidaqmx": {"Task": task},
        "nidaqmx.constants": {k: v for k, v in vars(Constants).items() if isinstance(v, type)},
        "nidaqmx.stream_readers": {"AnalogUnscaledReader": AnalogUnscaledReader},
        "nidaqmx.system": {"Device": Device},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return hardware
