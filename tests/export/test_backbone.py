"""Backbones: truncated and pooled timm models, pooling against torch, invalid weights."""

import onnx
import pytest
import torch
from safetensors.torch import save_file
from timm.models.repvit import RepVggDw

from cvo_edge.engine.session import Session
from cvo_edge.errors import UsageError
from cvo_export.graph.to_onnx import check_parity, export_onnx
from cvo_export.networks.backbone import Backbone, BackboneConfig, load_weights


def backbone(**changes):
    return Backbone(BackboneConfig(**changes), 64, 96)


@pytest.mark.parametrize("name", ["mobilenetv2_100", "resnet18", "mobilenetv4_conv_small"])
def test_any_timm_model_is_cut_after_the_stage(name):
    whole, cut = backbone(name=name, stages=("final",), grid=(1, 1)), backbone(name=name)
    assert count(cut) < count(whole)
    image = torch.randint(0, 255, (2, 64, 96, 3), dtype=torch.uint8)
    assert cut(image).shape == (2, cut.size)


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_several_stages_are_joined():
    both = backbone(stages=("8", "16"))
    assert both.size == backbone(stages=("8",)).size + backbone(stages=("16",)).size


@pytest.mark.parametrize("grid", [(1, 1), (2, 3), (4, 6)])
def test_pooling_to_a_grid_that_divides_is_torchs(grid):
    made = backbone(grid=grid)
    image = torch.randint(0, 255, (1, 64, 96, 3), dtype=torch.uint8)
    with torch.no_grad():
        expected = torch.nn.functional.adaptive_avg_pool2d(made.maps(image)[0], grid).flatten(1)
        torch.testing.assert_close(made(image), expected, rtol=1e-4, atol=1e-5)


def test_pooling_of_a_constant_map_is_constant_on_every_grid():
    made = backbone(grid=(3, 5))
    rows, columns = made._rows0, made._columns0
    torch.testing.assert_close(rows @ torch.ones(4, 6) @ columns, torch.ones(3, 5))


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"name": "no_such_net"}, "backbone: expected a timm model, found no_such_net"),
        ({"name": "a/b"}, "backbone: expected a timm model, found a/b"),
        ({"name": "local-dir:/none"}, "backbone: expected a timm model, found local-dir"),
        ({"stages": ("7",)}, "stages: expected some of 2, 4, 8, 16, 32"),
        ({"stages": ("final", "16")}, "stages"),
        ({"grid": (9, 9)}, "grid: expected at most 4x6"),
    ],
)
def test_what_cannot_be_built_is_refused(changes, rule):
    with pytest.raises(UsageError, match=rule):
        backbone(**changes)


def test_weights_are_loaded_by_name_and_their_digest_returned(tmp_path):
    made, other = backbone(), backbone()
    path = tmp_path / "weights.safetensors"
    save_file({k: v.contiguous() for k, v in made.body.state_dict().items()}, path)
    assert len(load_weights(other, str(path))) == 64
    image = torch.randint(0, 255, (1, 64, 96, 3), dtype=torch.uint8)
    with torch.no_grad():
        torch.testing.assert_close(made(image), other(image))
    assert load_weights(other, "none") is None


def test_wrong_weights_are_refused(tmp_path):
    path = tmp_path / "weights.safetensors"
    with pytest.raises(UsageError, match="found no file at"):
        load_weights(backbone(), str(path))
    path.write_bytes(b"not safetensors")
    with pytest.raises(UsageError, match="not a valid safetensors file"):
        load_weights(backbone(), str(path))
    save_file({"conv_stem.weight": torch.zeros(1)}, path)
    with pytest.raises(UsageError, match="tensors missing and 1 of another shape"):
        load_weights(backbone(), str(path))


def test_branches_for_training_become_one_convolution_in_the_exported_graph():
    class Tuple(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.block = RepVggDw(8, 3, legacy=False)

        def forward(self, x):
            return (self.block(x),)

    torch.manual_seed(0)
    made = Tuple()
    made(torch.randn(16, 8, 12, 16))  # statistics of the normalisations
    image = torch.randn(1, 8, 12, 16)
    content = export_onnx(made, [image], ["x"], ["y"])
    assert [node.op_type for node in onnx.load_from_string(content).graph.node] == ["Conv"]
    assert count(made) > count(made.block.conv.c)  # the network itself still has its branches
    check_parity(made, Session(content), [{"x": image.numpy()}], ["x"], ["y"])
