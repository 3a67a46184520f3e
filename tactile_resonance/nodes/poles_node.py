# SPDX-License-Identifier: Apache-2.0
"""FRF, and the bins it brings -> poles."""

from __future__ import annotations

from pathlib import Path

from tactile_resonance import msg
from tactile_resonance.calibration.estimator import CalibratedEstimator, calibrated_poles
from tactile_resonance.calibration.model import read_calibration
from tactile_resonance.frf.result import FRF
from tactile_resonance.nodes.managed_node import ManagedNode
from tactile_resonance.nodes.messages import frf_from_message, poles_to_message
from tactile_resonance.nodes.parameters import Fixed, Parameter, values
from tactile_resonance.nodes.running import POLES, RESULTS
from tactile_resonance.poles.compiled import compiled
from tactile_resonance.poles.estimator import POLES_METHODS, poles_of_bands
from tactile_resonance.poles.result import Poles, PolesStatus
from tactile_resonance.poles.structure import PoleBand
from tactile_resonance.record import Contact
from tactile_resonance.recording.messages import origin_from_message

PARAMETERS = (
    Parameter(
        "band_low_hz",
        200.0,
        "Lower end of the band of the fit, of FRFs that name none [Hz].",
        0.0,
        1e6,
    ),
    Parameter("band_high_hz", 300.0, "Upper end of it [Hz].", 0.0, 1e6),
    Parameter(
        "order",
        2,
        "Order of the denominator: two poles per mode; 0: the data choose one to three modes and six to "
        "ten residual terms, which takes nine fits.",
        0,
        20,
    ),
    Parameter(
        "residual_terms",
        6,
        "Real polynomial terms beside the modes, for those outside the band; 1 is the bare "
        "second-order model.",
        0,
        20,
    ),
    Parameter(
        "method",
        "auto",
        "joint: poles and transient from all bins of the band; frf: from the FRF; auto: joint where "
        "the FRF brings the bins.",
        choices=POLES_METHODS,
    ),
    Fixed(
        "calibration",
        "",
        "File of `tactile_resonance calibrate`: poles of the first band through this sensor, from rest; where "
        "data contradict it, or lines outside of the band are excited, as without. Empty: none.",
    ),
)


class PolesNode(ManagedNode):
    """Every FRF that arrives becomes poles, with the same header.

    In the bands that its excitation names; the parameters hold for an FRF that names none.
    """

    def __init__(self) -> None:
        super().__init__("poles_node", PARAMETERS)

    def configure(self) -> None:
        """Topics in and out; the compiled fits are loaded before the first FRF is here."""
        compiled()
        (calibration,) = values(self, "calibration")
        self._sensor = None
        if calibration:
            known = read_calibration(Path(calibration))
            self._sensor = CalibratedEstimator(known.calibration, known.tip_radius_m)
        self._publisher = self.publish_on(msg.Poles, "poles", POLES)
        self.listen(msg.FRF, "frf", self._on_frf, RESULTS)

    def _on_frf(self, message: msg.FRF) -> None:
        try:
            frf, origin = frf_from_message(message)
            poles = self._identify(frf, origin.contact)
        except Exception as error:  # a reader waits for an answer to every FRF
            origin = origin_from_message(message)
            reason = self.health.failed(f"FRF of measurement {origin.measurement_id}", error)
            poles = Poles(status=PolesStatus.FAILED, message=reason)
        self._publisher.publish(poles_to_message(poles, origin))

    def _identify(self, frf: FRF, contact: Contact) -> Poles:
        low_hz, high_hz, order, terms, method = values(
            self, "band_low_hz", "band_high_hz", "order", "residual_terms", "method"
        )
        bands = frf.bands or (PoleBand(low_hz, high_hz, order, terms),)
        if self._sensor is None:
            return poles_of_bands(frf, bands, method)
        force_n, force_std_n = contact.force_n, contact.force_std_n
        if not (force_n > 0 and force_std_n >= 0):
            force_n, force_std_n = float("nan"), 0.0
        return calibrated_poles(frf, bands, self._sensor, force_n, force_std_n, method)


main = PolesNode.run
