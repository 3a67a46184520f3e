# SPDX-License-Identifier: Apache-2.0
"""Decoding of CAN frames by description."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.can_frames import Assembler, read_can_description

ROBOTOUS = read_can_description(Path("robotous.yaml"))
counts = st.lists(st.integers(-32767, 32767), min_size=6, max_size=6)


def by_hand(values, overload=0, command=0x0B):
    """D1 to D16 of the manual, byte by byte."""
    data = [command]
    for value in values:
        data += [(value >> 8) & 0xFF, value & 0xFF]
    return bytes([*data, overload, 0, 0])


@given(counts, st.integers(0, 0x3F))
def test_what_was_sent_is_read(values, bits):
    got, over = ROBOTOUS.decode(by_hand(values, bits))
    assert list(got) == values
    assert over is bool(bits or max(map(abs, values)) >= 32767)


@given(counts, st.integers(0, 5))
def test_a_count_that_is_no_number_is_none(values, axis):
    values[axis] = -32768
    got, _ = ROBOTOUS.decode(by_hand(values))
    assert np.isnan(got[axis])
    assert np.isfinite(np.delete(got, axis)).all()


def test_answers_to_commands_are_no_wrenches():
    assert ROBOTOUS.decode(by_hand([0] * 6, command=0x0F)) is None
    assert ROBOTOUS.decode(bytes(8)) is None


@given(st.integers(1, 4), st.sets(st.integers(0, 80), max_size=20))
def test_no_wrench_mixes_two_and_each_that_lacks_a_frame_counts_once(n, missing):
    assembler = Assembler(tuple(range(1, n + 1)), 5e-4)
    whole = []
    for i in range(20):
        for j in range(n):
            if n * i + j not in missing:
                joined = assembler.add(j + 1, bytes([i]), 1e-3 * i + 1.3e-4 * j)
                whole += [joined] if joined else []
        assert assembler.add(7, b"x", 1e-3 * i) is None  # another device's
    assembler.add(1, b"", 1.0)  # what comes next shows that the last one is not whole
    lacking = [len(missing.intersection(range(n * i, n * i + n))) for i in range(20)]
    assert whole == [bytes([i] * n) for i in range(20) if not lacking[i]]
    assert assembler.lost == sum(0 < lacks < n for lacks in lacking)


def test_lost_wrenches_are_counted():
    assembler = Assembler((1, 2), 5e-4)
    for can_id in (1, 2, 1, 1, 2, 2, 1, 2):
        assembler.add(can_id, b"", 0.0)
    assert assembler.lost == 2


COMMANDS_WITH_A_REPLY_TOO_FAR = {
    "id": 0x64,
    "rates": {1000: [0x0F, 8]},
    "reply": {"result_byte": 1, "good": 1, "error_byte": 16, "errors": {}},
}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"layout": ">B6hB3x"}, "layout: got '>B6hB3x'; accepted is at most 8 bytes a frame"),
        ({"layout": "6?!"}, "layout"),
        ({"fields": ["fx"]}, "fields"),
        ({"frame_ids": [1, 1]}, "frame_ids"),
        ({"frame_ids": ["1"]}, "frame_ids"),
        ({"constant": {"colour": 1}}, "constant.colour"),
        ({"overload": {"field": "fw", "mask": 1}}, "overload.field: got 'fw'"),
        ({"full_scale_counts": -1}, "full_scale_counts"),
        ({"commands": {"id": 0x64, "stop": [256]}}, "commands.stop"),
        ({"commands": {"id": 0x64, "setup": [{"data": [1]}]}}, "commands.reply"),
        ({"frame_ids": [0x001, 0x800]}, "frame_ids: .* from 0 to 0x7ff"),
        ({"extended_ids": "no"}, "extended_ids: got 'no'; accepted is true or false"),
        ({"commands": COMMANDS_WITH_A_REPLY_TOO_FAR}, "commands.reply.error_byte"),
        ({"endian": "little"}, "endian"),
    ],
)
def test_a_bad_description_is_refused_with_its_field(tmp_path, change, reason):
    content = yaml.safe_load(
        share_path("config/force/frames/robotous.yaml").read_text(encoding="utf-8")
    )
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump({**content, **change}), encoding="utf-8")
    with pytest.raises(ValueError, match=f"bad.yaml: {reason}"):
        read_can_description(path)
