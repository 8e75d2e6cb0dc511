"""One rule for TUM files: ``--ground-truth`` and ``tum:`` give a frame the same pose, or none."""

import cv2
import numpy as np
import pytest

from cvo_edge.errors import SourceError
from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Status
from cvo_edge.sets import unbounded_set
from cvo_export.datasets import open_dataset

STAMPS = ("1.000", "2.000", "3.000")


def by_dataset(folder):
    """x of each frame that has a pose, and what was skipped."""
    found = open_dataset(f"tum:{folder}")
    names = [name.split("/")[1] for name in found.frame_names]
    return dict(zip(names, found.poses[:, 0].tolist(), strict=True)), str(found.skipped)


def by_ground_truth(folder):
    truth = open_ground_truth(folder / "groundtruth.txt")
    pose, chart = Pose.from_array([0, 0, 0, 0, 0, 0, 1]), Chart("tangent_predicted")
    found = {}
    for seq, stamp in enumerate(STAMPS):
        estimate = PoseInterval(
            seq,
            int(stamp.replace(".", "")) * 1_000_000,
            stamp,
            Status.OK,
            (),
            pose,
            unbounded_set(),
            0.9,
            "marginal",
            chart,
        )
        true = truth.pose_of(estimate)
        if true is not None:
            found[stamp] = true[0]
    return found, str(truth.skipped)


PLAIN = "1.0 10 0 0 0 0 0 1\n2.0 20 0 0 0 0 0 1\n3.0 30 0 0 0 0 0 1\n"
ALL = {"1.000": 10.0, "2.000": 20.0, "3.000": 30.0}
BUT_SECOND = {"1.000": 10.0, "3.000": 30.0}


@pytest.mark.parametrize(
    ("text", "poses", "skipped"),
    [
        (PLAIN, ALL, "none skipped"),
        ("\ufeff" + PLAIN, ALL, "none skipped"),
        (PLAIN.replace("\n", "\r\n"), ALL, "none skipped"),
        ("# a\n  # b\n\n\t# c\n" + PLAIN, ALL, "none skipped"),
        ("\n".join(reversed(PLAIN.splitlines())), ALL, "none skipped"),
        (PLAIN.replace(" ", "\t ") + "  ", ALL, "none skipped"),
        (PLAIN + "2.0 20 0 0 0 0 0 1\n", ALL, "listed twice 1 (first in groundtruth.txt, line 4)"),
        (PLAIN + "2.0 99 0 0 0 0 0 1\n", ALL, "listed twice 1 (first in groundtruth.txt, line 4)"),
        # The nearest row has no valid pose; the next one is near enough, but of another time.
        (
            PLAIN.replace("20 ", "nan ") + "2.01 99 0 0 0 0 0 1\n",
            BUT_SECOND,
            "invalid pose 1 (first in groundtruth.txt, line 2: a number that is not finite)",
        ),
        (
            PLAIN.replace("20 0 0 0 0 0 1", "20 0 0 0 0 0 .5"),
            BUT_SECOND,
            "invalid pose 1 (first in groundtruth.txt, line 2: a quaternion of norm 0.5)",
        ),
        (PLAIN.replace("20 0 0 0 0 0 1", "20 0 0 0 0 0 .995"), ALL, "none skipped"),
        (
            "timestamp tx ty tz qx qy qz qw\n" + PLAIN,
            "expected timestamp tx ty tz qx qy qz qw, found 'timestamp tx ty tz qx qy qz qw' in "
            "line 1; put # before a line of names",
            None,
        ),
        (
            PLAIN.replace("2.0", "1403636579763555584"),
            "expected stamps in seconds, found 1403636579763555584 in line 2; convert nanoseconds",
            None,
        ),
        (
            "# a\n1.0 nan 0 0 0 0 0 1\n",
            "expected poses, found no valid one: groundtruth.txt, line 2: a number that is not",
            None,
        ),
        (PLAIN + "4.0 1 2 3\n", "found '4.0 1 2 3' in line 4", None),
    ],
)
def test_both_sides_read_a_file_by_one_rule(tmp_path, text, poses, skipped):
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb.txt").write_text("".join(f"{s} rgb/{s}.png\n" for s in STAMPS))
    for stamp in STAMPS:
        cv2.imwrite(str(tmp_path / "rgb" / f"{stamp}.png"), np.full((8, 8, 3), 90, np.uint8))
    (tmp_path / "groundtruth.txt").write_bytes(text.encode())
    if skipped is None:
        for read in (by_dataset, by_ground_truth):
            with pytest.raises(SourceError) as refusal:
                read(tmp_path)
            message = str(refusal.value).removeprefix(str(tmp_path / "groundtruth.txt") + ": ")
            assert message.startswith(poses) or poses in message
        return
    for read in (by_dataset, by_ground_truth):
        found, counted = read(tmp_path)
        assert found == poses
        assert counted.endswith(skipped)
