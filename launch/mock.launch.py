# SPDX-License-Identifier: Apache-2.0
"""The nodes on a simulated bench, with a simulated robot and load cell; what they find is no measurement."""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Arguments of the bench; all of bringup.launch.py hold too."""
    bringup = PathJoinSubstitution(
        [FindPackageShare("tactile_resonance"), "launch", "bringup.launch.py"]
    )
    arguments = [
        DeclareLaunchArgument(
            "scene",
            default_value="",
            description="What lies on the bench's table; by default config/scenes/inclusion_scan.yaml.",
        ),
        DeclareLaunchArgument(
            "real_time",
            default_value="",
            choices=["", "true", "false"],
            description="true: on the wall clock, for tests of load and limits. false (default): in simulated "
            "time (clock, use_sim_time), in which a slow machine takes longer and nothing else.",
        ),
    ]
    include = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(bringup),
        launch_arguments={"use_mock_hardware": "true"}.items(),
    )
    return LaunchDescription([*arguments, include])
