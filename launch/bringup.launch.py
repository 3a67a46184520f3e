# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of a scan; with `use_mock_hardware` the simulated bench, robot and load cell too."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "tactile_resonance"
STREAM = ("excitation_node", "frf_node", "poles_node")
# Where the simulated robot answers, and the phantom under its tip.
MOCK_ROBOT = "127.0.1.1"
MOCK_TABLE = [-0.49, -0.13, 0.2, 0.0, 0.0, -1.5707963267948966]


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
            choices=["true", "false"],
            description="Whether a robot brings the tip to the tissue; otherwise the tip is taken to be "
            "where tcp_pose says.",
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
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="Start rviz2 with the view of the pole map; it must be installed.",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context):
    """The nodes that the arguments ask for, and the manager that brings them up in this order."""

    def given(name):
        return LaunchConfiguration(name).perform(context)

    mock, robot = given("use_mock_hardware") == "true", given("robot") == "true"
    host = given("robot_ip") or (MOCK_ROBOT if mock else "")
    simulated_cell = host if mock and given("force_config") == "can_simulated.yaml" else ""
    own = {
        "fake_hardware_node": {
            "scene": given("scene"),
            "robot_host": host if robot else "",
            "table_in_base": MOCK_TABLE,
        },
        "contact_node": {
            "robot_host": host,
            "force_config": given("force_config"),
            "force_host": simulated_cell,
        },
        "scan_node": {
            "contact": "robot" if robot else "none",
            "run_folder": given("run_folder"),
            **({"table_in_base": MOCK_TABLE} if mock and robot else {}),
        },
    }
    names = [
        *(["fake_hardware_node"] if mock else []),
        *STREAM,
        *(["contact_node"] if robot else []),
        *("pole_map_node", "scan_node"),
    ]
    own["manager_node"] = {"nodes": names}
    nodes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), own.get(name, {})],
            output="screen",
            respawn=True,  # the manager brings up again what was started anew
            respawn_delay=1.0,
        )
        for name in [*names, "manager_node"]
    ]
    if given("rviz") == "true":
        view = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "pole_map.rviz"])
        nodes.append(Node(package="rviz2", executable="rviz2", arguments=["-d", view]))
    return nodes
