# SPDX-License-Identifier: Apache-2.0
"""How a surgery stack takes in two sensors: mock.launch.py twice, in two namespaces, a topic remapped.

Copy it into the stack. Here both sensors are simulated, each with a robot of its own in a time of its own;
ur.launch.py is included in the same way.
"""

from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import SetRemap
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "tactile_resonance"
SENSORS = {"left": "127.0.1.2", "right": "127.0.1.3"}


def generate_launch_description():
    """Arguments of the stack, and each sensor in a group of its own: what is set there stays there.

    All other arguments of mock.launch.py hold for both: scene, discovery, rviz ...
    """
    arguments = [
        DeclareLaunchArgument(
            f"{name}_robot_ip", default_value=ip, description=f"Address of the {name} robot."
        )
        for name, ip in SENSORS.items()
    ]
    return LaunchDescription([*arguments, *(_sensor(name) for name in SENSORS)])


def _sensor(name):
    mock = PathJoinSubstitution([FindPackageShare(PACKAGE), "launch", "mock.launch.py"])
    return GroupAction(
        [
            # the stack's name for what this sensor finds; all other topics stay under the namespace
            SetRemap(src="poles", dst=f"/stack/tissue/{name}/poles"),
            SetRemap(src="point_result", dst=f"/stack/tissue/{name}/point_result"),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(mock),
                launch_arguments={
                    "namespace": name,
                    "robot_ip": LaunchConfiguration(f"{name}_robot_ip"),
                    "base_frame": f"{name}_base",
                    "run_folder": f"runs/{name}",
                }.items(),
            ),
        ]
    )
