# SPDX-License-Identifier: Apache-2.0
"""What the simulated bench knows: the exact modes of its sensor as the tip is, on topic and service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import PoseStamped

from tactile_resonance import msg
from tactile_resonance.contact.force_spread import ForceSpread
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import poles_to_message
from tactile_resonance.nodes.running import TRUTHS
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.record import Origin
from tactile_resonance.recording.messages import (
    contact_from_message,
    fill,
    fill_complex,
    time_from_message,
)
from tactile_resonance.simulation.sensor.bench import SimulatedBench
from tactile_resonance.simulation.sensor.bimorph import CoupledBimorph
from tactile_resonance.simulation.sensor.changing_contact import BenchTip
from tactile_resonance.srv import Truth as TruthService


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
        parts: Sequence[CoupledBimorph] = (),
    ) -> None:
        """Publish the modes of a tip at a pose and its time.

        Parameters
        ----------
        pose : PoseStamped
        tip : BenchTip
        measurement_id : int
            Of the measurement whose poles they are; 0: of none.
        parts : sequence of CoupledBimorph
            Of a contact that changes, in equal parts: modes and force are means over them, as an estimate has
            them; empty: the tip as it is.
        """
        coupled = parts or [tip.coupled(self._bench)]
        modes = [each.modes for each in coupled]
        forces_n = [each.contact.force_n if each.contact else 0.0 for each in coupled]

        def mean(name: str) -> npt.NDArray:
            return np.mean([[getattr(mode, name) for mode in at] for at in modes], axis=0)

        truth = Poles(
            poles_rad_s=mean("pole_rad_s"),
            f0_hz=mean("f0_hz"),
            damping_ratio=mean("damping_ratio"),
            residues=mean("residue_rad_s"),
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
            contact=replace(
                contact_from_message(pose, float(np.mean(forces_n)), 0.0),
                spread=ForceSpread(float(np.std(forces_n)), min(forces_n), max(forces_n)),
            ),
        )
        self._publisher.publish(poles_to_message(truth, origin))


def truth_to_response(
    truth: CoupledBimorph, frequency_hz: Sequence[float], response: TruthService.Response
) -> None:
    """Fill the answer of `bench/get_truth`, with the response at frequencies (F,) [Hz]."""
    response.success = True
    response.feedthrough = truth.feedthrough
    fill_complex(response, "pole_", truth.poles_rad_s, "_rad_s")
    fill_complex(response, "residue_", truth.residues_rad_s, "_rad_s")
    fill(response.f0_hz, [mode.f0_hz for mode in truth.modes])
    fill(response.damping_ratio, [mode.damping_ratio for mode in truth.modes])
    frequency = np.asarray(frequency_hz, dtype=float)
    fill_complex(response, "response_", truth.frequency_response(frequency))
    contact = truth.contact
    if contact is not None:
        response.tissue = contact.tissue.name
        response.force_n = contact.force_n
        response.contact_radius_m = contact.contact_radius_m
        response.indentation_m = contact.indentation_m
        response.relaxation_modulus_1s_pa = contact.tissue.relaxation_modulus_1s_pa
        stiffness = contact.dynamic_stiffness(2j * np.pi * frequency)
        fill_complex(response, "stiffness_", stiffness, "_n_per_m")
