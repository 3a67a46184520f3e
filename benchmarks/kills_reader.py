# SPDX-License-Identifier: Apache-2.0
"""What the files of a run hold, read by rosbags with the definitions that stand in them."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.highlevel import AnyReader

COUNTED = ("/record", "/frf", "/poles")


@dataclass(frozen=True)
class Finished:
    """One finished point.

    Attributes
    ----------
    index : int
    digest : str
        Of the whole file.
    counts : tuple of int
        Messages on `COUNTED`.
    poles : tuple of float
        Natural frequency [Hz], damping ratio and their standard deviations.
    """

    index: int
    digest: str
    counts: tuple[int, ...]
    poles: tuple[float, ...] = field(compare=False)  # NaN where none were found; the digest tells


def finished_points(recording: Path) -> dict[str, Finished]:
    """Finished points by file, every message of every file read; the folder may not be there yet.

    Raises
    ------
    AssertionError
        If a file does not hold the result of exactly one point. What rosbags raises for a file that it
        cannot read goes through.
    """
    found = {}
    for path in sorted(recording.glob("*.mcap")):
        counts: Counter[str] = Counter()
        results = []
        with AnyReader([path]) as reader:
            for connection, _, cdr in reader.messages():
                message = reader.deserialize(cdr, connection.msgtype)
                topic = "/" + connection.topic.rpartition("/")[2]  # it may have been relayed
                counts[topic] += 1
                if topic == "/point_result":
                    results.append(message)
        if path.name.startswith("reference-"):
            continue
        assert len(results) == 1, f"{path.name}: {len(results)} results"
        (result,) = results
        found[path.name] = Finished(
            int(result.index),
            hashlib.sha256(path.read_bytes()).hexdigest(),
            tuple(counts[topic] for topic in COUNTED),
            (
                *(float(result.f0_hz), float(result.damping_ratio)),
                *(float(result.f0_std_hz), float(result.damping_ratio_std)),
            ),
        )
    return found
