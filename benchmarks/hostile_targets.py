# SPDX-License-Identifier: Apache-2.0
"""What reads bytes or messages from outside, with whole examples to begin from, and how often each is tried."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import select
import shutil
import socket
import struct
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import scipy.io

from benchmarks.endurance import content
from benchmarks.skip_hands import VirtualHands
from tactile_resonance.array_files import read_arrays
from tactile_resonance.bringup import read_parameter_file
from tactile_resonance.commands.analyze import parse_harmonics, parse_order, parse_segments
from tactile_resonance.configuration import share_path
from tactile_resonance.contact.parameters import read_contact
from tactile_resonance.drivers.can_frames import Assembler, read_can_description
from tactile_resonance.drivers.force_config import read_force_config
from tactile_resonance.drivers.nidaq_config import read_nidaq_config
from tactile_resonance.drivers.rtde_stream import PORT, RtdeStream
from tactile_resonance.drivers.twist import read_twist_config
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.record import Channel, Record
from tactile_resonance.recording.stored_file import read_stored, write_stored
from tactile_resonance.scan.mesh import read_stl
from tactile_resonance.scan.notes import parse_notes
from tactile_resonance.scan.plan import make_plan
from tactile_resonance.scan.point_file import read_content, read_messages
from tactile_resonance.scan.progress import Controls
from tactile_resonance.scan.run_content import read_run
from tactile_resonance.scan.run_directory import RunDirectory
from tactile_resonance.scan.runner import ScanRunner
from tactile_resonance.scan.scene import read_scan_scene
from tactile_resonance.scan.table_file import read_table
from tactile_resonance.sensor import read_sensor
from tactile_resonance.simulation.cell.transducer import CellParameters
from tactile_resonance.simulation.tissue.library import read_tissues
from tactile_resonance.simulation.tissue.scene import read_scene
from tactile_resonance.strict_yaml import dump_yaml, parse_yaml
from tactile_resonance.tissue.references import read_classes

Read = Callable[[bytes], object]
TABLE = b"""format: tactile_resonance table 1
base_frame: base
table_in_base: [0.3, 0.0, 0.1, 0.0, 0.0, 0.0]
covariance: [[1.0e-8, 0.0, 0.0], [0.0, 1.0e-8, 0.0], [0.0, 0.0, 1.0e-8]]
"""
CONFIGURATION: dict[str, Callable[[Path], object]] = {
    "contact.yaml": read_contact,
    "devices/nidaqmx.yaml": read_nidaq_config,
    "devices/twist.yaml": read_twist_config,
    "devices/ur5e.yaml": read_ur_config,
    "force/*.yaml": read_force_config,
    "force/frames/*.yaml": read_can_description,
    "load_cells/*.yaml": CellParameters.from_yaml,
    "scenes/*.yaml": read_scan_scene,
    "sensors/*.yaml": read_sensor,
    "tissues.yaml": read_tissues,
}
"""Readers of the files in config/, by pattern."""
WANTED = ("u", "y", "sample_rate_hz", "samples_per_period")


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
    """

    name: str
    seeds: list[bytes]
    read: Read
    share: float


