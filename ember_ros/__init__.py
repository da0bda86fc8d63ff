"""ember_ros: legs that learn to walk, each a module of its own, on a ROS 2 graph.

After D. Jacob, D. Polani and C. L. Nehaniv, "Legs that can walk: Embodiment-Based Modular
Reinforcement Learning applied" (2005).

For a notebook: ``import ember_ros as er``, then ``er.train()``, ``er.walk(table=...)``; see
``docs/PYTHON.md``. The names below are found when they are first used: every node imports this
package, and most of them need none of it.

The pure parts (``signals``, ``params``, ``errors``, ``kinematics`` here, and everything in
``leg_node`` and ``cpg_node`` but their node files) import neither ROS nor PyBullet; a test holds
them to it.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Any

    from cpg_node.cpg import CentralPatternGenerator
    from ember_ros.api import load, make_params, train, walk
    from ember_ros.errors import EmberError
    from ember_ros.params import Params
    from ember_ros.result import QTable, Run, SavedRun
    from ember_ros.signals import Beat, BodyState, LegCommand, LegSense, TDUpdate, Transition
    from ember_ros.worlds import World
    from leg_node.assembly import make_leg
    from leg_node.discretizer import Discretizer
    from leg_node.gait import Gait, GaitStep
    from leg_node.learner import Learner
    from leg_node.policy import Policy
    from leg_node.reward import RewardFunction
    from leg_node.value import ValueEstimate
    from sim_node.contract import check_world

    __version__: str

__all__ = [
    "Beat",
    "BodyState",
    "CentralPatternGenerator",
    "Discretizer",
    "EmberError",
    "Gait",
    "GaitStep",
    "Learner",
    "LegCommand",
    "LegSense",
    "Params",
    "Policy",
    "QTable",
    "RewardFunction",
    "Run",
    "SavedRun",
    "TDUpdate",
    "Transition",
    "ValueEstimate",
    "World",
    "check_world",
    "load",
    "make_leg",
    "make_params",
    "train",
    "walk",
]

_HOMES = {
    "cpg_node.cpg": "CentralPatternGenerator",
    "ember_ros.api": "load make_params train walk",
    "ember_ros.errors": "EmberError",
    "ember_ros.params": "Params",
    "ember_ros.result": "QTable Run SavedRun",
    "ember_ros.signals": "Beat BodyState LegCommand LegSense TDUpdate Transition",
    "leg_node.assembly": "make_leg",
    "leg_node.discretizer": "Discretizer",
    "leg_node.gait": "Gait GaitStep",
    "leg_node.learner": "Learner",
    "leg_node.policy": "Policy",
    "leg_node.reward": "RewardFunction",
    "leg_node.value": "ValueEstimate",
    "sim_node.contract": "check_world",
    "ember_ros.worlds": "World",
}
"""The modules that the names come from."""


if not TYPE_CHECKING:  # a type checker would take any name for one of these

    def __getattr__(name: str) -> "Any":
        """Return one of ``__all__``, or the version, and keep it."""
        import importlib

        if name == "__version__":
            from ember_ros.versions import version

            found = version()
        else:
            homes = [home for home, names in _HOMES.items() if name in names.split()]
            if not homes:
                raise AttributeError(f"module 'ember_ros' has no attribute {name!r}")
            found = getattr(importlib.import_module(homes[0]), name)
        globals()[name] = found
        return found


def __dir__() -> list[str]:
    """Return the names that are there, and those that are found when they are used."""
    return sorted({*globals(), *__all__, "__version__"})
