# SPDX-License-Identifier: Apache-2.0
"""The topic `bench/truth`: the exact modes of the simulated sensor as its tip is."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped

from tactile_resonance import msg
from tactile_resonance.identification.result import Poles, PolesStatus
from tactile_resonance.nodes.conversions import (
    contact_from_message,
    poles_to_message,
    time_from_message,
)
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.running import TRUTHS
from tactile_resonance.record import Origin
from tactile_resonance.simulation.bench import SimulatedBench
from tactile_resonance.simulation.bench_tip import BenchTip
from tactile_resonance.simulation.truth import truth_of


class TruthTopic:
    """Publishes exact poles.

    Parameters
    ----------
    node : ManagedNode
        Whose publisher it is, until it is cleaned up.
    bench : SimulatedBench
    frame_id : str
        Of the tip.
    """

    def __init__(self, node: ManagedNode, bench: SimulatedBench, frame_id: str) -> None:
        self._bench, self._frame_id = bench, frame_id
        self._publisher = node.publish_on(msg.Poles, "bench/truth", TRUTHS)

    def publish(
        self,
        pose: PoseStamped,
        tip: BenchTip,
        measurement_id: int = 0,
        force_n: float | None = None,
    ) -> None:
        """Publish the modes of a tip at a pose and its time.

        Parameters
        ----------
        pose : PoseStamped
        tip : BenchTip
        measurement_id : int
            Of the measurement whose poles they are; 0: of none.
        force_n : float, optional
            Force to be stated with them [N], where it is not that of the tip.
        """
        modes = truth_of(tip.coupled(self._bench), ()).modes
        truth = Poles(
            poles_rad_s=np.array([mode.pole_rad_s for mode in modes]),
            f0_hz=np.array([mode.f0_hz for mode in modes]),
            damping_ratio=np.array([mode.damping_ratio for mode in modes]),
            residues=np.array([mode.residue_rad_s for mode in modes]),
            method="simulation",
            status=PolesStatus.TRUTH,
            message="exact poles of the simulated sensor on this tissue",
        )
        origin = Origin(
            measurement_id=measurement_id,
            time_ns=time_from_message(pose.header.stamp),
            final=True,
            frame_id=self._frame_id,
            label=tip.tissue.name if tip.tissue else "air",
            simulated=True,
            contact=contact_from_message(pose, tip.force_n if force_n is None else force_n, 0.0),
        )
        self._publisher.publish(poles_to_message(truth, origin))
