"""Recordings of the viewer rerun, and a viewer that watches a run.

What a frame may show is decided by ``messages.spoken``: a frame that may not say a pose clears the
camera, its box and the bands, so that nothing of an earlier frame is seen in its place.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.output.messages import Placement, StoredImage, spoken
from cvo_edge.output.named import opened_empty
from cvo_edge.output.records import Header
from cvo_edge.record import Status

Look = Callable[[], NDArray[Any] | None]

_APPLICATION = "cvo-edge"
# On this machine alone: an SSH tunnel may end here.
_HOST, _PORT = "127.0.0.1", 9876
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
_LEVELS = {Status.OK: "INFO", Status.DEGRADED: "WARN", Status.INVALID: "ERROR"}
_COLOURS = ((120, 120, 120), (40, 140, 255), (120, 120, 120))
_SECONDS_TO_FINISH = 10.0
# Images for a viewer are not kept: small ones are sent faster.
_WIDEST_PX, _JPEG_QUALITY = 640, 80


def _library() -> Any:  # noqa: ANN401 - an optional module
    """Return the module rerun; raises UsageError if it is not installed."""
    try:
        import rerun
    except ImportError:
        raise UsageError('rerun: not installed; pip install "cvo-edge[rerun]"') from None
    return rerun


class RerunSink:
    """Logs estimates for the viewer; used like ``Sink``.

    Entities: ``world/camera`` (pose), ``world/path``, ``world/box`` (the set of the position),
    ``bands/DOF`` (lower, pose and upper, m or rad, in the chart of the records), ``latency/STAGE``
    (ms), ``status`` and ``image``; timelines ``frame`` and, for frames with a stamp, ``stamp``.

    Parameters
    ----------
    path
        The recording, replaced when the first frame is written; None shows the frames in a viewer.
    header
        What all records share.
    placement
        Where the estimates are seen from.
    look
        Gives the image of the last frame, BGR, to be shown with it.

    Raises UsageError if rerun is missing, or there is no viewer and none can be opened.
    """

    def __init__(
        self, path: str | None, header: Header, placement: Placement, look: Look | None = None
    ) -> None:
        if path == "-":
            raise UsageError("rrd: expected a file, found standard output")
        self._rr = _library()
        self._path, self._header, self._placement, self._look = path, header, placement, look
        self._stream: Any = None
        self._copy: _Copy | None = None
        self._last: NDArray[np.float64] | None = None
        if path is None:
            _open_viewer()

    def __enter__(self) -> RerunSink:
        """Return itself."""
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Finish the recording; raises SinkError if it could not be written."""
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        try:
            stream.flush(timeout_sec=_SECONDS_TO_FINISH)
        except (RuntimeError, ValueError):
            if self._copy is None:
                raise SinkError("rerun: the viewer does not take the frames") from None
        finally:
            stream.disconnect()
            if self._copy is not None:
                self._copy.close()
        if error is None:
            self._check()

    def write(self, estimate: PoseInterval, image: StoredImage | None = None) -> None:
        """Log a frame, and its image as it is stored; raises SinkError and UsageError."""
        if self._stream is None:
            self._open()
        self._check()
        self._set_time(estimate)
        rr, log = self._rr, self._stream.log
        said = ", ".join([estimate.status, *estimate.reasons])
        unbounded = estimate.status is Status.OK and not estimate.bounded
        level = "WARN" if unbounded else _LEVELS[estimate.status]
        text = f"{estimate.source or estimate.seq}: {said}{', unbounded' * unbounded}"
        log("status", rr.TextLog(text, level=level))
        for stage, value in estimate.latency_ms.items():
            log(f"latency/{stage}", rr.Scalars(value))
        self._log_pose(estimate)
        if image is not None:
            log("image", rr.EncodedImage(contents=image.data, media_type=f"image/{image.encoding}"))
        elif self._look is not None:
            self._log_pixels(self._look())

    def _log_pose(self, estimate: PoseInterval) -> None:
        rr, log = self._rr, self._stream.log
        found = spoken(estimate, self._placement)
        if found is None:
            log("world/camera", rr.Clear(recursive=True))
        else:
            pose = found.pose
            log(
                "world/camera",
                rr.Transform3D(translation=pose.t_m, quaternion=pose.q_xyzw),
                rr.TransformAxes3D(0.1),
            )
            if self._last is not None:
                log("world/path", rr.LineStrips3D([[self._last, pose.t_m]], colors=[_COLOURS[1]]))
        self._last = None if found is None else found.pose.t_m
        if found is None or estimate.pose is None or not estimate.vouched:
            log("world/box", rr.Clear(recursive=True))
            log("bands", rr.Clear(recursive=True))
            return
        low, high = estimate.position_boxes().transpose(2, 0, 1)
        outer = self._placement.T_map_world
        centres, turn = 0.5 * (low + high), np.array([0.0, 0.0, 0.0, 1.0])
        if outer is not None:
            centres, turn = centres @ outer.to_matrix()[:3, :3].T + outer.t_m, outer.q_xyzw
        box = rr.Boxes3D(
            centers=centres,
            half_sizes=0.5 * (high - low),
            quaternions=[turn] * len(centres),
            colors=[_COLOURS[1]],
        )
        log("world/box", box)
        point = estimate.chart.point(estimate.pose.to_array())
        bands = np.stack([estimate.lower, point, estimate.upper], axis=1)
        for dof, numbers in zip(self._header.dof, bands, strict=True):
            log(f"bands/{dof}", rr.Scalars(numbers))

    def _log_pixels(self, image: NDArray[Any] | None) -> None:
        import cv2

        if image is None:
            return
        small = min(1.0, _WIDEST_PX / max(1, image.shape[1]))
        shown = cv2.resize(image, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
        done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if done:
            contents = data.tobytes()
            self._stream.log(
                "image", self._rr.EncodedImage(contents=contents, media_type="image/jpeg")
            )

    def _set_time(self, estimate: PoseInterval) -> None:
        stream, stamp_ns = self._stream, estimate.stamp_ns
        stream.set_time("frame", sequence=estimate.seq)
        if stamp_ns is None:
            stream.disable_timeline("stamp")
        elif not -(2**63) <= stamp_ns < 2**63:
            raise UsageError(f"stamp: expected one of 64 bits, found {stamp_ns} ns")
        elif self._header.stamps == "fps":
            stream.set_time("stamp", duration=np.timedelta64(stamp_ns, "ns"))
        else:
            stream.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"))

    def _open(self) -> None:
        self._stream = self._rr.RecordingStream(_APPLICATION)
        blueprint = _blueprint(self._header.dof)
        if self._path is None:
            url = f"rerun+http://{_HOST}:{_PORT}/proxy"
            self._stream.connect_grpc(url, default_blueprint=blueprint)
        else:
            self._copy = _Copy(self._path)
            self._stream.save(self._copy.entrance, default_blueprint=blueprint)
        for dof in self._header.dof:
            names = [f"{dof} {which}" for which in ("lower", "estimate", "upper")]
            lines = self._rr.SeriesLines(names=names, colors=_COLOURS)
            self._stream.log(f"bands/{dof}", lines, static=True)
        fields = "\n".join(f"- {key}: {value}" for key, value in _flat(self._header).items())
        document = self._rr.TextDocument(fields, media_type="text/markdown")
        self._stream.log("header", document, static=True)

    def _check(self) -> None:
        if self._copy is not None and self._copy.error is not None:
            raise SinkError(f"{self._path}: cannot be written: {self._copy.error.strerror}")


class _Copy:
    """A pipe that is copied into a file: rerun's own writer only prints that a disk is full.

    ``entrance`` is the name to write to; ``error`` is what went wrong, or None.
    """

    def __init__(self, path: str) -> None:
        self.error: OSError | None = None
        try:
            self._file = opened_empty(path, buffering=0)
        except OSError as error:
            raise SinkError(f"{path}: cannot be written: {error.strerror}") from None
        self._exit, self._kept = os.pipe()
        self.entrance = f"/dev/fd/{self._kept}"
        self._thread = threading.Thread(target=self._run, name="rrd", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Wait for what was written; call it after the writer has closed its side."""
        os.close(self._kept)
        self._thread.join(_SECONDS_TO_FINISH)

    def _run(self) -> None:
        with self._file, os.fdopen(self._exit, "rb", buffering=0) as pipe:
            while data := pipe.read(1 << 16):
                rest = memoryview(data)
                # After an error the pipe is emptied, so that its writer goes on to its end.
                while rest and self.error is None:
                    try:
                        rest = rest[self._file.write(rest) :]
                    except OSError as error:
                        self.error = error


def _open_viewer() -> None:
    """Start a viewer on loopback unless one is there; raises UsageError without a display."""
    # Imported here because most runs have no viewer.
    import socket
    import subprocess

    with socket.socket() as probe:
        probe.settimeout(1.0)
        if probe.connect_ex((_HOST, _PORT)) == 0:
            return
    if not any(os.environ.get(name) for name in _DISPLAYS):
        raise UsageError(
            f"--view: expected a display, or a viewer at port {_PORT}, found neither; start rerun "
            f"on your computer and log in with ssh -R {_PORT}:{_HOST}:{_PORT}, or write -o FILE.rrd"
        )
    # rerun's own spawn listens on every interface. Where CI is set, its analytics are off.
    options = ["--bind", _HOST, "--port", str(_PORT), "--hide-welcome-screen", "--expect-data-soon"]
    subprocess.Popen(  # noqa: S603 - this very interpreter, no shell
        [sys.executable, "-m", "rerun_cli", *options],
        env={**os.environ, "CI": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


@cache
def _blueprint(dof: tuple[str, ...]) -> Any:  # noqa: ANN401 - rerun's types
    """Return the layout of the windows: place and image beside bands, latency and status."""
    import rerun.blueprint as rrb

    # The path is drawn piece by piece: all pieces up to now are seen.
    so_far = [
        rrb.VisibleTimeRange(
            timeline,
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(seq=0)
            if timeline == "frame"
            else rrb.TimeRangeBoundary.cursor_relative(seconds=0),
        )
        for timeline in ("frame", "stamp")
    ]
    place = rrb.Spatial3DView(
        name="Path and set of the position",
        origin="world",
        overrides={"world/path": rrb.VisibleTimeRanges(so_far)},
    )
    bands = [rrb.TimeSeriesView(name=name, origin=f"bands/{name}") for name in dof]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(place, rrb.Spatial2DView(name="Image", origin="image")),
            rrb.Vertical(
                rrb.Grid(*bands, grid_columns=2),
                rrb.Horizontal(
                    rrb.TimeSeriesView(name="Latency, ms", origin="latency"),
                    rrb.TextLogView(name="Status", origin="status"),
                ),
                row_shares=[3, 1],
            ),
        ),
        collapse_panels=True,
    )


def _flat(header: Header) -> dict[str, str]:
    return {key: str(getattr(header, key)) for key in header.__struct_fields__}
