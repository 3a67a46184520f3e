# SPDX-License-Identifier: Apache-2.0
"""Points of runs whose tissue is known: labels from a file or by place, poles at the nominal contact."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tactile_resonance.fields import read_text, read_yaml, require
from tactile_resonance.frf.spectra import Spectrum
from tactile_resonance.scan.point_result import PointKind, PointResult
from tactile_resonance.scan.recorded import recording_of_point
from tactile_resonance.scan.run_content import RunContent
from tactile_resonance.scan.scene import read_run_scene
from tactile_resonance.tissue.classify import UNKNOWN
from tactile_resonance.tissue.nominal_contact import ContactLoad, NominalContact, refer_to_nominal
from tactile_resonance.tissue.references import parse_nominal_contact
from tactile_resonance.tissue.spread import ReferencePoints

PLACE_M = 1e-4
"""To which places are rounded, in x and y: points of one preparation at one place are repetitions."""
_COLUMNS = ("run", "index", "tissue", "preparation", "position")


@dataclass(frozen=True)
class Label:
    """What is known of a point; empty: the preparation is that of the run, the position that of its place."""

    tissue: str
    preparation: str = ""
    position: str = ""


LabelOf = Callable[[RunContent, PointResult], Label | None]
"""Label of a point; None where its tissue is not known."""


def read_labels(path: Path, runs: Sequence[RunContent]) -> LabelOf:
    """Labels of a CSV file.

    Its columns are ``tissue`` and, at will, ``run`` (name of the folder; may be left out for a single run),
    ``index`` (that of ``results.csv``; empty: all points of the run), ``preparation`` and ``position``. A row
    with an index comes before one for the whole run.

    Raises
    ------
    ValueError
        If a column is unknown or there twice, a tissue, run or point is missing, or two rows are of one point.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path)), skipinitialspace=True)
        rows, columns = list(reader), reader.fieldnames or []
    except csv.Error as error:
        raise ValueError(f"{path.name}: cannot be read as CSV: {error}") from error
    for name in columns:
        require(name in _COLUMNS, f"{path.name}: column", name, f"one of {', '.join(_COLUMNS)}")
    require("tissue" in columns, f"{path.name}: columns", columns, "tissue among them")
    require(len(set(columns)) == len(columns), f"{path.name}: columns", columns, "each once")
    names = run_names(runs)
    indexes = {name: {p.index for p in r.points} for name, r in zip(names, runs, strict=True)}
    labels: dict[tuple[str, int | None], Label] = {}
    for number, row in enumerate(rows, start=2):
        where = f"{path.name}, line {number}: "
        require(None not in row, f"{where}cells", row.get(None), f"{len(columns)} of them")
        values = {key: (row.get(key) or "").strip() for key in _COLUMNS}
        if not values["run"] and len(names) == 1:
            values["run"] = names[0]
        require(values["run"] in names, f"{where}run", values["run"], f"one of {', '.join(names)}")
        index = values["index"]
        require(not index or index.isdecimal(), f"{where}index", index, "that of results.csv")
        tissue = values["tissue"]
        require(bool(tissue) and tissue != UNKNOWN, f"{where}tissue", tissue, "a name")
        for key in ("tissue", "preparation", "position"):
            require(values[key].isprintable(), f"{where}{key}", values[key], "text of one line")
        point = values["run"], int(index) if index else None
        known = point[1] is None or point[1] in indexes[values["run"]]
        require(known, f"{where}index", index, f"that of a point of {values['run']}")
        require(point not in labels, f"{where}index", index, "one row for each point")
        labels[point] = Label(tissue, values["preparation"], values["position"])

    def of(run: RunContent, result: PointResult) -> Label | None:
        name = run.path.resolve().name
        return labels.get((name, result.index)) or labels.get((name, None))

    return of


def run_names(runs: Sequence[RunContent]) -> list[str]:
    """Names of the runs' folders, by which labels and tables name them.

    Raises
    ------
    ValueError
        If two are alike, or hold the same measurement to the last digit: copies, or simulations of one seed,
        would count as independent.
    """
    names = [run.path.resolve().name for run in runs]
    require(len(set(names)) == len(names), "runs", names, "folders of different names")
    seen: dict[tuple[float, ...], str] = {}
    for name, run in zip(names, runs, strict=True):
        for result in run.latest:
            if result.kind is PointKind.TISSUE and not result.failed:
                key = (*result.estimate.tolist(), *result.std.tolist())
                first = seen.setdefault(key, name)
                same = f"point {result.index + 1} of {name} as in {first}"
                require(first == name, "runs", same, "no copy, and none of the same seed")
    return names


