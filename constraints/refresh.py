"""Rewrite ``runtime.txt`` and ``export.txt`` from the installed environment: ``make constraints``.

Each file pins the dependency closure of one package and of its user-facing extras, in the versions
that the running environment has.
"""

from __future__ import annotations

import platform
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

FOLDER = Path(__file__).resolve().parent
ROOTS = {
    "runtime.txt": (
        "cvo-edge[mavlink,mcap,metrics,openvino,plot,ray,rosbag,sign]",
        "pip install -c constraints/runtime.txt .",
    ),
    "export.txt": (
        "cvo-export[plot,ray,reconstruct,rosbag]",
        "pip install -c constraints/export.txt . ./export",
    ),
}
OWN = {"cvo-edge", "cvo-export"}


def closure(requirement: str) -> dict[str, str]:
    """Versions of all distributions that a requirement needs on this platform, by canonical name.

    The project's own packages are left out, and so are local version labels such as ``+cpu``.

    Raises importlib.metadata.PackageNotFoundError if a requirement is not installed.
    """
    versions: dict[str, str] = {}
    visited: set[tuple[str, str]] = set()
    pending = [Requirement(requirement)]
    while pending:
        wanted = pending.pop()
        name = canonicalize_name(wanted.name)
        found = distribution(name)
        if name not in OWN:
            versions[name] = Version(found.version).public
        needed = [Requirement(line) for line in found.requires or ()]
        for extra in {"", *wanted.extras}:
            if (name, extra) in visited:
                continue
            visited.add((name, extra))
            pending += [
                one for one in needed if one.marker is None or one.marker.evaluate({"extra": extra})
            ]
    return versions


def main() -> None:
    """Write both files."""
    for file, (requirement, command) in ROOTS.items():
        pins = closure(requirement)
        lines = [
            f"# {requirement} as tested: CPython {platform.python_version()}, "
            f"{platform.system()} on {platform.machine()}.",
            f"# Install with `{command}`; refresh with `make constraints`.",
            *(f"{name}=={version}" for name, version in sorted(pins.items())),
        ]
        (FOLDER / file).write_text("\n".join(lines) + "\n", "utf-8")
        print(f"constraints/{file}: {len(pins)} packages")


if __name__ == "__main__":
    main()
