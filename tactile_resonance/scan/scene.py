# SPDX-License-Identifier: Apache-2.0
"""A scan's scene: what is on the table and what is wanted from it.

The same file may hold ``regions``, what is ``buried`` and the ``motion`` of the surface, which the simulated
bench reads (`tactile_resonance.simulation.scene`) and a scan does not need.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from tactile_resonance.configuration import share_path
from tactile_resonance.fields import (
    known_keys,
    number,
    read_dataclass,
    read_yaml,
    require,
    section,
)
from tactile_resonance.scan.decision import BlockLimits, Precise, Separate
from tactile_resonance.scan.notes import Notes, read_notes
from tactile_resonance.scan.patterns import read_positions
from tactile_resonance.scan.surface import (
    NormalRequest,
    Plane,
    Surface,
    TouchRequest,
    read_surface,
)
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import NominalContact
from tactile_resonance.tissue.references import (
    parse_classes,
    parse_nominal_contact,
    read_classes,
)

E = TypeVar("E", bound=Enum)

# Of the simulated bench: what lies on its table, and how it moves.
BENCH_KEYS = {"regions", "buried", "motion"}
_KEYS = {
    *("name", "frame_id", "force_n", "hold", "sensor", "surface", "positions"),
    *("outputs", "precision", "blocks", "tissue_classes", "nominal_contact", "on_failure"),
    *("gate", "time_limits", "drift_limits", "notes", "normals"),
    *BENCH_KEYS,
}


class Hold(str, Enum):
    """What contact control keeps while it is measured."""

    FORCE = "force"
    INDENTATION = "indentation"


class Output(str, Enum):
    """What a scan can bring home."""

    POLES = "poles"
    FRF = "frf"  # over the sensor's whole range, not only the mode's band
    DISTORTION = "distortion"
    RELAXATION = "relaxation"
    MAP = "map"
    SILENT = "silent"  # tones and noise, from a record without drive before the first point


class OnFailure(str, Enum):
    """What a scan does after a point that failed."""

    CONTINUE = "continue"
    STOP = "stop"


@dataclass(frozen=True)
class SensorUse:
    """The sensor and how it is used.

    Attributes
    ----------
    name : str
        Of ``config/sensors``.
    band_low_hz, band_high_hz : float
        Around the mode that is identified.
    level_v : float
        Drive [V rms], if the sensor's whole range were excited: the amplitude of each line follows from
        it, however few are.
    heading_rad : float
        Direction of the beam from clamp to tip, seen from above, from the x axis [rad].
    """

    name: str = "bimorph"
    band_low_hz: float = 200.0
    band_high_hz: float = 300.0
    level_v: float = 1.0
    heading_rad: float = 0.0

    def __post_init__(self) -> None:
        known = sorted(path.stem for path in share_path("config/sensors").glob("*.yaml"))
        require(self.name in known, "name", self.name, f"one of config/sensors: {', '.join(known)}")
        require(self.band_low_hz > 0, "band_low_hz", self.band_low_hz, "a number above 0")
        good = self.band_high_hz > self.band_low_hz
        require(
            good, "band_high_hz", self.band_high_hz, f"above band_low_hz = {self.band_low_hz:g}"
        )
        require(self.level_v > 0, "level_v", self.level_v, "a number above 0")


@dataclass(frozen=True)
class TimeLimits:
    """Longest durations [s]; a point that takes longer fails, a scan that does ends."""

    point_s: float = 60.0
    scan_s: float = 3600.0

    def __post_init__(self) -> None:
        for name in ("point_s", "scan_s"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number above 0")


@dataclass(frozen=True)
class DriftLimits:
    """How far the poles in air may move during a scan; what is less is no warning, however significant.

    Both are this project's choice: a fiftieth of what tells 10 from 12 % gelatine (arXiv 1805.00682).
    """

    f0_hz: float = 0.05
    damping_ratio: float = 5e-5

    def __post_init__(self) -> None:
        for name in ("f0_hz", "damping_ratio"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number above 0")


@dataclass(frozen=True)
class Gate:
    """How quiet the force must be while a point is measured.

    Attributes
    ----------
    force_rms_n : float
        Most that it may move by over the whole of a measurement: `ForceSpread.rms_n` [N].
    force_error_n : float
        Most that its mean may differ from the scene's force [N].
    measurements : int
        Most that are begun in one contact.
    """

    force_rms_n: float
    force_error_n: float = math.inf
    measurements: int = 20

    def __post_init__(self) -> None:
        for name in ("force_rms_n", "force_error_n"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number above 0")
        most = self.measurements
        require(1 <= most <= 100, "measurements", most, "1 to 100")


@dataclass(frozen=True, eq=False)
class ScanScene:
    """What a scan is to do.

    Attributes
    ----------
    name : str
    frame_id : str
        Frame of positions and surface.
    force_n : float
        Contact force [N].
    hold : Hold
    sensor : SensorUse
    surface : Surface or TouchRequest
    positions_m : (n, 3) float
        In order; z is NaN where the surface decides it [m].
    outputs : tuple of Output
    precision : Precise, Separate or None
        When a point's blocks are enough; None: after the most blocks.
    blocks : BlockLimits
    gate : Gate or None
        A measurement during which the force moved more is repeated; None: none is.
    tissue_classes : tuple of TissueClass
        Tissues that a point may be called; empty: none is called.
    nominal_contact : NominalContact or None
        Force and age of contact to which the classes refer, and how poles change beside them; None: not known.
    on_failure : OnFailure
    time_limits : TimeLimits
    drift_limits : DriftLimits
        Of the poles in air, before the sensor counts as drifted.
    normals : NormalRequest or None
        How the normal of each point is found by touch; None: it is the surface's.
    notes : Notes
        What people know of the session and no instrument tells.
    """

    name: str
    force_n: float
    positions_m: npt.NDArray[np.float64]
    frame_id: str = "table"
    hold: Hold = Hold.FORCE
    sensor: SensorUse = field(default_factory=SensorUse)
    surface: Surface | TouchRequest = field(default_factory=Plane)
    outputs: tuple[Output, ...] = (Output.POLES, Output.MAP)
    precision: Precise | Separate | None = None
    blocks: BlockLimits = field(default_factory=BlockLimits)
    gate: Gate | None = None
    tissue_classes: tuple[TissueClass, ...] = ()
    nominal_contact: NominalContact | None = None
    on_failure: OnFailure = OnFailure.CONTINUE
    time_limits: TimeLimits = field(default_factory=TimeLimits)
    drift_limits: DriftLimits = field(default_factory=DriftLimits)
    normals: NormalRequest | None = None
    notes: Notes = field(default_factory=Notes)


def read_scan_scene(path: Path) -> ScanScene:
    """Read a scene file; everything a scan needs has a default but the positions and the force.

    Raises
    ------
    ValueError
        One line that names the field, its value and what is accepted.
    """
    path = Path(path)
    return parse_scan_scene(read_yaml(path), path)


def parse_scan_scene(content: Mapping[str, Any], path: Path) -> ScanScene:
    """Scene of a file's content.

    Parameters
    ----------
    content : mapping
    path : Path
        Of the file: for messages, and for the files that it names.

    Raises
    ------
    ValueError
        One line that names the field, its value and what is accepted.
    """
    where = path.name
    for key, value in content.items():
        require(key in _KEYS, f"{where}: {key}", value, f"one of {sorted(_KEYS)}")
    force_n = number(content.get("force_n"), f"{where}: force_n")
    require(force_n > 0, f"{where}: force_n", force_n, "a number above 0")
    frame_id = content.get("frame_id", "table")
    good = isinstance(frame_id, str) and bool(frame_id)
    require(good, f"{where}: frame_id", frame_id, "the name of a frame")
    classes, nominal = _read_tissues(content, path)
    if nominal is not None:
        good = 0.1 <= nominal.force_n / force_n <= 10
        accepted = f"a tenth to ten times force_n, {force_n:g}"
        require(good, f"{where}: nominal_contact.force_n", nominal.force_n, accepted)
    outputs = _read_outputs(content, where)
    surface: Surface | TouchRequest = Plane()
    if "surface" in content:
        surface = read_surface(section(content, "surface", where), path.parent, f"{where}: surface")
    return ScanScene(
        name=str(content.get("name", path.stem)),
        force_n=force_n,
        positions_m=read_positions(section(content, "positions", where), f"{where}: positions"),
        frame_id=frame_id,
        hold=_choice(content, "hold", Hold.FORCE, where),
        sensor=_part(SensorUse, content, "sensor", where),
        surface=surface,
        outputs=outputs,
        precision=_read_precision(content, classes, where),
        blocks=_part(BlockLimits, content, "blocks", where),
        gate=_part(Gate, content, "gate", where) if "gate" in content else None,
        tissue_classes=classes,
        nominal_contact=nominal,
        on_failure=_choice(content, "on_failure", OnFailure.CONTINUE, where),
        time_limits=_part(TimeLimits, content, "time_limits", where),
        drift_limits=_part(DriftLimits, content, "drift_limits", where),
        normals=_part(NormalRequest, content, "normals", where) if "normals" in content else None,
        notes=read_notes(section({"notes": {}, **content}, "notes", where), f"{where}: notes"),
    )


def _read_outputs(content: Mapping[str, Any], where: str) -> tuple[Output, ...]:
    names = content.get("outputs", ["poles", "map"])
    accepted = [output.value for output in Output]
    good = isinstance(names, list) and len(names) > 0 and all(n in accepted for n in names)
    require(good, f"{where}: outputs", names, f"a list out of {', '.join(accepted)}")
    assert isinstance(names, list)
    return tuple(output for output in Output if output.value in names)


def _read_tissues(
    content: Mapping[str, Any], path: Path
) -> tuple[tuple[TissueClass, ...], NominalContact | None]:
    """Classes and the contact to which they refer: given in place, or in a file beside the scene."""
    given, where = content.get("tissue_classes"), path.name
    if isinstance(given, str):
        good = "nominal_contact" not in content
        require(
            good, f"{where}: nominal_contact", "one", f"none: it belongs to the classes, in {given}"
        )
        return read_classes(path.parent / given)
    nominal = parse_nominal_contact(content, where)
    if given is None:
        accepted = "classes, to which nominal_contact belongs (they are missing)"
        require(nominal is None, f"{where}: tissue_classes", None, accepted)
        return (), None
    return parse_classes(given, f"{where}: tissue_classes"), nominal


def _read_precision(
    content: Mapping[str, Any], classes: tuple[TissueClass, ...], where: str
) -> Precise | Separate | None:
    if "precision" not in content:
        return None
    fields = section(content, "precision", where)
    where = f"{where}: precision"
    try:
        if "separate" not in fields:
            known_keys(fields, {"f0_std_hz", "damping_ratio_std"}, where)
            require(
                len(fields) > 0, where, dict(fields), "f0_std_hz, damping_ratio_std or separate"
            )
            wanted = {key: number(value, f"{where}.{key}") for key, value in fields.items()}
            return Precise(**wanted)
        known_keys(fields, {"separate", "probability"}, where)
        names, by_name = fields["separate"], {c.name: c for c in classes}
        good = isinstance(names, list) and len(names) == 2 and all(n in by_name for n in names)
        require(good, f"{where}.separate", names, f"two out of tissue_classes: {sorted(by_name)}")
        probability = number(fields.get("probability"), f"{where}.probability")
        return Separate(by_name[names[0]], by_name[names[1]], probability)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(where) else f"{where}.{text}") from error


def _part(cls: type, content: Mapping[str, Any], key: str, where: str) -> Any:
    return read_dataclass(cls, section({key: {}, **content}, key, where), f"{where}: {key}")


def _choice(content: Mapping[str, Any], key: str, default: E, where: str) -> E:
    value = content.get(key, default.value)
    accepted = {item.value: item for item in type(default)}
    require(value in accepted, f"{where}: {key}", value, f"one of {', '.join(accepted)}")
    return accepted[value]
