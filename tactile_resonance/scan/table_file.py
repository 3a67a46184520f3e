# SPDX-License-Identifier: Apache-2.0
"""The file of a calibrated table: written by scan_node, read by the launch files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_resonance.contact.vectors import Six, Vector
from tactile_resonance.fields import read_dataclass, read_yaml, require
from tactile_resonance.strict_yaml import dump_yaml

if TYPE_CHECKING:  # a launch file needs no fit
    from tactile_resonance.scan.table_calibration import CalibrationRequest, TableCalibration

FORMAT = "tactile_resonance table 1"
ORDER = ("height_m", "tilt_x_rad", "tilt_y_rad")
NOT_ESTIMATED = ("x", "y", "turn about the normal")
_HEADER = """\
# A table in the robot's base, found by touch: `ros2 launch ... table_in_base:=THIS_FILE` takes it.
# Lengths in m, angles in rad. No touch along the normal determines what is not estimated: it is as given.
"""


def as_text(made: TableCalibration, request: CalibrationRequest, known: Mapping[str, Any]) -> str:
    """Content of the file.

    Parameters
    ----------
    made : TableCalibration
    request : CalibrationRequest
    known : mapping
        What else a reader should know: frames, date, who made it.
    """
    touches = [
        {"ball_m": list(t.ball_m), "std_m": std, "force_n": t.force_n, "residual_m": residual}
        for t, std, residual in zip(
            made.touches, made.std_m.tolist(), made.residuals_m.tolist(), strict=True
        )
    ]
    content = {
        "format": FORMAT,
        "table_in_base": made.table_in_base.vector.tolist(),
        **known,
        "estimated": list(ORDER),
        "not_estimated": list(NOT_ESTIMATED),
        "correction": made.correction.tolist(),
        "covariance": made.covariance.tolist(),
        "reduced_chi_square": made.reduced_chi_square,
        "force_n": request.force_n,
        "flatness_m": request.flatness_m,
        "height_m": request.height_m,
        "sensor": request.sensor,
        "touches": touches,  # in the frame of the table as it was known
    }
    return _HEADER + dump_yaml(content)


def read_table(path: Path, base_frame: str) -> list[float]:
    """Position [m] and rotation vector [rad] of a table in a base, from its file.

    Raises
    ------
    ValueError
        If it cannot be read, or is something else, or of another base; names field, value and what is accepted.
    """
    content = read_yaml(path)
    form = content.get("format")
    require(form == FORMAT, f"{path}: format", form, f"{FORMAT!r}, as calibrate_table writes it")
    read = {item.name: content.get(item.name) for item in fields(_Table)}  # the rest is for people
    table = read_dataclass(_Table, read, f"{path}:")
    accepted = f"{base_frame!r}, the robot's base here"
    require(table.base_frame == base_frame, f"{path}: base_frame", table.base_frame, accepted)
    return list(table.table_in_base)


@dataclass(frozen=True)
class _Table:
    table_in_base: Six
    covariance: tuple[Vector, Vector, Vector]
    base_frame: str

    def __post_init__(self) -> None:
        for index, row in enumerate(self.covariance):
            name = f"covariance[{index}][{index}]"
            require(row[index] > 0, name, row[index], "a variance above 0")
