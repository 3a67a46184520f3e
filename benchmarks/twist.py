# SPDX-License-Identifier: Apache-2.0
"""1 cN through contact_node and a stub of somebody's twist controller, beside ur_rtde, in simulated time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.contact import REFERENCE, cases
from benchmarks.contact_case import FORCE_N, KNOWN, Outcome, run_controller
from benchmarks.contact_client import ContactClient
from benchmarks.contact_drivers import TISSUES
from benchmarks.simulated_robot import simulated_robot
from benchmarks.twist_stub import TwistStub, stub_parameters
from tactile_resonance._typing import FloatArray
from tactile_resonance.clock import PORT
from tactile_resonance.contact.parameters import ContactParameters
from tactile_resonance.processes import NodeProcesses, free_domain_id
from tactile_resonance.simulation.plant.bench_time import START_NS
from tactile_resonance.simulation.plant.defaults import order

HOST = "127.0.13.78"
STEP_M = 0.006  # between contacts: fresh tissue
RATES_HZ = (500.0, 125.0)

Truth = Callable[[float], tuple[FloatArray, FloatArray]]
"""Time [s] and true force along the normal [N] of all steps after a time."""


@dataclass(frozen=True)
class Held:
    """One contact: from the first touch to ready [s]; the rest as shares of the aim, the last two over 1 s."""

    ready_s: float
    overshoot: float
    mean_error: float
    rms: float


@dataclass(frozen=True)
class Lab:
    """A running contact_node on some arm.

    Attributes
    ----------
    client : ContactClient
    place_tissue : callable
        What the tip finds at its next new place, by name.
    truth : Truth
    """

    client: ContactClient
    place_tissue: Callable[[str], object]
    truth: Truth


def run(output: Path, quick: bool) -> str:
    """Measure; return the page."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    contacts = 2 if quick else 12
    rows: dict[str, list[Held | str]] = {}
    for rate_hz in RATES_HZ:
        with _twist(rate_hz) as lab:
            rows[f"twist over topics, poses at {rate_hz:g} Hz"] = _contacts(lab, contacts)
    with _ur_rtde() as lab:
        rows["ur_rtde, states at 500 Hz"] = _contacts(lab, contacts)
    grid = cases(False)[:: 9 if quick else 1]
    virtual = {}
    for rate_hz in RATES_HZ:
        parameters = ContactParameters(period_s=1 / rate_hz, **KNOWN)
        virtual[rate_hz] = [run_controller(case, REFERENCE, parameters) for case in grid]
    text = _report(rows, virtual, contacts)
    return text


@contextmanager
def _node(parameters: dict[str, object], folder: Path) -> Iterator[ContactClient]:
    with NodeProcesses(folder) as nodes:
        nodes.bring_up(["contact_node"], {"contact_node": parameters})
        with ContactClient(nodes.check) as client:
            yield client


@contextmanager
def _twist(rate_hz: float) -> Iterator[Lab]:
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id({}))
    with tempfile.TemporaryDirectory() as name, TwistStub(rate_hz) as stub:
        folder = Path(name)
        with _node(stub_parameters(folder, rate_hz), folder) as client:

            def truth(after_s: float) -> tuple[FloatArray, FloatArray]:
                rows = np.array(stub.controller.force_n)
                return rows[rows[:, 0] > after_s].T

            yield Lab(client, stub.place_tissue, truth)


@contextmanager
def _ur_rtde() -> Iterator[Lab]:
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id({}))
    server = f"{HOST}:{PORT}"
    parameters = {"robot_host": HOST, "force_host": HOST, "time_server": server}
    parameters["publish_rate_hz"] = 50.0
    with (
        tempfile.TemporaryDirectory() as name,
        simulated_robot(HOST, 0, "--simulated-time"),
        _node(parameters, Path(name)) as client,
    ):

        def truth(after_s: float) -> tuple[FloatArray, FloatArray]:
            # the plant counts from 0, the time of its bench does not
            times, forces = [after_s - 1e-9 * START_NS], [0.0]
            while (part := order(HOST, "history", after_s=times[-1]))["time_s"]:
                times += part["time_s"]
                forces += part["normal_force_n"]
            return np.array(times) + 1e-9 * START_NS, np.array(forces)

        yield Lab(client, lambda tissue: order(HOST, "place_tissue", name=tissue), truth)


