"""All topics and services of the graph: names, types and quality of service.

All names are relative, ``clock`` included, so a namespace makes a second robot on one machine.

=========================  ==========================  ==========================================
name                       type                        carries
=========================  ==========================  ==========================================
``clock``                  rosgraph_msgs/Clock         simulated time: tick times tick length
``cpg/phase``              sensor_msgs/JointState      stamp, and cycles since the start, unwrapped
``<leg>/joint_states``     sensor_msgs/JointState      hip, knee: rad and rad/s
``<leg>/contact``          sensor_msgs/JointState      foot sensors, see ``wire.CONTACT``
``<leg>/command``          sensor_msgs/JointState      hip, knee: rad/s and maximum torque, N m
``<leg>/transition``       sensor_msgs/JointState      state, action, reward by term, next state:
                                                       see ``wire.TRANSITION``
``falls``                  std_msgs/Int64              falls so far
``odometry``               nav_msgs/Odometry           the body's pose, for viewers and bags
``diagnostics``            diagnostic_msgs/            absent legs, number of refused messages
                           DiagnosticArray
``recorder/tick``          std_msgs/Int64              the last tick a recorder node heard
``run/card``               std_msgs/String             in bags only: what determined the run
``run/values``             std_msgs/Float64MultiArray  in bags only: the table at the start
``run/visits``             std_msgs/Int64MultiArray    in bags only: its visits of each cell
``run/crc``                std_msgs/UInt32MultiArray   in bags only: CRC-32 of each leg's senses
``table/push`` (service)   rcl_interfaces/             a leg's table updates of one epoch
                           SetParametersAtomically
``table/pull`` (service)   rcl_interfaces/             the table, or what changed in it
                           GetParameters
``table/save`` (service)   std_srvs/Trigger            write the table now
``table/learning``         std_srvs/SetBool            whether pushes are merged
(service)
=========================  ==========================  ==========================================

Types are stored by name and imported when a node needs them, so this module works without ROS.
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

DEPTH = 16
"""Queue depth of a subscription: messages that wait for the callback."""

JOINT_STATE = "sensor_msgs/msg/JointState"


def class_of(kind: str) -> Any:
    """Return the class of a message or service named as ``std_msgs/msg/Float64``."""
    package, folder, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


def latest(depth: int = 1) -> QoSProfile:
    """Return the quality of service of all topics: a late joiner receives the latest message.

    It is reliable and transient local, and keeps the last ``depth`` messages.
    """
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
        self, node: Node, callback: Callable[[bytes], None], *, depth: int = DEPTH
    ) -> Subscription:
        """Return a new subscription of ``node``; ``callback`` receives serialized messages.

        The queue holds more than one message, so that a second publisher does not push out those of
        the first. A publisher with an incompatible quality of service is logged as a warning.
        """
        from rclpy.event_handler import SubscriptionEventCallbacks
        from rclpy.qos import qos_policy_name_from_kind

        def on_incompatible_qos(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            node.get_logger().warning(
                f"no messages from a publisher of {node.resolve_topic_name(self.name)}: its "
                f"{policy} is incompatible; reliable, transient_local and keep_last would be right"
            )

        return node.create_subscription(
            class_of(self.kind),
            self.name,
            callback,
            latest(depth),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=on_incompatible_qos),
            raw=True,
        )


class Service(NamedTuple):
    """A service's name and type."""

    name: str
    kind: str

    def serve(self, node: Node, callback: Callable[[Any, Any], Any]) -> rclpy.service.Service:
        """Return a new service of ``node``; ``callback`` fills in the response to a request."""
        return node.create_service(class_of(self.kind), self.name, callback)

    def call(self, node: Node) -> Client:
        """Return a new client of ``node``."""
        return node.create_client(class_of(self.kind), self.name)


CLOCK = Topic("clock", "rosgraph_msgs/msg/Clock")
PHASE = Topic("cpg/phase", JOINT_STATE)
BARE_PHASE = Topic("cpg/phase", "std_msgs/msg/Float64")
"""In older bags, whose phase has no stamp: a multiple of 1 / ``gait.ticks``."""
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
    """Return the topic of a leg's foot sensors."""
    return Topic(f"{leg}/contact", JOINT_STATE)


def command(leg: str) -> Topic:
    """Return the topic of the commands for a leg's motors."""
    return Topic(f"{leg}/command", JOINT_STATE)


def transition(leg: str) -> Topic:
    """Return the topic of a leg's transitions: state, action, reward and next state."""
    return Topic(f"{leg}/transition", JOINT_STATE)
