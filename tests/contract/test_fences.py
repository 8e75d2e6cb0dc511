"""Boundaries: permitted imports of the runtime, its public names, and codes of its errors."""

import subprocess
import sys
from pathlib import Path

import pytest

import cvo_edge
from cvo_edge import errors

PACKAGE = Path(cvo_edge.__file__).parent
MODULES = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in PACKAGE.rglob("*.py")
)
FORBIDDEN = {"torch", "torchvision", "timm", "onnx", "sklearn", "scipy", "cvo_export", "pydantic"}
FORBIDDEN |= {"rosbags", "ruamel", "yaml"}


def fresh_process(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_every_module_of_the_runtime_imports_without_the_training_side():
    names = [name.removesuffix(".__init__") for name in MODULES]
    assert "cvo_edge.programs.cli" in names
    assert "cvo_edge.heads.cjp" in names
    code = f"import importlib, sys\nfor name in {names}: importlib.import_module(name)\n"
    found = fresh_process(code + "print(*sys.modules, sep='\\n')").stdout.splitlines()
    assert FORBIDDEN.isdisjoint(name.split(".")[0] for name in found)


def test_importing_the_package_needs_no_command_line():
    code = (
        "import cvo_edge, sys, logging\n"
        "print(*sys.modules, sep='\\n')\n"
        "assert not logging.root.handlers"
    )
    found = fresh_process(code).stdout.splitlines()
    assert {"typer", "rich", "click"}.isdisjoint(name.split(".")[0] for name in found)


def test_a_plain_start_imports_neither_numpy_nor_what_only_help_needs():
    code = (
        "import sys; sys.argv = ['cvo-edge', '--version']\n"
        "from cvo_edge.__main__ import main\n"
        "try: main()\nexcept SystemExit: print(*sys.modules, sep='\\n')"
    )
    found = fresh_process(code).stdout.splitlines()
    assert found[0].startswith("cvo-edge ")
    assert {"rich", "numpy", "cv2"}.isdisjoint(name.split(".")[0] for name in found)


def test_the_public_names_are_sorted_and_exist():
    assert cvo_edge.__all__ == sorted(cvo_edge.__all__)
    assert set(cvo_edge.__all__) <= set(dir(cvo_edge))
    assert "import_module" not in dir(cvo_edge)
    assert all(hasattr(cvo_edge, name) for name in cvo_edge.__all__)


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("UsageError", 2),
        ("CalibrationFileError", 3),
        ("ModelError", 4),
        ("BundleMismatchError", 5),
        ("SourceError", 6),
        ("SinkError", 7),
        ("GateError", 8),
    ],
)
def test_each_error_has_its_documented_exit_code(name, code):
    error = getattr(errors, name)
    assert issubclass(error, errors.CvoError)
    assert error.exit_code == code
    assert name in cvo_edge.__all__
    assert f"{name} " in (errors.__doc__ or "")


def test_importing_either_command_line_leaves_the_environment_alone():
    pytest.importorskip("cvo_export")
    code = (
        "import os\nbefore = dict(os.environ)\n"
        "import cvo_edge.programs.cli, cvo_edge.process, cvo_export.cli\n"
        "assert dict(os.environ) == before, set(os.environ) ^ set(before)"
    )
    fresh_process(code)
