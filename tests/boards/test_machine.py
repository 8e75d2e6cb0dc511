"""The packages that are installed on an emulated board."""

import tomllib

import pytest

from boards.machine import BOARDS, ROOT, TEST_PACKAGES, SetUpError, requirements


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


@pytest.mark.parametrize("board", BOARDS.values(), ids=lambda board: board.name)
def test_every_test_of_a_board_exists(board):
    for test in board.tests:
        path, *names = test.partition("[")[0].split("::")
        assert (ROOT / path).exists(), test
        for name in names:
            assert f"def {name}(" in (ROOT / path).read_text("utf-8"), test