def _contacts(lab: Lab, count: int) -> list[Held | str]:
    """Contacts on one tissue after the other, each at a new place; why, where one is not ready."""
    client, done = lab.client, []
    for number in range(count):
        lab.place_tissue(TISSUES[number % len(TISSUES)])
        handle = client.start(STEP_M * (number % 4), STEP_M * (number // 4), FORCE_N)
        began_s = 1e-9 * client.told_ns
        result = client.result(handle)
        if result.reached:
            client.until("hold")
            ready_s = client.states[-1][1]
            client.let_pass(1.1)
            done.append(_judged(*lab.truth(began_s), ready_s))
        else:
            done.append(f"{result.cause}: {result.message}")
        client.ask("retract")
        client.until("idle")
    return done


def _judged(time_s: FloatArray, force_n: FloatArray, ready_s: float) -> Held:
    touched_s = time_s[np.argmax(force_n > 0)]
    until = force_n[time_s <= ready_s + 1.0] / FORCE_N - 1
    second = until[time_s[: len(until)] > ready_s]
    return Held(
        float(ready_s - touched_s),
        float(until.max()),
        float(abs(second.mean())),
        float(np.sqrt(np.mean(second**2))),
    )


def _pair(values: list[float], share: float = 100.0) -> str:
    """Median and largest."""
    return f"{share * np.median(values):.2f} / {share * max(values):.2f}"


def _report(
    rows: dict[str, list[Held | str]], virtual: dict[float, list[Outcome]], contacts: int
) -> str:
    lines = [
        "# Twist commands over topics, beside ur_rtde",
        "",
        "Simulated, not measured: `tactile_resonance benchmark twist`. contact_node as a process, its topics",
        "and action; the sensor's beam and ball on four tissues of the library, cell under the sample,",
        f"defaults of `config/contact.yaml`, aim {1e3 * FORCE_N:g} mN, {contacts} contacts a row. The twist",
        "rows: a stub of a controller in lockstep (`benchmarks/twist_stub.py`), arm with 4 ms dead time, 10 ms",
        "lag and 3 um rms vibration, forces of the same simulated cell at 500 Hz as WrenchStamped,",
        "`contact.period_s` as the poses come. The row of ur_rtde: the simulated UR5e with a cell on CAN at",
        "1000 Hz. Both in simulated time: no delay of a network or of an operating system is in these figures.",
        "",
        "Ready: from the first touch until the contact is called ready. Overshoot: largest true force until a",
        "second after that. Error, rms: of the true force over that second, its mean and its deviation from",
        "the aim.",
        "",
        "| Arm | ready, median / largest s | overshoot % | error % | rms % | failed |",
        "|---|---|---|---|---|---|",
    ]
    failures = []
    for name, row in rows.items():
        held = [one for one in row if isinstance(one, Held)]
        failures += [f"{name}: {one}" for one in row if isinstance(one, str)]
        cells = (
            _pair([one.ready_s for one in held], 1.0),
            _pair([one.overshoot for one in held]),
            _pair([one.mean_error for one in held]),
            _pair([one.rms for one in held]),
        )
        lines.append(f"| {name} | {' | '.join(cells)} | {len(row) - len(held)} |")
    lines += ["", *(f"Failed, {why}  " for why in failures), *([""] if failures else [])]
    lines += [
        "What 125 Hz costs, without topics: the first row of [contact control](contact.md), with the loop at",
        f"both rates, {len(virtual[RATES_HZ[0]])} cases, rigid tip, forces at 500 Hz, 95 % quantiles. A force",
        "source below 200 Hz is refused at any rate of the loop.",
        "",
        "| Loop | ready, median / p95 s | overshoot p95 % | error p95 % | failed |",
        "|---|---|---|---|---|",
    ]
    for rate_hz, outcomes in virtual.items():
        ready = np.quantile([one.ready_s for one in outcomes], [0.5, 0.95], method="higher")
        high = [
            100 * np.nanquantile([getattr(one, name) for one in outcomes], 0.95, method="higher")
            for name in ("overshoot", "mean_error")
        ]
        failed = sum(not np.isfinite(one.ready_s) for one in outcomes)
        lines.append(
            f"| {rate_hz:g} Hz | {ready[0]:.2f} / {ready[1]:.2f} | {high[0]:.1f} | {high[1]:.1f} | {failed} |"
        )
    return "\n".join(lines) + "\n"
