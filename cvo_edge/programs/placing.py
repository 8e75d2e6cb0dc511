"""In which frames other programs see a pose, as options state it."""

from __future__ import annotations

from typing import NamedTuple

from cvo_edge.errors import UsageError
from cvo_edge.output.messages import Placement
from cvo_edge.output.records import Header
from cvo_edge.pose import Pose


class Placing(NamedTuple):
    """The options of these names; None was not given.

    ``base`` and ``map`` are ``tx,ty,tz,qx,qy,qz,qw``, metres and a unit quaternion;
    ``unknown_variance`` is in m^2 and rad^2.
    """

    base: str | None
    map: str | None
    frame_id: str | None
    child_frame_id: str | None
    unknown_variance: float | None

    @property
    def stated(self) -> bool:
        """Whether any of the options was given."""
        return any(each is not None for each in self)

    def placement(self, header: Header) -> Placement | None:
        """Return what the options say, or None if they say nothing.

        Raises UsageError for a pose that is none.
        """
        if not self.stated:
            return None
        # A frame that is moved is no longer the bundle's: REP 105 has names for it.
        return Placement(
            self.frame_id or (header.frame_id if self.map is None else "map"),
            self.child_frame_id or (header.child_frame_id if self.base is None else "base_link"),
            _pose("--base", self.base),
            _pose("--map", self.map),
            self.unknown_variance,
        )


def _pose(option: str, text: str | None) -> Pose | None:
    if text is None:
        return None
    try:
        return Pose.from_array([float(word) for word in text.split(",")])
    except (ValueError, UsageError):
        raise UsageError(
            f"{option}: expected tx,ty,tz,qx,qy,qz,qw in metres and a quaternion, found {text}"
        ) from None
