"""The node ``odometry``: subscriptions, publishers and a thread around ``estimation``."""

from __future__ import annotations

import sys
from threading import Thread
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from cvo_edge.camera import Camera
from cvo_edge.errors import CvoError
from cvo_edge_ros.estimation import PARAMETERS, answers, camera_of, settings_of
from cvo_edge_ros.filling import filled, message_class
from cvo_edge_ros.newest import Newest

# Cameras publish with best effort, and an old image is of no use.
NEWEST_IMAGE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
_QUEUE = 10
_REMINDER_S = 5.0


class Odometry(Node):  # type: ignore[misc] # rclpy has no types
    """Gives images to the odometer and publishes what it says.

    Attributes
    ----------
    failure
        The error that ended it, or None.

    Raises UsageError for parameters that cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("cvo_edge")
        values = {
            name: self.declare_parameter(name, default).value
            for name, default in PARAMETERS.items()
        }
        self.failure: CvoError | None = None
        self._settings = settings_of(values)
        self._arrivals = Newest()
        self._senders: dict[str, Any] = {}
        self._worker: Thread | None = None
        kind = CompressedImage if self._settings.compressed else Image
        self.create_subscription(kind, self._settings.image_topic, self._arrivals.put, NEWEST_IMAGE)
        info = self._settings.info_topic
        if info is None:
            self._start(None)
            return
        self.create_subscription(CameraInfo, info, self._on_camera, NEWEST_IMAGE)
        self._reminder = self.create_timer(_REMINDER_S, self._remind)

    def _on_camera(self, info: Any) -> None:
        if self._worker is not None or self.failure is not None:
            return
        self._reminder.cancel()
        try:
            self._start(camera_of(info, self.resolve_topic_name(self._settings.image_topic)))
        except CvoError as error:
            self._end(error)

    def _remind(self) -> None:
        self.get_logger().warning(
            f"waiting for {self._settings.info_topic}; set camera_info_topic, to none for the "
            "bundle's own camera"
        )

    def _start(self, camera: Camera | None) -> None:
        self._worker = Thread(target=self._work, args=(camera,), name="cvo-edge", daemon=True)
        self._worker.start()

    def _work(self, camera: Camera | None) -> None:
        try:
            clock = self.get_clock()
            for answer in answers(
                self._settings, camera, self._arrivals, lambda: int(clock.now().nanoseconds)
            ):
                if answer.news is not None:
                    self.get_logger().info(answer.news)
                for message in answer.messages:
                    self._send(message.topic, message.type, message.content)
        except CvoError as error:
            self._end(error)

    def _send(self, topic: str, kind: str, content: Any) -> None:
        sender = self._senders.get(topic)
        if sender is None:
            # Ours are relative, so that a namespace holds several cameras.
            name = topic.removeprefix("/") if topic.startswith("/cvo/") else topic
            sender = self.create_publisher(message_class(kind), name, _QUEUE)
            self._senders[topic] = sender
        sender.publish(filled(kind, content))

    def _end(self, error: CvoError) -> None:
        self.failure = error
        self.get_logger().fatal(str(error))
        rclpy.try_shutdown()

    def close(self) -> None:
        """Finish the frame at work, and end the thread."""
        self._arrivals.close()
        if self._worker is not None:
            self._worker.join(2.0)


def main() -> None:
    """Run the node; its exit codes are those of ``cvo-edge``."""
    rclpy.init()
    node = None
    try:
        node = Odometry()
        rclpy.spin(node)
    except CvoError as error:
        sys.exit(_complaint(error))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    if node is not None and node.failure is not None:
        sys.exit(node.failure.exit_code)


def _complaint(error: CvoError) -> int:
    print(f"cvo_edge: {error}", file=sys.stderr)
    return error.exit_code
