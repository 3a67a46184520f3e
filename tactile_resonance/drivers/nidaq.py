# SPDX-License-Identifier: Apache-2.0
"""NI hardware through nidaqmx: one output and two inputs on one sample clock, and their configuration.

Written after the interface of nidaqmx-python 1.x and tested against a stand-in of it. It has not
been run on hardware: go through docs/first_connection.md before a sensor is connected.
"""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from tactile_resonance._typing import FloatArray
from tactile_resonance.clock import WallClock
from tactile_resonance.drivers.acquisition import AcquisitionDevice, DeviceError, DeviceInfo
from tactile_resonance.fields import (
    AboveZero,
    Checked,
    OrUnknown,
    known_keys,
    one_line,
    read,
    read_dataclass,
    require,
)
from tactile_resonance.multisine import Excitation
from tactile_resonance.record import BetweenSamples, Channel, InputKind, Origin, Record

TERMINALS = {
    "differential": "DIFF",
    "rse": "RSE",
    "nrse": "NRSE",
    "pseudo_differential": "PSEUDO_DIFF",
    "default": "DEFAULT",
}
"""Our names, and those of ``nidaqmx.constants.TerminalConfiguration``."""


@dataclass(frozen=True)
class InputChannel(Checked):
    """One analogue input: its name, half its range [V], and a key of `TERMINALS`."""

    channel: str
    range_v: AboveZero
    terminals: str

    def __post_init__(self) -> None:
        require(bool(self.channel), "channel", self.channel, "a name such as Dev1/ai0")
        super().__post_init__()
        good = self.terminals in TERMINALS
        require(good, "terminals", self.terminals, f"one of {', '.join(TERMINALS)}")


@dataclass(frozen=True)
class OutputChannel(Checked):
    """The analogue output: its name, and the largest voltage of either sign that may be put out."""

    channel: str
    max_voltage_v: AboveZero

    def __post_init__(self) -> None:
        require(bool(self.channel), "channel", self.channel, "a name such as Dev1/ao0")
        super().__post_init__()


def _read_actuator(value: Any, field: str) -> InputChannel | None:
    """None where the drive is taken to be what was asked of the output."""
    source = value.get("source") if isinstance(value, dict) else None
    measured = read(InputKind, source, f"{field}.source") is InputKind.MEASURED
    channel = {key: item for key, item in value.items() if key != "source"}
    if not measured:
        known_keys(channel, {"source"}, field)
    return read_dataclass(InputChannel, channel, field) if measured else None


@dataclass(frozen=True)
class NiDaqConfig(Checked):
    """What `NiDaqDevice` needs to know; see ``config/devices/nidaqmx.yaml``.

    Attributes
    ----------
    output : OutputChannel
    actuator : InputChannel or None
        None where the drive is not measured.
    sensor : InputChannel
    between_samples : BetweenSamples
    buffer_s : float
        Length of the input buffer [s].
    anti_alias_filter : str
    channel_delay_s : float
        Of the sensor channel behind the actuator channel; NaN where not measured.
    clock_device : str
        Whose sample clock and start trigger all use; empty: that of the sensor.
    """

    output: OutputChannel
    actuator: Annotated[InputChannel | None, _read_actuator]
    sensor: InputChannel
    between_samples: BetweenSamples
    buffer_s: AboveZero
    anti_alias_filter: str = ""
    channel_delay_s: OrUnknown = math.nan
    clock_device: str = ""

    def __post_init__(self) -> None:
        taken = self.actuator is not None and self.actuator.channel == self.sensor.channel
        require(not taken, "sensor.channel", self.sensor.channel, "another than actuator.channel")
        super().__post_init__()

    @property
    def inputs(self) -> list[InputChannel]:
        """In the order in which they are read: actuator, where it is measured, then sensor."""
        return [self.actuator, self.sensor] if self.actuator else [self.sensor]


_PROBES = 1001


