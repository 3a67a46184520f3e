# SPDX-License-Identifier: Apache-2.0
"""Parts of the arm's driver that need no robot: its page of memory, its configuration, its fault names."""

import dataclasses
import struct
import tempfile
import threading

import numpy as np
import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmFault
from tactile_resonance.drivers.ur_config import UrArmConfig, read_ur_config
from tactile_resonance.drivers.ur_exchange import SIZE, ClientState, Exchange
from tactile_resonance.drivers.ur_safety import motion_fault
from tactile_resonance.simulation.plant_process import TIP_IN_FLANGE

STATE = ClientState(
    received_ns=123456789012345, robot_time_s=1.5, state_ns=123456789012000,
    tip_pose=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), tip_speed=(0.1,) * 6, tip_force=(-1.0,) * 6,
    safety_bits=1 << 10 | 1, runtime_state=2, robot_mode=-1, safety_mode=1, connected=True, moving=False,
    done=7, refused=6, clock_std_s=1e-3, rate_hz=500.0,
)  # fmt: skip


@pytest.fixture
def exchanges():
    with tempfile.TemporaryFile() as page:
        page.truncate(SIZE)
        pair = Exchange(page.fileno()), Exchange(page.fileno())
        yield pair
        for exchange in pair:
            exchange.close()


def test_a_state_arrives_as_it_was_written(exchanges):
    client, owner = exchanges
    assert owner.read() is None
    client.write(STATE)
    assert owner.read() == STATE


def test_sign_of_life_ages(exchanges):
    client, owner = exchanges
    owner.beat()
    first = client.silence_s()
    assert 0 <= first <= client.silence_s()


def test_a_client_killed_while_it_writes_leaves_the_state_before(exchanges):
    client, owner = exchanges
    states = [dataclasses.replace(STATE, received_ns=n, done=n) for n in (1, 2, 3)]
    for state in states:
        client.write(state)
    page = client._page
    at = page.find(struct.pack("<qd", 3, STATE.robot_time_s))
    page[at + 40 : at + 48] = b"unfinish"
    assert owner.read() == states[1]
    client.write(states[2])  # elsewhere: nothing newer is whole, but this is
    assert owner.read() == states[2]


def test_no_state_is_ever_read_half_written(exchanges):
    client, owner = exchanges
    ended = threading.Event()

    def write():
        number = 0
        while not ended.is_set():
            number += 1
            value = float(number)
            client.write(
                dataclasses.replace(
                    STATE, robot_time_s=value, tip_pose=(value,) * 6, tip_force=(value,) * 6
                )
            )

    writer = threading.Thread(target=write)
    client.write(STATE)
    writer.start()
    try:
        seen = set()
        while len(seen) < 50:
            state = owner.read()
            if state.robot_time_s != STATE.robot_time_s:
                assert {*state.tip_pose, *state.tip_force} == {state.robot_time_s}
                seen.add(state.robot_time_s)
    finally:
        ended.set()
        writer.join()


def test_shipped_configuration_is_that_of_the_simulated_robot():
    config = read_ur_config(share_path("config/devices/ur5e.yaml"))
    assert config.host == "127.0.1.1"
    np.testing.assert_allclose(config.tip_in_flange.vector, TIP_IN_FLANGE.vector)
    again = UrArmConfig.from_dict(config.to_dict())
    assert again.to_dict() == config.to_dict()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "host: missing"),
        ("host: ''", "host: ''"),
        ("{host: a, watchdog_hz: 5}", "watchdog_hz: 5, expected 25 to 125"),
        ("{host: 10.0.0.127, watchdog_hz: 5}", "watchdog_hz: 5, expected 25 to 125"),
        ("{host: localhost, watchdog_hz: 5}", "watchdog_hz: 5, expected 25 to 125"),
        ("{host: 127.0.0.9, watchdog_hz: 4}", "watchdog_hz: 4, expected 5 to 125"),
        ("{host: a, tip_in_flange: [1, 2]}", "tip_in_flange: .*expected 6 numbers"),
        ("{host: a, tip_in_flange: [.nan, 0, 0, 0, 0, 0]}", "tip_in_flange"),
        ("{host: a, max_speed_m_s: fast}", "max_speed_m_s: 'fast'"),
        ("{host: a, realtime_priority: 2.5}", "realtime_priority"),
        ("{host: a, realtime_priority: true}", "realtime_priority"),
        ("{host: a, check_dashboard: maybe}", "check_dashboard: 'maybe', expected true or false"),
        ("{host: a, payload_cog_m: [true, 0, 0]}", "payload_cog_m"),
        ("{host: a, colour: red}", "colour: not known"),
        ("[1]", "expected names and values"),
        ("{host: a", "mine.yaml"),
    ],
)
def test_wrong_configurations_are_named(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_ur_config(path)


@pytest.mark.parametrize(
    ("bits", "mode", "runtime", "fault"),
    [
        (1, 7, 2, None),
        (1 << 1, 7, 2, None),  # reduced mode
        (1 << 2 | 1 << 10, 7, 1, ArmFault.PROTECTIVE_STOP),
        (1 << 4, 7, 2, ArmFault.PROTECTIVE_STOP),
        (1 << 6 | 1 << 7, 7, 2, ArmFault.EMERGENCY_STOP),
        (1, 5, 1, ArmFault.PROGRAM_STOPPED),
        (1, 7, 1, ArmFault.PROGRAM_STOPPED),
    ],
)
def test_bits_and_modes_have_names(bits, mode, runtime, fault):
    found = motion_fault(bits, mode, runtime)
    assert (None if found is None else found[0]) is fault
