# SPDX-License-Identifier: Apache-2.0
"""What a cell carries, how to identify it from a few orientations, and the force at the tip that it shows.

What it carries exerts ``m g`` on the cell and ``c x m g`` about its origin, centre of mass at c. Its inertia is
taken off where a contact is controlled (`observer.Observer`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from tactile_resonance._typing import FloatArray
from tactile_resonance.contact.samples import CellSample, Pose, WrenchSample
from tactile_resonance.contact.vectors import (
    NO_TURN,
    Six,
    Turn,
    Vector,
    cross,
    difference,
    rotated,
    rotated_back,
    scaled,
    transposed,
    turn_product,
    vector,
)
from tactile_resonance.fields import require

GRAVITY_M_S2 = np.array([0.0, 0.0, -9.80665])
"""Standard gravity in a base that stands upright."""
_GRAVITY_M_S2 = vector(GRAVITY_M_S2)
LARGEST_CONDITION = 50.0
"""Largest condition number of the scaled equations: orientations that differ too little exceed it."""


@dataclass(frozen=True)
class Payload:
    """What the cell carries beyond its sensing element.

    Attributes
    ----------
    mass_kg : float
    centre_m : tuple of 3 floats
        Centre of mass in the cell's frame [m].
    """

    mass_kg: float
    centre_m: Vector

    def __post_init__(self) -> None:
        require(0 <= self.mass_kg < math.inf, "mass_kg", self.mass_kg, "a number, 0 or above")
        good = np.shape(self.centre_m) == (3,) and bool(np.all(np.isfinite(self.centre_m)))
        require(good, "centre_m", self.centre_m, "3 finite numbers")

    def wrench(self, turn: Turn) -> Six:
        """Wrench of the payload on the cell, in the cell's frame.

        Parameters
        ----------
        turn : Turn
            Rotation from the cell's frame into the base.

        Returns
        -------
        tuple of 6 floats
            Force [N] and torque about the cell's origin [N m].
        """
        force = scaled(self.mass_kg, rotated_back(turn, _GRAVITY_M_S2))
        return *force, *cross(self.centre_m, force)


@dataclass(frozen=True)
class PayloadIdentification:
    """Result of `identify_payload`.

    Attributes
    ----------
    payload : Payload
    bias : (6,) array
        What the cell reads without any load [N], [N m].
    covariance : (10, 10) array
        Of mass [kg], centre (3) [m] and bias (6), from the stated noise.
    condition_number : float
        Of the equations, columns scaled to length 1.
    chi_square, dof : float, int
        Weighted sum of squared residuals, and what it is expected to be.
    """

    payload: Payload
    bias: FloatArray
    covariance: FloatArray
    condition_number: float
    chi_square: float
    dof: int

    @property
    def consistent(self) -> bool:
        """Whether noise explains the residuals (5 standard deviations of chi square)."""
        return self.chi_square < self.dof + 5 * math.sqrt(2 * max(1, self.dof))


def identify_payload(
    rotations: FloatArray, wrenches: FloatArray, std: FloatArray
) -> PayloadIdentification:
    """Mass, centre of mass and bias from mean wrenches at rest in several orientations.

    Linear least squares in mass, mass times centre, and bias, weighted by the stated noise.

    Parameters
    ----------
    rotations : (n, 3, 3) array
        From the cell's frame into the base, for each orientation.
    wrenches : (n, 6) array
        Mean readings [N], [N m].
    std : (6,) or (n, 6) array
        Standard deviation of these means.

    Raises
    ------
    ValueError
        If the orientations do not distinguish the unknowns, or the mass comes out negative.
    """
    rotations, wrenches = np.asarray(rotations, float), np.asarray(wrenches, float)
    n = len(rotations)
    shapes = rotations.shape, wrenches.shape
    require(shapes == ((n, 3, 3), (n, 6)), "rotations, wrenches", shapes, "shapes (n, 3, 3), (n, 6)")
    # NaN compares as false
    turned = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(initial=0.0) < 1e-6
    good = bool(turned and np.all(np.linalg.det(rotations) > 0))
    require(good, "rotations", rotations, "rotation matrices, orthonormal and not mirrored")
    require(bool(np.all(np.isfinite(wrenches))), "wrenches", wrenches, "finite numbers")
    sigma = np.broadcast_to(np.asarray(std, float), (n, 6))
    require(bool(np.all(sigma > 0)), "std", std, "numbers above 0")
    require(n >= 3, "orientations", n, "3 or more")
    gravity = np.einsum("nji,j->ni", rotations, GRAVITY_M_S2)  # (n, 3) in the cell's frame
    equations = np.zeros((n, 6, 10))
    equations[:, :3, 0] = gravity
    # (m c) x g, for each part of m c a column
    equations[:, 3:, 1:4] = np.cross(np.eye(3), gravity[:, None]).swapaxes(1, 2)
    equations[:, :, 4:] = np.eye(6)
    a = (equations / sigma[..., None]).reshape(6 * n, 10)
    b = (wrenches / sigma).ravel()
    scale = np.linalg.norm(a, axis=0)
    scale[scale == 0] = 1.0  # an unknown that no equation holds: found by the condition number
    u, s, vt = np.linalg.svd(a / scale, full_matrices=False)
    condition = float(s[0] / s[-1]) if s[-1] > 0 else math.inf
    accepted = f"below {LARGEST_CONDITION:g}: turn the tool about two axes, by 45 degrees or more"
    require(condition < LARGEST_CONDITION, "condition number of orientations", condition, accepted)
    theta = (vt.T @ ((u.T @ b) / s)) / scale
    inverse = (vt.T / s) / scale[:, None]
    covariance = inverse @ inverse.T
    residual = a @ theta - b
    mass = float(theta[0])
    mass_std = math.sqrt(covariance[0, 0])
    accepted = "above two deviations: check the cell's frame and signs, and whether it carries anything"
    require(mass > 2 * mass_std, "mass_kg", f"{mass:.4g} +- {mass_std:.2g}", accepted)
    # centre = (m c) / m
    jacobian = np.eye(10)
    jacobian[1:4, 1:4] /= mass
    jacobian[1:4, 0] = -theta[1:4] / mass**2
    return PayloadIdentification(
        payload=Payload(mass, vector(theta[1:4] / mass)),
        bias=theta[4:],
        covariance=jacobian @ covariance @ jacobian.T,
        condition_number=condition,
        chi_square=float(residual @ residual),
        dof=6 * n - 10,
    )


class Mount(str, Enum):
    """Where the force sensor sits."""

    TOOL = "tool"
    TABLE = "table"


@dataclass(frozen=True)
class Mounting:
    """Where the cell sits and what it carries.

    Attributes
    ----------
    mount : Mount
    frame : Pose
        The cell's frame: given in the frame `tip` on the tool, in the base under the sample.
    payload : Payload or None
        Of a cell on the tool; what lies on a cell under the sample does not move and goes with the tare.

    Raises
    ------
    ValueError
        If a cell under the sample is given a payload.
    """

    mount: Mount
    frame: Pose
    payload: Payload | None = None

    def __post_init__(self) -> None:
        good = self.mount is not Mount.TABLE or self.payload is None
        require(good, "payload", self.payload, "none for mount table: the sample goes with the tare")

    @cached_property
    def _seat(self) -> tuple[Vector, Turn]:
        """Place and rotation of the cell in what it sits on."""
        return vector(self.frame.position_m), self.frame.turn

    def to_tip(
        self, samples: Iterable[CellSample], tip_m: Vector, tip_turn: Turn
    ) -> list[WrenchSample]:
        """Wrenches of the tissue on the tip, from those on the cell.

        On the tool the payload's weight is taken off and the cell passes on what the tip feels; under the
        sample it feels the opposite.

        Parameters
        ----------
        samples : iterable of CellSample
        tip_m, tip_turn : Vector, Turn
            Place and orientation of the frame `tip` in the base while they were measured.
        """
        cfx = cfy = cfz = ctx = cty = ctz = 0.0  # what the cell carries
        place, seat_turn = self._seat
        if self.mount is Mount.TOOL:
            turn, lever = seat_turn, place
            if self.payload is not None:
                cfx, cfy, cfz, ctx, cty, ctz = self.payload.wrench(turn_product(tip_turn, turn))
        else:
            back = transposed(tip_turn)
            turn = back if seat_turn == NO_TURN else turn_product(back, seat_turn)
            lever = rotated(back, difference(place, tip_m))
        (a, b, c, d, e, f, g, h, i), (lx, ly, lz) = turn, lever
        if self.mount is Mount.TABLE:  # what acts on the sample, turned round
            a, b, c, d, e, f, g, h, i = -a, -b, -c, -d, -e, -f, -g, -h, -i
        felt = []
        for time_ns, (fx, fy, fz, tx, ty, tz), overload in samples:
            # written out: this is done for every wrench
            fx, fy, fz, tx, ty, tz = fx - cfx, fy - cfy, fz - cfz, tx - ctx, ty - cty, tz - ctz
            x, y, z = a * fx + b * fy + c * fz, d * fx + e * fy + f * fz, g * fx + h * fy + i * fz
            torque = (
                a * tx + b * ty + c * tz + (ly * z - lz * y),
                d * tx + e * ty + f * tz + (lz * x - lx * z),
                g * tx + h * ty + i * tz + (lx * y - ly * x),
            )
            felt.append(WrenchSample(time_ns, (x, y, z), torque, overload))
        return felt
