# SPDX-License-Identifier: Apache-2.0
"""From the last sample of a block to the poles of all blocks so far, stage by stage.

The nodes run as processes of their own on the simulated bench in real time. Stages are distinguished by when
each message was handed to the middleware, which it carries; transport is in the stage of the node that
receives.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from tactile_resonance._typing import FloatArray, IntArray
from tactile_resonance.commands.options import require_packages
from tactile_resonance.processes import NodeProcesses, free_domain_id

NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node")
PERIODS = 8
PLACE_M = (0.0, 0.0, 0.0)  # on gelatine
START_WITHIN_S = 60.0
GOAL_MS = 10.0
NICE = -15
CASES = {
    "all lines, 10 Hz to 10 kHz": {},
    "lines of a scan, 180 to 320 Hz": {"f_min_hz": 180.0, "f_max_hz": 320.0, "level_v": 0.12},
}
STAGES = (
    "bench: last sample to block published",
    "block to excitation_node, in its file, handed out",
    "record to frf_node, FRF handed out",
    "FRF to poles_node, poles handed out",
    "poles to a reader",
)
COMPUTING = (2, 3)
TRANSPORTS = ("record", "FRF", "poles")
COMPUTED_FROM = {"frf_node": "record", "poles_node": "frf"}
"""The topic whose messages a node computes from."""


@dataclass(frozen=True)
class Latencies:
    """One case.

    Attributes
    ----------
    stages_s : (blocks, stages) array
    transports_s : (blocks, 3) array
        Until a reader beside the nodes received a message; a node may have it earlier or later.
    computing_ms : dict of (seconds, 2) arrays
        By node, of each second of measuring: mean and longest time that a message kept the node, from when
        it was handed to it until the result was handed out.
    periods : (blocks,) array
        Of the record that the FRF rests on.
    record_bytes : int
        Of a serialised record.
    """

    stages_s: FloatArray
    transports_s: FloatArray
    computing_ms: Mapping[str, FloatArray]
    periods: IntArray
    record_bytes: int

    @property
    def nodes_s(self) -> FloatArray:
        """FRF and poles with the transport to their nodes."""
        return self.stages_s[:, COMPUTING].sum(axis=1)

    @property
    def total_s(self) -> FloatArray:
        """From the last sample of a block."""
        return self.stages_s.sum(axis=1)


def run(output: Path, quick: bool) -> str:
    """Measure, draw ``pipeline.png`` into `output`, and return the page.

    Raises
    ------
    ValueError
        Where ROS 2 or the messages are not there.
    """
    require_packages("rclpy", "tactile_resonance.msg")
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    measurements = 4 if quick else 20
    raised = _may_take_precedence()
    results = {name: measure(goal, measurements, raised) for name, goal in CASES.items()}
    text = _report(results, raised)
    _draw(results, output / "pipeline.png")
    return text


def _may_take_precedence() -> bool:
    """Whether nodes may run before other work of this machine; tried, and left as it was."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, before + NICE)
        os.setpriority(os.PRIO_PROCESS, 0, before)
    except OSError:
        return False
    return True


def measure(goal: Mapping[str, float], measurements: int, raised: bool) -> Latencies:
    """Latencies of every block of so many measurements of `PERIODS` blocks.

    With `raised` what computes runs before all else: bench and listener stand for what takes no processor.
    """
    from benchmarks.pipeline_listener import PipelineListener

    with tempfile.TemporaryDirectory() as folder, NodeProcesses(Path(folder) / "log") as nodes:
        nodes.bring_up(
            NODES,
            {"excitation_node": {"record_folder": Path(folder) / "records"}},
            dict.fromkeys(NODES[1:], NICE if raised else 0),
        )
        with PipelineListener(nodes.check) as listener:
            listener.wait_for_nodes(START_WITHIN_S)
            listener.warm_up(PLACE_M, START_WITHIN_S)
            listener.forget_times()
            keys = [
                listener.measure_block_by_block(PLACE_M, goal, PERIODS, seed=1 + k)
                for k in range(measurements)
            ]
            times_ns, size = listener.times_ns(keys)
            computing = {
                node: listener.busy_ms(node, topic) for node, topic in COMPUTED_FROM.items()
            }
    # what each node itself has done: the reader's times would put its own delay into a node's stage
    stages_s = np.diff(times_ns[:, :6], axis=1) * 1e-9
    if not np.all(stages_s > 0):
        raise ValueError(
            "benchmark pipeline: a message was sent before its cause; was the clock set?"
        )
    transports_s = (times_ns[:, [6, 7, 5]] - times_ns[:, 2:5]) * 1e-9
    periods = np.tile(np.arange(1, PERIODS + 1), measurements)
    return Latencies(stages_s, transports_s, computing, periods, size)