def targets(folder: Path) -> list[Target]:
    """All readers; files are written into a folder."""
    run = _recorded(folder / "run")
    return [
        Target("YAML text", [path.read_bytes() for path in _config("**/*.yaml")], _yaml, 0.25),
        *_configuration(folder),
        *_arrays(folder),
        *_of_run(folder, run),
        Target("STL surface", _stl(), _file(folder / "surface.stl", read_stl), 0.06),
        Target("stored record", [_stored(folder)], _file(folder / "r.npz", partial(read_stored, kind=Record)),
               0.03),
        Target("options of analyze", [b"3,10:20:5", b"0:10,20:30", b"auto", b"4"], _options, 0.15),
        Target("notes of a run", [b"{temperature_c: 21.5, tip_wetness: wet}"], _notes, 0.08),
        *_wire(),
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
        yield Target(name, seeds, _file(folder / "configuration.yaml", reader), 0.005)
    scenes = [path.read_bytes() for path in _config("scenes/*.yaml")]
    read_phantom = _file(folder / "phantom.yaml", lambda path: read_scene(library, path))
    yield Target("phantom of a scene", scenes, read_phantom, 0.005)
    scene = (share_path("config/scenes") / "two_gelatines.yaml").read_bytes()
    yield Target("tissue classes", [scene], _file(folder / "classes.yaml", read_classes), 0.01)
    yield Target("table", [TABLE], _file(folder / "table.yaml", lambda path: read_table(path, "base")), 0.01)


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
    for suffix, seeds, share in (
        ("npz", [npz.getvalue(), packed.getvalue()], 0.05),
        ("csv", [csv.encode(), csv.replace(",", ";").encode()], 0.05),
        ("mat", [mat.getvalue()], 0.0002),  # each in a process of its own
    ):
        read = _file(folder / f"record.{suffix}", lambda path: read_arrays(path, WANTED))
        yield Target(f"arrays of .{suffix}", seeds, read, share)


def _recorded(run: Path) -> Path:
    """A small run."""
    scene = run.with_name("scene.yaml")
    text = dump_yaml(content(4))
    scene.write_text(text)
    plan, hands = make_plan(read_scan_scene(scene)), VirtualHands(read_scene(read_tissues(), scene), 1.2)
    with RunDirectory.create(run, text, plan.points, {"seed": 1}) as made:
        ScanRunner(plan, made, hands, Controls(), lambda progress: None, 1, lambda done: None).run()
    return run


def _of_run(folder: Path, run: Path) -> Iterable[Target]:
    point = next((run / "recording").glob("point*.mcap"))

    def point_file(path: Path) -> None:
        read_content(path)
        for _ in read_messages(path, "poles"):
            pass

    yield Target("recording of a point", [point.read_bytes()], _file(folder / "p.mcap", point_file), 0.008)
    for name in ("run.json", "index.jsonl", "results.csv", "scene.yaml"):
        if not (run / name).exists():
            continue
        own = folder / f"run of {name}"
        shutil.copytree(run, own)
        read = _file(own / name, lambda _, own=own: read_run(own))
        yield Target(f"{name} of a run", [(run / name).read_bytes()], read, 0.006)


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


def _wire() -> Iterable[Target]:
    description = read_can_description(_config("force/frames/*.yaml")[0])
    assembler = Assembler((1, 2), 5e-4)

    def frames(data: bytes) -> None:
        for k in range(0, len(data) - 1, 9):
            joined = assembler.add(data[k] % 3, data[k + 1 : k + 9], 1e-3 * data[k])
            if joined:
                description.decode(joined)
        description.decode(data)

    yield Target("CAN frames", [bytes(range(18)), b"\x0b" + bytes(15), bytes(36)], frames, 0.2)
    yield Target("states of a robot", [_state(), _state() * 3], _Robot().read, 0.002)


class _Robot:
    """Answers the driver's requests as a robot does, then sends it what it is given, and closes.

    A robot of 127.0.0.0/8 that nobody else simulates.
    """

    ANSWERS = {b"V": b"\1", b"S": b"\1"}
    TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,UINT32,UINT32,INT32,INT32"

    def __init__(self) -> None:
        self._host = f"127.0.{os.getpid() % 200 + 20}.{os.getpid() // 200 % 250 + 2}"
        self._listener = socket.create_server((self._host, PORT))
        self._data = b""
        threading.Thread(target=self._serve, daemon=True).start()

    def read(self, data: bytes) -> None:
        """Let a driver read it."""
        self._data = data
        stream = RtdeStream(self._host, 500.0)
        try:
            for _ in range(3):
                select.select([stream], [], [], 0.02)
                stream.read()
        finally:
            stream.close()

    def _serve(self) -> None:
        while True:
            with self._listener.accept()[0] as channel, contextlib.suppress(OSError):
                while head := channel.recv(3, socket.MSG_WAITALL):
                    size, kind = struct.unpack(">Hc", head)
                    channel.recv(size - 3, socket.MSG_WAITALL)
                    answer = self.ANSWERS.get(kind, b"\1" + self.TYPES)
                    channel.sendall(struct.pack(">Hc", 3 + len(answer), kind) + answer)
                    if kind == b"S":
                        channel.sendall(self._data)
                        break


def _state() -> bytes:
    """A data package of the recipe that the driver asks for: all of it zero."""
    payload = bytes(1 + 8 * 19 + 4 * 4)
    return struct.pack(">Hc", 3 + len(payload), b"U") + payload
