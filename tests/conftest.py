"""Shared fixtures: the demonstration bundle, its clip, and real data if CVO_DATA is set."""

from __future__ import annotations

import os
import resource
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import settings

from cvo_edge.bundle.format import CALIBRATION_FILE, Calibration, Threshold
from cvo_edge.bundle.reading import encode_calibration
from cvo_edge.engine import cores
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.heads import HEADS, Head
from cvo_edge.vocabulary import Joint, Scope

# No deadline: shared machines are slow at times, and a slow pass is still a pass.
settings.register_profile("project", deadline=None)
settings.load_profile("project")

# A worker has a core of its own: further threads would wait, busily, for the other worker's core.
# Its libraries read this when they are loaded.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

ROOT = Path(__file__).resolve().parent.parent
ARTIFACTS = ROOT / "calibration_artifacts"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the files that train first, so that no core waits at the end for one that began late."""
    items.sort(key=lambda item: "export" not in item.path.relative_to(ROOT).parts)


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """Run models in one thread where a test asks for no number; commands use all cores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cores, "allowed_cores", lambda: 1)
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_model_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep commands run by tests away from the user's model cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CVO_EDGE_CACHE", str(tmp_path_factory.mktemp("models")))
        yield


@pytest.fixture
def files_limited() -> Callable[[int], AbstractContextManager[None]]:
    """Limit the size of each file that this process writes, like a full disk."""

    @contextmanager
    def limited(limit: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            signal.signal(signal.SIGXFSZ, handler)

    return limited


@pytest.fixture(scope="session")
def bundle_dir() -> Path:
    return ARTIFACTS / "synthetic-room-cjp"


@pytest.fixture(scope="session")
def artifacts_dir() -> Path:
    return ARTIFACTS


@pytest.fixture(scope="session")
def clip_dir() -> Path:
    return ARTIFACTS / "synthetic-room-clip"


@pytest.fixture(scope="session")
def bundle(bundle_dir: Path) -> Bundle:
    return read_bundle(bundle_dir)


@pytest.fixture
def copied_bundle(bundle_dir: Path, tmp_path: Path) -> Path:
    """A copy of the demonstration bundle that tests may damage."""
    return Path(shutil.copytree(bundle_dir, tmp_path / "bundle"))


@pytest.fixture
def rewrite(copied_bundle: Path) -> Callable[[Calibration], Path]:
    """Write another calibration into the copied bundle, with a matching digest."""

    def write(calibration: Calibration) -> Path:
        content = encode_calibration(calibration)
        (copied_bundle / CALIBRATION_FILE).write_bytes(content)
        return copied_bundle

    return write


@pytest.fixture(scope="session")
def make_head(bundle: Bundle) -> Callable[..., Head]:
    """Build a method's head with these parameters, score and thresholds at 0.9."""

    def make(
        method: str,
        score: str,
        parameters: dict[str, Any],
        q_hat: Any = (None,) * 6,
        q_hat_upper: Any = None,
        scope: Scope = "marginal",
        joint: Joint = "max",
    ) -> Head:
        entry = Threshold(confidence=0.9, scope=scope, q_hat=q_hat, q_hat_upper=q_hat_upper)
        calibration = msgspec.structs.replace(bundle.calibration, method_parameters=parameters)
        head = HEADS[method](calibration.parameters(HEADS[method].parameters_type), score)
        head.check((entry,), joint)
        return head

    return make


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder with real recordings; skips the test if CVO_DATA is not set."""
    folder = os.environ.get("CVO_DATA")
    if not folder:
        pytest.skip("CVO_DATA is not set: no real data")
    return Path(folder)


def changed(calibration: Calibration, **values: object) -> Calibration:
    return msgspec.structs.replace(calibration, **values)