def _report(results: Mapping[str, Latencies], raised: bool) -> str:
    def cells(values: FloatArray) -> str:
        median, high = np.quantile(values, [0.5, 0.99]) * 1e3
        return f"{median:.2f} | {high:.2f}"

    def computing(nodes: Sequence[str], result: Latencies) -> FloatArray:
        """Median of the means and 99 % of the longest of each second, added up over nodes [ms]."""
        return sum(
            np.array([np.median(kept[:, 0]), np.quantile(kept[:, 1], 0.99)])
            for kept in (result.computing_ms[node] for node in nodes)
        )

    each = list(results.values())
    first = each[0]
    lines = [
        "# From the last sample to the poles",
        "",
        "`tools/run.sh tactile_resonance benchmark pipeline`. " + " ".join(__doc__.split()),
        "50 kHz, two channels, blocks of one period of 20000 samples; after every block FRF, bins of 200 to",
        f"300 Hz and poles of all blocks so far, up to {PERIODS}. {os.cpu_count()} cores for all nodes, the",
        f"bench's synthesis and the listener together. A record is {first.record_bytes / 1e3:.0f} kB;",
        f"{len(first.total_s)} blocks a column.",
        "",
        "| stage [ms] | " + " | ".join(f"{name}: median | 99 %" for name in results) + " |",
        "|---|" + "---|---|" * len(results),
    ]
    for index, stage in enumerate(STAGES):
        row = " | ".join(cells(result.stages_s[:, index]) for result in each)
        lines.append(f"| {stage} | {row} |")
    for name, values in (
        ("**FRF and poles, transport included**", [result.nodes_s for result in each]),
        ("**last sample to poles**", [result.total_s for result in each]),
    ):
        lines.append(f"| {name} | " + " | ".join(cells(value) for value in values) + " |")
    for periods in (1, PERIODS):
        values = [result.nodes_s[result.periods == periods] for result in each]
        row = " | ".join(cells(value) for value in values)
        lines.append(
            f"| FRF and poles, record of {periods} period{'s' if periods > 1 else ''} | {row} |"
        )
    for index, name in enumerate(TRANSPORTS):
        row = " | ".join(cells(result.transports_s[:, index]) for result in each)
        lines.append(f"| transport of the {name}, to a reader beside | {row} |")
    both = tuple(COMPUTED_FROM)
    for title, nodes in (
        *((f"computing in {node}", (node,)) for node in both),
        ("**computing in both**", both),
    ):
        row = " | ".join("{:.2f} | {:.2f}".format(*computing(nodes, result)) for result in each)
        lines.append(f"| {title} | {row} |")
    lines += ["", f"Goal for the median of computing FRF and poles: below {GOAL_MS:g} ms."]
    for name, result in results.items():
        median_ms = float(computing(both, result)[0])
        verdict = "met" if median_ms < GOAL_MS else "not met"
        total_ms = 1e3 * float(np.median(result.nodes_s))
        lines.append(
            f"{name[0].upper()}{name[1:]}: {median_ms:.1f} ms, {verdict}; {total_ms:.1f} ms with transport."
        )
    lines += [
        "",
        "A stage ends where the next begins: what waits for a processor is in the stage that waits. The bench",
        "makes a block when its last sample would have been taken: only then it knows what became of the",
        "contact; a device has its own latency in place of the first row. The second row holds the record's",
        "way to `excitation_node`, the question for its force, and its file, before anybody hears of it; the",
        "disk has it soon after.",
        "Computing is what the nodes tell of themselves in `/diagnostics`, of every second: the median of the",
        "means, 99 % of the longest. It is the time in which a message kept its node, publishing included;",
        "between the nodes it is the middleware and the waking of a process that take their time.",
        f"Nodes that compute ran at nice {NICE}, before bench, listener and other work of the machine."
        if raised
        else "All processes ran at the machine's ordinary priority.",
        "",
        "![Stages](pipeline.png)",
    ]
    return "\n".join(lines) + "\n"


def _draw(results: Mapping[str, Latencies], path: Path) -> None:
    figure, panels = plt.subplots(
        1, len(results), figsize=(12, 4.2), layout="constrained", sharex=True, sharey=True
    )
    names = [*STAGES, "FRF and poles, transport included", "last sample to poles"]
    for axes, (name, result) in zip(panels, results.items(), strict=True):
        columns = [*result.stages_s.T, result.nodes_s, result.total_s]
        axes.boxplot(
            [column * 1e3 for column in columns],
            vert=False,
            whis=(1, 99),
            showfliers=False,
            widths=0.6,
        )
        axes.set_yticks(range(1, len(names) + 1), names)
        axes.axvline(GOAL_MS, color="0.6", linestyle="--", linewidth=0.8)
        axes.set_xscale("log")
        axes.set_xlabel("ms: median, quartiles, 1 % and 99 %")
        axes.set_title(name)
    panels[0].invert_yaxis()
    figure.suptitle("From the last sample of a block to its poles (simulated bench in real time)")
    figure.savefig(path, dpi=130)
    plt.close(figure)
