# SPDX-License-Identifier: Apache-2.0
"""Hostile inputs to all readers: each is read, or refused in one line, in time.

Inputs are whole examples, changed at random: bits, bytes, numbers, pieces left out, doubled or taken from
elsewhere. An input whose answer is new, or which takes a step from one line of the package to another that none
before it took, becomes an example too, so that what was reached is gone on from.
An answer is wrong if it is an exception that is neither ``ValueError`` nor ``OSError``, or of more than one
line, if it takes too long, needs more memory than allowed, or ends the process.
"""

from __future__ import annotations

import mmap
import multiprocessing
import os
import re
import resource
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from tempfile import TemporaryDirectory
from types import CodeType, FrameType
from typing import Any

import numpy as np

import tactile_resonance
from benchmarks.hostile_flips import FLIPS, QUICK_FLIPS, flipped_bits
from benchmarks.hostile_targets import PROCESS_WITHIN_S, WITHIN_S, Target, targets
from benchmarks.hostile_wire import wire_targets

FULL_INPUTS, INPUTS, QUICK_INPUTS = 1_000_000, 100_000, 5_000
MEMORY_BYTES = 6 << 30
TOO_LONG, REPEATS = "no answer in time", 2
LONGEST_LINE = 1200
LONGEST_INPUT = 1 << 16
MOST_EXAMPLES = 2000
PACKAGE = str(Path(tactile_resonance.__file__).parent)
SEED = 1
NUMBERS = tuple(b"0 -1 1e999 nan .inf -.inf 010 1:30 1e-320 null true".split()) + (b"9" * 40,)
PIECES = (
    *(b": ", b"- ", b"[", b"]", b"{", b"}", b"&a ", b"*a", b"!!python/object:os.system", b"\n", b"\t", b"\0"),
    *(b"\xff\xfe", b"<<: ", b'"', b"%YAML 1.1\n", b"---\n", b"PK\x03\x04", b"\x89MCAP0\r\n", b"=1+1"),
    *(b",", b";"),
)


class TooLong(BaseException):
    """An answer did not come in time; no reader can take it for an error of its own."""


@dataclass
class Answers:
    """Of one reader.

    Attributes
    ----------
    name : str
    inputs, accepted : int
    longest_s : float
    kinds : set of str
        Answers without their numbers and names.
    steps : int
        Different steps from a line of the package to another.
    wrong : dict of str to bytes
        Wrong answers, and an input of each.
    """

    name: str
    inputs: int = 0
    accepted: int = 0
    longest_s: float = 0.0
    kinds: set[str] = field(default_factory=set)
    steps: int = 0
    wrong: dict[str, bytes] = field(default_factory=dict)


class Steps:
    """Steps from one line of the package to another, of what runs in this thread in the context."""

    def __init__(self) -> None:
        self.known: set[tuple[CodeType, int, int]] = set()
        self._last = 0

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Note them."""
        self._last = 0
        sys.settrace(self._called)
        try:
            yield
        finally:
            sys.settrace(None)

    def _called(self, frame: FrameType, event: str, of: Any) -> Callable[..., Any] | None:
        # what libraries do is not followed: it would take most of the time
        return self._stepped if frame.f_code.co_filename.startswith(PACKAGE) else None

    def _stepped(self, frame: FrameType, event: str, of: Any) -> Callable[..., Any]:
        line = frame.f_lineno
        self.known.add((frame.f_code, self._last, line))
        self._last = line
        return self._stepped


def changed(data: bytes, examples: list[bytes], rng: np.random.Generator) -> bytes:
    """An example with one to four changes."""
    content = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(len(content) + 1))
        length = int(min(rng.geometric(0.1), len(content)))
        kind = int(rng.integers(9))
        if kind == 0 and content:
            content[at % len(content)] ^= 1 << int(rng.integers(8))
        elif kind == 1 and content:
            content[at % len(content)] = int(rng.integers(256))
        elif kind == 2:
            del content[at : at + length]
        elif kind == 3:
            content[at:at] = content[at : at + length] * int(rng.integers(1, 4))
        elif kind == 4:
            other = examples[int(rng.integers(len(examples)))]
            begin = int(rng.integers(len(other) + 1))
            content[at : at + length] = other[begin : begin + length]
        elif kind == 5:
            content[at:at] = PIECES[int(rng.integers(len(PIECES)))]
        elif kind == 6:
            numbers = list(re.finditer(rb"-?\d[\d.e+-]*", bytes(content[:4096])))
            if numbers:
                found = numbers[int(rng.integers(len(numbers)))]
                content[found.start() : found.end()] = NUMBERS[int(rng.integers(len(NUMBERS)))]
        elif kind == 7:
            number = int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF]))
            content[at : at + 4] = number.to_bytes(4, "little")
        else:
            del content[at:]
    return bytes(content[:LONGEST_INPUT])


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise `TooLong` in what takes longer; time in which others had the processor does not count."""
    begun_s = _own_s()

    def alarm(*_: object) -> None:
        left_s = seconds - (_own_s() - begun_s)
        if left_s <= 0:
            raise TooLong
        signal.setitimer(signal.ITIMER_REAL, left_s)

    signal.signal(signal.SIGALRM, alarm)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _own_s() -> float:
    """Time on the wall less that in which this process was ready and did not run [s]."""
    waited_ns = Path("/proc/self/schedstat").read_text().split()[1]
    return time.perf_counter() - 1e-9 * int(waited_ns)


