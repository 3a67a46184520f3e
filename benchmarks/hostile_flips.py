# SPDX-License-Identifier: Apache-2.0
"""Single flipped bits in the files of a run and beside it: refused, named, or without effect; never silent."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.hostile_run import BAND_HZ, make_run
from tactile_resonance.record import Channel, Record
from tactile_resonance.recording.recording import read_recording
from tactile_resonance.recording.store import read_stored, write_stored
from tactile_resonance.scan.kept_bins import NAME, kept_bins
from tactile_resonance.scan.recorded import measurements_of_file
from tactile_resonance.scan.run_content import INDEX, RECORDING, read_run

FLIPS, QUICK_FLIPS = 1000, 80
SEED = 2
POINT = f"{RECORDING}/point-00001-00.mcap"


@dataclass(frozen=True)
class Place:
    """A file whose bits are flipped.

    Attributes
    ----------
    name : str
    path : Path
    read : callable
        All that is read with it, as text, and what is said of damage; raises where it is refused.
    """

    name: str
    path: Path
    read: Callable[[], tuple[str, object]]


def flipped_bits(folder: Path, flips: int = FLIPS) -> dict[str, Counter[str]]:
    """Flips of each kind of file by what became of them: refused, named, without effect, silent."""
    places = places_in(folder)
    each = flips // len(places)
    return {place.name: flips_of(place, each, number) for number, place in enumerate(places)}


def flips_of(place: Place, flips: int, number: int) -> Counter[str]:
    """Flips of one file, which is whole again behind them; the place's number makes the seed."""
    rng, counts = np.random.default_rng([SEED, number]), Counter[str]()
    whole = place.path.read_bytes()
    before, said_before = place.read()
    for _ in range(flips):
        content = bytearray(whole)
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
        place.path.write_bytes(content)
        try:
            after, said = place.read()
        except (ValueError, OSError):
            counts["refused"] += 1
            continue
        effect = "without effect" if after == before else "silent"
        counts["named" if said != said_before else effect] += 1
    place.path.write_bytes(whole)
    return counts


def places_in(folder: Path) -> list[Place]:
    """Files of a run, of one without its index, and records beside it."""
    run = make_run(folder / "run")
    alone = Path(shutil.copytree(run, folder / "alone"))
    (alone / INDEX).unlink()
    places = [
        Place(f"{name} of a run", of / path, lambda of=of: _run(of))
        for name, of, path in (
            ("recording", run, POINT),
            ("recording without the index", alone, POINT),
            ("index.jsonl", run, INDEX),
            ("run.json", run, "run.json"),
            ("scene.yaml", run, "scene.yaml"),
        )
    ]
    stored, arrays = folder / "record.npz", folder / "arrays.npz"
    counts = Channel(np.arange(400, dtype=np.int16), 1e-4)
    write_stored(stored, Record(counts, counts, 100.0, 100))
    u, y = np.random.default_rng(0).standard_normal((2, 400))
    np.savez(arrays, u=u, y=y, sample_rate_hz=100.0, samples_per_period=100)
    return [
        *places,
        Place("kept bins of a run", run / NAME, lambda: _bins(run)),
        Place("stored record", stored, lambda: (_text(read_stored(stored, Record)), "")),
        Place("record of .npz", arrays, lambda: (_text(read_recording(arrays)), "")),
    ]


def _run(run: Path) -> tuple[str, object]:
    """Scene, plan, facts, results, topics and every sample; problems and unchecked files."""
    content = read_run(run)
    measured = [of for path in content.paths() for of in measurements_of_file(path)]
    text = _text((content.scene, content.points, dict(content.facts), content.results, measured))
    return text, (content.problems, content.unchecked)


def _bins(run: Path) -> tuple[str, object]:
    """Every bin; None, from which on they are made anew."""
    kept = kept_bins(run, BAND_HZ)
    if kept is None:
        return "", "made anew"
    rows = [(piece.kind, piece.read().tobytes()) for piece in kept.pieces]
    return _text((rows, kept.left_out)), ""


def _text(content: object) -> str:
    """With every element of every array."""
    with np.printoptions(threshold=np.inf, floatmode="unique"):
        return repr(content)
