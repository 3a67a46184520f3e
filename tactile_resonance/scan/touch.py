# SPDX-License-Identifier: Apache-2.0
"""A surface found by touch: a plane or quadric through a few contacts, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from tactile_resonance._typing import BoolArray, FloatArray
from tactile_resonance.fields import require
from tactile_resonance.scan.surface import unit_normal

FORMS = {"plane": 3, "quadric": 6}
_IMPROBABLE = 1e-3  # residuals less probable than this are no noise
_WORST_CONDITION = 1e6


@dataclass(frozen=True, eq=False)
class TouchedSurface:
    """A polynomial surface fitted to contacts.

    Attributes
    ----------
    form : str
        plane or quadric.
    center_m : (2,) float
        Origin of the polynomial, the contacts' mean position.
    scale_m : float
        Its unit of length.
    coefficients_m : (3,) or (6,) float
        Of 1, x, y and x^2, x y, y^2.
    covariance_m2 : square array
        Of the coefficients; scaled up by the residuals where these are larger than the contacts' own
        uncertainty explains.
    residuals_m : (n,) float
        Contact minus surface.
    consistent : bool
        False where the residuals are improbably large (below 0.1 %): another form, or a contact that
        was none. True where there is no contact to spare.
    """

    form: str
    center_m: FloatArray
    scale_m: float
    coefficients_m: FloatArray
    covariance_m2: FloatArray
    residuals_m: FloatArray
    consistent: bool

    def height_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) height [m]; beyond the contacts too, where `height_std_m` grows."""
        return np.asarray(self._basis(xy_m)[0] @ self.coefficients_m)

    def normal(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(..., 3) upward unit normal."""
        _, by_x, by_y = self._basis(xy_m)
        return unit_normal(by_x @ self.coefficients_m, by_y @ self.coefficients_m)

    def height_std_m(self, xy_m: npt.ArrayLike) -> FloatArray:
        """(...) standard deviation of the height [m]."""
        basis, _, _ = self._basis(xy_m)
        return np.sqrt(np.einsum("...i,ij,...j->...", basis, self.covariance_m2, basis))

    def known(self, xy_m: npt.ArrayLike) -> BoolArray:
        """(...) in the square about the contacts: a form fitted to them need not go on beside them."""
        return np.all(np.abs(np.asarray(xy_m, float) - self.center_m) <= self.scale_m, axis=-1)

    def _basis(self, xy_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Terms (..., k) and their derivatives by x and y [1/m]."""
        x, y = np.moveaxis((np.asarray(xy_m, float) - self.center_m) / self.scale_m, -1, 0)
        return _basis(x, y, self.form, self.scale_m)


def fit_surface(
    contacts_m: npt.ArrayLike, std_m: npt.ArrayLike, form: str = "plane"
) -> TouchedSurface:
    """Weighted least squares of heights over x, y.

    Parameters
    ----------
    contacts_m : (n, 3) float
        Where the surface was found [m].
    std_m : (n,) float or float
        Standard deviation of each height [m].
    form : str
        plane (three contacts or more) or quadric (six or more).

    Raises
    ------
    ValueError
        If there are too few contacts, or they do not determine the form (on one line, say).
    """
    contacts = np.asarray(contacts_m, float)
    require(form in FORMS, "form", form, f"one of {', '.join(FORMS)}")
    terms = FORMS[form]
    good = contacts.ndim == 2 and contacts.shape[1] == 3 and len(contacts) >= terms
    require(good, "contacts_m", contacts.shape, f"shape (n, 3), n at least {terms} for a {form}")
    require(bool(np.all(np.isfinite(contacts))), "contacts_m", "NaN", "finite positions")
    std = np.broadcast_to(np.asarray(std_m, float), len(contacts))
    require(bool(np.all((std > 0) & np.isfinite(std))), "std_m", std_m, "numbers above 0")
    center = contacts[:, :2].mean(axis=0)
    scale = float(np.max(np.abs(contacts[:, :2] - center)))
    require(scale > 0, "contacts_m", "one position", "positions apart from each other")
    x, y = ((contacts[:, :2] - center) / scale).T
    design = _basis(x, y, form, scale)[0] / std[:, None]  # (n, terms)
    condition = float(np.linalg.cond(design * np.median(std)))
    require(
        condition < _WORST_CONDITION,
        "contacts_m",
        f"positions of condition number {condition:.1e}",
        f"positions that determine a {form}, not on one line or conic",
    )
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ (contacts[:, 2] / std)
    covariance = inverse @ inverse.T
    weighted = contacts[:, 2] / std - design @ coefficients
    spare = len(contacts) - terms
    cost, consistent = float(weighted @ weighted), True
    if spare > 0:
        consistent = bool(special.chdtrc(spare, cost) >= _IMPROBABLE)
        if not consistent:
            covariance = covariance * cost / spare
    return TouchedSurface(form, center, scale, coefficients, covariance, weighted * std, consistent)


def _basis(
    x: FloatArray, y: FloatArray, form: str, scale_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    zero, one = np.zeros_like(x), np.ones_like(x)
    value, by_x, by_y = [one, x, y], [zero, one, zero], [zero, zero, one]
    if form == "quadric":
        value += [x * x, x * y, y * y]
        by_x += [2 * x, y, zero]
        by_y += [zero, x, 2 * y]
    first, second, third = (np.stack(terms, axis=-1) for terms in (value, by_x, by_y))
    return first, second / scale_m, third / scale_m
