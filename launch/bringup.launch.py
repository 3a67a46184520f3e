# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of the stream; with `use_mock_hardware` the simulated bench too."""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
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
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context):
    """The stream, the bench where asked for, and the manager that brings them up in this order."""
    mock = LaunchConfiguration("use_mock_hardware").perform(context) == "true"
    parameters = LaunchConfiguration("params_file")
    own = {"fake_hardware_node": {"scene": LaunchConfiguration("scene")}}
    names = ["fake_hardware_node", *STREAM] if mock else list(STREAM)
    own["manager_node"] = {"nodes": names}
    return [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            parameters=[parameters, own.get(name, {})],
            output="screen",
            respawn=True,  # the manager brings up again what was started anew
            respawn_delay=1.0,
        )
        for name in [*names, "manager_node"]
    ]
