# SPDX-License-Identifier: Apache-2.0
"""Parts of the arm's driver that need no robot: page, commands, states, motion, configuration, fault names."""

import itertools
import pickle
import socket
import tempfile
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_resonance.configuration import share_path
from tactile_resonance.contact.interfaces import ArmError, ArmFault
from tactile_resonance.contact.samples import Pose
from tactile_resonance.drivers.rtde_stream import (
    PROGRAM_PLAYING,
    RobotState,
    StateReader,
    motion_fault,
)
from tactile_resonance.drivers.ur_arm import UrArm
from tactile_resonance.drivers.ur_config import UrArmConfig, read_ur_config
from tactile_resonance.drivers.ur_exchange import (
    FRESH,
    NOTHING,
    REST,
    REVIVED,
    SIZE,
    SPEED,
    STOP,
    Exchange,
    UrCommand,
)
from tactile_resonance.simulation.plant.tabletop import TIP_IN_FLANGE


@pytest.fixture
def exchanges():
    """The page as the client has it, and as its owner has it."""
    with tempfile.TemporaryFile() as page:
        page.truncate(SIZE)
        pair = Exchange(page.fileno()), Exchange(page.fileno())
        yield pair
        for exchange in pair:
            exchange.close()


@pytest.mark.parametrize(
    "command",
    [
        UrCommand(SPEED, 7, 1 << 61, 2, (0.1, -0.2, 0.3, -1e-300, 5.0, 6.0), 0.5),
        UrCommand(STOP, 8, acceleration=2.0),
        UrCommand(NOTHING, until_ns=1_000_000_000, demand=1),
    ],
)
def test_commands_arrive_as_they_were_said(command):
    data = command.pack()
    assert UrCommand.unpack(data) == command
    assert (
        data[:1] == command.kind
    )  # by which the client passes over velocities that were overtaken


def test_a_configuration_arrives_at_the_client_process_as_it_was_read():
    config = read_ur_config(share_path("config/devices/ur5e.yaml"))
    data = pickle.dumps(config)
    assert data[:1] == pickle.PROTO  # by which the client distinguishes requests from commands
    assert data[:1] not in {SPEED, STOP, NOTHING}
    again = pickle.loads(data)
    assert repr(again) == repr(config)


def test_each_side_of_the_page_reads_what_the_other_wrote_and_its_own_stays(exchanges):
    client, owner = exchanges
    assert (*owner.answered, owner.heard_ns, client.seen) == (0, 0, 0, 0)
    owner.beat(FRESH | REVIVED)
    client.hear(1 << 61)
    client.report(5, True)
    assert (*owner.answered, owner.heard_ns) == (5, 0, 1 << 61)
    assert client.seen == FRESH | REVIVED
    client.report(6, False)
    assert owner.answered == (6, 6)
    client.report(4, True)  # a stop that could only be done now: later commands stay answered
    assert owner.answered == (6, 6)
    owner.beat()
    assert client.seen == FRESH | REVIVED


def test_sign_of_life_ages_until_the_next(exchanges):
    client, owner = exchanges
    owner.beat()
    first = client.silence_s()
    assert 0 <= first <= client.silence_s()
    owner._values[0] = 0  # as if given when this machine began
    assert client.silence_s() > 0.01
    owner.beat(FRESH)
    assert client.silence_s() < first + 60.0


def state(time_s, runtime=2, safety=1, mode=7, z_m=0.3):
    return RobotState(
        time_s, (0.1, 0.2, z_m, 0.0, 0.0, 0.0), (0.01,) * 6, (-1.0,) * 6, safety, runtime, mode
    )


class States:
    """A `StateReader` on states that the test sends, on a clock of the test's."""

    def __init__(self, round_trip_s=2e-4):
        self.sent = []
        self.now = 10**12
        stream = SimpleNamespace(read=self._take)
        self.reader = StateReader(stream, lambda: self.now, round_trip_s)

    def _take(self):
        sent, self.sent = self.sent, []
        return sent

    def read(self, *states):
        self.sent += states
        return self.reader.read()


