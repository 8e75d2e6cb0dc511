"""A network that torch exported, in the forms that people have it, becomes a bundle."""

import json
import re

import cv2
import numpy as np
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from cvo_edge import Odometer
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import BundleMismatchError
from cvo_edge.programs.cli import app as edge
from cvo_export.cli import app
from cvo_export.data.splits import same_split
from cvo_export.datasets import open_dataset

DATASET = "synthetic:room,flights=12,frames=20,size=64x48,seed=4"
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
RUNNER = CliRunner()


class Network(nn.Module):
    """Position and quaternion, scalar first, by a linear map of twelve mean colours."""

    def __init__(self, slope: np.ndarray) -> None:
        super().__init__()
        self.slope = nn.Parameter(torch.from_numpy(slope))

    def forward(self, pixels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        means = nn.functional.avg_pool2d(pixels, 16).flatten(1)
        seen = torch.cat([means, torch.ones_like(means[:, :1])], dim=1)
        numbers = seen @ self.slope
        return numbers[:, :3], numbers[:, 3:] / numbers[:, 3:].norm(dim=1, keepdim=True), means


@pytest.fixture(scope="module")
def dataset():
    return open_dataset(DATASET)


@pytest.fixture(scope="module")
def pixels(dataset):
    """Images as people's own code prepares them, (n, 3, 48, 64)."""
    images = [cv2.cvtColor(dataset.read_image(k), cv2.COLOR_BGR2RGB) for k in range(len(dataset))]
    scaled = (np.stack(images) / np.float32(255) - np.float32(MEAN)) / np.float32(STD)
    return torch.from_numpy(scaled.transpose(0, 3, 1, 2).astype(np.float32))


@pytest.fixture(scope="module")
def network(dataset, pixels):
    means = nn.functional.avg_pool2d(pixels, 16).flatten(1).numpy()
    seen = np.hstack([means, np.ones((len(means), 1))])
    poses = dataset.poses[:, [0, 1, 2, 6, 3, 4, 5]]
    # Learned from a third of the frames; the ridge keeps the numbers small enough for float16.
    some = slice(None, None, 3)
    square = seen[some].T @ seen[some] + 0.1 * np.eye(seen.shape[1])
    slope = np.linalg.solve(square, seen[some].T @ poses[some])
    return Network(slope.astype(np.float32)).eval()


FORMS = {
    "external": {"dynamo": True, "external_data": True},
    "dynamic": {
        "dynamo": True,
        "external_data": False,
        "dynamic_shapes": {"pixels": {0: "n", 2: "h", 3: "w"}},
    },
    "legacy": {"dynamo": False},
    "float16": {"dynamo": True},
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("form", FORMS)
def test_bundles_answer_as_the_network_does(form, dataset, pixels, network, tmp_path):
    given, own = (pixels[:1].half(), network.half()) if form == "float16" else (pixels[:1], network)
    file = tmp_path / "own.onnx"
    names = {"input_names": ["pixels"], "output_names": ["where", "turn", "means"]}
    torch.onnx.export(own, (given,), file, verbose=False, **names, **FORMS[form])
    network.float()
    assert (tmp_path / "own.onnx.data").exists() == (form in ("external", "float16"))
    size = ["--size", "48x64"] if form == "dynamic" else []
    done = RUNNER.invoke(
        app,
        [
            *("calibrate", str(file), DATASET, str(tmp_path / "bundle"), *size),
            *("--input", "layout=nchw,range=0-1,mean=.485/.456/.406,std=.229/.224/.225"),
            *("--output", "translation=where", "--output", "rotation=turn,form=quaternion_wxyz"),
        ],
    )
    assert done.exit_code == 0, done.output
    assert "outputs left out: means" in done.output
    with torch.no_grad():
        where, turn, _ = (each.numpy() for each in network(pixels))
    split = same_split(dataset, read_calibration(tmp_path / "bundle").calibration.split)
    judged = np.concatenate([split.roles["val"], split.roles["cal"]])
    error = np.median(np.linalg.norm(where[judged] - dataset.poses[judged, :3], axis=1))
    printed = re.search(r"point error: median (\S+) m .*; their mean pose's (\S+) m", done.output)
    tolerance = 0.02 if form == "float16" else 2e-3
    assert float(printed[1]) == pytest.approx(error, rel=tolerance)
    assert float(printed[1]) < 0.8 * float(printed[2])
    assert "with --" not in done.output
    with Odometer.load(tmp_path / "bundle") as odometer:
        found = np.array([odometer.step(dataset.read_image(k)).pose.to_array() for k in range(9)])
    expected = np.hstack([where[:9], turn[:9][:, [1, 2, 3, 0]]])
    np.testing.assert_allclose(found, expected, atol=0.02 if form == "float16" else 1e-4)
    assert RUNNER.invoke(edge, ["verify", str(tmp_path / "bundle")]).exit_code == 0


@pytest.mark.filterwarnings("ignore")
def test_its_intervals_hold_as_often_as_they_say(pixels, network, tmp_path):
    file, bundle, report = tmp_path / "own.onnx", tmp_path / "bundle", tmp_path / "report.json"
    torch.onnx.export(network, (pixels[:1],), file, verbose=False, dynamo=False)
    refused = RUNNER.invoke(app, ["calibrate", str(file), DATASET, str(bundle)])
    # The exporter's own names; the message says how to state them.
    names = re.findall(r"--output (?:translation|rotation)=(\S+)", str(refused.exception))
    assert isinstance(refused.exception, BundleMismatchError)
    assert (len(names), bundle.exists()) == (2, False)
    outputs = [f"--output=translation={names[0]}", f"--output=rotation={names[1]}"]
    outputs[1] += ",form=quaternion_wxyz"
    normal = "--input=layout=nchw,range=0-1,mean=.485/.456/.406,std=.229/.224/.225"
    arguments = ["calibrate", str(file), DATASET, str(bundle), "--split", "random", normal]
    done = RUNNER.invoke(app, [*arguments, *outputs])
    assert done.exit_code == 0, done.output
    done = RUNNER.invoke(app, ["evaluate", str(bundle), DATASET, "--json", str(report)])
    assert done.exit_code == 0, done.output
    for level in json.loads(report.read_text())["levels"]:
        if level["scope"] == "marginal" and level["coverage_band"] is not None:
            low, high = level["coverage_band"]
            assert all(low <= share <= high for share in level["coverage"]), level
