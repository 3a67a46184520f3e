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
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "tactile_resonance"


def generate_launch_description():
    """Bring-up, and a node that asks for the scan."""
    scenes = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "scenes"])
    arguments = [
        DeclareLaunchArgument(
            "scene",
            default_value=PathJoinSubstitution([scenes, "demo.yaml"]),
            description="Scene file: what lies on the simulated bench's table, and what is wanted from it.",
        ),
        DeclareLaunchArgument(
            "run_directory",
            default_value="",
            description="New or empty folder of the run; empty: made in tactile_resonance/runs of $ROS_HOME.",
        ),
        DeclareLaunchArgument(
            "notes",
            default_value="",
            description="Of the session, as YAML: {temperature_c: 21.5, tip_wetness: wet, adhesion: none}.",
        ),
        DeclareLaunchArgument(
            "robot_ip",
            default_value="127.0.1.1",
            description="Address 127.x.y.z of the simulated robot.",
        ),
        DeclareLaunchArgument(
            "patient",
            default_value="true",
            choices=["true", "false"],
            description="Data of the simulated robot and load cell may be 60 ms old instead of 20 and 10.",
        ),
        DeclareLaunchArgument(
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="Start rviz2 with the view of the pole map, where it is installed.",
        ),
        DeclareLaunchArgument(
            "record",
            default_value="false",
            choices=["true", "false"],
            description="Record all topics with ros2 bag beside what the scan records itself.",
        ),
    ]
    passed = ("scene", "robot_ip", "patient", "rviz", "record")
    bringup = IncludeLaunchDescription(
        PythonLaunchDescriptionSource([ThisLaunchFileDir(), "/bringup.launch.py"]),
        launch_arguments={
            "use_mock_hardware": "true",
            **{name: LaunchConfiguration(name) for name in passed},
        }.items(),
    )
    goal = Node(
        package=PACKAGE,
        executable="scan_goal",
        name="scan_goal",
        parameters=[
            {
                name: ParameterValue(LaunchConfiguration(name), value_type=str)
                for name in ("scene", "run_directory", "notes")
            }
        ],
        output="screen",
    )
    end = OnProcessExit(target_action=goal, on_exit=[Shutdown(reason="the scan has ended")])
    return LaunchDescription([*arguments, bringup, goal, RegisterEventHandler(end)])
