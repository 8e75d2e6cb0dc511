"""Whether a picture, or a part of it, came before: frozen cameras, reused buffers, loops.

Three checks, which compare a frame with the 256 frames before it:

- *Equal to the bit.* Sensor noise never repeats, so a textured block of the picture that equals the
  same block of an earlier frame is a copy. This finds frozen pictures, pictures of which a part is
  frozen, a clock drawn over a still, and drivers that hand out old buffers.
- *A loop.* A recording that is played again and again may carry fresh noise. While the picture
  moves, its thumbnail is then much nearer to an old frame than to the previous one, and the next
  frames repeat the frames after that one, in their order and at the same places. A camera that
  returns along its path meets its old frames in the reverse order, one that goes the same way again
  stands between two of them, and one at rest is no nearer to old frames than to the previous one.
- *Still.* A frozen picture with fresh noise looks as that of a camera at rest. Only a caller who
  knows that the camera moves can tell them apart.

Nothing is concluded from blocks without texture, because clipping and compression make them equal.
"""

from __future__ import annotations

from collections import deque
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.record import Reason

Image8 = NDArray[np.uint8]
Numbers = NDArray[np.float32]

# Eight seconds at 30 frames per second.
FRAMES = 256
# Blocks of the model's input, as rows and columns, and cells of each side of a block.
_ROWS, _COLUMNS, _CELLS = 6, 8, 4
# Share of the textured blocks; a moving picture has none that is equal to an earlier one.
_EQUAL_SHARE = 0.05
# Grey levels out of 255, of the means of a block's cells: their standard deviation, and the range
# in which the values of a cell are not clipped. A quarter of the cells has to lie in it.
_TEXTURE, _DARKEST, _BRIGHTEST = 4.0, 8.0, 247.0
# A thumbnail has two cells of a block in one. Brightness is divided by that of its row, because
# lamps flicker, and exposure times differ between frames; the sum keeps dark rows from being noise.
_THUMBNAIL = 2 * _ROWS, 2 * _COLUMNS
_LEVEL, _DARK = 128.0, 16.0
# In levels of the thumbnail. Noise of 4 grey levels in the model's input changes the thumbnail by
# 0.3 (root mean square), and half of its values by less than 0.2; the slowest hundredth of the
# frames of real recordings by 2.5 and by 1.
_STILL, _CHANGED = 1.0, 0.5
_STILL_FRAMES = 4
# Distance to an earlier frame, as a share of that to the previous one, over so many moving frames
# that repeat earlier ones in their order.
_NEAR, _IN_ORDER = 0.15, 8
# The frame before that earlier one is as far away as the previous frame, because both show the
# same; where a camera only passes the same way again, it stood somewhere between two of its frames.
# Relative difference of the squares: the place is the same to a hundredth of a step.
_SAME = 0.02
# A camera at rest that vibrates, or whose lamp flickers (100 Hz at 30 frames a second), comes back
# within fewer frames than a loop has, and then again and again.
_SHORTEST_LOOP, _NEARER = 8, 0.6


