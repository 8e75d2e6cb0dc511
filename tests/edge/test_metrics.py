"""Prometheus reads the counts that were written."""

from urllib.request import urlopen

import numpy as np
import pytest

from cvo_edge.errors import SinkError
from cvo_edge.estimate import Drift, PoseInterval
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set

parser = pytest.importorskip("prometheus_client.parser")

from cvo_edge.output.metrics import MetricsSink  # noqa: E402 - after the library is known


def frame(status, reasons=(), drift="clear"):
    pose = Pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    half = np.arange(1.0, 7.0)
    found = ConformalSet(-half, half) if status is Status.OK else unbounded_set()
    return PoseInterval(
        *(0, 2_500_000_000, "", status, reasons, pose, found, 0.9, "marginal"),
        Chart("tangent_predicted"),
        {"total": 15.0},
        drift=Drift(drift),
    )


def test_what_is_served_is_what_was_written():
    with MetricsSink(0) as sink:
        for each in (
            frame(Status.OK),
            frame(Status.OK),
            frame(Status.DEGRADED, (Reason.IMAGE_BLACK,), "alarm"),
        ):
            sink.write(each)
        with urlopen(f"http://127.0.0.1:{sink.port}/metrics") as answer:
            text = answer.read().decode()
    samples = {
        (each.name, *sorted(each.labels.values())): each.value
        for family in parser.text_string_to_metric_families(text)
        for each in family.samples
    }
    assert samples["cvo_frames_total", "ok"] == 2
    assert samples["cvo_frames_total", "invalid"] == 0
    assert samples["cvo_reasons_total", "image_black"] == 1
    assert samples["cvo_unbounded_frames_total",] == 1
    assert samples["cvo_width", "rz"] == 12
    assert samples["cvo_latency_seconds_bucket", "0.01"] == 0
    assert samples["cvo_latency_seconds_bucket", "0.02"] == 3
    assert samples["cvo_drift_alarm",] == 1
    assert samples["cvo_last_stamp_seconds",] == 2.5


def test_a_taken_port_is_refused():
    with MetricsSink(0) as sink, pytest.raises(SinkError, match=f"port {sink.port} cannot"):
        MetricsSink(sink.port)
