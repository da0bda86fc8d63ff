"""The legs of the default robot."""

from ember_ros.params import Params

LEGS = Params().robot.legs