def read_nominal(path: Path) -> NominalContact:
    """Section ``nominal_contact`` of a YAML file, such as a scene or a library.

    Raises
    ------
    ValueError
        If it is not there, or wrong.
    """
    nominal = parse_nominal_contact(read_yaml(path), f"{path.name}:")
    if nominal is None:
        raise ValueError(f"{path.name}: nominal_contact: got None; accepted is a file with one")
    return nominal


def nominal_of(runs: Sequence[RunContent]) -> NominalContact | None:
    """The nominal contact of the runs' scenes.

    Raises
    ------
    ValueError
        If they differ, or a scene cannot be read.
    """
    found = [read_run_scene(run.path / "scene.yaml").nominal_contact for run in runs]
    # equal for equal ones
    texts = [each and json.dumps(asdict(each), default=np.ndarray.tolist) for each in found]
    for run, text in zip(runs, texts, strict=True):
        accepted = f"that of {runs[0].path.name}; give one for all with --nominal FILE"
        require(text == texts[0], f"{run.path.name}: nominal_contact", text or "none", accepted)
    return found[0]


def reference_points(
    runs: Sequence[RunContent], label_of: LabelOf, nominal: NominalContact | None
) -> tuple[ReferencePoints, Counter[str]]:
    """Latest attempts at the labelled points, at the nominal contact, and why others are left out.

    Raises
    ------
    ValueError
        If two runs have one name, or no point is left.
    """
    names = run_names(runs)
    rows, left_out = [], Counter[str]()
    for run, name in zip(runs, names, strict=True):
        for result in run.latest:
            label = label_of(run, result)
            if result.kind is not PointKind.TISSUE:
                continue
            if label is None:
                left_out["no label"] += 1
                continue
            at = referred(result, nominal)
            if isinstance(at, str):
                left_out[at] += 1
                continue
            rows.append((*at, float(result.blocks), label.tissue, *_where(label, name, result), name))
    require(bool(rows), "points", dict(left_out), "one labelled point with poles or more")
    return ReferencePoints(*(np.array(column) for column in zip(*rows, strict=True))), left_out


def referred(
    result: PointResult, nominal: NominalContact | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
    """Pole (2,) at the nominal contact, its covariance for tissue, and as measured; why there is none."""
    own = result.covariance
    if result.failed or not (np.all(np.isfinite(result.estimate)) and np.all(np.isfinite(own))):
        return "no pole with a covariance"
    load = ContactLoad(result.force_n, result.force_std_n, result.contact_age_s)
    at = refer_to_nominal(result.estimate, own, load, nominal)
    return at.note if np.isnan(at.compared).any() else (at.compared, at.covariance, own)


def labelled_frfs(
    runs: Sequence[RunContent], label_of: LabelOf
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Counter[str]]:
    """FRFs of the single periods of labelled points, for the paper's figure 9.

    The first period of each realisation is not settled, and is left out.

    Returns
    -------
    g : (n, F) complex
    frequency_hz : (F,) float
        Lines that all of them have; points with others than the first are left out.
    groups : (n, 4) int
        Tissue, preparation, position and repetition of each.
    left_out : Counter
        Points by reason.

    Raises
    ------
    ValueError
        If two runs have one name, or no point is left.
    """
    g, groups, left_out = [], [], Counter[str]()
    frequency_hz: np.ndarray = np.empty(0)
    for run, name in zip(runs, run_names(runs), strict=True):
        for result in run.latest:
            label = label_of(run, result)
            if label is None or result.kind is not PointKind.TISSUE:
                continue
            try:
                recording = recording_of_point(run.path, result)
                spectrum = Spectrum.of(recording.u[:, 1:], recording.y[:, 1:])
            except ValueError as error:
                left_out[str(error)] += 1
                continue
            harmonics = recording.excited_harmonics
            assert harmonics is not None  # the store's recordings know them
            lines_hz = harmonics * recording.resolution_hz
            if not frequency_hz.size:
                frequency_hz = lines_hz
            if not np.array_equal(lines_hz, frequency_hz):
                left_out["excited on other lines than the first point"] += 1
                continue
            sensed, driven = np.moveaxis(spectrum.by_period[..., harmonics], -3, 0)
            periods = (sensed / driven).reshape(-1, lines_hz.size)
            where = _where(label, name, result)
            g.append(periods)
            groups += [(label.tissue, *where, f"{name}, {result.index}")] * len(periods)
    require(bool(g), "points", dict(left_out), "one labelled point of two blocks or more")
    columns = [np.unique(column, return_inverse=True)[1] for column in zip(*groups, strict=True)]
    return np.concatenate(g), frequency_hz, np.stack(columns, axis=1), left_out


def _where(label: Label, run: str, result: PointResult) -> tuple[str, str]:
    """Preparation and position."""
    place = (f"{round(each / PLACE_M)}" for each in result.position_m[:2])
    return label.preparation or run, label.position or ", ".join(place)
