"""The only table of names, types and qualities of service on the graph.

All names are relative, ``clock`` included: a namespace makes a second robot on the same machine.

=========================  ==========================  ==========================================
name                       type                        carries
=========================  ==========================  ==========================================
``clock``                  rosgraph_msgs/Clock         simulated time: tick times tick length
``cpg/phase``              std_msgs/Float64            cycles since the start, unwrapped
``<leg>/joint_states``     sensor_msgs/JointState      hip, knee: rad and rad/s
``<leg>/contact``          sensor_msgs/JointState      what the foot feels, see ``wire.CONTACT``
``<leg>/command``          sensor_msgs/JointState      hip, knee: rad/s and largest N m
``falls``                  std_msgs/Int64              falls so far
``odometry``               nav_msgs/Odometry           the body's pose, for viewers only
``diagnostics``            diagnostic_msgs/            who is absent, what was refused
                           DiagnosticArray
``table/push`` (service)   rcl_interfaces/             a leg's pairs of one epoch
                           SetParametersAtomically
``table/pull`` (service)   rcl_interfaces/             the table, or what changed in it
                           GetParameters
``table/save`` (service)   std_srvs/Trigger            write the table now
``table/learning``         std_srvs/SetBool            whether pushes are merged
=========================  ==========================  ==========================================
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import rclpy.service
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.client import Client
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Int64
from std_srvs.srv import SetBool, Trigger

LATEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""For everything a tick depends on: who joins late gets the latest, nothing is lost."""

VIEW = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
"""For viewers: never holds up the robot."""

HELD = 16
"""Messages that a subscription holds until they are heard."""


class Topic(NamedTuple):
    """A topic's name, message type and quality of service."""

    name: str
    type: Any
    qos: QoSProfile = LATEST

    def publish(self, node: Node) -> Publisher:
        """Return a new publisher of ``node``."""
        return node.create_publisher(self.type, self.name, self.qos)

    def subscribe(self, node: Node, hear: Callable[[bytes], None]) -> Subscription:
        """Return a new subscription of ``node`` that hears serialized messages.

        It holds more than the latest: a second publisher must not push the first one's out.
        """
        qos = QoSProfile(
            history=self.qos.history,
            depth=HELD,
            reliability=self.qos.reliability,
            durability=self.qos.durability,
        )
        return node.create_subscription(self.type, self.name, hear, qos, raw=True)


class Service(NamedTuple):
    """A service's name and type."""

    name: str
    type: Any

    def serve(self, node: Node, answer: Callable[[Any, Any], Any]) -> rclpy.service.Service:
        """Return a new service of ``node``."""
        return node.create_service(self.type, self.name, answer)

    def call(self, node: Node) -> Client:
        """Return a new client of ``node``."""
        return node.create_client(self.type, self.name)


CLOCK = Topic("clock", Clock)
PHASE = Topic("cpg/phase", Float64)
FALLS = Topic("falls", Int64)
ODOMETRY = Topic("odometry", Odometry, VIEW)
DIAGNOSTICS = Topic("diagnostics", DiagnosticArray)

PUSH = Service("table/push", SetParametersAtomically)
PULL = Service("table/pull", GetParameters)
SAVE = Service("table/save", Trigger)
LEARNING = Service("table/learning", SetBool)


def joint_states(leg: str) -> Topic:
    """Return the topic of a leg's joint angles and speeds."""
    return Topic(f"{leg}/joint_states", JointState)


def contact(leg: str) -> Topic:
    """Return the topic of what a leg's foot feels."""
    return Topic(f"{leg}/contact", JointState)


def command(leg: str) -> Topic:
    """Return the topic of what a leg asks of its motors."""
    return Topic(f"{leg}/command", JointState)
