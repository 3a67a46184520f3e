# SPDX-License-Identifier: Apache-2.0
"""On the near machine of `benchmarks.two_machines`: `FOLDER scan`, or `FOLDER measure BLOCKS`; tells JSON."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rclpy.action import ActionClient
from tactile_resonance.action import Measure

from tactile_resonance import msg
from tactile_resonance.nodes.client import ScanClient
from tactile_resonance.nodes.running import RESULTS

UP_WITHIN_S = 240.0
COUNTED = {"record": msg.Record, "frf": msg.FRF, "poles": msg.Poles}


class Client(ScanClient):
    """Asks for measurements and scans, and counts what is published."""

    def join(self) -> None:
        """Readers of what is counted, beside those of a client of scans."""
        super().join()
        self._measure = ActionClient(self._node, Measure, "measure")
        self._counts: dict[str, dict[int, int]] = {topic: {} for topic in COUNTED}
        for topic, kind in COUNTED.items():
            self._node.create_subscription(kind, topic, self._counter(topic), RESULTS)

    def measure(self, periods: int, late_s: float = 20.0) -> Measure.Result:
        """One measurement; waits until everything of it has come, so long at most after its last block."""
        self.wait(self._measure.server_is_ready, 30.0, "the action measure")
        sent = self._measure.send_goal_async(Measure.Goal(periods=periods))
        self.wait(sent.done, 30.0, "the goal to be taken")
        future = sent.result().get_result_async()
        self.wait(future.done, 600.0, "the measurement")
        result = future.result().result
        end_s = time.monotonic() + late_s
        while time.monotonic() < end_s:
            self.spin(0.05)
            if set(self.counts(result.measurement_id).values()) == {result.blocks}:
                break
        return result

    def counts(self, key: int) -> dict[str, int]:
        """Messages of a measurement by topic."""
        return {topic: counts.get(key, 0) for topic, counts in self._counts.items()}

    def _counter(self, topic: str) -> Callable:
        def count(message) -> None:
            counts = self._counts[topic]
            counts[message.measurement_id] = counts.get(message.measurement_id, 0) + 1

        return count


def main() -> None:
    """The last line of the output is JSON."""
    folder, order, *arguments = sys.argv[1:]
    with Client(lambda: None) as client:
        client.wait_until_up(UP_WITHIN_S)
        for _ in range(10):  # until all have found each other
            if set(client.counts(client.measure(3, 5.0).measurement_id).values()) == {3}:
                break
        begun_s = time.monotonic()
        if order == "measure":
            result = client.measure(int(arguments[0]))
            told = {"published": result.blocks, "message": result.message}
            told |= client.counts(result.measurement_id)
        else:
            run = Path(folder)
            outcome = client.scan(300.0, scene=run / "scene.yaml", run_directory=run / "run")
            names = ("message", "points", "done", "failed", "blocks")
            told = {"ending": outcome.ending.value}
            told |= {name: getattr(outcome, name) for name in names}
        told["took_s"] = time.monotonic() - begun_s
    print(json.dumps(told))


if __name__ == "__main__":
    main()
