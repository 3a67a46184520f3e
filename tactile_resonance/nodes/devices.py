# SPDX-License-Identifier: Apache-2.0
"""Which acquisition device a node drives, and where its records go."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_resonance.drivers.acquisition import AcquisitionDevice
from tactile_resonance.drivers.nidaq import NiDaqDevice
from tactile_resonance.drivers.nidaq_config import read_nidaq_config
from tactile_resonance.nodes.bench_device import BenchDevice
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.parameters import Parameter, values
from tactile_resonance.recording.store import RecordStore

if TYPE_CHECKING:
    from tactile_resonance.recording.store import StoredEntry

PARAMETERS = (
    Parameter(
        "device",
        "bench",
        "What plays and reads: the simulated bench, a recording, or NI hardware.",
        choices=("bench", "replay", "nidaqmx"),
        read_only=True,
    ),
    Parameter(
        "device_config",
        "",
        "For replay the folder or file of the recording, for nidaqmx its YAML file (see "
        "config/devices); empty for the bench.",
        read_only=True,
    ),
    Parameter(
        "replay_speed",
        1.0,
        "Signal time over real time of a replay; 0: as fast as possible.",
        0.0,
        1e3,
        read_only=True,
    ),
    Parameter(
        "record_folder",
        "",
        "Folder that receives every excitation and record before it is published; empty: "
        "tactile_resonance/records/DATE-TIME in $ROS_HOME (~/.ros where that is not set), UTC; for "
        "a replay, which is on disk already, none.",
        read_only=True,
    ),
    Parameter("frame_id", "tip", "Frame of the sensor's tip.", read_only=True),
)


def make_device(node: ManagedNode) -> AcquisitionDevice:
    """The device that the node's parameters name.

    Raises
    ------
    ValueError, OSError
        If the configuration is missing or wrong.
    DeviceError
        If what drives it is not installed.
    """
    device, config, speed, frame_id = values(
        node, "device", "device_config", "replay_speed", "frame_id"
    )
    if device == "bench":
        return BenchDevice(node, frame_id)
    if not config:
        raise ValueError(f"device_config: empty, expected a path for the device {device}")
    path = Path(config).expanduser().absolute()
    if device == "replay":
        # only here: it takes a node a tenth of a second more to start
        from tactile_resonance.drivers.replay import ReplayDevice

        return ReplayDevice(path, speed, _entries_of(path))
    return NiDaqDevice(read_nidaq_config(path))


def replayed_results(node: ManagedNode) -> tuple[bytes, ...]:
    """Serialised point results of the run that is played again; of any other device none."""
    device, config = values(node, "device", "device_config")
    path = Path(config).expanduser().absolute()
    if device != "replay" or not _is_run(path):
        return ()
    from tactile_resonance.scan.recorded import recorded_results
    from tactile_resonance.scan.run_content import read_run

    return tuple(recorded_results(read_run(path)))


def _is_run(path: Path) -> bool:
    return (path / "run.json").is_file()


def _entries_of(path: Path) -> list[StoredEntry] | None:
    """The measurements of a scan's run; None for a folder that the device reads without them."""
    if not _is_run(path):
        return None
    try:
        # only here: everything else works without the library for recordings
        from tactile_resonance.scan.recorded import run_entries
    except ImportError as error:
        raise ValueError(
            f"device: replay of a run: {error.name} not found; pip install rosbags"
        ) from error
    return run_entries(path)


def open_store(
    folder: str, device: str, environment: Mapping[str, str] = os.environ
) -> RecordStore | None:
    """The store of a node's records.

    Parameters
    ----------
    folder, device : str
        The parameters ``record_folder`` and ``device``.
    environment : mapping

    Returns
    -------
    RecordStore or None
        In a folder that no other node uses where none is named; None for a replay that names none.

    Raises
    ------
    OSError
        If the folder cannot be made.
    """
    if folder:
        return RecordStore(Path(folder).expanduser().absolute())
    if device == "replay":
        return None
    home = environment.get("ROS_HOME")
    parent = (Path(home) if home else Path.home() / ".ros") / "tactile_resonance" / "records"
    parent.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    number = 1
    while True:
        # several nodes may start in the same second
        path = parent / (stamp if number == 1 else f"{stamp}-{number}")
        try:
            path.mkdir()
        except FileExistsError:
            number += 1
        else:
            return RecordStore(path)
