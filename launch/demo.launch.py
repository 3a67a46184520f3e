# SPDX-License-Identifier: Apache-2.0
"""A whole scan on the simulated bench: nodes, robot, load cell, one goal; ends with the scan."""

from launch.actions import (
    DeclareLaunchArgument,
    IncludeLaunchDescription,
    RegisterEventHandler,
    Shutdown,
)
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "tactile_resonance"


def generate_launch_description():
    """Bring-up, and a node that asks for the scan."""
    share = FindPackageShare(PACKAGE)
    arguments = [
        DeclareLaunchArgument(
            "scene",
            default_value=PathJoinSubstitution([share, "config", "scenes", "demo.yaml"]),
            description="Scene file: what lies on the simulated bench's table, and what is wanted from it.",
        ),
        DeclareLaunchArgument(
            "run_directory",
            default_value="",
            description="New or empty folder of the run, relative to run_folder; empty: made there.",
        ),
        DeclareLaunchArgument(
            "notes",
            default_value="",
            description="Of the session, as YAML: {temperature_c: 21.5, tip_wetness: wet, adhesion: none}.",
        ),
    ]
    # the scene and all other arguments of mock.launch.py are passed on: namespace, robot_ip, rviz ...
    mock = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "mock.launch.py"]))
    )
    goal = Node(
        package=PACKAGE,
        executable="scan_goal",
        name="scan_goal",
        namespace=LaunchConfiguration("namespace"),  # that of bring-up, as the range of discovery
        additional_env={"ROS_AUTOMATIC_DISCOVERY_RANGE": LaunchConfiguration("discovery")},
        parameters=[
            {
                name: ParameterValue(LaunchConfiguration(name), value_type=str)
                for name in ("scene", "run_directory", "notes")
            }
        ],
        output="screen",
    )
    end = OnProcessExit(target_action=goal, on_exit=[Shutdown(reason="the scan has ended")])
    return LaunchDescription([*arguments, mock, goal, RegisterEventHandler(end)])
