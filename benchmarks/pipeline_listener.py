# SPDX-License-Identifier: Apache-2.0
"""Client of the nodes that keeps when each message was sent and received, as the middleware tells."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message
from tactile_resonance.action import Measure

from benchmarks.scan_session import ScanSession
from tactile_resonance import msg
from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.nodes.running import LONGEST, MEAN, PERIOD_S, RESULTS
from tactile_resonance.recording.messages import record_from_message

TOPICS = {"bench/block": msg.Record, "record": msg.Record, "frf": msg.FRF, "poles": msg.Poles}
ALL_WITHIN_S = 60.0
DIAGNOSTICS_WITHIN_S = 2 * PERIOD_S


class PipelineListener(ScanSession):
    """Keeps every message as it came, and looks into them only when all is over."""

    def join(self) -> None:
        """Readers beside those of a session."""
        super().join()
        self._kept: dict[str, list[tuple[bytes, Mapping[str, int]]]] = {name: [] for name in TOPICS}
        for topic, kind in TOPICS.items():
            self._node.create_subscription(
                kind, topic, self._keeper(self._kept[topic]), RESULTS, raw=True
            )

        self._busy: defaultdict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_busy, 50)

    @staticmethod
    def _keeper(kept: list[tuple[bytes, Mapping[str, int]]]) -> Any:
        # rclpy looks at the signature: two parameters ask for the times
        def keep(cdr: bytes, info: Any) -> None:
            kept.append((cdr, info))

        return keep

    def forget_times(self) -> None:
        """Forget how long nodes were kept so far: first messages take longer."""
        end_s = time.monotonic() + DIAGNOSTICS_WITHIN_S
        while time.monotonic() < end_s:
            self.spin(0.05)
        self._busy.clear()

    def busy_ms(self, node: str, topic: str) -> FloatArray:
        """How long messages of a topic kept a node.

        Returns
        -------
        (seconds, 2)
            Mean and longest, of each second in which there were any.
        """
        return np.array(self._busy[node, topic])

    def _on_busy(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            for key in values:
                topic = key.removesuffix(MEAN)
                if topic != key:
                    told = float(values[key]), float(values[f"{topic}{LONGEST}"])
                    self._busy[status.name.lstrip("/"), topic].append(told)

    def measure_block_by_block(
        self,
        position_m: tuple[float, float, float],
        goal: Mapping[str, float],
        periods: int,
        seed: int,
    ) -> int:
        """One measurement; its id."""
        request = Measure.Goal(periods=periods, seed=seed, **goal)
        result = self.measure(position_m, request, lambda done, planned: None)
        return result.origin.measurement_id

    def times_ns(self, keys: Sequence[int]) -> tuple[IntArray, int]:
        """Times of every block of these measurements, and the size of a record.

        Returns
        -------
        (blocks, 8) int
            Last sample; block, record, FRF and poles sent; poles, record and FRF received here (UNIX
            time) [ns].
        int
            Bytes.

        Raises
        ------
        ValueError
            If a message is missing.
        """
        deadline = time.monotonic() + ALL_WITHIN_S
        while time.monotonic() < deadline:
            self.spin(0.05)
            heard = {topic: self._by_block(topic, keys) for topic in TOPICS}
            if len({tuple(sorted(blocks)) for blocks in heard.values()}) == 1:
                break
        else:
            counts = {topic: len(blocks) for topic, blocks in heard.items()}
            raise ValueError(
                f"benchmark pipeline: messages heard: {counts}, expected as many of each"
            )
        rows = []
        for place in sorted(heard["record"]):
            samples = record_from_message(heard["record"][place][0])
            last_ns = samples.origin.time_ns + round(1e9 * samples.duration_s)
            sent = [heard[topic][place][1]["source_timestamp"] for topic in TOPICS]
            received = [
                heard[topic][place][1]["received_timestamp"] for topic in ("poles", "record", "frf")
            ]
            rows.append((last_ns, *sent, *received))
        return np.array(rows, np.int64), len(self._kept["record"][-1][0])

    def _by_block(
        self, topic: str, keys: Sequence[int]
    ) -> dict[tuple[int, int], tuple[Any, Mapping[str, int]]]:
        """(measurement, block) -> message, times; results come in the order of the blocks."""
        found: dict[tuple[int, int], tuple[Any, Mapping[str, int]]] = {}
        order = {key: number for number, key in enumerate(keys)}
        counts = [0] * len(keys)
        for cdr, info in self._kept[topic]:
            message = deserialize_message(cdr, TOPICS[topic])
            number = order.get(message.measurement_id)
            if number is not None:
                found[number, counts[number]] = message, info
                counts[number] += 1
        return found
