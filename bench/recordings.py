"""Train, publish, evaluate and run bundles on recordings of every kind.

    python bench/recordings.py WORK [--cases NAME ...] [--methods NAME ...] [--copies N] [--steps N]

Real recordings come from ``CVO_DATA``, the backbone from ``CVO_WEIGHTS``. Each case is trained with
its default split (``-random``: frame by frame), through the commands that a user calls. Test frames
are then written as a folder and run by ``cvo-edge run``. A repetition of the command continues;
WORK keeps the runs. Results: ``results/recordings/CASE-METHOD.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import RESULTS, write_result

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.pose import Pose
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset

DATA = Path(os.environ.get("CVO_DATA", "data"))
WEIGHTS = Path(os.environ.get("CVO_WEIGHTS", "weights")) / "mobilenetv2_100_imagenet.safetensors"
# That of all results.
SIZE = "256x192"
UTM_M = (500_000.0, 5_000_000.0, 100.0)
ROOM = "synthetic:room,flights=48,frames=40"


def kitchen(folder: Path, origin_m: tuple[float, ...] = (0.0, 0.0, 0.0), frames: int = 400) -> str:
    """Link the first frames of redkitchen, with positions moved by ``origin_m`` (3,)."""
    sequence = next(iter(sorted((DATA / "redkitchen").glob("seq-*"))))
    target = folder / sequence.name
    target.mkdir(parents=True, exist_ok=True)
    for number in range(frames):
        image = f"frame-{number:06d}.color.jpg"
        if not (target / image).exists():
            (target / image).symlink_to((sequence / image).resolve())
        T = np.loadtxt(sequence / f"frame-{number:06d}.pose.txt")
        T[:3, 3] += origin_m
        np.savetxt(target / f"frame-{number:06d}.pose.txt", T, fmt="%.17g")
    return f"7scenes:{folder}"


# What is trained, and the case that it stands beside.
CASES: dict[str, tuple[str, str | None]] = {
    "redkitchen-400": ("", None),
    "redkitchen-400-random": ("", "redkitchen-400"),
    "redkitchen-400-utm": ("", "redkitchen-400"),
    "euroc-mh05": (f"euroc:{DATA / 'euroc_mh05'}", None),
    "euroc-mh05-random": (f"euroc:{DATA / 'euroc_mh05'}", "euroc-mh05"),
    "kitti-00": (f"kitti:{DATA / 'kitti_00'}", None),
    "kitti-00-random": (f"kitti:{DATA / 'kitti_00'}", "kitti-00"),
    "room": (ROOM, None),
    "room-full-turn": (f"{ROOM},turn=1", "room"),
    "room-planar": (f"{ROOM},turn=1,still=z+pitch+roll", "room-full-turn"),
    "room-never-turns": (f"{ROOM},still=yaw+pitch+roll", "room"),
    "street": ("synthetic:street,drives=24,frames=80", None),
}


def spec(case: str, work: Path) -> str:
    """Return the data set of a case as FORMAT:PATH."""
    if case in ("redkitchen-400", "redkitchen-400-random"):
        return kitchen(work / "data" / case)
    if case == "redkitchen-400-utm":
        return kitchen(work / "data" / case, UTM_M)
    return CASES[case][0]


def call(*words: str | Path) -> str:
    """Run a command of this environment; return what it prints on both streams."""
    command = [str(Path(sys.executable).parent / words[0]), *map(str, words[1:])]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: exit {done.returncode}\n{done.stdout}")
    return done.stdout


def played(bundle: Path, dataset: PoseDataset, test: np.ndarray, folder: Path) -> dict[str, Any]:
    """Write the test frames as a folder, run it, and count what the records say."""
    folder.mkdir(parents=True, exist_ok=True)
    for row in test:
        name = folder / f"frame-{row:06d}"
        cv2.imwrite(f"{name}.png", dataset.read_image(int(row)))
        np.savetxt(f"{name}.pose.txt", Pose.from_array(dataset.poses[row]).to_matrix(), fmt="%.17g")
    records = folder / "records.jsonl"
    records.unlink(missing_ok=True)
    printed = call(
        "cvo-edge", "run", bundle, folder, "--scope", "joint", "--ground-truth", folder,
        "-o", records,
    )  # fmt: skip
    lines = [json.loads(line) for line in records.read_text("utf-8").splitlines()]
    statuses = [line["status"] for line in lines if "status" in line]
    return {
        "frames": len(statuses),
        "ok": statuses.count("ok") / len(statuses),
        "summary": printed.splitlines()[-12:],
    }


def main() -> None:
    """Run the cases; write one result each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--methods", nargs="+", default=["cjp", "cqr"])
    parser.add_argument("--copies", type=int, default=6)
    parser.add_argument("--steps", type=int, default=4000)
    options = parser.parse_args()
    for case in options.cases:
        text = spec(case, options.work)
        dataset = open_dataset(text)
        for method in options.methods:
            run, bundle = (options.work / kind / f"{case}-{method}" for kind in ("runs", "bundles"))
            print(f"== {case}, {method}", flush=True)
            if not bundle.exists():
                print(
                    call(
                        "cvo-export", "train", method, text, run, "--weights", WEIGHTS, "--cache",
                        options.work / "cache" / case, "--copies", str(options.copies),
                        "--steps", str(options.steps), "--size", SIZE,
                        *(("--split", "random") if case.endswith("-random") else ()),
                    ),
                    call("cvo-export", "publish", run, bundle),
                    flush=True,
                )  # fmt: skip
            report = options.work / "reports" / f"{case}-{method}.json"
            report.parent.mkdir(parents=True, exist_ok=True)
            print(call("cvo-export", "evaluate", bundle, text, "--json", report), flush=True)
            split = same_split(dataset, read_calibration(bundle).calibration.split)
            test = split.roles["test"]
            found = {
                "case": case,
                "beside": CASES[case][1],
                "data": text.split(":")[0] + ":" + case if "/" in text else text,
                "frames_by_role": {role: int(rows.size) for role, rows in split.roles.items()},
                "run": played(bundle, dataset, test, options.work / "played" / f"{case}-{method}"),
                "evaluation": json.loads(report.read_text("utf-8")),
            }
            print(*found["run"]["summary"], sep="\n", flush=True)
            write_result(RESULTS / "recordings" / f"{case}-{method}.json", found)


if __name__ == "__main__":
    main()