def _pairs(count: int) -> Numbers:
    """Return the matrix (count / 2, count) of the means of two neighbours."""
    return np.repeat(np.eye(count // 2, dtype=np.float32), 2, axis=1) / np.float32(2.0)


# A product with cells from the left and the right gives the thumbnail less each row's mean, and as
# the last column that mean.
_PAIRS_OF_ROWS = _pairs(_ROWS * _CELLS)
_WIDE = _pairs(_COLUMNS * _CELLS).T
_MEAN = _WIDE.mean(axis=1, keepdims=True)
_CENTRED_AND_MEAN = np.hstack([_WIDE - _MEAN, _MEAN])


class Digest(NamedTuple):
    """What is compared of a picture.

    Attributes
    ----------
    hashes
        (48,) uint64: a number for each block.
    cells
        (24, 32): mean grey levels.
    thumbnail
        (193,): values relative to the brightness of their row, and their squared length.
    """

    hashes: NDArray[np.uint64]
    cells: Numbers
    thumbnail: Numbers

    @classmethod
    def of(cls, tensor: Image8) -> Digest:
        """Digest the model's input, (1, height, width, 3)."""
        cells = _cells(tensor)
        return cls(_block_hashes(tensor), cells, _thumbnail(cells))


class Repetition:
    """Compares each picture with those before it; pass every picture once, in order."""

    def __init__(self) -> None:
        self._hashes = _Newest(_ROWS * _COLUMNS, np.dtype(np.uint64))
        self._numbers = _Seen()
        # The last column is the squared length of the others.
        self._thumbnails = _Newest(_THUMBNAIL[0] * _THUMBNAIL[1] + 1, np.dtype(np.float32))
        # Squared distances to earlier frames, of the last frames in which the picture moved, and
        # of these the distances to the previous frame.
        self._moving: deque[Numbers] = deque(maxlen=_IN_ORDER)
        self._steps: deque[float] = deque(maxlen=_IN_ORDER)

    def doubts(
        self, digest: Digest, *, fresh_noise: bool = True, moving: bool | None = None
    ) -> tuple[Reason, ...]:
        """Compare a picture with earlier ones and store it.

        Parameters
        ----------
        digest
            Of the picture.
        fresh_noise
            Whether equal blocks are copies. Behind a codec that codes the difference to the
            previous frame, they mean that nothing moved.
        moving
            Whether the camera moves; None if that is unknown.
        """
        hashes, cells, thumbnail = digest
        # Usually none of the numbers was seen before, and a set is the fastest way to find out.
        seen = self._numbers.add(hashes.tolist())
        repeated = seen and fresh_noise and self._equal(hashes, cells)
        squares = self._squared_distances(thumbnail)
        looped = self._loops(squares, thumbnail) and moving is not False
        still = moving is True and _still(squares)
        self._hashes.add(hashes)
        self._thumbnails.add(thumbnail)
        return (Reason.FRAME_REPEATED,) * (repeated or looped) + (Reason.PICTURE_STILL,) * still

    def _equal(self, hashes: NDArray[np.uint64], cells: Numbers) -> bool:
        textured = _textured(cells)
        found = int(np.count_nonzero((self._hashes.rows == hashes).any(axis=0) & textured))
        return found > 0 and found >= _EQUAL_SHARE * int(np.count_nonzero(textured))

    def _squared_distances(self, thumbnail: Numbers) -> Numbers:
        """Return the squared distance to each earlier thumbnail, the newest last."""
        factors = np.float32(-2.0) * thumbnail
        factors[-1] = 1.0
        squares: Numbers = self._thumbnails.rows @ factors + thumbnail[-1]
        return squares

    def _loops(self, squares: Numbers, thumbnail: Numbers) -> bool:
        if len(squares) == 0 or not self._moved(thumbnail):
            return False
        self._moving.append(squares)
        self._steps.append(float(squares[-1]))
        old = squares[: 1 - _SHORTEST_LOOP]
        if len(self._moving) < _IN_ORDER or len(old) == 0:
            return False
        moved = sum(self._steps)
        near = min(_IN_ORDER * _STILL**2 * (thumbnail.size - 1), _NEAR**2 * moved)
        # A sum below a limit has no part beyond it: usually, this is the end.
        return bool(old.min() < near) and _is_loop(self._by_lag().sum(axis=0), moved, near)

    def _by_lag(self) -> Numbers:
        """Return the distances of the moving frames, (8, 256), infinite where nothing was before.

        Each row is of one frame, its last column of the frame before that one: a lag of 1. In a
        loop, the lag stays the same from row to row.
        """
        by_lag = np.full((_IN_ORDER, FRAMES), np.inf, np.float32)
        for row, distances in zip(by_lag, self._moving, strict=True):
            row[-len(distances) :] = distances
        return by_lag

    def _moved(self, thumbnail: Numbers) -> bool:
        """Whether at least half of the picture changed since the previous frame."""
        change = np.abs(thumbnail[:-1] - self._thumbnails.rows[-1, :-1])
        return bool(2 * np.count_nonzero(change > _CHANGED) >= change.size)


def _is_loop(total: Numbers, moved: float, near: float) -> bool:
    """Whether sums of distances by lag, (256,), show a loop; ``moved`` is that of the lag 1."""
    # From the second frame on that is compared with all of them: the first has none before it.
    oldest = int(np.isfinite(total).argmax()) + 1
    if oldest > FRAMES - _SHORTEST_LOOP:
        return False
    nearest = oldest + int(total[oldest : 1 - _SHORTEST_LOOP].argmin())
    same_place = abs(total[nearest - 1] - moved) < _SAME * moved
    oscillates = total[1 - _SHORTEST_LOOP : -1].min() < _NEARER**2 * moved
    return bool(total[nearest] < near and same_place and not oscillates)


class _Seen:
    """The numbers of at least the newest ``FRAMES`` frames, and of fewer than twice as many."""

    def __init__(self) -> None:
        self._newer: set[int] = set()
        self._older: set[int] = set()
        self._frames = 0

    def add(self, numbers: list[int]) -> bool:
        """Store the numbers of a frame; tell whether any of them was there before."""
        seen = not (self._newer.isdisjoint(numbers) and self._older.isdisjoint(numbers))
        if self._frames == FRAMES:
            self._older, self._newer, self._frames = self._newer, set(), 0
        self._newer.update(numbers)
        self._frames += 1
        return seen


class _Newest:
    """The newest ``FRAMES`` rows, in order, as a view of twice as many."""

    def __init__(self, width: int, kind: np.dtype[Any]) -> None:
        self._rows = np.zeros((2 * FRAMES, width), kind)
        self._begin = self._end = 0

    @property
    def rows(self) -> NDArray[Any]:
        """Shape (at most ``FRAMES``, width), the newest last."""
        return self._rows[self._begin : self._end]

    def add(self, row: NDArray[Any]) -> None:
        """Append a row; the oldest is forgotten if there are too many."""
        if self._end == len(self._rows):
            self._rows[:FRAMES] = self._rows[FRAMES:]
            self._end = FRAMES
        self._rows[self._end] = row
        self._end += 1
        self._begin = max(0, self._end - FRAMES)


@cache
def _factors(tall: int, words: int) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return odd numbers for the rows of a block, (tall,), and for words, (6, words)."""
    generator = np.random.default_rng([tall, words])
    rows = generator.integers(2**64, size=tall, dtype=np.uint64)
    columns = generator.integers(2**64, size=(_ROWS, words), dtype=np.uint64)
    return rows | np.uint64(1), columns | np.uint64(1)


def _block_hashes(tensor: Image8) -> NDArray[np.uint64]:
    """Model input -> a number for each block, (48,): the sum of its words times random factors.

    A factor for the row times one for the column. Blocks with other bytes have another number, but
    for a chance of about 2^-64. A word has eight
    bytes, or one if the input is narrower than 22 pixels; what is beyond a whole number of words
    for each block is left out.
    """
    rows = tensor.reshape(tensor.shape[1], -1)
    word = np.dtype(np.uint64 if rows.shape[1] >= 8 * _COLUMNS else np.uint8)
    tall, long = len(rows) // _ROWS, rows.shape[1] // (_COLUMNS * word.itemsize)
    words = rows[: tall * _ROWS, : long * _COLUMNS * word.itemsize].view(word)
    row_factors, column_factors = _factors(tall, words.shape[1])
    # Rows first: no product is as large as the image.
    blocks = words.reshape(_ROWS, tall, -1)
    columns: NDArray[np.uint64] = np.einsum("brc,r->bc", blocks, row_factors) * column_factors
    return np.asarray(columns.reshape(_ROWS * _COLUMNS, long).sum(axis=1))


def _cells(tensor: Image8) -> Numbers:
    """Model input -> mean grey levels of 24 x 32 cells."""
    grey = cv2.cvtColor(tensor[0], cv2.COLOR_RGB2GRAY)
    size = _COLUMNS * _CELLS, _ROWS * _CELLS
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def _thumbnail(cells: Numbers) -> Numbers:
    values = _PAIRS_OF_ROWS @ cells @ _CENTRED_AND_MEAN
    thumbnail = np.empty(_THUMBNAIL[0] * _THUMBNAIL[1] + 1, np.float32)
    relative = thumbnail[:-1]
    np.multiply(values[:, :-1], _LEVEL / (values[:, -1:] + _DARK), out=relative.reshape(_THUMBNAIL))
    thumbnail[-1] = relative @ relative
    return thumbnail


def _textured(cells: Numbers) -> NDArray[np.bool_]:
    """Tell for each block, (48,), whether noise must have changed it."""
    blocks = cells.reshape(_ROWS, _CELLS, _COLUMNS, _CELLS)
    unclipped = ((blocks > _DARKEST) & (blocks < _BRIGHTEST)).mean(axis=(1, 3)) >= 0.25
    textured: NDArray[np.bool_] = (blocks.std(axis=(1, 3)) >= _TEXTURE) & unclipped
    return textured.ravel()


def _still(squares: Numbers) -> bool:
    """Whether the last few frames differ from this one by no more than noise."""
    last = squares[-_STILL_FRAMES:]
    size = _THUMBNAIL[0] * _THUMBNAIL[1]
    return len(last) == _STILL_FRAMES and bool(last.max() < _STILL**2 * size)