def test_the_newest_of_the_states_that_have_come_counts():
    states = States()
    assert not states.read()
    assert states.reader.sample is None
    assert states.read(state(1.0, z_m=0.3), state(1.002, z_m=0.4))
    sample = states.reader.sample
    assert states.reader.newest.robot_time_s == sample.robot_time_s == 1.002
    assert sample.position_m == (0.1, 0.2, 0.4)
    assert sample.velocity == (0.01,) * 6
    assert sample.tool_wrench == (-1.0,) * 6
    assert sample.moving_allowed


def test_a_state_that_is_said_again_is_heard_and_changes_nothing():
    """So does a robot whose time stands."""
    states = States()
    states.read(state(1.0))
    first = states.reader.sample
    states.now += 10**9
    assert states.read(state(1.0), state(1.0))
    assert states.reader.sample is first


def test_times_are_those_of_the_quickest_states_however_late_others_come():
    """Random delays on a network of 0.2 ms there and back; now and then nothing is read for 50 ms."""
    rng = np.random.default_rng(3)
    states, taken_ns, told_ns = States(round_trip_s=2e-4), [], []
    start_ns = 10**12
    waiting, free_ns = [], 0
    for n in range(6000):
        sent_ns = start_ns + 2_000_000 * n
        waiting.append(state(5.0 + 0.002 * n))
        states.now = max(states.now, sent_ns + round(1e9 * (1e-4 + rng.exponential(1e-3))))
        if rng.random() < 0.005:
            free_ns = sent_ns + 50_000_000
        if states.now < free_ns:
            continue
        states.read(*waiting)
        waiting = []
        taken_ns.append(sent_ns)
        told_ns.append(states.reader.sample.time_ns)
    error_s = 1e-9 * (np.array(told_ns) - np.array(taken_ns))[1500:]
    std_s = states.reader.clock_std_s
    # of a quarter of a second the quickest is late by some 1 ms / 125
    assert np.abs(error_s).max() < 1e-4
    # half of the round trip, and how long a state waits for its cycle, cannot be seen
    assert 0.002 / 12**0.5 < std_s < 1e-3


def test_where_the_time_is_not_known_states_are_dated_by_those_before():
    states = States(round_trip_s=0.0)
    states.sent = [state(1.0)]
    states.reader.read()
    begun_ns = states.reader.sample.time_ns
    states.sent = [state(1.002)]  # come, while this clock still shows the time before
    states.reader.read(now_known=False)
    assert states.reader.sample.time_ns == begun_ns + 2_000_000
    states.now += 4_000_000
    states.read(state(1.004))
    assert states.reader.sample.time_ns == states.now
    states.now += 1_000_000_000
    states.read(state(1.006))
    states.reader.date_anew()
    assert states.reader.sample.time_ns == states.now


@pytest.mark.parametrize(
    ("states_of_program", "fault", "revived"),
    [
        ((2, 2, 2), None, False),
        ((2, 1), ArmFault.PROGRAM_STOPPED, False),
        ((2, 1, 2), ArmFault.PROGRAM_STOPPED, True),
        ((2, 4, 2), ArmFault.PROGRAM_STOPPED, True),  # paused, and let go on at the pendant
    ],
)
def test_only_the_program_that_was_guarded_is_ours(states_of_program, fault, revived):
    times = itertools.count(1)
    for at_once in (False, True):
        states = States()
        states.read(state(0.5))
        states.reader.guard(True)
        told = [state(0.002 * next(times) + 1, runtime=runtime) for runtime in states_of_program]
        for batch in [told] if at_once else [[one] for one in told]:
            states.read(*batch)
        found = states.reader.fault
        assert (None if found is None else found[0]) is fault
        assert states.reader.sample.moving_allowed is (fault is None)
        assert states.reader.revived is revived
        states.reader.guard(True)  # the next program was started by us
        states.read(state(100.0))
        assert states.reader.fault is None


