# SPDX-License-Identifier: Apache-2.0
"""What reads bytes or messages from outside, with whole examples to begin from, and how often each is tried."""

from __future__ import annotations

import argparse
import io
import shutil
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import scipy.io

from benchmarks.hostile_run import BAND_HZ, make_run
from tactile_resonance.array_files import read_arrays
from tactile_resonance.bringup import read_parameter_file
from tactile_resonance.calibration.model import (
    CalibratedSensor,
    Calibration,
    SensorModel,
    read_calibration,
)
from tactile_resonance.commands.analyze import parse_harmonics, parse_order, parse_segments
from tactile_resonance.commands.mechanics import COLUMNS
from tactile_resonance.configuration import parse_yaml, share_path
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.drivers.can_frames import read_can_description
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.drivers.nidaq import NiDaqConfig
from tactile_resonance.drivers.twist import TwistConfig
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.fields import read_file
from tactile_resonance.mechanics.indentation import BallTip, IndentationRecord, Protocol
from tactile_resonance.record import Channel, Record
from tactile_resonance.recording.recording import read_recording
from tactile_resonance.recording.store import read_stored, write_stored
from tactile_resonance.scan.kept_bins import NAME, kept_bins
from tactile_resonance.scan.labels import read_labels
from tactile_resonance.scan.point_file import read_content
from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.scene import parse_notes, read_scan_scene
from tactile_resonance.scan.surface import read_stl
from tactile_resonance.scan.table_calibration import read_table
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.tissue.references import read_classes, read_sources

Read = Callable[[bytes], object]
WITHIN_S, PROCESS_WITHIN_S = 5.0, 60.0
"""Of an answer; of one by a process of its own, for whose start a busy machine takes long."""
TABLE = b"""format: tactile_resonance table 1
base_frame: base
table_in_base: [0.3, 0.0, 0.1, 0.0, 0.0, 0.0]
covariance: [[1.0e-8, 0.0, 0.0], [0.0, 1.0e-8, 0.0], [0.0, 0.0, 1.0e-8]]
"""
CONFIGURATION: dict[str, Callable[[Path], object]] = {
    "contact.yaml": read_contact,
    "devices/nidaqmx.yaml": partial(read_file, NiDaqConfig),
    "devices/twist.yaml": partial(read_file, TwistConfig),
    "devices/ur5e.yaml": read_ur_config,
    "force/*.yaml": read_force_config,
    "force/frames/*.yaml": read_can_description,
    "load_cells/*.yaml": CellParameters.from_yaml,
    "scenes/*.yaml": read_scan_scene,
    "sensors/*.yaml": read_sensor,
    "tissues.yaml": read_tissues,
}
"""Readers of the files in config/, by pattern."""
LIBRARY = b"""spread:
  gel10:
    preparation: {f0_std_hz: 1.0, damping_ratio_std: 0.001, degrees_of_freedom: 4, holds: [position]}
    repetition: {f0_std_hz: 0.5, damping_ratio_std: 0.001, correlation: 0.1, degrees_of_freedom: 9}
"""


@dataclass(frozen=True, eq=False)
class Target:
    """A reader.

    Attributes
    ----------
    name : str
    seeds : list of bytes
        Examples that it accepts.
    read : callable
        Takes bytes; returns, or raises what it may raise.
    share : float
        Of all inputs.
    within_s : float
        In which it answers [s].
    """

    name: str
    seeds: list[bytes]
    read: Read
    share: float
    within_s: float = WITHIN_S


def targets(folder: Path) -> list[Target]:
    """All readers; files are written into a folder."""
    run = make_run(folder / "run")
    return [
        Target("YAML text", [path.read_bytes() for path in _config("**/*.yaml")], _yaml, 0.25),
        *_configuration(folder),
        *_arrays(folder),
        *_of_run(folder, run),
        Target("calibration", [_calibration()], _file(folder / "calibration.yaml", read_calibration), 0.01),
        Target("STL surface", _stl(), _file(folder / "surface.stl", read_stl), 0.02),
        Target("stored record", [_stored(folder)], _file(folder / "r.npz", partial(read_stored, kind=Record)),
               0.03),
        Target("options of analyze", [b"3,10:20:5", b"0:10,20:30", b"auto", b"4"], _options, 0.15),
        Target("notes of a run", [b"{temperature_c: 21.5, tip_wetness: wet}"], _notes, 0.08),
    ]  # fmt: skip


def _config(pattern: str) -> list[Path]:
    return sorted(share_path("config").glob(pattern))


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _yaml(data: bytes) -> None:
    parse_yaml(_text(data))


def _notes(data: bytes) -> None:
    parse_notes(_text(data), "notes")


