"""The packages that are installed on an emulated board."""

import tomllib

import pytest

from boards.machine import ROOT, TEST_PACKAGES, SetUpError, requirements


def test_requirements_are_those_of_the_project_without_the_oracles():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    found = requirements(project)
    assert found[: -len(TEST_PACKAGES)] == project["project"]["dependencies"]
    assert set(found) <= {
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["test"],
    }


def test_a_missing_test_package_is_named():
    project = {"project": {"dependencies": [], "optional-dependencies": {"test": ["pytest>=8"]}}}
    with pytest.raises(SetUpError, match="hypothesis"):
        requirements(project)
