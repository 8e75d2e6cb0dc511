"""Both packages: their metadata, and the versions that constraints/ pins."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import cvo_edge
from constraints.refresh import ROOTS, closure

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = {"cvo-edge": ROOT, "cvo-export": ROOT / "export"}
PROJECTS = {
    name: tomllib.loads((folder / "pyproject.toml").read_text("utf-8"))
    for name, folder in FOLDERS.items()
}
both = pytest.mark.parametrize("name", FOLDERS)


def requirements(name, *extras):
    """Requirements of a package and of these extras, without the project's own packages."""
    project = PROJECTS[name]["project"]
    lines = list(project["dependencies"])
    for extra in extras:
        lines += project["optional-dependencies"][extra]
    found = [Requirement(line) for line in lines]
    return {canonicalize_name(one.name): one for one in found if one.name not in FOLDERS}


def pins(file):
    """Versions in a file of constraints/, by canonical name; every line is ``name==version``."""
    lines = (ROOT / "constraints" / file).read_text("utf-8").splitlines()
    found = [line.split("==") for line in lines if not line.startswith("#")]
    versions = {canonicalize_name(name): Version(version) for name, version in found}
    assert len(versions) == len(found)
    return versions


def installed_version(name):
    """Installed version without a local label such as ``+cpu``; None if it is not installed."""
    try:
        return Version(Version(version(name)).public)
    except PackageNotFoundError:
        return None


@both
def test_the_wheel_carries_licence_readme_classifiers_and_urls(name):
    folder, project = FOLDERS[name], PROJECTS[name]["project"]
    assert project["license"] == "Apache-2.0"
    for file in (*project["license-files"], project["readme"]):
        assert (folder / file).stat().st_size > 0
    assert (folder / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert {"Typing :: Typed", "Operating System :: POSIX :: Linux"} <= {*project["classifiers"]}
    assert project["urls"]
    assert all(url.startswith("https://") for url in project["urls"].values())


def test_every_url_is_one_that_the_citation_names():
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    for project in PROJECTS.values():
        paper = project["project"]["urls"]["Paper"]
        assert f"arXiv:{paper.removeprefix('https://arxiv.org/abs/')}" in citation


@both
def test_every_data_pattern_matches_files_and_types_are_marked(name):
    data = PROJECTS[name]["tool"]["setuptools"]["package-data"]
    package = name.replace("-", "_")
    assert set(data) == {package}
    assert "py.typed" in data[package]
    for pattern in data[package]:
        assert list((FOLDERS[name] / package).glob(pattern)), pattern


@both
def test_every_file_of_a_package_is_code_or_data_of_its_wheel(name):
    package = FOLDERS[name] / name.replace("-", "_")
    patterns = PROJECTS[name]["tool"]["setuptools"]["package-data"][package.name]
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    for path in package.rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert path in packed or path.suffix == ".py", path
            assert (path.parent / "__init__.py").is_file() or path in packed, path


def test_all_places_name_the_same_version():
    expected = cvo_edge.__version__
    other = (ROOT / "export" / "cvo_export" / "__init__.py").read_text("utf-8")
    assert re.findall(r'^__version__ = "(.+)"$', other, re.MULTILINE) == [expected]
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.findall(r"^version: (.+)$", citation, re.MULTILINE) == [expected]
    for project in PROJECTS.values():
        assert project["project"]["dynamic"] == ["version"]
        assert "version" not in project["project"]


def test_the_training_side_takes_this_minor_version_of_the_runtime_only():
    (pin,) = [
        Requirement(line).specifier
        for line in PROJECTS["cvo-export"]["project"]["dependencies"]
        if Requirement(line).name == "cvo-edge"
    ]
    own = Version(cvo_edge.__version__)
    assert own in pin
    assert Version(f"{own.major}.{own.minor}.99") in pin
    assert Version(f"{own.major}.{own.minor + 1}.0") not in pin


def test_the_lowest_constraints_are_the_declared_lower_bounds():
    wanted, lowest = requirements("cvo-edge", "openvino", "sign"), pins("lowest.txt")
    assert set(lowest) == set(wanted)
    for name, requirement in wanted.items():
        (bound,) = [part.version for part in requirement.specifier if part.operator == ">="]
        release = Version(bound).release
        assert lowest[name] in requirement.specifier
        padded = (*lowest[name].release, *[0] * len(release))
        assert padded[: len(release)] == release, name


@pytest.mark.parametrize(
    ("file", "name", "extras"),
    [
        ("runtime.txt", "cvo-edge", ("openvino", "ray", "rosbag", "sign")),
        ("export.txt", "cvo-export", ("plot", "rosbag")),
    ],
)
def test_pinned_versions_are_in_the_closure_and_in_the_declared_ranges(file, name, extras):
    pinned, declared = pins(file), requirements(name, *extras)
    assert set(declared) <= set(pinned)
    for other, requirement in declared.items():
        assert pinned[other] in requirement.specifier, other
    if name == "cvo-export":
        runtime = requirements("cvo-edge")
        assert all(pinned[other] in one.specifier for other, one in runtime.items())


@pytest.mark.parametrize("file", ROOTS)
def test_the_pins_are_the_dependency_closure(file):
    pinned = pins(file)
    others = [one for one, pin in pinned.items() if installed_version(one) != pin]
    if others:
        pytest.skip(f"installed versions differ from constraints/{file}: {', '.join(others[:3])}")
    assert {one: Version(text) for one, text in closure(ROOTS[file][0]).items()} == pinned


def test_both_sides_pin_the_same_versions_of_what_they_share():
    runtime, export = pins("runtime.txt"), pins("export.txt")
    shared = runtime.keys() & export.keys()
    assert {"numpy", "onnxruntime"} <= shared
    assert {name: runtime[name] for name in shared} == {name: export[name] for name in shared}


def test_make_help_lists_every_target():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    named = re.findall(r"^\.PHONY: (.+)$", makefile, re.MULTILINE)
    told = re.findall(r"^([a-z0-9 -]+):.* ## \S", makefile, re.MULTILINE)
    assert {*" ".join(told).split()} == {*" ".join(named).split()}
