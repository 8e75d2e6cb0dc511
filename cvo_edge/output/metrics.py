"""Figures of a running odometer for Prometheus, on this machine alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.record import Status

_ADDRESS = "127.0.0.1"
_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.033, 0.05, 0.1, 0.2, 0.5, 1.0)


class Count(NamedTuple):
    """A figure that is asked for when the metrics are read."""

    name: str
    help: str
    value: float
    grows: bool = True


# What a service counts beside the frames that it estimates.
Counts = Callable[[], list[Count]]


class _Asked:
    """A collector of counts, as the library's registry asks for them."""

    def __init__(self, kinds: Any, counts: Counts) -> None:  # noqa: ANN401 - the library
        self._counter, self._gauge = kinds.CounterMetricFamily, kinds.GaugeMetricFamily
        self._counts = counts

    def collect(self) -> Iterator[Any]:
        for name, text, value, grows in self._counts():
            yield (self._counter if grows else self._gauge)(name, text, value=value)


class MetricsSink:
    """Serves counts, latencies, widths and the state of the alarm under ``/metrics``.

    Parameters
    ----------
    port
        On the loopback interface; 0: any free one.
    counts
        Returns further figures whenever the metrics are read.

    Attributes
    ----------
    port
        The port that is served.

    Raises UsageError if prometheus-client is not installed, and SinkError if the port is taken.
    """

    def __init__(self, port: int, counts: Counts | None = None) -> None:
        try:
            import prometheus_client as kinds
            from prometheus_client import core
        except ImportError:
            raise UsageError(
                'metrics: prometheus-client is not installed; pip install "cvo-edge[metrics]"'
            ) from None
        # A registry of its own: that of the library is one for the whole process.
        registry = kinds.CollectorRegistry()
        counter = partial(kinds.Counter, registry=registry)
        gauge = partial(kinds.Gauge, registry=registry)
        self._frames = counter("cvo_frames", "Frames by status.", ["status"])
        for status in Status:
            self._frames.labels(status.value)
        self._dropped = counter("cvo_dropped_frames", "Frames dropped for newer ones.")
        self._next_seq = 0
        self._reasons = counter("cvo_reasons", "Remarks on frames.", ["reason"])
        self._unbounded = counter("cvo_unbounded_frames", "Frames without finite bounds.")
        self._latency = kinds.Histogram(
            "cvo_latency_seconds",
            "From a frame's arrival to its interval.",
            buckets=_BUCKETS_S,
            registry=registry,
        )
        self._width = gauge("cvo_width", "Width of the last finite interval, m or rad.", ["dof"])
        self._alarm = gauge("cvo_drift_alarm", "1 during an alarm, 0 when clear.")
        self._stamp = gauge("cvo_last_stamp_seconds", "Stamp of the last frame.")
        if counts is not None:
            registry.register(_Asked(core, counts))
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

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def write(self, estimate: PoseInterval) -> None:
        """Count one frame."""
        self._frames.labels(estimate.status.value).inc()
        self._dropped.inc(max(0, estimate.seq - self._next_seq))
        self._next_seq = estimate.seq + 1
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
