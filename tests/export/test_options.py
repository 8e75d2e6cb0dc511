"""Command-line options of methods: taken from their structs, and refused for other methods."""

from typing import Annotated, Literal

import pytest
from msgspec import Meta, Struct
from typer.testing import CliRunner

from cvo_edge.errors import UsageError
from cvo_export.cli import app
from cvo_export.networks.heads import Method
from cvo_export.networks.methods import TRAINABLE
from cvo_export.training.options import method_parameters


class ToyConfig(Struct, frozen=True, tag="toy", tag_field="method", forbid_unknown_fields=True):
    springs: Annotated[int, Meta(ge=1, description="Springs of the toy.")] = 3
    latent: Literal["mean", "wound"] = "wound"
    pair: Annotated[tuple[int, float], Meta(description="One of each.")] = (1, 2.0)
    key: Annotated[Annotated[float, Meta(gt=0)] | None, Meta(description="May be missing.")] = None


class OtherConfig(Struct, frozen=True, tag="other", tag_field="method"):
    springs: float = 1.0


def toy(config):
    return Method(config, train=None, restore=None)


def run(*arguments):
    return CliRunner(env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).invoke(app, arguments)


def text_of(result):
    """Return the words of a help page, without borders and line ends."""
    return " ".join(result.output.replace("│", " ").split())


def test_a_registered_method_is_in_the_help_and_takes_its_options(monkeypatch):
    monkeypatch.setitem(TRAINABLE, "toy", toy(ToyConfig))
    shown = run("train", "--help")
    assert shown.exit_code == 0
    text = text_of(shown)
    assert "Options of toy" in text
    assert "Springs of the toy. (>= 1; default: 3)" in text
    assert "wound" in text
    # The struct behind the option refuses the value, so the option reached it.
    refused = run("train", "toy", "synthetic:room", "unused", "--springs", "0", "--pair", "1", "2")
    assert isinstance(refused.exception, UsageError)
    assert str(refused.exception) == "--springs of toy: expected `int` >= 1, found 0"


def test_an_option_of_another_method_is_refused_before_any_data_is_opened(tmp_path):
    refused = run("train", "cqr", "synthetic:nowhere", str(tmp_path), "--latent-size", "4")
    assert isinstance(refused.exception, UsageError)
    assert str(refused.exception).startswith(
        "--latent-size is not an option of cqr; its options are --quantiles, --trees, "
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (("train", "walk", "synthetic:room", "unused"), "'cjp', 'cqr', 'csp', 'mcqr'"),
        (("train", "cjp", "synthetic:room", "unused", "--latent", "x"), "'mean', 'codebook'"),
        (("train", "cjp", "synthetic:room", "unused", "--split", "x"), "'random', 'block'"),
        (("publish", "a", "b", "--provider", "x"), "'onnxruntime', 'openvino'"),
        (("calibrate", "a", "b", "c", "--sides", "x"), "'symmetric', 'asymmetric'"),
        (("evaluate", "a", "b", "--subset", "x"), "'test', 'all'"),
        (("study", "a", "b", "--engine", "x"), "'local', 'ray'"),
    ],
)
def test_a_word_that_is_no_choice_is_refused_with_the_choices(arguments, choices):
    refused = run(*arguments)
    assert refused.exit_code == 2
    assert choices in text_of(refused)


def test_one_name_has_one_type():
    methods = {"toy": toy(ToyConfig), "other": toy(OtherConfig)}
    with pytest.raises(TypeError, match="springs: expected one type in the options of toy, other"):
        method_parameters(methods)


def test_a_shared_option_names_its_methods_and_their_defaults():
    text = text_of(run("train", "--help"))
    assert "(>= 0; cjp: 0.001; mcqr: 0.01)" in text
    assert "Widths of the two hidden layers. (cjp, cqr, csp, mcqr, " in text
    assert "Gaussians in the mixture of each degree of freedom. (>= 1, <= 64; mdn: 3)" in text


@pytest.mark.parametrize(
    "command",
    [
        (),
        ("train",),
        ("publish",),
        ("calibrate",),
        ("sign",),
        ("evaluate",),
        ("compare",),
        ("study",),
        ("plot",),
        ("render",),
        ("dataset",),
    ],
)
def test_every_help_page_fits_80_columns(command):
    shown = run(*command, "--help")
    assert shown.exit_code == 0
    assert max(len(line) for line in shown.output.splitlines()) <= 80


@pytest.mark.parametrize("command", ["train", "publish", "calibrate", "evaluate"])
def test_a_help_page_ends_with_examples(command):
    shown = run(command, "--help").output
    assert f"cvo-export {command} " in shown[shown.index("Examples:") :]
