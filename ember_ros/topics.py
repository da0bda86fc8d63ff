"""The only table of names, types and qualities of service on the graph.

All names are relative, ``clock`` included: a namespace makes a second robot on the same machine.

=========================  ==========================  ==========================================
name                       type                        carries
=========================  ==========================  ==========================================
``clock``                  rosgraph_msgs/Clock         simulated time: tick times tick length
``cpg/phase``              sensor_msgs/JointState      stamp, and cycles since the start, unwrapped
``<leg>/joint_states``     sensor_msgs/JointState      hip, knee: rad and rad/s
``<leg>/contact``          sensor_msgs/JointState      what the foot feels, see ``wire.CONTACT``
``<leg>/command``          sensor_msgs/JointState      hip, knee: rad/s and largest N m
``<leg>/transition``       sensor_msgs/JointState      state, action, reward by term, next state:
                                                       see ``wire.TRANSITION``
``falls``                  std_msgs/Int64              falls so far
``odometry``               nav_msgs/Odometry           the body's pose, for viewers and bags
``diagnostics``            diagnostic_msgs/            who is absent, what was refused
                           DiagnosticArray
``recorder/tick``          std_msgs/Int64              the last tick a recorder node heard
``run/card``               std_msgs/String             in bags only: what determined the run
``run/values``             std_msgs/Float64MultiArray  in bags only: the table at the start
``run/visits``             std_msgs/Int64MultiArray    the same, how often each cell was visited
``run/crc``                std_msgs/UInt32MultiArray   in bags only: CRC-32 of each leg's senses
``table/push`` (service)   rcl_interfaces/             a leg's pairs of one epoch
                           SetParametersAtomically
``table/pull`` (service)   rcl_interfaces/             the table, or what changed in it
                           GetParameters
``table/save`` (service)   std_srvs/Trigger            write the table now
``table/learning``         std_srvs/SetBool            whether pushes are merged
=========================  ==========================  ==========================================

Types are named, and looked up when a node needs them: what only talks about messages needs no ROS.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import rclpy.service
    from rclpy.client import Client
    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription

HELD = 16
"""Messages that a subscription holds until they are heard."""

JOINT_STATE = "sensor_msgs/msg/JointState"


def class_of(kind: str) -> Any:
    """Return the class of a message or service named as ``std_msgs/msg/Float64``."""
    package, folder, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


def latest(depth: int = 1) -> QoSProfile:
    """Return the one quality of service here: who joins late gets the latest, nothing is lost."""
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


class Topic(NamedTuple):
    """A topic's name and message type."""

    name: str
    kind: str

    def publish(self, node: Node) -> Publisher:
        """Return a new publisher of ``node``."""
        return node.create_publisher(class_of(self.kind), self.name, latest())

    def subscribe(
        self, node: Node, hear: Callable[[bytes], None], *, held: int = HELD
    ) -> Subscription:
        """Return a new subscription of ``node`` that hears serialized messages.

        It holds more than the latest: a second publisher must not push the first one's out. A
        publisher that it cannot hear is told of, with what would be right.
        """
        from rclpy.event_handler import SubscriptionEventCallbacks
        from rclpy.qos import qos_policy_name_from_kind

        def cannot_hear(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            node.get_logger().warning(
                f"a publisher of {node.resolve_topic_name(self.name)} cannot be heard for its "
                f"{policy}: reliable and transient_local, keeping the last, would be right"
            )

        return node.create_subscription(
            class_of(self.kind),
            self.name,
            hear,
            latest(held),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=cannot_hear),
            raw=True,
        )


class Service(NamedTuple):
    """A service's name and type."""

    name: str
    kind: str

    def serve(self, node: Node, answer: Callable[[Any, Any], Any]) -> rclpy.service.Service:
        """Return a new service of ``node``."""
        return node.create_service(class_of(self.kind), self.name, answer)

    def call(self, node: Node) -> Client:
        """Return a new client of ``node``."""
        return node.create_client(class_of(self.kind), self.name)


CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock")
PHASE = Topic("cpg/phase", JOINT_STATE)
BARE_PHASE = Topic("cpg/phase", "std_msgs/msg/Float64")
"""Of bags of before the phase had a stamp: a multiple of 1 / ``gait.ticks``."""
FALLS = Topic("falls", "std_msgs/msg/Int64")
ODOMETRY = Topic("odometry", "nav_msgs/msg/Odometry")
DIAGNOSTICS = Topic("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
RECORDED = Topic("recorder/tick", "std_msgs/msg/Int64")

RUN_METADATA = Topic("run/card", "std_msgs/msg/String")
VALUES = Topic("run/values", "std_msgs/msg/Float64MultiArray")
VISITS = Topic("run/visits", "std_msgs/msg/Int64MultiArray")
CRC = Topic("run/crc", "std_msgs/msg/UInt32MultiArray")

PUSH = Service("table/push", "rcl_interfaces/srv/SetParametersAtomically")
PULL = Service("table/pull", "rcl_interfaces/srv/GetParameters")
SAVE = Service("table/save", "std_srvs/srv/Trigger")
LEARNING = Service("table/learning", "std_srvs/srv/SetBool")


def joint_states(leg: str) -> Topic:
    """Return the topic of a leg's joint angles and speeds."""
    return Topic(f"{leg}/joint_states", JOINT_STATE)


def contact(leg: str) -> Topic:
    """Return the topic of what a leg's foot feels."""
    return Topic(f"{leg}/contact", JOINT_STATE)


def command(leg: str) -> Topic:
    """Return the topic of what a leg asks of its motors."""
    return Topic(f"{leg}/command", JOINT_STATE)


def transition(leg: str) -> Topic:
    """Return the topic of a leg's transitions: what it did, its reward, and what came of it."""
    return Topic(f"{leg}/transition", JOINT_STATE)
