"""Figures of a running odometer for Prometheus, on this machine alone."""

from __future__ import annotations

from types import TracebackType

import numpy as np

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.record import Status

_ADDRESS = "127.0.0.1"
_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5, 1.0)


class MetricsSink:
    """Serves counts, latencies, widths and the state of the alarm under ``/metrics``.

    Parameters
    ----------
    port
        On the loopback interface; 0: any free one.

    Attributes
    ----------
    port
        The port that is served.

    Raises UsageError if prometheus-client is not installed, and SinkError if the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            import prometheus_client as kinds
        except ImportError:
            raise UsageError(
                'metrics: prometheus-client is not installed; pip install "cvo-edge[metrics]"'
            ) from None
        # A registry of its own: that of the library is one for the whole process.
        registry = kinds.CollectorRegistry()
        self._frames = kinds.Counter(
            "cvo_frames", "Frames by status.", ["status"], registry=registry
        )
        for status in Status:
            self._frames.labels(status.value)
        self._reasons = kinds.Counter(
            "cvo_reasons", "Remarks on frames.", ["reason"], registry=registry
        )
        self._unbounded = kinds.Counter(
            "cvo_unbounded_frames", "Frames without finite bounds.", registry=registry
        )
        self._latency = kinds.Histogram(
            "cvo_latency_seconds",
            "From a frame's arrival to its interval.",
            buckets=_BUCKETS_S,
            registry=registry,
        )
        self._width = kinds.Gauge(
            "cvo_width",
            "Width of the last finite interval, m or rad.",
            ["dof"],
            registry=registry,
        )
        self._alarm = kinds.Gauge(
            "cvo_drift_alarm", "1 during an alarm, 0 when clear.", registry=registry
        )
        self._stamp = kinds.Gauge(
            "cvo_last_stamp_seconds", "Stamp of the last frame.", registry=registry
        )
        try:
            self._server, self._thread = kinds.start_http_server(
                port, addr=_ADDRESS, registry=registry
            )
        except OSError as error:
            raise SinkError(f"metrics: port {port} cannot be served: {error.strerror}") from None
        self.port = int(self._server.server_port)

    def __enter__(self) -> MetricsSink:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def write(self, estimate: PoseInterval) -> None:
        """Count one frame."""
        self._frames.labels(estimate.status.value).inc()
        for reason in estimate.reasons:
            self._reasons.labels(reason.value).inc()
        if estimate.bounded:
            widths = np.subtract(estimate.upper, estimate.lower).tolist()
            for dof, width in zip(estimate.chart.dof, widths, strict=True):
                self._width.labels(dof).set(width)
        else:
            self._unbounded.inc()
        total_ms = estimate.latency_ms.get("total")
        if total_ms is not None:
            self._latency.observe(1e-3 * total_ms)
        if estimate.drift.state != "unknown":
            self._alarm.set(estimate.drift.state == "alarm")
        if estimate.stamp_ns is not None:
            self._stamp.set(1e-9 * estimate.stamp_ns)
