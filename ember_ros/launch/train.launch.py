"""Starts the trainer: one leg learns alone and fills the table that four legs walk with later.

    ros2 launch ember_ros train.launch.py cycles:=3000 save:=trained.npz

The graph and the arguments are those of walk.launch.py, with the trainer as the world.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


def generate_launch_description() -> LaunchDescription:
    """Include walk.launch.py with the trainer as its world."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "world", default_value="trainer", choices=["trainer"], description="the trainer"
            ),
            # A path as plain text: for a substitution, --show-args would list no arguments.
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(Path(__file__).with_name("walk.launch.py")))
            ),
        ]
    )