class Control:
    """What a `Session` says to ur_rtde."""

    def __init__(self):
        self.said = []

    def kickWatchdog(self):
        self.said.append("kick")
        return True

    def speedL(self, twist, acceleration, time_s):
        self.said.append((twist, acceleration))
        return True


def test_the_watchdog_is_fed_with_the_newest_velocity_and_never_with_an_older_one():
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    from tactile_resonance.drivers.ur_session import Session

    control = Control()
    session = Session(UrArmConfig("127.0.0.1"), None)
    session.control = control
    twist = (0.0, 0.0, -0.005, 0.0, 0.0, 0.0)
    assert session.feed()
    assert not session.commanded
    session.speed(twist, 0.5)
    session.feed()
    assert session.commanded
    session.rest(1.5)  # nothing is sent, but from now on zero
    assert not session.commanded
    session.feed()
    session.speed(twist, 0.5)
    session.stop(2.0)
    session.feed()
    assert not session.commanded
    assert control.said == [
        "kick", (twist, 0.5), (twist, 0.5), (REST, 1.5), (twist, 0.5), (REST, 2.0), (REST, 2.0)
    ]  # fmt: skip
    assert session.packets == len(control.said)


def test_shipped_configuration_is_that_of_the_simulated_robot():
    config = read_ur_config(share_path("config/devices/ur5e.yaml"))
    assert config.host == "127.0.1.1"
    np.testing.assert_allclose(config.tip_in_flange.vector, TIP_IN_FLANGE.vector)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", "host: got None; accepted is text .it is missing."),
        ("host: ''", "host: got ''; accepted is a name"),
        ("{host: a, watchdog_hz: 5}", "watchdog_hz: got 5.0; accepted is 25 to 125"),
        ("{host: 10.0.0.127, watchdog_hz: 5}", "watchdog_hz: got 5.0; accepted is 25 to 125"),
        ("{host: localhost, watchdog_hz: 5}", "watchdog_hz: got 5.0; accepted is 25 to 125"),
        ("{host: 127.0.0.9, watchdog_hz: 4}", "watchdog_hz: got 4.0; accepted is 5 to 125"),
        ("{host: a, tip_in_flange: [1, 2]}", "tip_in_flange: .*accepted is a list of 6 numbers"),
        ("{host: a, tip_in_flange: [.nan, 0, 0, 0, 0, 0]}", "tip_in_flange"),
        ("{host: a, max_speed_m_s: fast}", "max_speed_m_s: got 'fast'"),
        ("{host: a, realtime_priority: 2.5}", "realtime_priority"),
        ("{host: a, realtime_priority: true}", "realtime_priority"),
        (
            "{host: a, check_dashboard: maybe}",
            "check_dashboard: got 'maybe'; accepted is true or false",
        ),
        ("{host: a, payload_cog_m: [true, 0, 0]}", "payload_cog_m"),
        ("{host: a, colour: red}", "colour: got 'red'; accepted is one of"),
        ("[1]", "got .list.; accepted is a mapping"),
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


