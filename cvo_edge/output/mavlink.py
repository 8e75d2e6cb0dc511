"""Poses for an autopilot, as MAVLink messages VISION_POSITION_ESTIMATE.

The message ODOMETRY is not used: it has velocities, which a single frame does not give, and an
autopilot that takes zeros or NaN for them falls. A heartbeat a second tells the autopilot that the
odometer is alive; a frame that must not be believed is not sent at all, see ``messages``.

Axes are the autopilot's: the placement has to map the bundle's world to north, east, down, and the
camera to forward, right, down. Angles are roll, pitch and yaw, R = Rz Ry Rx; their covariance is
M^-1 Sigma M^-T with the axes M = [Rz Ry ex, Rz ey, ez] that they turn about.
"""

from __future__ import annotations

import io
import math
import socket
from contextlib import redirect_stdout
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.covariance import euler_axes
from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.output.messages import Placement, spoken
from cvo_edge.pose import Pose

Array = NDArray[np.float64]

_UPPER = np.triu_indices(6)
# Close to straight up or down, roll and yaw are the same rotation.
_LEVEL_ENOUGH = math.radians(85.0)
# A pose after a pause, or one that no vehicle can have reached, is a reset of the estimate.
_PAUSE_S, _FASTEST_MPS = 1.0, 50.0
_HEARTBEAT_S = 1.0


class MavlinkSink:
    """Sends the pose of every frame that may be believed.

    Parameters
    ----------
    address
        As pymavlink has it: ``udpout:HOST:PORT``, ``tcp:HOST:PORT``, or a serial device,
        ``/dev/ttyUSB0:BAUD``.
    placement
        Maps to north, east, down, and to forward, right, down.

    Attributes
    ----------
    sent
        Number of poses sent.

    Raises UsageError if pymavlink is not installed, and SinkError if the address does not open.
    """

    def __init__(self, address: str, placement: Placement, clock: Clock = SYSTEM_CLOCK) -> None:
        try:
            # Version 2 alone has the reset counter.
            from pymavlink import mavutil
            from pymavlink.dialects.v20 import common
        except ImportError:
            raise UsageError(
                'mavlink: pymavlink is not installed; pip install "cvo-edge[mavlink]"'
            ) from None
        self._address, self._placement, self._clock = address, placement, clock
        self._kinds: Any = common
        device, _, baud = address.rpartition(":")
        serial = device.startswith("/dev/") and baud.isdecimal()
        try:
            # What it prints of a refused connection would be among the records.
            with redirect_stdout(io.StringIO()):
                self._link: Any = mavutil.mavlink_connection(
                    device if serial else address,
                    baud=int(baud) if serial else 115200,
                )
            if isinstance(self._link, mavutil.mavudp) and not self._link.udp_server:
                self._resolve()
        # pyserial's errors are OSErrors; a malformed address ends in any of the others.
        except (OSError, ValueError, IndexError, OverflowError) as error:
            raise SinkError(f"mavlink: {address} does not open: {error}") from None
        component = common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._messages: Any = common.MAVLink(self._link, srcSystem=1, srcComponent=component)
        self.sent = 0
        self._resets = 0
        self._last: tuple[int, Pose] | None = None
        self._beat_s = -math.inf

    def __enter__(self) -> MavlinkSink:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the link."""
        self._link.close()

    def write(self, estimate: PoseInterval) -> None:
        """Send a frame's pose if it may be believed.

        Raises SinkError if the link fails, and UsageError for a frame without a stamp.
        """
        try:
            self._beat()
            said = spoken(estimate, self._placement)
            if said is None:
                return
            if estimate.stamp_ns is None:
                raise UsageError("mavlink: expected a stamp for every frame; give --fps")
            turn = geometry.quaternion_to_euler_zyx(said.pose.q_xyzw)
            if abs(turn[1]) > _LEVEL_ENOUGH:
                return
            to_angles = np.eye(6)
            to_angles[3:, 3:] = np.linalg.inv(euler_axes(turn))
            covariance = to_angles @ said.covariance @ to_angles.T
            self._resets = (self._resets + self._is_reset(estimate.stamp_ns, said.pose)) % 256
            self._last = estimate.stamp_ns, said.pose
            self._messages.vision_position_estimate_send(
                max(0, estimate.stamp_ns) // 1000,
                *said.pose.t_m.tolist(),
                *turn.tolist(),
                covariance[_UPPER].tolist(),
                self._resets,
            )
            self.sent += 1
        except OSError as error:
            raise SinkError(f"mavlink: {self._address}: {error}") from None

    def _resolve(self) -> None:
        """Look up the destination of a link by UDP once, which drops what it cannot send.

        Raises OSError for a name that is not known, and ValueError for no port; the link is then
        closed.
        """
        host, port = self._link.destination_addr
        try:
            if not 0 < port < 1 << 16:
                raise ValueError(f"expected a port from 1 to 65535, found {port}")
            self._link.destination_addr = socket.gethostbyname(host), port
        except BaseException:
            self._link.close()
            raise

    def _beat(self) -> None:
        now = self._clock.now_s()
        if now - self._beat_s < _HEARTBEAT_S:
            return
        self._beat_s = now
        kinds = self._kinds
        self._messages.heartbeat_send(
            kinds.MAV_TYPE_ONBOARD_CONTROLLER, kinds.MAV_AUTOPILOT_INVALID, 0, 0, 0
        )

    def _is_reset(self, stamp_ns: int, pose: Pose) -> bool:
        if self._last is None:
            return False
        seconds = 1e-9 * (stamp_ns - self._last[0])
        moved = float(np.linalg.norm(pose.t_m - self._last[1].t_m))
        return not 0.0 < seconds <= _PAUSE_S or moved > _FASTEST_MPS * seconds
