"""Relative errors are those of evo, on the pairs that evo chooses; evo runs as its own process."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cvo_edge.motion.files import read_poses
from cvo_edge.motion.relative import motion, norms, residual

from .simulated_drives import drive

EVO = shutil.which("evo_rpe")
# Prints evo's own pairs and errors; the two files are given as arguments.
SCRIPT = """
import json, sys
from evo.core import metrics, sync
from evo.tools import file_interface
truth, estimate = (file_interface.read_tum_trajectory_file(path) for path in sys.argv[1:])
truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=1e-4)
found = []
for delta, name in ((1, "frames"), (20, "frames"), (5.0, "meters"), (0.3, "radians")):
    unit = metrics.Unit[name]
    pairs = metrics.id_pairs_from_delta(estimate.poses_se3, delta, unit, all_pairs=True)
    errors = []
    for relation in ("translation_part", "rotation_angle_rad"):
        rpe = metrics.RPE(metrics.PoseRelation[relation], delta, unit, all_pairs=True)
        rpe.process_data((truth, estimate))
        errors.append(rpe.error.tolist())
    found.append([[[int(i), int(j)] for i, j in pairs], errors])
print(json.dumps(found))
"""


@pytest.mark.skipif(EVO is None, reason="evo is not installed")
def test_relative_errors_are_those_of_evo(tmp_path: Path) -> None:
    assert EVO is not None
    pair = drive(50, 200)
    for name, poses in (("truth", pair.track.poses), ("estimate", pair.estimate)):
        table = np.column_stack([1e-9 * pair.stamps_ns, poses])
        np.savetxt(tmp_path / name, table, fmt="%.17g")
    command = [Path(EVO).parent / "python", "-c", SCRIPT, "truth", "estimate"]
    environment = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "agg"}
    environment.pop("PYTHONPATH", None)
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    truth, estimate = (read_poses(tmp_path / name).poses for name in ("truth", "estimate"))
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found) == 4
    for pairs, errors in found:
        start, end = np.array(pairs).T
        off = residual(motion(estimate[start], estimate[end]), motion(truth[start], truth[end]))
        assert len(off) > 50
        np.testing.assert_allclose(norms(off), np.array(errors).T, atol=1e-9)
