# SPDX-License-Identifier: Apache-2.0
"""Excitation, bench and scan on one machine, FRF, poles and map on another: two network namespaces and a cable.

`tools/run.sh python -m benchmarks.two_machines` (as root, Linux) joins two network namespaces of this machine
by a veth pair, so that nothing but the cable connects their nodes, and counts what crosses it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.killed_scan import HOST, without_robot
from tactile_resonance.commands.bench_scan import Job, node_parameters
from tactile_resonance.processes import NodeProcesses, end_with_parent

NEAR_NODES = ("fake_hardware_node", "excitation_node")
FAR_NODES = ("frf_node", "poles_node", "pole_map_node")
NEAR, FAR = 0, 1
# RFC 5737: addresses for documentation, in no network
ADDRESSES = ("192.0.2.1", "192.0.2.2")
CABLE = "veth0"
CLIENT = "benchmarks.two_machines_client"
DOMAIN = "7"
UP_WITHIN_S = 240.0
SCENE = """
name: seen from the other machine
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.025}}
positions:
  grid: {center_m: [0.0, 0.0], size_m: [0.004, 0.004], spacing_m: 0.004}
outputs: [poles, frf, map]
blocks: {least: 4, most: 4}
"""


class TwoMachines:
    """Two network namespaces that a cable joins; a context that removes them.

    Parameters
    ----------
    discipline : str
        For ``tc qdisc add dev ... root``: what the cable does to what it carries; empty: nothing.

    Raises
    ------
    ValueError
        Where the system does not permit it.
    """

    def __init__(self, discipline: str = "") -> None:
        self.names = tuple(f"tactile-{os.getpid()}-{side}" for side in ("near", "far"))
        self._discipline = discipline
        self._holders: list[subprocess.Popen] = []

    def __enter__(self) -> TwoMachines:
        if reason := not_permitted():
            raise ValueError(reason)
        try:
            for name in self.names:
                _ip("netns", "add", name)
            near, far = self.names
            _ip("link", "add", CABLE, "netns", near, "type", "veth", "peer", CABLE, "netns", far)
            for name, address in zip(self.names, ADDRESSES, strict=True):
                _ip("-n", name, "address", "add", f"{address}/30", "dev", CABLE)
                for device in ("lo", CABLE):
                    _ip("-n", name, "link", "set", device, "up")
                if self._discipline:
                    self.run(
                        name, "tc", "qdisc", "add", "dev", CABLE, "root", *self._discipline.split()
                    )
                self._holders.append(_hold(name))
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for holder in self._holders:
            holder.kill()
            holder.wait()
        for name in self.names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    def prefix(self, side: int) -> tuple[str, ...]:
        """What runs a command on one side."""
        return ("nsenter", "--target", str(self._holders[side].pid), "--mount", "--net")

    @staticmethod
    def run(name: str, *command: str) -> str:
        """Output of a command in a namespace."""
        done = subprocess.run(
            ["ip", "netns", "exec", name, *command], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise ValueError(f"two machines: {' '.join(command)}: {done.stderr.strip()}")
        return done.stdout

    def carried_bytes(self) -> int:
        """That have crossed the cable, either way."""
        counters = [f"/sys/class/net/{CABLE}/statistics/{way}_bytes" for way in ("rx", "tx")]
        return sum(int(line) for line in self.run(self.names[NEAR], "cat", *counters).split())

    def losses(self) -> dict[str, int]:
        """Datagrams that could not be put together or found no room, on both sides."""
        found = {"ReasmFails": 0, "RcvbufErrors": 0}
        for name in self.names:
            rows = [line.split() for line in self.run(name, "cat", "/proc/net/snmp").splitlines()]
            for names, values in zip(rows[::2], rows[1::2], strict=True):
                if names[0] in ("Ip:", "Udp:"):
                    for key, value in zip(names, values, strict=True):
                        if key in found:
                            found[key] += int(value)
        return found


def _hold(name: str) -> subprocess.Popen:
    """A process that keeps one side's own shared memory: two machines have none in common."""
    script = "mount -t tmpfs tmpfs /dev/shm && echo ready && exec sleep infinity"
    holder = subprocess.Popen(
        ["ip", "netns", "exec", name, "unshare", "--mount", "sh", "-c", script],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=end_with_parent,
    )
    assert holder.stdout is not None
    if (line := holder.stdout.readline().strip()) != "ready":
        holder.kill()
        holder.wait()
        raise ValueError(f"two machines: no shared memory of its own: {line}")
    return holder


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"two machines: ip {' '.join(arguments)}: {done.stderr.strip()}")


