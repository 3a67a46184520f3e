# SPDX-License-Identifier: Apache-2.0
"""Scans of poses, and of a scene, in frames that only the tf2 of ROS connects with the robot's base."""

import json

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not here")
pytest.importorskip("tactile_resonance.msg", reason="the messages are not built")
pytest.importorskip("tf2_ros", reason="tf2_ros is not here: it comes with a full ROS 2")

import rclpy
import tf2_ros
from geometry_msgs.msg import Point, Pose, Quaternion, TransformStamped
from robot_at_hand import RobotAtHand, own_host, own_time
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from tactile_resonance.client import Ending
from tactile_resonance.configuration import share_path
from tactile_resonance.drivers.ur_config import read_ur_config
from tactile_resonance.nodes.client import ScanClient
from tactile_resonance.processes import NodeProcesses
from tactile_resonance.scan.run_content import read_run

TIME = own_time(96)
NODES = ("fake_hardware_node", "excitation_node", "frf_node", "poles_node", "scan_node")
PHANTOM = (np.array([-0.4, 0.1, 0.25]), Rotation.from_rotvec([0.0, 0.0, 0.3]))
"""In the base: where the bench has its tissue."""
TABLE = (np.array([-0.49, -0.13, 0.2]), Rotation.from_rotvec([0.0, 0.0, -1.5]))
CAMERA = (np.array([0.2, 0.3, 0.9]), Rotation.from_rotvec([2.0, -1.0, 0.5]))
SCENE = """
name: a dish
frame_id: phantom
force_n: 0.01
regions:
  - {name: gelatine 10 %, gelatine_percent: 10.0, disc: {center_m: [0.0, 0.0], radius_m: 0.01}}
positions: {list: [[0.0, 0.0], [0.004, 0.002]]}
blocks: {least: 3, most: 3}
"""
PLACES = [[0.0, 0.0, 0.0], [0.004, 0.002, 0.0]]


def listed(frame):
    return [float(value) for value in (*frame[0], *frame[1].as_rotvec())]


def broadcast(node, **frames):
    """Fixed frames in the base, by a node of the stack."""
    sent = []
    for name, (place, turn) in frames.items():
        message = TransformStamped(child_frame_id=name)
        message.header.frame_id = "base"
        to, (x, y, z, w) = message.transform.translation, turn.as_quat().tolist()
        to.x, to.y, to.z = place.tolist()
        message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
        sent.append(message)
    broadcaster = tf2_ros.StaticTransformBroadcaster(node)
    broadcaster.sendTransform(sent)
    return broadcaster


@pytest.fixture
def nodes(domain, tmp_path):
    (tmp_path / "dish.yaml").write_text(SCENE)
    bench = {"scene": tmp_path / "dish.yaml", "serve_contact": True, "table_in_base": listed(PHANTOM)}
    parameters = {
        "fake_hardware_node": bench,
        "excitation_node": {"record_folder": tmp_path / "records"},
        "scan_node": {"table_in_base": listed(TABLE), "run_folder": tmp_path / "runs"},
    }
    parameters["scan_node"]["goal_folders"] = [str(tmp_path)]
    for name in ("fake_hardware_node", "excitation_node", "scan_node"):
        parameters[name]["time_server"] = TIME
    with NodeProcesses(tmp_path / "log") as started:
        started.bring_up(NODES, parameters)
        yield started


def tips(run):
    """(n, 3) places of the tip in the base, of all poles of points on the tissue."""
    with AnyReader([run / "recording"]) as reader:
        topics = [c for c in reader.connections if c.topic == "/poles"]
        heard = [reader.deserialize(cdr, c.msgtype) for c, _, cdr in reader.messages(topics)]
    poses = [m.tip_pose for m in heard if m.label != "air"]
    assert {pose.header.frame_id for pose in poses} == {"base"}
    return np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses])


def assert_on_the_phantom(run, points):
    """Where the scan must have been, in the base, whatever it was told in; and what was felt there."""
    wanted = PHANTOM[0] + PHANTOM[1].apply(PLACES)
    found = tips(run)
    off_m = np.linalg.norm(found[:, None] - wanted[None], axis=2)
    assert off_m.min(axis=1).max() < 1e-9
    assert off_m.min(axis=0).max() < 1e-9
    content = read_run(run)
    assert len(content.results) == points
    for result in content.results:
        assert result.f0_hz == pytest.approx(254.0, abs=1.0)  # of gelatine; beside the dish 240
    return content


