"""Write bundle folders atomically."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE, Calibration
from cvo_edge.bundle.reading import encode_calibration, read_calibration
from cvo_edge.bundle.signature import SIGNATURE_FILE
from cvo_edge.engine.selftest import check_reaction, check_selftest
from cvo_edge.errors import SinkError
from cvo_edge.heads.plausible import check_plausible
from cvo_edge.odometer import Odometer


def check_target(bundle_dir: Path) -> None:
    """Raise SinkError if the folder contains files that do not belong to a bundle."""
    own = {CALIBRATION_FILE, MODEL_FILE}
    if bundle_dir.exists() and not (
        bundle_dir.is_dir()
        # The signature of the bundle that is replaced goes with it.
        and {path.name for path in bundle_dir.iterdir()} - {SIGNATURE_FILE} in (own, set())
    ):
        raise SinkError(
            f"{bundle_dir}: expected a new folder or a bundle to replace, found other files"
        )


def write_bundle(bundle_dir: Path, calibration: Calibration, model_bytes: bytes) -> Calibration:
    """Write to a temporary folder next to the target, read and self-test it, move it into place.

    Raises
    ------
    GateError
        The written bundle fails its own self-test.
    SinkError
        The folder cannot be written.
    """
    content = encode_calibration(calibration)
    parent = bundle_dir.resolve().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{bundle_dir.name}.", dir=parent))
    except OSError as error:
        raise SinkError(f"{parent}: cannot be written: {error.strerror}") from None
    try:
        partial.chmod(0o755)
        (partial / MODEL_FILE).write_bytes(model_bytes)
        (partial / CALIBRATION_FILE).write_bytes(content)
        with Odometer.load(partial) as odometer:
            check_plausible(odometer.calibration, odometer.head)
            check_selftest(odometer)
            check_reaction(odometer)
        replaced = None
        if bundle_dir.exists():
            replaced = Path(tempfile.mkdtemp(prefix=f".{bundle_dir.name}.", dir=parent)) / "old"
            bundle_dir.rename(replaced)
        partial.rename(bundle_dir)
        if replaced is not None:
            shutil.rmtree(replaced.parent)
    except OSError as error:
        raise SinkError(f"{bundle_dir}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return read_calibration(bundle_dir)