def not_permitted() -> str:
    """Why there can be no namespaces here; empty where there can."""
    for command in ("ip", "nsenter", "unshare"):
        if shutil.which(command) is None:
            return f"two machines: no command {command} (iproute2, util-linux)"
    name = f"tactile-{os.getpid()}-try"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"two machines: ip netns add: {made.stderr.strip()}"
    try:
        tried = subprocess.run(
            ["ip", "netns", "exec", name, "true"], capture_output=True, text=True, check=False
        )
    finally:
        subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)
    return f"two machines: ip netns exec: {tried.stderr.strip()}" if tried.returncode else ""


def on_two_machines(
    machines: TwoMachines,
    folder: Path,
    order: list[str],
    *,
    robot_host: str = "",
    real_time: bool = False,
    environment: dict[str, str] | None = None,
) -> dict:
    """Start the nodes of both sides, run an order of the client near, return what it tells."""
    scene = folder / "scene.yaml"
    scene.write_text(SCENE)
    near = [*NEAR_NODES, *(["contact_node"] if robot_host else []), "scan_node"]
    job = Job(scene, folder, robot_host or HOST, real_time=real_time)
    parameters = node_parameters(job, False, folder)
    # to count what was published
    parameters["excitation_node"] = {**parameters["excitation_node"], "keep_all_records": True}
    parameters["manager_node"] = {"nodes": [*near[:2], *FAR_NODES, *near[2:]]}
    if not robot_host:
        without_robot(parameters)
    given = {
        "ROS_DOMAIN_ID": DOMAIN,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        **(environment or {}),
    }
    before = {name: os.environ.get(name) for name in given}
    os.environ.update(given)
    try:
        with (
            NodeProcesses(folder / "near", machines.prefix(NEAR)) as here,
            NodeProcesses(folder / "far", machines.prefix(FAR)) as there,
        ):
            for node in FAR_NODES:
                there.start(node, parameters.get(node))
            for node in (*near, "manager_node"):
                here.start(node, parameters.get(node))
            return _near(machines, folder, order)
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _near(machines: TwoMachines, folder: Path, order: list[str]) -> dict:
    """What a client on the near machine tells."""
    carried, lost = machines.carried_bytes(), machines.losses()
    answer = subprocess.run(
        [*machines.prefix(NEAR), sys.executable, "-m", CLIENT, str(folder), *order],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        preexec_fn=end_with_parent,
    )
    if answer.returncode:
        raise ValueError(
            f"two machines: the client ended with {answer.returncode}: {answer.stdout}"
        )
    told = json.loads(answer.stdout.splitlines()[-1])
    told["carried_bytes"] = machines.carried_bytes() - carried
    told["losses"] = {name: n - lost[name] for name, n in machines.losses().items()}
    return told


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=" ".join(__doc__.split()))
    parser.add_argument(
        "order", nargs="*", default=["measure", "50"], help="scan, or measure BLOCKS"
    )
    parser.add_argument("--real-time", action="store_true", help="default: simulated time")
    parser.add_argument("--robot-host", default="", metavar="127.X.Y.Z")
    parser.add_argument(
        "--cable", default="", help="for tc qdisc add dev ... root: netem delay 1ms"
    )
    parser.add_argument("--environment", default="", metavar="NAME=VALUE,...")
    options = parser.parse_args()
    # asked to end, it still removes what it made
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    given = dict(pair.split("=") for pair in options.environment.split(",") if pair)
    with tempfile.TemporaryDirectory() as folder, TwoMachines(options.cable) as machines:
        told = on_two_machines(
            machines,
            Path(folder),
            options.order,
            robot_host=options.robot_host,
            real_time=options.real_time,
            environment=given,
        )
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
