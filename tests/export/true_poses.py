"""What tests of ``--ground-truth`` share: its poses are those of training."""

from dataclasses import replace

import numpy as np

from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.input.image_files import frame_name
from cvo_edge.input.sources import open_source
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Status
from cvo_edge.sets import unbounded_set
from cvo_export.datasets import open_dataset


def estimates(frames):
    """What a run makes of a folder, as far as it matters here."""
    pose, chart = Pose.from_array([0, 0, 0, 0, 0, 0, 1]), Chart("tangent_predicted")
    bare = PoseInterval(0, None, "", Status.OK, (), pose, unbounded_set(), 0.9, "marginal", chart)
    return [
        replace(bare, seq=seq, stamp_ns=frame.stamp_ns, source=frame.source)
        for seq, frame in enumerate(open_source(frames))
    ]


def same_as_training(dataset, frames, path):
    """The frames of folders that have a true pose, and the poses, are those of training."""
    found = {}
    for folder in frames:
        truth = open_ground_truth(path, folder)
        for estimate in estimates(folder):
            if (pose := truth.pose_of(estimate)) is not None:
                found[frame_name(estimate.source)] = pose
    expected = open_dataset(dataset)
    names = [name.rpartition("/")[2] for name in expected.frame_names]
    assert sorted(found) == sorted(names)
    np.testing.assert_array_equal([found[name] for name in names], expected.poses)
    return truth
