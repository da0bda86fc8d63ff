"""ember_ros: legs that learn to walk, each a module of its own, on a ROS 2 graph.

After D. Jacob, D. Polani and C. L. Nehaniv, "Legs that can walk: Embodiment-Based Modular
Reinforcement Learning applied" (2005).

The pure parts (``signals``, ``params``, ``errors``, ``kinematics`` here, and everything in
``leg_node`` and ``cpg_node`` but their node files) import neither ROS nor PyBullet; a test holds
them to it.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ember_ros")
except PackageNotFoundError:  # a bare checkout on the path
    __version__ = "unknown"