def test_poses_in_the_frame_of_a_camera_are_those_places_of_the_phantom(nodes, tmp_path):
    seen = CAMERA[1].inv()
    poses = []
    for place in PLACES:
        x, y, z = seen.apply(PHANTOM[0] + PHANTOM[1].apply(place) - CAMERA[0]).tolist()
        qx, qy, qz, qw = (seen * PHANTOM[1]).as_quat().tolist()
        turn = Quaternion(x=qx, y=qy, z=qz, w=qw)
        poses.append(Pose(position=Point(x=x, y=y, z=z), orientation=turn))
    run = tmp_path / "run"
    with ScanClient(nodes.check) as client:
        broadcast(client._node, camera=CAMERA)
        outcome = client.scan(poses=poses, frame="camera", force_n=0.01, run_directory=run)
        unknown = client.scan(poses=poses, frame="hand", force_n=0.01)
    assert (outcome.ending, outcome.done) == (Ending.COMPLETE, 2), outcome
    content = assert_on_the_phantom(run, 2)
    # without a scene points are in the table
    assert {result.frame_id for result in content.results} == {"table"}
    noted = json.loads((run / "run.json").read_text())["facts"]["frames"]
    np.testing.assert_allclose(noted["camera"], [*CAMERA[0], *CAMERA[1].as_rotvec()], atol=1e-9)
    assert unknown.ending is Ending.REJECTED
    assert unknown.message.startswith(
        "poses.header.frame_id: got 'hand'; accepted is 'table' or 'base' (tf2: \"hand\" passed"
    )
    assert unknown.message.endswith("it knows base, camera, table)")


def test_a_scan_stays_where_its_scene_stood_when_it_began(nodes, tmp_path):
    run, points = tmp_path / "run", []
    with ScanClient(nodes.check) as client:
        before = broadcast(client._node, phantom=PHANTOM)

        def on_feedback(feedback):
            if feedback.finished:
                client.tactile.cancel()

        scene = tmp_path / "dish.yaml"
        outcome = client.scan(scene=scene, run_directory=run, on_feedback=on_feedback)
        assert (outcome.ending, outcome.done) == (Ending.CANCELLED, 1), outcome
        client._node.destroy_publisher(before.pub_tf)
        broadcast(client._node, phantom=TABLE)
        outcome = client.scan(run_directory=run, resume=True, on_point=points.append)
        assert (outcome.ending, outcome.done) == (Ending.COMPLETE, 2), outcome
    content = assert_on_the_phantom(run, 2)
    assert {result.frame_id for result in content.results} == {"phantom"}
    assert [point.position_m for point in content.points] == [tuple(place) for place in PLACES]


def matrix(place, turn):
    """(4, 4) of a frame."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn.as_matrix(), place
    return result


def test_the_tree_has_tip_and_flange_where_the_robot_has_them(domain, tmp_path):
    """The robot's flange and tip as its controller tells them, beside what TF holds."""
    (tmp_path / "dish.yaml").write_text(SCENE)
    arm = share_path("config/devices/ur5e.yaml").read_text()
    mounted = "[0.01, -0.02, 0.12, 0.1, 3.0, 0.2]  #"  # no symmetry between flange and tip
    arm = arm.replace("[0.0, 0.0, 0.12, 0.0, 3.141592653589793, 0.0]  #", mounted)
    (tmp_path / "arm.yaml").write_text(arm)
    host, robot = own_host(97), {"time_server": own_time(97), "robot_host": own_host(97)}
    parameters = {
        "fake_hardware_node": {**robot, "scene": tmp_path / "dish.yaml"},
        "contact_node": {
            **robot,
            "robot_config": tmp_path / "arm.yaml",
            "force_host": host,
            "frame_id": "left/tip",
            "tool_frame": "flange",
        },
        "pole_map_node": {"tip_frame": "left/tip"},
    }
    names = ("left/tip", "flange", "sensor")
    with NodeProcesses(tmp_path / "log") as started:
        started.bring_up(tuple(parameters), parameters)
        with ScanClient(started.check) as client:
            buffer = tf2_ros.Buffer()
            listener = tf2_ros.TransformListener(buffer, client._node)
            newest = rclpy.time.Time()
            client.wait(
                lambda: all(buffer.can_transform("base", name, newest) for name in names),
                120.0,
                "the frames",
            )
            told = RobotAtHand(host).order("state")["tcp_pose"]
            found = {}
            for name in names:
                there = buffer.lookup_transform("base", name, newest).transform
                to, turn = there.translation, there.rotation
                turn = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
                found[name] = matrix([to.x, to.y, to.z], turn)
            listener.unregister()
    tip = matrix(told[:3], Rotation.from_rotvec(told[3:]))
    np.testing.assert_allclose(found["left/tip"], tip, atol=1e-6)  # it rests
    offset = read_ur_config(tmp_path / "arm.yaml").tip_in_flange
    assert offset.vector.tolist() == [0.01, -0.02, 0.12, 0.1, 3.0, 0.2]
    tip_in_flange = matrix(offset.position_m, offset.rotation)
    np.testing.assert_allclose(found["flange"] @ tip_in_flange, found["left/tip"], atol=1e-9)
    beam_m = np.linalg.norm(found["sensor"][:3, 3] - found["left/tip"][:3, 3])
    assert beam_m == pytest.approx(0.064, abs=1e-9)
