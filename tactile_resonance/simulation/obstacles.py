# SPDX-License-Identifier: Apache-2.0
"""What a ball may meet beside soft tissue: bone below it, and what clings to the ball above it."""

from __future__ import annotations

import math
from collections.abc import Callable

from tactile_resonance.fields import require
from tactile_resonance.simulation.indenter import Indenter

UP_M = 1e-7
"""Over which the slope of a pull is taken [m]."""


class OnSoft:
    """A ball on soft tissue that something else acts on, too."""

    def __init__(self, soft: Indenter) -> None:
        self._soft = soft

    @property
    def depth_m(self) -> float:
        """Of the ball's lowest point below the undisturbed surface [m]."""
        return self._soft.depth_m

    @property
    def contact_radius_m(self) -> float:
        """On the soft tissue [m]."""
        return self._soft.contact_radius_m


class OnBone(OnSoft):
    """Soft tissue on an elastic half-space: both press on the ball, the lower from its depth on.

    The layer's force is that of a thick one: on bone a thin one is stiffer (Dimitriadis
    et al., Biophys. J. 82 (2002)), so the ball meets the bone faster here, which is the worse case.

    Parameters
    ----------
    soft : Indenter
        Ball on the layer.
    layer_m : float
        Its thickness [m].
    radius_m : float
        Of the ball.
    modulus_pa, poisson_ratio : float
        Of the bone.
    """

    def __init__(
        self,
        soft: Indenter,
        *,
        layer_m: float,
        radius_m: float,
        modulus_pa: float = 10e6,
        poisson_ratio: float = 0.3,
    ) -> None:
        require(layer_m >= 0, "layer_m", layer_m, "0 or above")
        super().__init__(soft)
        self._layer_m = layer_m
        self._c = 4 / 3 * modulus_pa / (1 - poisson_ratio**2) * math.sqrt(radius_m)

    @property
    def force_n(self) -> float:
        """On the ball along the outward normal [N]."""
        return self._soft.force_n + self._bone()[0]

    def reset(self) -> None:
        """Return to undisturbed tissue."""
        self._soft.reset()

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move the ball to a depth within a time; return the force [N]."""
        self._soft.step(depth_m, dt_s)
        return self.force_n

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Force after holding for a time [N], and per further depth [N/m]."""
        force_n, slope = self._soft.tangent(dt_s)
        pressed_n, steeper = self._bone()
        return force_n + pressed_n, slope + steeper

    def _bone(self) -> tuple[float, float]:
        """Force of the bone and its slope (Hertz)."""
        root = math.sqrt(max(0.0, self._soft.depth_m - self._layer_m))
        return self._c * root**3, 1.5 * self._c * root


class Clinging(OnSoft):
    """Tissue that, once touched, holds the ball back above its surface: a film, a fibre, a hook.

    Parameters
    ----------
    soft : Indenter
    pull : callable
        Force [N] from the height of the ball above the surface [m] and its speed upwards [m/s]; None: it lets
        go until the tissue is touched again.
    """

    def __init__(self, soft: Indenter, pull: Callable[[float, float], float | None]) -> None:
        self.pull = pull
        super().__init__(soft)
        self._touched, self._pulled_n = False, 0.0

    @property
    def force_n(self) -> float:
        """On the ball along the outward normal [N]."""
        return self._soft.force_n - self._pulled_n

    def reset(self) -> None:
        """Return to undisturbed tissue."""
        self._soft.reset()
        self._touched, self._pulled_n = False, 0.0

    def step(self, depth_m: float, dt_s: float) -> float:
        """Move the ball to a depth within a time; return the force [N]."""
        up_m_s = (self._soft.depth_m - depth_m) / dt_s
        self._touched |= self._soft.step(depth_m, dt_s) > 0
        self._pulled_n = 0.0
        if self._touched and depth_m < 0:
            pulled_n = self.pull(-depth_m, up_m_s)
            self._touched, self._pulled_n = pulled_n is not None, pulled_n or 0.0
        return self.force_n

    def tangent(self, dt_s: float) -> tuple[float, float]:
        """Force after holding for a time [N], and per further depth [N/m]."""
        force_n, slope = self._soft.tangent(dt_s)
        height_m = -self._soft.depth_m
        if not self._touched or height_m <= 0:
            return force_n, slope
        pulled_n = self.pull(height_m, 0.0) or 0.0
        further_n = self.pull(height_m + UP_M, UP_M / dt_s) or 0.0
        return force_n - pulled_n, slope + max(0.0, further_n - pulled_n) / UP_M
