# SPDX-License-Identifier: Apache-2.0
"""The nodes with a Universal Robots arm; docs/robot.md states their arguments and the order of steps."""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Arguments of the arm; all of bringup.launch.py hold too."""
    bringup = PathJoinSubstitution(
        [FindPackageShare("tactile_resonance"), "launch", "bringup.launch.py"]
    )
    arguments = [
        DeclareLaunchArgument(
            "robot_config",
            default_value="",
            description="The arm: a file, absolute or in the share folder; by default "
            "config/devices/ur5e.yaml.",
        ),
    ]
    include = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(bringup),
        launch_arguments={"use_mock_hardware": "false"}.items(),
    )
    return LaunchDescription([*arguments, include])
