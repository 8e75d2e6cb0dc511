"""What can be trusted in a reconstruction, as a file and as text."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

from cvo_export.reconstruct.mapping import GOOD_SHARE, Mapped, Mapper
from cvo_export.reconstruct.model import Model
from cvo_export.reconstruct.recordings import frame_of
from cvo_export.reconstruct.scale import Scale

# Beyond these, a figure is mentioned as a doubt.
_LARGE_ERROR_PX, _SHORT_TRACK, _LARGE_SPREAD, _FEW_VIEWS = 1.0, 3.0, 0.02, 3


class Gap(Struct, frozen=True):
    """Frames in a row without a pose: first and last number, and how many images were used."""

    first: int
    last: int
    images: int


class Share(Struct, frozen=True):
    """A recording: its frames, the images used of it, and those placed in the map."""

    name: str
    frames: int
    images: int
    placed: int
    gaps: tuple[Gap, ...]


class Report(Struct, frozen=True):
    """Figures of a reconstruction; ``doubts`` says in words what is not to be trusted.

    ``camera`` holds fx, fy, cx, cy and the lens coefficients of the first image's camera, in
    pixels; ``unit`` is the unit of all positions.
    """

    recordings: tuple[Share, ...]
    images: int
    placed: int
    points: int
    error_px: float
    track: float
    mapper: Mapper
    other_worlds: list[int]
    intrinsics_known: bool
    camera: tuple[float, ...]
    unit: str
    scale: Scale
    doubts: tuple[str, ...]

    @property
    def registered(self) -> float:
        """Share of the images that have a pose."""
        return self.placed / self.images


def gaps(used: Sequence[int], placed: set[int]) -> tuple[Gap, ...]:
    """Return the runs of used frame numbers that are not placed."""
    found: list[Gap] = []
    run: list[int] = []
    for number in [*used, None]:
        if number is not None and number not in placed:
            run.append(number)
        elif run:
            found.append(Gap(run[0], run[-1], len(run)))
            run = []
    return tuple(found)


def make_report(
    frames: dict[str, int],
    names: Sequence[str],
    model: Model,
    mapped: Mapped,
    scale: Scale,
    *,
    intrinsics_known: bool,
) -> Report:
    """Return the report: ``frames`` has the length of each recording, ``names`` the images used."""
    shares = []
    for recording, length in frames.items():
        used = [frame_of(name)[1] for name in names if frame_of(name)[0] == recording]
        placed = {frame_of(name)[1] for name in model.names if frame_of(name)[0] == recording}
        missing = gaps(used, placed)
        shares.append(Share(recording, length, len(used), len(placed), missing))
    camera = model.cameras[0]
    return Report(
        recordings=tuple(shares),
        images=len(names),
        placed=len(model.names),
        points=model.points,
        error_px=model.error_px,
        track=model.track,
        mapper=mapped.mapper,
        other_worlds=mapped.other_worlds,
        intrinsics_known=intrinsics_known,
        camera=(camera.fx, camera.fy, camera.cx, camera.cy, *camera.coefficients),
        unit="arbitrary" if scale.origin == "none" else "metres",
        scale=scale,
        doubts=tuple(_doubts(shares, model, mapped, scale, intrinsics_known)),
    )


def _doubts(
    shares: Sequence[Share], model: Model, mapped: Mapped, scale: Scale, known: bool
) -> list[str]:
    doubts = []
    for share in shares:
        if not share.placed:
            doubts.append(f"{share.name} is not in the map: no image of it overlaps the others")
        elif share.placed < GOOD_SHARE * share.images:
            doubts.append(
                f"{share.name}: {share.placed} of {share.images} images have a pose; record its "
                "gaps again, slower"
            )
    if mapped.other_worlds:
        parts = ", ".join(map(str, mapped.other_worlds))
        doubts.append(f"the images fall apart; parts left out have {parts} images")
    if model.error_px > _LARGE_ERROR_PX:
        doubts.append(f"the mean reprojection error is {model.error_px:.2f} px, more than 1")
    if model.track < _SHORT_TRACK:
        doubts.append(f"a point is seen in {model.track:.1f} images only: few images overlap")
    if not known:
        doubts.append("the intrinsics are estimated; --intrinsics gives known ones")
    if scale.origin == "none":
        doubts.append(
            "the unit is arbitrary, not metres: nothing of known size was given (--tag-size, "
            "--distance, --known-poses)"
        )
    if scale.spread is not None and scale.spread > _LARGE_SPREAD:
        doubts.append(f"the scale is uncertain: its sources differ by +- {scale.spread:.1%}")
    if scale.origin == "distance":
        doubts.append("the scale comes from one distance and is as uncertain as that")
    if scale.tags and max(tag.views for tag in scale.tags) < _FEW_VIEWS:
        doubts.append("every tag is seen in two images only; show it longer")
    return doubts


def report_lines(report: Report) -> list[str]:
    """Return the report as text."""
    lines = [
        f"{share.name}: {share.images} of {share.frames} frames used, {share.placed} placed"
        + "".join(
            f"; gap {gap.first} to {gap.last} ({gap.images} image{'s' * (gap.images != 1)})"
            for gap in share.gaps
        )
        for share in report.recordings
    ]
    lines.append(
        f"map: {report.placed} of {report.images} images placed ({report.registered:.1%}) by the "
        f"{report.mapper} mapper"
    )
    lines.append(
        f"points: {report.points}, each in {report.track:.1f} images; mean reprojection error "
        f"{report.error_px:.2f} px"
    )
    fx, fy, cx, cy, *lens = report.camera
    source = "known" if report.intrinsics_known else "estimated"
    distortion = f", distortion {' '.join(f'{value:.4g}' for value in lens)}" if lens else ""
    lines.append(f"camera ({source}): fx {fx:.1f} fy {fy:.1f} cx {cx:.1f} cy {cy:.1f}{distortion}")
    scale = report.scale
    if scale.origin == "none":
        lines.append("unit: arbitrary")
    else:
        spread = "" if scale.spread is None else f", +- {scale.spread:.2%}"
        seen = ", ".join(f"tag {tag.number} in {tag.views} images" for tag in scale.tags)
        by = {"tags": seen, "distance": "a distance", "poses": "known poses"}[scale.origin]
        lines.append(f"unit: metres, by {by}{spread}")
    lines.extend(f"doubt: {doubt}" for doubt in report.doubts)
    return lines
