"""Starts a sim_node, a cpg_node, a table_node and one leg_node per leg, each in its own process.

    ros2 launch ember_ros walk.launch.py table:=trained.npz cycles:=500 gui:=true

train.launch.py starts the same graph with the trainer as its world and one leg. When one node ends
(the sim_node after its cycles, or any node after an error), all nodes stop and the table is saved.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from ember_ros.params import TRAINER_LEG
from ember_ros.params_file import robot_legs

UNSET = "; empty: the value in params_file, or the node's default"

ARGUMENTS = {
    "world": ("walker", "walker: four legs carry a body; trainer: one leg learns alone"),
    "namespace": ("", "namespace of all nodes and topics; another one makes a second robot"),
    "params_file": ("", "ROS parameter file for all nodes; launch arguments override it"),
    "table": ("", "file with the table to start from" + UNSET),
    "save": ("", "file to write the table to at exit" + UNSET),
    "cycles": ("", "number of cycles of the pattern generator, then stop" + UNSET),
    "seed": ("", "seed of the world and the legs" + UNSET),
    "gui": ("", "show PyBullet's window" + UNSET),
    "bag": ("", "folder of a new bag to record the run into; empty: none"),
    "mode": ("", "lockstep: wait for all commands; realtime: never" + UNSET),
}


def start(context: LaunchContext) -> list[Node]:
    """Return all nodes of the graph, with the launch arguments as their parameters."""
    argument = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    trainer = argument["world"] == "trainer"
    stage = {"stage": "train" if trainer else "walk"}
    # Neither a shell nor rcl expands the ~ in `params_file:=~/mine.yaml`. In the other arguments
    # the nodes expand it.
    params_file = (
        [str(Path(argument["params_file"]).expanduser())] if argument["params_file"] else []
    )

    def parameters_of(**kinds: type) -> dict[str, ParameterValue]:
        """Return the arguments of these names that are not empty, as typed parameters."""
        # A substitution, not its text: launch_ros converts only substitutions to a type.
        return {
            name: ParameterValue(LaunchConfiguration(name), value_type=kind)
            for name, kind in kinds.items()
            if argument[name]
        }

    def node(executable: str, name: str, parameters: dict[str, object]) -> Node:
        """Return a node of this package; its parameters override those of params_file.

        When one node ends, all nodes stop, because none works without the others.
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
            parameters_of(world=str, cycles=int, seed=int, gui=bool, mode=str, bag=str),
        ),
        node("cpg_node", "cpg_node", parameters_of(world=str)),
        node("table_node", "table_node", {**stage, **parameters_of(table=str, save=str, seed=int)}),
        *(
            node("leg_node", f"leg_{leg}", {"leg": leg, **stage, **parameters_of(seed=int)})
            for leg in ((TRAINER_LEG,) if trainer else robot_legs(params_file))
        ),
    ]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments; the nodes are created once the values are known."""
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
