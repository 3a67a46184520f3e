# SPDX-License-Identifier: Apache-2.0
"""Asks scan_node for one scan, reports its progress and ends with it: for launch files."""

from __future__ import annotations

import sys
from collections.abc import Callable

from tactile_resonance.action import Scan
from tactile_resonance.client import Ending, ScanOutcome
from tactile_resonance.nodes.client import NoAnswer, ScanClient
from tactile_resonance.nodes.parameters import Fixed, declare, values
from tactile_resonance.nodes.running import UNUSABLE
from tactile_resonance.processes import noting_signals

PARAMETERS = (
    Fixed(
        "scene",
        "config/scenes/demo.yaml",
        "Scene file, absolute or in the package's share folder.",
    ),
    Fixed(
        "run_directory",
        "",
        "New or empty folder of the run, or the run to continue; empty: made by scan_node.",
    ),
    Fixed("resume", False, "Go on with the run in run_directory."),
    Fixed(
        "notes",
        "",
        "Of the session, in place of the scene's: {temperature_c: 21.5, tip_wetness: wet}.",
    ),
    Fixed("start_within_s", 120.0, "Longest wait for an active scan_node [s].", 1.0, 3600.0),
)
QUIET = (
    Scan.Feedback.PHASE_SURFACE,
    Scan.Feedback.PHASE_REFERENCE,
    Scan.Feedback.PHASE_PAUSED,
    Scan.Feedback.PHASE_WAITING,
)
"""Phases in which no point is under way."""


class ScanRequest(ScanClient):
    """A node of that name with the goal's fields as parameters."""

    def __init__(self, check: Callable[[], None]) -> None:
        super().__init__(check, "scan_goal")
        self._said = ""

    def join(self) -> None:
        """As every client; and the parameters."""
        super().join()
        declare(self._node, PARAMETERS)

    def run(self) -> ScanOutcome:
        """Scan once scan_node is active, which comes up last, whoever brings it up."""
        names = ("scene", "run_directory", "resume", "notes")
        goal = dict(zip(names, values(self._node, *names), strict=True))
        if goal["resume"]:
            del goal["scene"]  # that of the run
        (wait_s,) = values(self._node, "start_within_s")
        outcome = self.scan(**goal, on_feedback=self._tell, wait_s=wait_s)
        if not outcome.points or outcome.done is None:
            states = sorted(self.states.items())
            down = "; ".join(f"{name}: {state}" for name, state in states if not state.startswith("active"))
            raise NoAnswer(f"{outcome.ending.value}: {outcome.message}{f' ({down})' if down else ''}")
        say = self._node.get_logger().info
        say(
            f"{outcome.message}: {outcome.done} of {outcome.points} points with poles, "
            f"{outcome.failed} failed, {outcome.skipped} skipped, {outcome.repeats} repeats; "
            f"run in {outcome.run_directory}"
        )
        if outcome.sensor_health:
            say(outcome.sensor_health)
        return outcome

    def _tell(self, feedback: Scan.Feedback) -> None:
        text = f"{feedback.finished} of {feedback.points} points finished"
        if feedback.phase in QUIET:
            text = feedback.phase
        elif feedback.finished and feedback.time_left_s > 0:
            text += f", {feedback.time_left_s:.0f} s left"
        key = f"{feedback.phase if feedback.phase == text else ''}{feedback.finished}"
        if key != self._said:
            self._said = key
            self._node.get_logger().info(text)


def main() -> None:
    """Console script: 0 where every point of the plan is finished."""
    try:
        with noting_signals() as check, ScanRequest(check) as client:
            outcome = client.run()
        sys.exit(0 if outcome.ending is Ending.COMPLETE else 1)
    except KeyboardInterrupt:
        sys.exit(130)  # the scan goes on without it
    except (NoAnswer, *UNUSABLE) as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        sys.exit(1)
