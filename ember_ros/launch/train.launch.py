"""Starts the trainer: one leg alone, which fills the table that four legs walk with later.

    ros2 launch ember_ros train.launch.py cycles:=3000 save:=trained.npz

The graph and its arguments are those of walk.launch.py, with the trainer as its world.
"""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution, ThisLaunchFileDir


def generate_launch_description() -> LaunchDescription:
    """Include walk.launch.py with the trainer as its world."""
    return LaunchDescription(
        [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    PathJoinSubstitution([ThisLaunchFileDir(), "walk.launch.py"])
                ),
                launch_arguments={"world": "trainer"}.items(),
            )
        ]
    )