def answer(target: Target, data: bytes) -> tuple[str, bool]:
    """What a reader answers, and whether it may."""
    try:
        with within(target.within_s):
            target.read(data)
    except (ValueError, OSError) as error:
        text = str(error)
        if "\n" in text:
            return f"{type(error).__name__} of several lines: {text[:100]!r}", False
        if len(text) > LONGEST_LINE:
            return f"{type(error).__name__} of more than {LONGEST_LINE} characters: {text[:100]}", False
        return f"{type(error).__name__}: {text}", True
    except TooLong:
        return TOO_LONG, False
    except BaseException as error:  # all that no caller expects
        return f"{type(error).__name__}: {str(error)[:200]}", False
    return "", True


def kind_of(text: str) -> str:
    """An answer without its numbers and names."""
    text = re.sub(r"'[^']*'|\"[^\"]*\"|got .*?;", "...", text)
    return re.sub(r"[-+.\d]+(e[-+]?\d+)?", "0", text)[:100]


def tried(target: Target, inputs: int, seed: int, last: mmap.mmap) -> Answers:
    """Try a reader; the newest input stands in `last`, where it outlives this process."""
    rng, found, steps = np.random.default_rng(seed), Answers(target.name), Steps()
    examples = list(target.seeds)
    for data in examples:  # what the reader refuses as it is would show nothing
        with steps.noted():
            refusal = answer(target, data)[0]
        if refusal:
            found.wrong[f"an example is refused: {refusal}"] = data
    for _ in range(inputs):
        data = changed(examples[int(rng.integers(len(examples)))], examples, rng)
        last[:8] = len(data).to_bytes(8, "little")
        last[8 : 8 + len(data)] = data
        begun_s, before = _own_s(), len(steps.known)
        with steps.noted():
            text, right = answer(target, data)
        found.longest_s = max(found.longest_s, _own_s() - begun_s)
        for _ in range(REPEATS if text == TOO_LONG else 0):  # the machine may be busy
            if text == TOO_LONG:
                text, right = answer(target, data)
        found.inputs += 1
        found.accepted += not text
        kind = kind_of(text)
        if not right:
            found.wrong.setdefault(kind, data)
        elif kind not in found.kinds or len(steps.known) > before:
            found.kinds.add(kind)
            if len(examples) < MOST_EXAMPLES:
                examples.append(data)
    found.steps = len(steps.known)
    return found


def _work(target: Target, inputs: int, newest: Path, answers: Connection) -> None:
    """One reader, in a process that may end."""
    warnings.simplefilter("ignore")
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, hard))
    with newest.open("r+b") as file:
        answers.send(tried(target, inputs, SEED, mmap.mmap(file.fileno(), 0)))


