# SPDX-License-Identifier: Apache-2.0
"""The nodes of a scan; not started itself: mock.launch.py and ur.launch.py say on which hardware."""

import difflib
import shutil
import time

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    GroupAction,
    LogInfo,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare
from launch_ros.utilities import make_namespace_absolute, prefix_namespace

from launch import LaunchDescription
from tactile_resonance.bringup import (
    ARGUMENTS,
    FILES_OF_GOALS,
    plan_bringup,
    read_parameter_file,
)
from tactile_resonance.processes import may_take_priority
from tactile_resonance.simulation.plant.defaults import PRIORITY

PACKAGE = "tactile_resonance"
DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"


def generate_launch_description():
    """Nodes and arguments; of a parameter's argument that is empty, params_file decides."""
    share = FindPackageShare(PACKAGE)
    arguments = [
        _argument("namespace", "Namespace of all nodes, for several sensors side by side."),
        _argument(
            "params_file",
            "Parameters of the nodes. An argument that is given wins over it.",
            PathJoinSubstitution([share, "config", "nodes.yaml"]),
        ),
        _argument(
            "discovery",
            f"Who finds these nodes: {DISCOVERY} for them. LOCALHOST: this machine only.",
            EnvironmentVariable(DISCOVERY, default_value="LOCALHOST"),
            choices=["LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT"],
        ),
        _argument(
            "enclaves",
            "Security enclaves of the nodes: /tactile_resonance for those of "
            "config/security/policy.xml. Empty: none is passed.",
        ),
        _argument(
            "robot",
            "true (default): a robot brings the tip to the tissue. ideal: with the mock, contact "
            "is ideal, without a 500 Hz loop, behind the same actions and topics. false: the tip is "
            "taken to be where tcp_pose states.",
            choices=["", "true", "ideal", "false"],
        ),
        _argument(
            "robot_ip",
            "Address of the robot. Several simulated ones need addresses 127.x.y.z of their own.",
        ),
        _argument("force_config", "Force source: a file of config/force or an absolute path."),
        _argument(
            "table_in_base",
            "Frame of scenes in the robot's base: [x, y, z, rx, ry, rz], m and rotation vector, or "
            "the file of `tactile_resonance calibrate-table`.",
        ),
        _argument(
            "run_folder",
            "Folder that receives the runs; by default tactile_resonance/runs in $ROS_HOME.",
        ),
        _argument(
            "table_frame",
            "Frame of the table, of poses and of the map; by default NAMESPACE/table.",
        ),
        _argument("tip_frame", "Frame of the sensor's tip; by default NAMESPACE/tip."),
        _argument(
            "static_transforms",
            "true (default): broadcast the table in the base, sensor and tool in the tip, where "
            "tf2_ros is installed. false: the stack does so, a robot description for example.",
            choices=["", "true", "false"],
        ),
        _argument(
            "tip_transform",
            "The same of the tip in the base, from tcp_pose.",
            choices=["", "true", "false"],
        ),
        _argument("base_frame", "Frame of the robot's base, that of its driver; by default base."),
        _argument(
            "record",
            "Record all topics of the namespace for as long as this runs, with ros2 bag (MCAP), "
            "into session-DATE-TIME of the working folder. Scans record themselves, with or without it.",
            "false",
            choices=["true", "false"],
        ),
        _argument(
            "rviz",
            "Start rviz2 with the view of the pole map, where it is installed.",
            "false",
            choices=["true", "false"],
        ),
    ]
    # also of the files that include this one
    names = {*(a.name for a in arguments), *ARGUMENTS, *FILES_OF_GOALS, "real_time", "notes"}
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes, args=[sorted(names)])])


def _argument(name, description, default="", choices=None):
    return DeclareLaunchArgument(
        name, default_value=default, description=description, choices=choices
    )


def _nodes(context, names):
    """The nodes that arguments and file ask for, and the manager that brings them up in this order."""
    given = context.launch_configurations
    stack, enclaves = given.get("ros_namespace"), given["enclaves"]
    namespace = make_namespace_absolute(prefix_namespace(stack, given["namespace"])) or "/"
    file = read_parameter_file(given["params_file"])
    plan = plan_bringup(given, file, namespace, may_take_priority(PRIORITY))
    nodes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *([parameters] if parameters else [])],
            # a clock of its own for each namespace: two benches do not share their time
            remappings=[("/clock", "clock")],
            ros_arguments=["--enclave", f"{enclaves}/{name}"] if enclaves else None,
            output="screen",
            respawn=True,  # the manager brings up again what was restarted
            respawn_delay=1.0,
        )
        for name, parameters in plan.nodes.items()
    ]
    if plan.of_others:
        text = f"params_file: {', '.join(plan.of_others)} hold for none of these nodes, whose names are "
        nodes.append(LogInfo(msg=f"{text}{', '.join(plan.nodes)}, after the namespace"))
    for name in (each.partition(":=")[0] for each in context.argv):
        # launch passes over it without a word, and a stack has arguments of its own
        if name not in names and (near := difflib.get_close_matches(name, names, 1, 0.8)):
            text = f"{name}: no argument of these nodes, and ignored by them; is {near[0]} meant?"
            nodes.append(LogInfo(msg=text))
    if not _installed("tf2_ros_py"):
        text = "tf2_ros is not installed here: no frames are broadcast, goals are in table or base"
        nodes.append(LogInfo(msg=text))
    if given["rviz"] == "true":
        there = _installed("rviz2")
        nodes.append(_rviz(plan) if there else LogInfo(msg="rviz2 is not installed here: left out"))
    if given["record"] == "true":
        nodes.append(_recorder(namespace.strip("/")))
    discovery = given["discovery"]
    return [
        LogInfo(
            msg=f"{DISCOVERY}={discovery} for these nodes; discovery:=SUBNET for other machines"
        ),
        GroupAction([SetEnvironmentVariable(DISCOVERY, discovery), *nodes]),
    ]


def _installed(package):
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        return False
    return True


def _rviz(plan):
    view = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "pole_map.rviz"])
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        # the view's topics are relative: those of the namespace, which the title names
        arguments=["-d", view, "-f", plan.table_frame, "-t", "Pole map of {NAMESPACE}"],
        parameters=[{"use_sim_time": plan.simulated_time}],
        remappings=[("/clock", "clock")],
    )


def _recorder(namespace):
    if shutil.which("ros2") is None:
        return LogInfo(msg="ros2 bag is not installed here: nothing is recorded beside the scans")
    topics = ["-e", f"^/{namespace}/.*|^/diagnostics$|^/tf_static$"] if namespace else ["-a"]
    folder = time.strftime("session-%Y%m%d-%H%M%S") + f"-{namespace}".replace("/", "-").rstrip("-")
    return ExecuteProcess(
        cmd=["ros2", "bag", "record", "-s", "mcap", "-o", folder, *topics], output="screen"
    )