@pytest.mark.parametrize("silent", ["kickWatchdog", "reuploadScript", "getTCPOffset", "setWatchdog"])
def test_what_the_library_raises_for_want_of_an_answer_is_a_lost_link(silent):
    """ur_rtde raises RuntimeError where a robot, or the machine, is too slow for its limit of 0.5 s."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    from tactile_resonance.drivers.ur_session import Session

    config = UrArmConfig(host="127.0.0.1", check_dashboard=False)

    def unanswered(*_):
        raise RuntimeError(f"{silent}() function did not succeed!")

    session = Session(config, None)
    session._threads = set()
    answers = dict.fromkeys(("kickWatchdog", "reuploadScript", "isProgramRunning", "setTcp"), lambda *_: True)
    answers["getTCPOffset"] = lambda: config.tip_in_flange.vector.tolist()
    answers |= {"setPayload": lambda *_: True, silent: unanswered}
    session.control = SimpleNamespace(**answers)
    with pytest.raises(ArmError, match=rf"127.0.0.1: {silent}\(\) function did not succeed!") as error:
        session.restart()
    assert error.value.fault is ArmFault.LINK_LOST


@pytest.mark.parametrize(
    ("answer", "taken"),
    [
        ([0, 0, 0.12, 0, np.pi, 0], True),
        ([0, 0, 0.12, 0, -np.pi, 0], True),
        ([0, 0, 0.12, 0, 3 * np.pi, 0], True),
        ([0, 0, 0.12, 0, np.pi - 1e-5, 0], False),
        ([0, 0, 0.12001, 0, np.pi, 0], False),
        ([0, 0, np.nan, 0, np.pi, 0], False),
    ],
)
def test_the_tip_is_taken_whatever_vector_its_rotation_comes_back_as(answer, taken):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed")
    from tactile_resonance.drivers.ur_session import Session

    class TakenError(Exception):
        """The next call was reached."""

    def next_call(*_):
        raise TakenError

    tip = Pose.from_vector(np.array([0, 0, 0.12, 0, np.pi, 0]))
    config = UrArmConfig(host="127.0.0.1", tip_in_flange=tip, payload_kg=1.0)
    session = Session(config, None)
    session.control = SimpleNamespace(
        setTcp=lambda _: True, getTCPOffset=lambda: answer, setPayload=next_call
    )
    with pytest.raises(TakenError if taken else ArmError):
        session._prepare()


class Reader:
    """Of the robot's states, of which no further one comes."""

    def __init__(self, robot_time_s):
        self.newest, self.reads = SimpleNamespace(robot_time_s=robot_time_s), 0
        self.stream, self._other = socket.socketpair()

    def read(self, now_known):
        self.reads += 1
        return False


def test_a_wait_for_a_state_goes_on_with_the_reader_of_a_new_connection():
    """Another thread connects anew meanwhile: the former reader never has the state that is waited for."""
    arm, former, later = UrArm(UrArmConfig("127.0.0.1")), Reader(1.0), Reader(3.0)
    arm._states = former
    waits = threading.Thread(target=arm.catch_up, args=(2_000_000_000,), daemon=True)
    waits.start()
    former.stream.close()
    arm._states = later
    waits.join(10.0)
    assert not waits.is_alive()
    assert later.reads < 3  # not without a pause


def test_a_connection_that_another_thread_closes_is_lost_and_the_new_one_stays():
    arm, former, later = UrArm(UrArmConfig("127.0.0.1")), Reader(1.0), Reader(3.0)

    def closed_meanwhile(now_known):
        arm._states = later
        former.stream.close()
        former.stream.recv(1)

    former.read = closed_meanwhile
    arm._states = former
    with pytest.raises(ArmError, match="the connection to 127.0.0.1 is lost") as error:
        arm.receive()
    assert error.value.fault is ArmFault.LINK_LOST
    assert arm._states is later
    assert later.stream.fileno() >= 0


@pytest.mark.parametrize("found_playing", [True, False])
def test_of_two_programs_only_the_one_that_was_there_before_is_called_another(found_playing):
    """That which was found does not end; of ours it is not known what it waits for."""

    def late(*_):
        raise ArmError(ArmFault.LINK_LOST, "127.0.0.1 is not ready after 15 s")

    arm, reader = UrArm(UrArmConfig("127.0.0.1")), Reader(1.0)
    reader.newest.runtime_state = PROGRAM_PLAYING
    arm._states, arm._found_playing = reader, found_playing
    with pytest.raises(ArmError, match="not ready after 15 s") as error:
        arm._ask("connect", of=SimpleNamespace(ask=late, end=lambda: None))
    assert ("another program" in str(error.value)) is found_playing
    assert error.value.fault is (ArmFault.PROGRAM_NOT_STARTED if found_playing else ArmFault.LINK_LOST)