class CountScale:
    """Counts to volts, ``volts = sum_k coefficients[k] * counts**k``.

    Parameters
    ----------
    channel : nidaqmx.task.channels.AIChannel
        Its ``ai_dev_scaling_coeff`` are the coefficients, two or more; a sample at the ends of its range, or
        beyond, is saturated.
    dtype : numpy.int16 or numpy.int32
        Of the raw samples.

    Raises
    ------
    DeviceError
        If the coefficients have no slope.
    """

    def __init__(self, channel: Any, dtype: type[np.signedinteger]) -> None:
        coefficients = np.array(channel.ai_dev_scaling_coeff, float)
        if coefficients.size < 2 or coefficients[1] == 0:
            raise DeviceError(f"nidaqmx: scaling coefficients {coefficients}, expected a slope")
        self._coefficients = coefficients
        self._limits_v = float(channel.ai_rng_low), float(channel.ai_rng_high)
        self._ends = np.iinfo(dtype)
        offset_v, slope_v = coefficients[:2]
        low, high = sorted((limit - offset_v) / slope_v for limit in self._limits_v)
        counts = np.linspace(max(low, self._ends.min), min(high, self._ends.max), _PROBES)
        bend_v = polynomial.polyval(counts, coefficients) - (offset_v + slope_v * counts)
        # a bend that no count could show is none
        self._is_straight = bool(np.max(np.abs(bend_v)) <= 0.5 * abs(slope_v))

    def channel(self, counts: npt.NDArray[np.signedinteger]) -> Channel:
        """(n,) counts as they are where a straight line converts them, else volts."""
        volts = polynomial.polyval(counts.astype(float), self._coefficients)
        saturated = bool(
            np.any((counts == self._ends.min) | (counts == self._ends.max))
            or np.any((volts <= self._limits_v[0]) | (volts >= self._limits_v[1]))
        )
        if self._is_straight:
            offset_v, slope_v = map(float, self._coefficients[:2])
            return Channel(counts.astype(np.int32), slope_v, offset_v, saturated)
        return Channel(volts, saturated=saturated)


_RATE_TOLERANCE = 1e-9

# Error codes of NI-DAQmx, as listed in nidaqmx.error_codes.DAQmxErrors.
_NOT_YET_AVAILABLE = -200284
_OVERRUN = {
    -200279: "samples were overwritten before they were read",
    -200222: "acquisition stopped before unread samples were overwritten",
    -200283: "the buffer between device and computer overflowed",
    -200361: "the device's own memory overflowed",
    -200010: "the device's own memory overflowed",
}