def _file(path: Path, read: Callable[[Path], object]) -> Read:
    """Of a reader of files."""

    def of_bytes(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return of_bytes


def _configuration(folder: Path) -> Iterable[Target]:
    library = read_tissues()
    for pattern, reader in {**CONFIGURATION, "nodes.yaml": read_parameter_file}.items():
        seeds = [path.read_bytes() for path in _config(pattern)]
        name = f"config/{pattern}"
        own = folder / f"{pattern.replace('/', '-').replace('*', 'all')}"  # readers run side by side
        yield Target(name, seeds, _file(own, reader), 0.005)
    scenes = [path.read_bytes() for path in _config("scenes/*.yaml")]
    read_phantom = _file(folder / "phantom.yaml", lambda path: read_scene(library, path))
    yield Target("phantom of a scene", scenes, read_phantom, 0.005)
    scene = (share_path("config/scenes") / "two_gelatines.yaml").read_bytes()
    yield Target("tissue classes", [scene], _file(folder / "classes.yaml", read_classes), 0.01)
    yield Target("table", [TABLE], _file(folder / "table.yaml", lambda path: read_table(path, "base")), 0.01)
    yield Target("sources of spread", [LIBRARY], _file(folder / "library.yaml", read_sources), 0.005)


def _arrays(folder: Path) -> Iterable[Target]:
    rng = np.random.default_rng(0)
    arrays = {
        "u": rng.standard_normal(24),
        "y": rng.standard_normal(24),
        "sample_rate_hz": 100.0,
        "samples_per_period": 8,
    }
    npz, packed, mat = io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.savez(npz, **arrays)
    np.savez_compressed(packed, **arrays)
    scipy.io.savemat(mat, arrays)
    csv = "u,y\n" + "\n".join(f"{a:.6g},{b:.6g}" for a, b in zip(arrays["u"], arrays["y"], strict=True))
    known = {"csv": {"sample_rate_hz": 100.0, "samples_per_period": 8}}
    for suffix, seeds, *share in (
        ("npz", [npz.getvalue(), packed.getvalue()], 0.05),
        ("csv", [csv.encode(), csv.replace(",", ";").encode()], 0.05),
        ("mat", [mat.getvalue()], 0.0002, PROCESS_WITHIN_S),
    ):
        read = partial(read_recording, **known.get(suffix, {}))
        yield Target(f"record of .{suffix}", seeds, _file(folder / f"record.{suffix}", read), *share)
    test = "time_s,force_n,indentation_m\n" + "\n".join(f"{k},{0.01 * k},{1e-5 * k}" for k in range(24))
    read_test = _file(folder / "test.csv", _mechanical_test)
    yield Target("mechanical test", [test.encode()], read_test, 0.02)


def _mechanical_test(path: Path) -> None:
    arrays, _ = read_arrays(path, COLUMNS)
    if set(arrays) == set(COLUMNS):
        in_order = (arrays[name].ravel().astype(float) for name in COLUMNS)
        IndentationRecord(Protocol.RELAXATION, *in_order, BallTip(0.0025))


def _calibration() -> bytes:
    """Of a sensor of two modes."""
    model = SensorModel(
        *(np.array(of) for of in ([2e3, 1e4], [0.01, 0.02], [30.0, 50.0], [90.0, -70.0])),
        *map(np.asarray, (0.1, 1.0, 2.0, 1e-5)),
    )
    size = model.values.size
    covariance = np.diag(1e-8 * np.arange(1.0, size + 1))
    made = Calibration(model, covariance, np.ones(size, bool), (100.0, 900.0), 1e-6, 1.0)
    return CalibratedSensor(made, 0.0025, 8e-5, 1e-7, {"sensor": "a"}).as_text().encode()


def _of_run(folder: Path, run: Path) -> Iterable[Target]:
    point = next((run / "recording").glob("point*.mcap"))

    def point_file(path: Path) -> None:
        read_content(path)
        for _ in measurements_of_file(path):
            pass

    yield Target("recording of a point", [point.read_bytes()], _file(folder / "p.mcap", point_file), 0.02)

    def bins_file(path: Path) -> None:
        kept = kept_bins(path.parent, BAND_HZ)
        for piece in kept.pieces if kept else ():
            for row in piece.read()[:8]:
                piece.kind.bins(row)

    readers = dict.fromkeys(("run.json", "index.jsonl", "scene.yaml"), read_run)
    for name, of_folder in readers.items():
        own = shutil.copytree(run, folder / f"run of {name}")
        read = _file(own / name, lambda _, own=own, of_folder=of_folder: of_folder(own))
        yield Target(f"{name} of a run", [(run / name).read_bytes()], read, 0.005)
    own = shutil.copytree(run, folder / "run of bins")
    yield Target("kept bins of a run", [(run / NAME).read_bytes()], _file(own / NAME, bins_file), 0.01)
    content = read_run(run)
    read = _file(folder / "labels.csv", lambda path: read_labels(path, [content]))
    yield Target("labels of points", [b"tissue,index\ngel10,0\ngel12,1\n"], read, 0.01)


def _stl() -> list[bytes]:
    triangles = np.array([[0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0]] * 2, "<f4")
    faces = b"".join(row.tobytes() + b"\0\0" for row in triangles)
    corners = "".join(f"vertex {corner}\n" for corner in ("0 0 0", "1 0 0", "0 1 0"))
    text = f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n"
    return [bytes(80) + struct.pack("<I", 2) + faces, text.encode()]


def _stored(folder: Path) -> bytes:
    counts = Channel(np.arange(24, dtype=np.int16), 1e-4)
    write_stored(folder / "seed.npz", Record(counts, counts, 100.0, 8))
    return (folder / "seed.npz").read_bytes()


def _options(data: bytes) -> None:
    for parse in (parse_harmonics, parse_segments, parse_order):
        try:
            parse(_text(data))
        except argparse.ArgumentTypeError as error:
            if "\n" in str(error).replace(repr(_text(data)), ""):
                raise
