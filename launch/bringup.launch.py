# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of a scan; with `use_mock_hardware` the simulated bench, robot and load cell too."""

import shutil
import time

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.actions import DeclareLaunchArgument, ExecuteProcess, LogInfo, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription
from tactile_resonance.clock import PORT as TIME_PORT
from tactile_resonance.processes import may_take_priority
from tactile_resonance.simulation.plant_defaults import HOST, PRIORITY, STALLS_S, TABLE_IN_BASE

PACKAGE = "tactile_resonance"
STREAM = ("excitation_node", "frf_node", "poles_node")


def generate_launch_description():
    """Nodes and arguments."""
    share = FindPackageShare(PACKAGE)
    arguments = [
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="Namespace of all nodes, for several sensors side by side.",
        ),
        DeclareLaunchArgument(
            "use_mock_hardware",
            default_value="true",
            choices=["true", "false"],
            description="Start the simulated bench; its results are no measurements.",
        ),
        DeclareLaunchArgument(
            "robot",
            default_value="true",
            choices=["true", "ideal", "false"],
            description="true: a robot brings the tip to the tissue. ideal: with use_mock_hardware, contact is "
            "ideal, without a 500 Hz loop, behind the same actions and topics. false: the tip is taken to be "
            "where tcp_pose states.",
        ),
        DeclareLaunchArgument(
            "robot_ip",
            default_value="",
            description="Address of the robot; empty: that of robot_config, or of the simulated one. "
            "Several simulated robots need addresses 127.x.y.z of their own.",
        ),
        DeclareLaunchArgument(
            "force_config",
            default_value="can_simulated.yaml",
            description="Force source: a file of config/force or an absolute path.",
        ),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "config", "nodes.yaml"]),
            description="Parameters of the nodes.",
        ),
        DeclareLaunchArgument(
            "scene",
            default_value=PathJoinSubstitution([share, "config", "scenes", "inclusion_scan.yaml"]),
            description="What lies on the simulated bench's table.",
        ),
        DeclareLaunchArgument(
            "run_folder",
            default_value="",
            description="Folder that receives the runs; empty: tactile_resonance/runs in $ROS_HOME.",
        ),
        DeclareLaunchArgument(
            "real_time",
            default_value="false",
            choices=["true", "false"],
            description="With use_mock_hardware: on the wall clock, for tests of load and limits. Otherwise in "
            "simulated time (/clock, use_sim_time), in which a slow machine takes longer and nothing else.",
        ),
        DeclareLaunchArgument(
            "static_transforms",
            default_value="true",
            choices=["true", "false"],
            description="Publish where the simulated table stands in the robot's base, where tf2_ros is "
            "installed; where a real one stands, its stack knows.",
        ),
        DeclareLaunchArgument(
            "table_frame",
            default_value="table",
            description="Frame of scenes and map; with a namespace it is best one of its own.",
        ),
        DeclareLaunchArgument(
            "base_frame",
            default_value="base",
            description="Frame of the robot's base, that of its driver.",
        ),
        DeclareLaunchArgument(
            "record",
            default_value="false",
            choices=["true", "false"],
            description="Record all topics of the namespace for as long as this runs, with ros2 bag (MCAP), "
            "into session-DATE-TIME of the working folder. Scans record themselves, with or without it.",
        ),
        DeclareLaunchArgument(
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="Start rviz2 with the view of the pole map, where it is installed.",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context):
    """The nodes that the arguments ask for, and the manager that brings them up in this order."""

    def given(name):
        return LaunchConfiguration(name).perform(context)

    mock, robot = given("use_mock_hardware") == "true", given("robot")
    if robot == "ideal" and not mock:
        raise ValueError("robot:=ideal is for use_mock_hardware:=true: there is no robot behind it")
    simulated_time = mock and given("real_time") == "false"
    host = given("robot_ip") or (HOST if mock else "")
    simulated_cell = host if mock and given("force_config") == "can_simulated.yaml" else ""
    time_server = {"time_server": f"{host}:{TIME_PORT}" if simulated_time else ""}
    stalls = mock and not (simulated_time or may_take_priority(PRIORITY))
    table = {"table_in_base": TABLE_IN_BASE} if mock and robot != "false" else {}
    own = {
        "fake_hardware_node": {
            "scene": given("scene"),
            "robot_host": host if robot == "true" else "",
            "serve_contact": robot == "ideal",
            "table_in_base": TABLE_IN_BASE,
            "base_frame": given("base_frame"),
            **time_server,
        },
        "excitation_node": {
            # without robot and bench nobody measures the force
            "contact_source": "force_over" if mock or robot == "true" else "tcp_pose",
            **time_server,
        },
        "contact_node": {
            "robot_host": host,
            "base_frame": given("base_frame"),
            "force_config": given("force_config"),
            "force_host": simulated_cell,
            "simulated_stalls_s": STALLS_S if stalls else 0.0,
            **time_server,
        },
        # where a real table stands, params_file says, if anything
        "pole_map_node": {"frame_id": given("table_frame"), "base_frame": given("base_frame"), **table}
        if mock
        else {},
        "scan_node": {
            "contact": "none" if robot == "false" else "robot",
            "run_folder": given("run_folder"),
            "base_frame": given("base_frame"),
            **table,
            **time_server,
        },
    }
    names = [
        *(["fake_hardware_node"] if mock else []),
        *STREAM,
        *(["contact_node"] if robot == "true" else []),
        *("pole_map_node", "scan_node"),
    ]
    own["manager_node"] = {"nodes": names}
    nodes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("params_file"),
                {"use_sim_time": simulated_time, **own.get(name, {})},
            ],
            # a clock of its own for each namespace: two benches do not share their time
            remappings=[("/clock", "clock")],
            output="screen",
            respawn=True,  # the manager brings up again what was started anew
            respawn_delay=1.0,
        )
        for name in [*names, "manager_node"]
    ]
    wanted = []
    if mock and robot != "false" and given("static_transforms") == "true":
        wanted.append(_table_in_base(given("base_frame"), given("table_frame")))
    if given("rviz") == "true":
        view = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "pole_map.rviz"])
        wanted.append(
            Node(
                package="rviz2",
                executable="rviz2",
                namespace=LaunchConfiguration("namespace"),
                # the view's topics are relative: those of the namespace, which the title names
                arguments=["-d", view, "-f", given("table_frame"), "-t", "Pole map of {NAMESPACE}"],
                parameters=[{"use_sim_time": simulated_time}],
                remappings=[("/clock", "clock")],
            )
        )
    for node in wanted:
        nodes.append(node if _installed(node.node_package) else _left_out(node.node_package))
    if given("record") == "true":
        nodes.append(_recorder(given("namespace")))
    return nodes


def _installed(package):
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        return False
    return True


def _left_out(package):
    return LogInfo(msg=f"{package} is not installed here: left out")


def _table_in_base(base_frame, table_frame):
    """Static transform of the simulated table."""
    x, y, z, roll, pitch, yaw = (
        TABLE_IN_BASE  # its rotation is about z alone: rotation vector and angles agree
    )
    values = {"x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw}
    arguments = [text for name, value in values.items() for text in (f"--{name}", str(value))]
    return Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        name="table_in_base",
        namespace=LaunchConfiguration("namespace"),
        arguments=[*arguments, "--frame-id", base_frame, "--child-frame-id", table_frame],
    )


def _recorder(namespace):
    if shutil.which("ros2") is None:
        return LogInfo(msg="ros2 bag is not installed here: nothing is recorded beside the scans")
    topics = ["-e", f"^/{namespace}/.*|^/diagnostics$|^/tf_static$"] if namespace else ["-a"]
    folder = time.strftime("session-%Y%m%d-%H%M%S") + (f"-{namespace}" if namespace else "")
    return ExecuteProcess(
        cmd=["ros2", "bag", "record", "-s", "mcap", "-o", folder, *topics], output="screen"
    )