class NiDaqDevice(AcquisitionDevice):
    """A device of NI.

    The inputs make the sample clock; the output runs on it and starts with the inputs' start
    trigger, one period repeated from the buffer. Every period is read whole and in order: a reader
    that is late by more than the buffer, or an output that ran dry, ends in `DeviceError`. Whatever
    ends a measurement, the output is then set to 0 V.

    Parameters
    ----------
    config : NiDaqConfig

    Raises
    ------
    DeviceError
        If the package nidaqmx is not installed.

    References
    ----------
    nidaqmx-python 1.x, https://nidaqmx-python.readthedocs.io: ``Timing.cfg_samp_clk_timing``,
    ``StartTrigger.cfg_dig_edge_start_trig``, ``AnalogUnscaledReader``,
    ``AIChannel.ai_dev_scaling_coeff``.
    """

    def __init__(self, config: NiDaqConfig) -> None:
        self._config = config
        self._daq = load("nidaqmx")
        self._constants = load("nidaqmx.constants")
        self._readers = load("nidaqmx.stream_readers")
        self._system = load("nidaqmx.system")
        self._lock = threading.RLock()  # play and stop come from different threads when a node ends
        self._rate_hz = 0.0
        self._playing: Excitation | None = None
        self._output: Any = None
        self._input: Any = None
        self._scales: list[CountScale] = []
        self._raw_dtype: type[np.signedinteger] = np.int16
        self._drive = np.empty(0)
        self._maybe_on = False  # until 0 V has been written
        self._index = 0
        self._clock, self._start_ns = WallClock(), 0
        self._closed = False

    def configure(self, sample_rate_hz: float) -> DeviceInfo:
        """Check devices, ranges and rate by setting up the inputs once; nothing moves."""
        config = self._config
        names = []
        with translated("configure"):
            for name in sorted({channel.channel.split("/")[0] for channel in config.inputs}):
                device = self._system.Device(name)
                names.append(f"{device.product_type} ({name})")
                simultaneous = bool(device.ai_simultaneous_sampling_supported)
                if config.actuator and not simultaneous and np.isnan(config.channel_delay_s):
                    raise DeviceError(
                        f"nidaqmx: {name} samples one channel after the other: measure the delay "
                        "by a loop-back and give it as channel_delay_s"
                    )
            output = self._system.Device(config.output.channel.split("/")[0])
            reach_v = max(output.ao_voltage_rngs, default=0.0)
        if config.output.max_voltage_v > reach_v:
            raise DeviceError(
                f"nidaqmx: output.max_voltage_v: {config.output.max_voltage_v:g}, the device reaches "
                f"{reach_v:g} V"
            )
        self._rate_hz = sample_rate_hz
        with translated("configure"), closing(self._make_input(samples=2)) as task:
            task.control(self._constants.TaskMode.TASK_VERIFY)
            real_hz = float(task.timing.samp_clk_rate)
        if abs(real_hz - sample_rate_hz) > _RATE_TOLERANCE * sample_rate_hz:
            raise DeviceError(
                f"nidaqmx: sample_rate_hz: {sample_rate_hz:.9g}, the device would sample at "
                f"{real_hz:.9g}: expected a rate that it makes exactly"
            )
        return DeviceInfo(", ".join(names), config.output.max_voltage_v)

    def play(self, excitation: Excitation) -> None:
        """Load one period, commit both tasks, start the output, which waits for the inputs, then these."""
        period = excitation.period()
        peak_v = float(np.max(np.abs(period)))
        if not peak_v <= self._config.output.max_voltage_v:
            raise DeviceError(
                f"nidaqmx: peak {peak_v:.3g} V, output.max_voltage_v is "
                f"{self._config.output.max_voltage_v:.3g} V"
            )
        if excitation.sample_rate_hz != self._rate_hz:
            raise DeviceError(
                f"nidaqmx: sample_rate_hz: {excitation.sample_rate_hz:g}, configured was "
                f"{self._rate_hz:g}"
            )
        with self._lock:
            if self._closed:
                raise DeviceError("nidaqmx: closed")
            self._close_tasks()
            with self._stopping("play"):
                # a reader may be late by the buffer, and two periods always fit
                late = round(self._config.buffer_s * self._rate_hz)
                self._input = self._make_input(max(late, 2 * period.size))
                self._output = self._make_output(period)
                commit = self._constants.TaskMode.TASK_COMMIT
                self._input.control(commit)
                self._output.control(commit)
                self._maybe_on = True
                self._output.start()
                self._input.start()
                self._clock = WallClock()
                self._start_ns = self._clock.now_ns()
            self._playing, self._drive, self._index = excitation, period, 0

    def read_block(self, timeout_s: float) -> Record:
        """The next period, whole; on any error the output is set to 0 V first."""
        task, output, excitation = self._input, self._output, self._playing
        if excitation is None or task is None or output is None:
            raise DeviceError("nidaqmx: nothing plays")
        n = excitation.samples_per_period
        raw = np.zeros((len(self._scales), n), self._raw_dtype)  # (channels, N)
        with self._stopping(f"block {self._index + 1}"):
            reader = self._readers.AnalogUnscaledReader(task.in_stream)
            read = reader.read_int16 if self._raw_dtype is np.int16 else reader.read_int32
            count = read(raw, number_of_samples_per_channel=n, timeout=timeout_s)
            # an output that ran dry is silent on the input's side: this call raises its error
            ended = output.is_task_done()
            if count != n:
                raise DeviceError(f"nidaqmx: block {self._index + 1}: {count} of {n} samples")
            if ended:
                raise DeviceError(f"nidaqmx: block {self._index + 1}: the output has stopped")
        channels = [scale.channel(row) for scale, row in zip(self._scales, raw, strict=True)]
        config, begun_ns = self._config, self._start_ns + round(self._index * excitation.period_s * 1e9)
        if not config.actuator:
            channels.insert(0, Channel(self._drive))
        block = Record(
            *(channels[0], channels[1], excitation.sample_rate_hz, n),
            block_index=self._index,
            input_kind=InputKind.MEASURED if config.actuator else InputKind.COMMANDED,
            between_samples=config.between_samples,
            channel_delay_s=config.channel_delay_s,
            anti_alias_filter=config.anti_alias_filter,
            origin=Origin(time_ns=self._clock.ros_ns(begun_ns)),
        )
        self._index += 1
        return block

    def stop(self) -> None:
        """End both tasks and set the output to 0 V."""
        with self._lock:
            self._playing = None
            errors = self._close_tasks()
            if self._maybe_on:
                failed = self._zero()
                self._maybe_on = bool(failed)
                errors += failed
            if errors:
                raise DeviceError("; ".join(errors))

    def close(self) -> None:
        """Stop for good."""
        with self._lock:
            self._closed = True
            self.stop()

    @contextmanager
    def _stopping(self, doing: str) -> Iterator[None]:
        """As `translated`, and after an error stop; with what went wrong in stopping."""
        try:
            with translated(doing):
                yield
        except DeviceError as error:
            further = attempt(doing, self.stop)
            raise DeviceError("; ".join([str(error), *further])) from error

    def _make_input(self, samples: int) -> Any:
        """Inputs that run until stopped, with a buffer of this many samples per channel."""
        task = self._daq.Task()
        try:
            channels = [
                task.ai_channels.add_ai_voltage_chan(
                    channel.channel,
                    terminal_config=self._constants.TerminalConfiguration[TERMINALS[channel.terminals]],
                    min_val=-channel.range_v,
                    max_val=channel.range_v,
                )
                for channel in self._config.inputs
            ]
            task.timing.cfg_samp_clk_timing(
                self._rate_hz,
                sample_mode=self._constants.AcquisitionType.CONTINUOUS,
                samps_per_chan=samples,
            )
            task.in_stream.input_buf_size = samples
            task.in_stream.overwrite = self._constants.OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
            bits = {int(channel.ai_raw_samp_size) for channel in channels}
            if bits not in ({16}, {32}):
                raise DeviceError(f"nidaqmx: raw samples of {sorted(bits)} bits, expected 16 or 32")
            self._raw_dtype = np.int16 if bits == {16} else np.int32
            self._scales = [CountScale(channel, self._raw_dtype) for channel in channels]
        except Exception:
            task.close()
            raise
        return task

    def _make_output(self, period: FloatArray) -> Any:
        """The period, repeated on the inputs' clock from the inputs' start on."""
        device = self._config.clock_device or self._config.sensor.channel.split("/")[0]
        clock = f"/{device}/ai"
        task = self._daq.Task()
        try:
            self._add_output(task)
            task.timing.cfg_samp_clk_timing(
                self._rate_hz,
                source=f"{clock}/SampleClock",
                sample_mode=self._constants.AcquisitionType.CONTINUOUS,
                samps_per_chan=period.size,
            )
            task.triggers.start_trigger.cfg_dig_edge_start_trig(f"{clock}/StartTrigger")
            task.out_stream.regen_mode = self._constants.RegenerationMode.ALLOW_REGENERATION
            task.out_stream.output_buf_size = period.size
            written = task.write(period, auto_start=False)
            if written != period.size:
                raise DeviceError(f"nidaqmx: {written} of {period.size} samples taken for output")
        except Exception:
            task.close()
            raise
        return task

    def _add_output(self, task: Any) -> None:
        limit_v = self._config.output.max_voltage_v
        task.ao_channels.add_ao_voltage_chan(
            self._config.output.channel, min_val=-limit_v, max_val=limit_v
        )

    def _close_tasks(self) -> list[str]:
        """Abort and release; what could not be closed."""
        errors = []
        for task in (self._output, self._input):
            if task is not None:
                errors += attempt("stop", task.close)  # closing aborts
        self._output = self._input = None
        return errors

    def _zero(self) -> list[str]:
        def write_zero() -> None:
            with closing(self._daq.Task()) as task:
                self._add_output(task)
                task.write(0.0, auto_start=True)

        errors = attempt("zero", write_zero)
        return [f"THE OUTPUT MAY NOT BE AT ZERO: {error}" for error in errors]


def load(name: str) -> ModuleType:
    """A module of the optional package; DeviceError where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise DeviceError(
            f"nidaqmx: {one_line(error)}; install the package with "
            "'pip install \"nidaqmx>=1.0,<2\"' and NI's driver NI-DAQmx"
        ) from error


@contextmanager
def translated(doing: str) -> Iterator[None]:
    """Whatever nidaqmx raises inside becomes a `DeviceError` of one line."""
    try:
        yield
    except DeviceError:
        raise
    except Exception as error:
        raise DeviceError(f"nidaqmx: {doing}: {_reason(error)}") from error


def attempt(doing: str, call: Callable[[], object]) -> list[str]:
    """Call, and return what went wrong instead of raising: what follows must be tried as well."""
    try:
        with translated(doing):
            call()
    except DeviceError as error:
        return [str(error)]
    return []


def _reason(error: Exception) -> str:
    code = getattr(error, "error_code", None)
    if code in _OVERRUN:
        return f"overrun, blocks are lost: {_OVERRUN[code]}"
    if code == _NOT_YET_AVAILABLE:
        return "no samples in time: the clock does not run, or runs slowly"
    return one_line(error)
