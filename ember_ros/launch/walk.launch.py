"""Starts a world, a pattern generator, a table and one leg node a leg, each a process of its own.

    ros2 launch ember_ros walk.launch.py table:=trained.npz cycles:=500 gui:=true

The trainer is the same graph with another world and one leg, which train.launch.py starts. When
one of them ends (the world because its cycles are over, any because it fails), everything stops,
and the table is saved.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from ember_ros.params import TRAINER_LEG
from ember_ros.params_file import robot_legs

UNSET = "; empty: the node's own default, or what params_file says"

ARGUMENTS = {
    "world": ("walker", "walker: four legs carry a body; trainer: one leg learns alone"),
    "namespace": ("", "namespace of every node and topic; another one makes a second robot"),
    "params_file": ("", "file of ROS parameters for every node; the arguments here come first"),
    "table": ("", "file with the table to start from" + UNSET),
    "save": ("", "file to write the table to at exit" + UNSET),
    "cycles": ("", "stop after so many cycles of the pattern generator" + UNSET),
    "seed": ("", "seed of the world and the legs" + UNSET),
    "gui": ("", "show PyBullet's window" + UNSET),
    "bag": ("", "folder of a new bag to record the run into; empty: none"),
    "mode": ("", "lockstep: wait for all commands; realtime: never" + UNSET),
}


def start(context: LaunchContext) -> list[Node]:
    """Return one node for each part of the graph, with the parameters given as arguments."""
    argument = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    trainer = argument["world"] == "trainer"
    stage = {"stage": "train" if trainer else "walk"}
    # Neither a shell nor rcl expands the ~ of `params_file:=~/mine.yaml`; of others, the nodes do.
    params_file = (
        [str(Path(argument["params_file"]).expanduser())] if argument["params_file"] else []
    )

    def given(**kinds: type) -> dict[str, ParameterValue]:
        """Return the arguments of these names that are not empty, as parameters of these types."""
        # Of the argument and not of its text: launch_ros turns nothing but substitutions into
        # numbers.
        return {
            name: ParameterValue(LaunchConfiguration(name), value_type=kind)
            for name, kind in kinds.items()
            if argument[name]
        }

    def node(executable: str, name: str, parameters: dict[str, object]) -> Node:
        """Return a node of this package; its parameters win over those of params_file.

        No node is of use without the others: when one ends, all do.
        """
        return Node(
            package="ember_ros",
            executable=executable,
            name=name,
            namespace=argument["namespace"],
            parameters=[*params_file, parameters] if parameters else params_file,
            output="screen",
            on_exit=[Shutdown(reason=f"{name} has ended")],
        )

    return [
        node(
            "sim_node",
            "sim_node",
            given(world=str, cycles=int, seed=int, gui=bool, mode=str, bag=str),
        ),
        node("cpg_node", "cpg_node", given(world=str)),
        node("table_node", "table_node", {**stage, **given(table=str, save=str, seed=int)}),
        *(
            node("leg_node", f"leg_{leg}", {"leg": leg, **stage, **given(seed=int)})
            for leg in ((TRAINER_LEG,) if trainer else robot_legs(params_file))
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; what they start is decided once their values are known."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