def _tried_apart(every: Sequence[Target], inputs: int, folder: Path) -> list[Answers]:
    """Each reader in a process of its own, as many at a time as there are processors."""
    context = multiprocessing.get_context("fork")  # examples and modules are there already
    done: dict[str, Answers] = {}
    running: dict[Connection, tuple[Target, multiprocessing.process.BaseProcess, Path]] = {}
    waiting = list(enumerate(every))
    while waiting or running:
        while waiting and len(running) < (os.cpu_count() or 1):
            number, target = waiting.pop(0)
            newest = folder / f"newest-{number}"
            newest.write_bytes(bytes(8 + LONGEST_INPUT))
            mine, its = context.Pipe(duplex=False)
            count = max(20, round(target.share * inputs))
            process = context.Process(target=_work, args=(target, count, newest, its))
            process.start()
            its.close()  # before the next process begins: it would keep this one's end open
            running[mine] = target, process, newest
        for ready in wait(list(running)):
            assert isinstance(ready, Connection)
            target, process, newest = running.pop(ready)
            try:
                found = ready.recv()
                process.join()
            except EOFError:  # it has ended: what it read last
                process.join()
                data = newest.read_bytes()
                data = data[8 : 8 + int.from_bytes(data[:8], "little")]
                text = f"the process ended with {process.exitcode}"
                found = Answers(target.name, wrong={text: data})
            done[target.name] = found
            print(found.name, found.inputs, "inputs,", len(found.wrong), "wrong", flush=True)
    return [done[target.name] for target in every]


def run(output: Path, quick: bool, full: bool = False) -> str:
    """Try all readers, write inputs with a wrong answer into `output`; return the page."""
    inputs = FULL_INPUTS if full else QUICK_INPUTS if quick else INPUTS
    with TemporaryDirectory() as folder:
        every = [*targets(Path(folder)), *wire_targets()]
        done = _tried_apart(every, inputs, Path(folder))
    with TemporaryDirectory() as folder:
        flips = flipped_bits(Path(folder), QUICK_FLIPS if quick else FLIPS)
    for of in done:
        for k, data in enumerate(of.wrong.values()):
            name = re.sub(r"\W+", "-", of.name)
            (output / f"hostile-{name}-{k}.bin").write_bytes(data)
    text = _page(done, flips)
    return text


def _page(done: Sequence[Answers], flips: Mapping[str, Counter[str]]) -> str:
    wrong = sum(len(of.wrong) for of in done)
    assert __doc__ is not None
    about = " ".join(__doc__.split("\n\n", 1)[1].split())
    lines = [
        "# Hostile inputs",
        "",
        "`tools/run.sh tactile_resonance benchmark hostile` (`--quick`: 5000 inputs, `--full`: a million). "
        f"{about} Limits: {WITHIN_S:g} s ({PROCESS_WITHIN_S:g} s for .mat, whose reader is a process that has "
        f"to start), {MEMORY_BYTES >> 30} GiB.",
        "",
        f"{sum(of.inputs for of in done)} inputs, {sum(of.accepted for of in done)} accepted. "
        f"**Wrong answers: {wrong}.**",
        "",
        "| reader | inputs | accepted | kinds of refusals | steps | longest [s] | wrong |",
        "|---|---:|---:|---:|---:|---:|---:|",
        *(
            f"| {of.name} | {of.inputs} | {of.accepted} | {len(of.kinds - {''})} | {of.steps} | "
            f"{of.longest_s:.2f} | {len(of.wrong)} |"
            for of in done
        ),
        "",
    ]
    wrong_answers = [f"- {of.name}: {kind}" for of in done for kind in of.wrong]
    lines += [*wrong_answers, ""] if wrong_answers else []
    return "\n".join([*lines, *_flips_table(flips)])


def _flips_table(flips: Mapping[str, Counter[str]]) -> list[str]:
    every = sum(flips.values(), Counter[str]())
    ends = "refused", "named", "without effect", "silent"
    return [
        "## Flipped bits",
        "",
        "One bit of one file. The file is refused; or the damage is named, and a damaged recording counts as "
        "if it were not there; or all that is read is equal to the last digit, samples included; else it is "
        "silent. Files "
        "that follow from the recording (`results.csv`, `metadata.yaml`, those of `report`) hold no checksums, "
        "and the package does not read them.",
        "",
        f"**Silent: {every['silent']} of {every.total()}.**",
        "",
        f"| file | flips | {' | '.join(ends)} |",
        "|---|" + "---:|" * (1 + len(ends)),
        *(
            f"| {name} | {of.total()} | {' | '.join(str(of[end]) for end in ends)} |"
            for name, of in flips.items()
        ),
        "",
    ]
