# SPDX-License-Identifier: Apache-2.0
"""A scan's scene: what is on the table and what is wanted from it.

The same file may hold ``regions``, what is ``buried`` and the ``motion`` of the surface, which the simulated
bench reads (`tactile_resonance.simulation.tissue.scene`) and a scan does not need.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, cast

from tactile_resonance._typing import FloatArray
from tactile_resonance.configuration import parse_yaml, share_path
from tactile_resonance.contact.goal import HoldMode
from tactile_resonance.fields import (
    AboveZero,
    BelowOne,
    Checked,
    build,
    known_keys,
    read,
    read_dataclass,
    read_yaml,
    require,
    section,
)
from tactile_resonance.poles.structure import DEFAULT_RESIDUAL_TERMS, PoleBand
from tactile_resonance.scan.adaptive import Adaptive, read_adaptive
from tactile_resonance.scan.clearance import is_plane
from tactile_resonance.scan.decision import BlockLimits, Gate, Precise, Separate
from tactile_resonance.scan.points import flat, read_positions, require_near
from tactile_resonance.scan.surface import NormalRequest, Plane, Surface, TouchRequest, read_surface
from tactile_resonance.scan.tissue_tests import ProtocolRequest
from tactile_resonance.tissue.classify import TissueClass
from tactile_resonance.tissue.nominal_contact import NominalContact
from tactile_resonance.tissue.references import parse_classes, parse_nominal_contact, with_library

# Of the simulated bench: what lies on its table, and how it moves.
BENCH_KEYS = {"regions", "buried", "motion"}
AUTO = "auto"
"""What the plan chooses."""
MOST_FORCE_N = 1.0
"""A hundred times the preload of the method: beyond it a figure is a slip of the unit."""
NEIGHBOUR = 0.5
"""Of the lower end of a band: other modes are expected from there downwards."""
LEFT_OF_NEIGHBOURS = 1e-6
"""Of the response of such a mode, what residual terms may leave."""


class Output(str, Enum):
    """What a scan can bring home."""

    POLES = "poles"
    FRF = "frf"  # over the sensor's whole range, not only the mode's band
    DISTORTION = "distortion"  # even and odd, at input and output, in each band
    MAP = "map"
    SILENT = "silent"  # tones and noise, from a record without drive before the first point


class OnFailure(str, Enum):
    """What a scan does after a point that failed."""

    CONTINUE = "continue"
    STOP = "stop"


def _read_period(value: object, field: str) -> int | None:
    """Samples of a period; None where the plan chooses them."""
    if value == AUTO:
        return None
    require(type(value) is int, field, value, f"an integer or {AUTO}")
    return cast(int, value)


def residual_terms_of(ends_hz: tuple[float, float]) -> int:
    """Residual terms that a band needs for modes beside it.

    A polynomial of r terms follows the response of a pole beside a band up to ``rho^-r`` of it, rho the sum of
    the half axes of the ellipse through the pole whose foci are the band's ends, over half the band's width
    (Bernstein; Trefethen, Approximation Theory and Approximation Practice (2013), theorem 8.2).
    """
    low_hz, high_hz = ends_hz
    away = (low_hz + high_hz - 2 * NEIGHBOUR * low_hz) / (high_hz - low_hz)
    return math.ceil(-math.log(LEFT_OF_NEIGHBOURS) / math.acosh(away))


@dataclass(frozen=True)
class SensorUse(Checked):
    """The sensor and how it is used.

    Attributes
    ----------
    name : str
        Of ``config/sensors``.
    band_low_hz, band_high_hz : float
        Around the main mode: precision, tissue and the comparison with free air are of this one.
    order, residual_terms : int
        Of the model there: see `PoleBand`. Terms None: as many as are usual or, where the plan chooses the
        period, as the band needs.
    further_bands : tuple of PoleBand
        Around other modes that are identified and mapped too.
    sample_rate_hz : float
    samples_per_period : int or None
        Lines are multiples of their ratio; a block is one period. None (``auto``): the plan chooses it, see
        `tactile_resonance.scan.measurement`.
    level_v : float
        Drive [V rms], if the sensor's whole range were excited: the amplitude of each line follows from
        it, however few are.
    heading_rad : float
        Direction of the beam from clamp to tip, seen from above, from the x axis [rad].
    calibrated : bool
        Poles come through the calibrated sensor of poles_node (its parameter ``calibration``): short blocks.
    """

    name: str = "bimorph"
    band_low_hz: AboveZero = 200.0
    band_high_hz: float = 300.0
    order: int = 2
    residual_terms: int | None = None
    further_bands: tuple[PoleBand, ...] = ()
    sample_rate_hz: AboveZero = 50_000.0
    samples_per_period: Annotated[int | None, _read_period] = 20_000
    level_v: AboveZero = 1.0
    heading_rad: float = 0.0
    calibrated: bool = False

    def __post_init__(self) -> None:
        known = sorted(path.stem for path in share_path("config/sensors").glob("*.yaml"))
        require(self.name in known, "name", self.name, f"one of config/sensors: {', '.join(known)}")
        super().__post_init__()
        samples = self.samples_per_period
        require(samples is None or 4 <= samples <= 10**8, "samples_per_period", samples, "4 to 1e+08")
        low, high = self.band_low_hz, self.band_high_hz
        require(high > low, "band_high_hz", high, f"above band_low_hz = {low:g}")
        needed = self.bands[0].residual_terms
        accepted = f"a narrower band with samples_per_period auto: residual terms {needed} of up to 20"
        if self.residual_terms is None:
            require(needed <= 20, "band_low_hz, band_high_hz", [low, high], accepted)
        for band in self.bands:
            require(band.order in range(21), "order", band.order, "0 (the data choose) to 20")
            terms = band.residual_terms
            require(terms in range(1, 21), "residual_terms", terms, "1 to 20")
        ends = sorted(band.ends_hz for band in self.bands)
        for (_, top_hz), following in pairwise(ends):
            accepted = "bands that do not overlap"
            require(
                following[0] >= top_hz, "further_bands", [list(each) for each in ends], accepted
            )

    @property
    def bands(self) -> tuple[PoleBand, ...]:
        """All, the main one first."""
        ends_hz, terms = (self.band_low_hz, self.band_high_hz), self.residual_terms
        if terms is None:
            chosen = self.samples_per_period is None
            terms = residual_terms_of(ends_hz) if chosen else DEFAULT_RESIDUAL_TERMS
        main = PoleBand(*ends_hz, self.order, terms)
        return (main, *self.further_bands)


@dataclass(frozen=True)
class TimeLimits(Checked):
    """Longest durations [s]; a point that takes longer fails, a scan that does ends."""

    point_s: AboveZero = 60.0
    scan_s: AboveZero = 3600.0


@dataclass(frozen=True)
class DriftLimits(Checked):
    """How far the poles in air may move during a scan; what is less is no warning, however significant.

    Both are this project's choice: a fiftieth of what distinguishes 10 from 12 % gelatine (arXiv 1805.00682).
    """

    f0_hz: AboveZero = 0.05
    damping_ratio: AboveZero = 5e-5


@dataclass(frozen=True)
class Notes:
    """Notes of a session; what is None or empty was not noted.

    Attributes
    ----------
    temperature_c : float or None
        Of the sample [degrees Celsius].
    tip_wetness : str
        dry or wet.
    adhesion : str
        Whether the tip sticks to the sample, in words.
    remarks : str
    """

    temperature_c: float | None = None
    tip_wetness: str | None = None
    adhesion: str | None = None
    remarks: str | None = None

    def __post_init__(self) -> None:
        warm = self.temperature_c
        good = warm is None or -50 <= warm <= 150
        require(good, "temperature_c", warm, "-50 to 150 degrees Celsius")
        good = self.tip_wetness in ("dry", "wet", "", None)
        require(good, "tip_wetness", self.tip_wetness, "one of dry, wet")

    def as_json(self) -> dict[str, float | str]:
        """What was noted, by name."""
        return {key: value for key, value in asdict(self).items() if value not in (None, "")}


@dataclass(frozen=True, eq=False)
class ScanScene(Checked):
    """What a scan is to do.

    Attributes
    ----------
    name : str
    frame_id : str
        Frame of positions and surface.
    force_n : float
        Contact force [N].
    hold : HoldMode
    sensor : SensorUse
    surface : Surface or TouchRequest
    positions_m : (n, 3) float
        In order; z is NaN where the surface decides it [m]. Of an adaptive scan those it may choose.
    outputs : tuple of Output
    precision : Precise, Separate or None
        When a point's blocks are enough; None: after the most blocks.
    blocks : BlockLimits or None
        None: as the plan chooses.
    gate : Gate or None
        A measurement during which the force moved more is repeated; None: none is.
    tissue_classes : tuple of TissueClass
        Tissues that a point may be called; empty: none is called.
    unknown_level : float
        A pole farther from every class than this part of the class's members is of none: see `classify`.
    nominal_contact : NominalContact or None
        Force and age of contact to which the classes refer, and how poles change beside them; None: not known.
    on_failure : OnFailure
    time_limits : TimeLimits
    drift_limits : DriftLimits
        Of the poles in air, before the sensor counts as drifted.
    normals : NormalRequest or None
        How the normal of each point is found by touch; None: it is the surface's.
    notes : Notes
        What people know of the session and no instrument measures.
    adaptive : Adaptive or None
        How positions are chosen; None: all are touched.
    protocols : tuple of ProtocolRequest
        Mechanical tests after the poles of a point are measured, in this order.
    """

    name: str
    force_n: AboveZero
    positions_m: FloatArray
    frame_id: str = "table"
    hold: HoldMode = HoldMode.FORCE
    sensor: SensorUse = field(default_factory=SensorUse)
    surface: Surface | TouchRequest = field(default_factory=Plane)
    outputs: tuple[Output, ...] = (Output.POLES, Output.MAP)
    precision: Precise | Separate | None = None
    blocks: BlockLimits | None = None
    gate: Gate | None = None
    tissue_classes: tuple[TissueClass, ...] = ()
    unknown_level: BelowOne = 0.01
    nominal_contact: NominalContact | None = None
    on_failure: OnFailure = OnFailure.CONTINUE
    time_limits: TimeLimits = field(default_factory=TimeLimits)
    drift_limits: DriftLimits = field(default_factory=DriftLimits)
    normals: NormalRequest | None = None
    notes: Notes = field(default_factory=Notes)
    adaptive: Adaptive | None = None
    protocols: tuple[ProtocolRequest, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        accepted = f"at most {MOST_FORCE_N:g}; contact control accepts less, by its limits"
        require(self.force_n <= MOST_FORCE_N, "force_n", self.force_n, accepted)
        require(bool(self.frame_id), "frame_id", self.frame_id, "the name of a frame")
        if self.nominal_contact is not None:
            nominal_n = self.nominal_contact.force_n
            good = 0.1 <= nominal_n / self.force_n <= 10
            accepted = f"a tenth to ten times force_n, {self.force_n:g}"
            require(good, "nominal_contact.force_n", nominal_n, accepted)
        most = len(self.positions_m) if self.adaptive is None else self.adaptive.most
        for k, asked in enumerate(self.protocols):
            good = max(asked.points, default=1) <= most
            accepted = f"numbers from 1 to {most}, of the points"
            require(good, f"protocols[{k}].points", list(asked.points), accepted)
        if self.adaptive is not None:
            accepted = "none with adaptive positions: their normals are the surface's"
            require(self.normals is None, "normals", self.normals, accepted)
            form = getattr(self.surface, "form", type(self.surface).__name__.lower())
            accepted = (
                "a plane with adaptive positions: of others the ways between points are checked"
            )
            require(is_plane(self.surface), "surface", form, accepted)


def read_scan_scene(path: Path) -> ScanScene:
    """Read a scene file; everything a scan needs has a default but the positions and the force.

    Raises
    ------
    ValueError
        One line that names the field, its value and what is accepted.
    """
    path = Path(path)
    return parse_scan_scene(read_yaml(path), path)


def read_run_scene(path: Path) -> ScanScene:
    """Scene of a run, also of one that an earlier version recorded.

    That version accepted outputs of which it made nothing, and took poles for granted.

    Raises
    ------
    ValueError
        As `read_scan_scene`.
    """
    content = read_yaml(path)
    if isinstance(given := content.get("outputs"), list):
        known = [output for output in given if output != "relaxation"]
        content = {**content, "outputs": list(dict.fromkeys([Output.POLES.value, *known]))}
    return parse_scan_scene(content, path)


def scene_of(run_path: Path) -> ScanScene | None:
    """Scene of a run; None where it cannot be read: a run is reported whatever became of its scene."""
    try:
        return read_run_scene(run_path / "scene.yaml")
    except ValueError:
        return None


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
    where = f"{path.name}:"
    keys = {item.name for item in fields(ScanScene)} - {"positions_m", "adaptive"} | {"positions"}
    known_keys(content, keys | BENCH_KEYS, where)
    content = with_library(content, path)
    nominal, named = parse_nominal_contact(content, where), content.get("tissue_classes")
    accepted = "classes, to which nominal_contact belongs (they are missing)"
    require(named is not None or nominal is None, f"{where} tissue_classes", named, accepted)
    classes = () if named is None else parse_classes(named, f"{where} tissue_classes")
    given: dict[str, Any] = {"tissue_classes": classes, "nominal_contact": nominal}
    positions = section(content, "positions", where)
    if "adaptive" in positions:
        require(len(positions) == 1, f"{where} positions", [*positions], "adaptive, or another one")
        asked = section(positions, "adaptive", f"{where} positions")
        given["adaptive"] = read_adaptive(asked, classes, f"{where} positions.adaptive")
        given["positions_m"] = flat(given["adaptive"].places_m())
        require_near(given["positions_m"], f"{where} positions.adaptive")
    else:
        given["positions_m"] = read_positions(positions, f"{where} positions")
    if "precision" in content:
        given["precision"] = _read_precision(content["precision"], classes, f"{where} precision")
    if "surface" in content:
        surface = section(content, "surface", where)
        given["surface"] = read_surface(surface, path.parent, f"{where} surface")
    if "outputs" in content:
        wanted = read(tuple[Output, ...], content["outputs"], f"{where} outputs")
        accepted = "a list with poles: a scan measures until they are known"
        require(Output.POLES in wanted, f"{where} outputs", content["outputs"], accepted)
        given["outputs"] = tuple(output for output in Output if output in wanted)
    handled = {*given, "positions", *BENCH_KEYS}
    rest = {key: value for key, value in content.items() if key not in handled}
    return read_dataclass(ScanScene, {"name": path.stem, **rest}, where, **given)


@dataclass(frozen=True)
class _Separate:
    separate: tuple[str, str]
    probability: float


def _read_precision(
    value: object, classes: tuple[TissueClass, ...], where: str
) -> Precise | Separate:
    if not (isinstance(value, Mapping) and "separate" in value):
        require(bool(value), where, value, "f0_std_hz, damping_ratio_std or separate")
        return read_dataclass(Precise, value, where)
    wanted, by_name = read_dataclass(_Separate, value, where), {c.name: c for c in classes}
    good = all(name in by_name for name in wanted.separate)
    accepted = f"two out of tissue_classes: {sorted(by_name)}"
    require(good, f"{where}.separate", wanted.separate, accepted)
    first, second = (by_name[name] for name in wanted.separate)
    return build(Separate, where, first, second, wanted.probability)


def parse_notes(text: str, where: str) -> Notes:
    """Notes of a text like ``{temperature_c: 21.5, tip_wetness: wet}``; of an empty one none.

    Raises
    ------
    ValueError
        If it is no mapping, or a field is unknown or of the wrong kind.
    """
    given = build(parse_yaml, f"{where}:", text) if text.strip() else {}
    require(isinstance(given, dict), where, text, "a YAML mapping")
    return read_dataclass(Notes, given, where)
