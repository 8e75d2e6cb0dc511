"""Training inputs of the heads: cached features of augmented copies, or fresh images.

Features of a frozen network come from its exported graph, run by the runtime: on a CPU this is
several times faster than torch, and it yields exactly what the device computes.
"""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from cvo_edge.engine.cores import allowed_cores
from cvo_edge.engine.session import Session
from cvo_edge.errors import SourceError
from cvo_edge.files import whole_file
from cvo_edge.input import preprocess
from cvo_edge.input.view import crop_view
from cvo_edge.vocabulary import Crop
from cvo_export.data.augment import AugmentConfig, augmented, noisy_copy
from cvo_export.datasets import PoseDataset
from cvo_export.graph.to_onnx import export_onnx
from cvo_export.progress import Progress

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


class ModelImages:
    """Frames of a data set as model inputs: (height, width, 3) uint8 RGB, kept in memory.

    Their poses are relative to the data set's ``origin_m``.
    """

    def __init__(
        self,
        dataset: PoseDataset,
        indices: NDArray[np.int64],
        height: int,
        width: int,
        crop: Crop,
    ) -> None:
        self.poses = dataset.local_poses[indices]
        self.images = np.empty((indices.size, height, width, 3), dtype=np.uint8)
        camera = dataset.camera()
        # The camera whose images these are, or None.
        self.camera = None
        if camera is not None:
            view = crop_view(camera.height, camera.width, height, width, crop)
            self.camera = view.camera(camera)
        for row, index in enumerate(indices.tolist()):
            image = preprocess.to_bgr8(dataset.read_image(index))
            if image is None:
                raise SourceError(f"{dataset.frame_names[index]}: expected a colour image")
            self.images[row] = preprocess.model_input(image, height, width, crop)[0]
            if not row:
                size = image.shape[0], image.shape[1]
                # Camera pixels per pixel of the input along a side.
                self._pixels = 1.0 / crop_view(*size, height, width, crop).enlarged

    def __len__(self) -> int:
        return len(self.images)

    def digest(self) -> str:
        """sha256 of all pixels."""
        return hashlib.sha256(self.images.tobytes()).hexdigest()

    def augmented(
        self,
        row: int,
        config: AugmentConfig,
        generator: np.random.Generator,
        zoom: float = 1.0,
        noise: float = 0.0,
    ) -> tuple[Image, Array]:
        """Return an augmented copy of one image and its exact pose (7,).

        ``noise`` is the probability that it is also degraded by one of the study's noises.
        """
        image, pose = self.images[row], self.poses[row]
        image, pose = augmented(image, pose, self.camera, config, generator, zoom)
        if noise > 0.0 and generator.random() < noise:
            image = noisy_copy(image, self._pixels, generator)
        return image, pose


class FeatureExtractor:
    """Images (height, width, 3) uint8 RGB -> features, by the exported backbone.

    The first image triggers the export: a run whose features are all cached does without it.
    """

    def __init__(self, backbone: nn.Module, height: int, width: int) -> None:
        self._backbone = backbone
        self._blank = torch.zeros((1, height, width, 3), dtype=torch.uint8)
        self._session: Session | None = None
        self._exporting = Lock()

    def __call__(self, image: Image) -> NDArray[np.float32]:
        """Return the features of one image."""
        with self._exporting:
            if self._session is None:
                content = export_onnx(self._backbone, [self._blank], ["image"], ["features"])
                # One thread per session: images are processed in parallel.
                self._session = Session(content, threads=1)
        return np.asarray(self._session.run({"image": image[np.newaxis]})["features"][0])


def cached_features(
    folder: Path, images: ModelImages, extractor: FeatureExtractor
) -> NDArray[np.float32]:
    """Features (n, ...) of the unaugmented images, cached in a file named after their pixels."""
    path = folder / f"frames-{images.digest()[:24]}.npz"
    found = _stored(path, len(images))
    if found is None:
        found = {"features": np.stack([extractor(image) for image in images.images])}
        _store(path, found)
    return found["features"]


def cached_copies(
    folder: Path,
    images: ModelImages,
    extractor: FeatureExtractor,
    config: AugmentConfig,
    copies: int,
    seed: int,
    progress: Progress,
    noise: float = 0.0,
) -> tuple[NDArray[np.float16], Array]:
    """Features (copies + 1, n, ...) and poses (copies + 1, n, 7); copy 0 is not augmented.

    ``noise`` is the share of the others that is degraded by one of the study's noises.
    Each copy is a separate file, written atomically, so that an interrupted run resumes with
    the next copy.
    """
    zooms = config.zooms(copies)
    # Filled as they come: a list of all copies would need twice the memory.
    features, poses = np.empty(0, np.float16), np.empty((copies + 1, len(images), 7))
    for number in range(copies + 1):
        path = folder / f"copy-{number:03d}.npz"
        found = _stored(path, len(images))
        if found is None:
            graded = config.graded(number / max(1, copies))
            share = noise if number else 0.0
            found = _one_copy(images, extractor, graded, (seed, number), zooms[number], share)
            _store(path, found)
        if not number:
            features = np.empty((copies + 1, *found["features"].shape), np.float16)
        features[number], poses[number] = found["features"], found["poses"]
        progress("features", number + 1, copies + 1)
    return features, poses


def _stored(path: Path, count: int) -> dict[str, NDArray[Any]] | None:
    """Return the arrays of ``count`` rows each, or None if the file is missing or incomplete."""
    try:
        with path.open("rb") as stream, np.load(stream) as stored:
            arrays = {name: stored[name] for name in ("features", "poses")}
            return arrays if {len(array) for array in arrays.values()} == {count} else None
    except MemoryError:
        raise
    # numpy and zipfile fail in a dozen ways on a file that holds anything else.
    except Exception:  # noqa: BLE001
        return None


def _store(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write atomically: another run may be writing the same file."""
    with whole_file(path, make_folder=True) as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def _one_copy(
    images: ModelImages,
    extractor: FeatureExtractor,
    config: AugmentConfig,
    seed: tuple[int, int],
    zoom: float,
    noise: float,
) -> dict[str, NDArray[Any]]:
    def one(row: int) -> tuple[NDArray[np.float16], Array]:
        # A generator per image makes the result independent of the processing order.
        generator = np.random.default_rng((*seed, row))
        image, pose = images.augmented(row, config, generator, zoom, noise)
        return extractor(image).astype(np.float16), pose

    # OpenCV and onnxruntime release the GIL, so threads can process whole images.
    with ThreadPoolExecutor(max_workers=allowed_cores()) as pool:
        found = list(pool.map(one, range(len(images))))
    return {
        "features": np.stack([features for features, _ in found]),
        "poses": np.stack([pose for _, pose in found]),
    }
