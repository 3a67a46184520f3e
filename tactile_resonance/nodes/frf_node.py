# SPDX-License-Identifier: Apache-2.0
"""Records -> FRF, streaming."""

from __future__ import annotations

import numpy as np

from tactile_resonance import msg
from tactile_resonance.fields import build
from tactile_resonance.frf.measurement import MeasurementFrf
from tactile_resonance.frf.result import FRF, FrfStatus
from tactile_resonance.multisine import Excitation
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import frf_to_message
from tactile_resonance.nodes.parameters import Parameter, values
from tactile_resonance.nodes.running import EXCITATIONS, RESULTS
from tactile_resonance.record import Record
from tactile_resonance.recording.messages import excitation_from_message, record_from_message

MOST_WAITING = 64

PARAMETERS = (
    Parameter("band_low_hz", 0.0, "Only lines from here are computed [Hz].", 0.0, 1e7),
    Parameter("band_high_hz", 0.0, "To here [Hz]; 0: all excited lines.", 0.0, 1e7),
    Parameter("transient_order", 2, "Order of the local polynomial for the transient.", 0, 10),
    Parameter("noise_dof", 6, "Degrees of freedom of the noise variance, at least.", 1, 100),
    Parameter(
        "bins_low_hz",
        200.0,
        "All bins of the record from here go with the FRF, for the joint estimator of poles [Hz]; those of "
        "the bands that an excitation names instead.",
        0.0,
        1e7,
    ),
    Parameter("bins_high_hz", 300.0, "To here [Hz]; 0: none are sent.", 0.0, 1e7),
)


class FrfNode(ManagedNode):
    """After every record the FRF of its measurement so far; one measurement at a time."""

    def __init__(self) -> None:
        super().__init__("frf_node", PARAMETERS)

    def configure(self) -> None:
        """Nothing known yet of any measurement."""
        self._publisher = self.publish_on(msg.FRF, "frf", RESULTS)
        self._excitations: dict[int, Excitation] = {}
        self._waiting: list[Record] = []
        self._measurement: MeasurementFrf | None = None
        self.listen(msg.Excitation, "excitation", self._on_excitation, EXCITATIONS)
        self.listen(msg.Record, "record", self._on_record, RESULTS)

    def _on_excitation(self, message: msg.Excitation) -> None:
        excitation = build(excitation_from_message, f"{message.excitation_id}:", message)
        # records of the measurement before may still be queued: forget the oldest only
        self._excitations.pop(excitation.excitation_id, None)
        self._excitations[excitation.excitation_id] = excitation
        while len(self._excitations) > EXCITATIONS.depth:
            del self._excitations[next(iter(self._excitations))]
        # excitation and record travel on topics of their own: a record may come first
        waiting, self._waiting = self._waiting, []
        for record in waiting:
            self._take(record)

    def _on_record(self, message: msg.Record) -> None:
        self._take(build(record_from_message, f"excitation {message.excitation_id}:", message))

    def _take(self, record: Record) -> None:
        """Publish an FRF, or why there is none: a reader waits for an answer to every record."""
        try:
            self._estimate(record)
        except Exception as error:
            reason = self.health.failed(
                f"record of excitation {record.origin.excitation_id}", error
            )
            excitation = self._excitations.get(record.origin.excitation_id)
            nothing = FRF(
                np.empty(0),
                np.empty(0, complex),
                status=FrfStatus.FAILED,
                message=reason,
                bands=() if excitation is None else excitation.bands,
            )
            self._publisher.publish(frf_to_message(nothing, record.origin, float("nan"), False))

    def _estimate(self, record: Record) -> None:
        excitation = self._excitations.get(record.origin.excitation_id)
        if excitation is None:
            self._waiting.append(record)
            if len(self._waiting) > MOST_WAITING:
                lost = self._waiting.pop(0)
                self.health.error(
                    f"no excitation {lost.origin.excitation_id} arrived: block {lost.block_index + 1} not used"
                )
            return
        measurement = self._measurement
        first = record.realisation == 0 and record.block_index == 0  # a replay may repeat an id
        if (
            measurement is None
            or first
            or record.origin.measurement_id != measurement.measurement_id
        ):
            measurement = self._measurement = self._begin(record.origin.measurement_id)
        frf = measurement.add(record, excitation)
        self._publisher.publish(
            frf_to_message(frf, measurement.origin(), excitation.level_v, measurement.saturated)
        )

    def _begin(self, measurement_id: int) -> MeasurementFrf:
        low_hz, high_hz, order, dof = values(
            self, "band_low_hz", "band_high_hz", "transient_order", "noise_dof"
        )
        bins_low_hz, bins_high_hz = values(self, "bins_low_hz", "bins_high_hz")
        return MeasurementFrf(
            measurement_id,
            band_hz=(low_hz, high_hz) if high_hz > 0 else None,
            order=order,
            dof=dof,
            bins_band_hz=(bins_low_hz, bins_high_hz) if bins_high_hz > 0 else None,
        )


main = FrfNode.run
