# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of the stream; with `use_mock_hardware` the simulated bench too."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

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
            "params_file",
            default_value=PathJoinSubstitution([share, "config", "nodes.yaml"]),
            description="Parameters of the nodes.",
        ),
        DeclareLaunchArgument(
            "scene",
            default_value=PathJoinSubstitution(
                [share, "config", "scenes", "gelatine_phantoms.yaml"]
            ),
            description="What lies on the simulated bench's table.",
        ),
    ]
    namespace = LaunchConfiguration("namespace")
    parameters = LaunchConfiguration("params_file")
    nodes = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=namespace,
            parameters=[parameters],
            output="screen",
        )
        for name in STREAM
    ]
    bench = Node(
        package=PACKAGE,
        executable="fake_hardware_node",
        name="fake_hardware_node",
        namespace=namespace,
        parameters=[parameters, {"scene": LaunchConfiguration("scene")}],
        output="screen",
        condition=IfCondition(LaunchConfiguration("use_mock_hardware")),
    )
    return LaunchDescription([*arguments, *nodes, bench])
