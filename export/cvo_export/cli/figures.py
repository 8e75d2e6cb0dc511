"""``cvo-export evaluate``, ``plot``, ``render``, ``dataset``: inspect bundles and data sets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cvo_edge.errors import UsageError
from cvo_edge.files import check_output, write_report
from cvo_edge.programs.options import ForceOption, examples
from cvo_edge.vocabulary import Scope
from cvo_export.cli.app import DatasetArgument, app, opened
from cvo_export.vocabulary import Subset

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cvo_export.datasets import PoseDataset


@app.command(
    epilog=examples(
        "cvo-export evaluate bundles/redkitchen 7scenes:scenes/redkitchen",
        "cvo-export evaluate bundles/redkitchen 7scenes:new-flights --subset all",
        "cvo-export evaluate bundles/room synthetic:room --noise speckle:0.3",
        "cvo-export evaluate bundles/room synthetic:room --online every=20,delay=5 --then speckle",
    )
)
def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    dataset: DatasetArgument,
    subset: Annotated[
        Subset, typer.Option(help="The run's test frames, or all frames of unseen data.")
    ] = "test",
    noise: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:STRENGTH]",
            help="Degrade the frames, e.g. speckle:0.3.",
        ),
    ] = None,
    online: Annotated[
        str | None,
        typer.Option(
            metavar="every=K,delay=D",
            help="Adapt to a label for every K-th frame, D frames late.",
        ),
    ] = None,
    then: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:STRENGTH]",
            help="With --online: play the frames clean, with this noise, and clean again.",
        ),
    ] = None,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the report as JSON to a file or -.")
    ] = None,
    force: ForceOption = False,
    min_coverage: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Exit 8 if any DoF covers less at 0.9 marginal."),
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Threads of one inference.")] = None,
) -> None:
    """Measure coverage, width and error of a bundle on held-out frames.

    With --noise, the frames are degraded; results are given for the bundle's own
    thresholds and for thresholds of calibration frames with the same noise. NAME
    is gaussian, salt-and-pepper, speckle, motion-blur, exposure or occlusion.
    """
    from cvo_export.bundles.online import parse_schedule
    from cvo_export.data.noise import parse_noise
    from cvo_export.evaluate import check_coverage, table
    from cvo_export.evaluate import evaluate as evaluate_bundle

    if json_file is not None:
        check_output(json_file, bundle, force=force)
    parsed = None if noise is None else parse_noise(noise)
    schedule = None if online is None else parse_schedule(online)
    changed = None if then is None else parse_noise(then)
    report = evaluate_bundle(bundle, opened(dataset), subset, threads, parsed, schedule, changed)
    if json_file is not None:
        write_report(json_file, report)
    if json_file != "-":
        print(*table(report), sep="\n")
    if min_coverage is not None:
        check_coverage(report, min_coverage)


@app.command(
    epilog=examples("cvo-export plot bundles/kitchen 7scenes:scenes/kitchen --out tube.png")
)
def plot(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    dataset: DatasetArgument,
    out: Annotated[Path, typer.Option(help="Picture to write: .png, .svg or .pdf.")],
    force: ForceOption = False,
    subset: Annotated[
        Subset, typer.Option(help="The run's test frames, or all frames of unseen data.")
    ] = "test",
    sequence: Annotated[str | None, typer.Option(help="Only this sequence.")] = None,
    confidence: Annotated[
        float, typer.Option(help="One stored in the bundle, or any if it holds quantiles.")
    ] = 0.9,
    scope: Annotated[
        Scope,
        typer.Option(
            help="Whether the confidence holds per degree of freedom or for all six at once."
        ),
    ] = "marginal",
) -> None:
    """Plot truth, point and bands of each degree of freedom, and x against y."""
    from cvo_export.plot import plot as draw

    check_output(out, force=force)
    draw(
        bundle,
        opened(dataset),
        out,
        subset=subset,
        sequence=sequence,
        confidence=confidence,
        scope=scope,
    )
    print(out)


@app.command(epilog=examples("cvo-export render synthetic:room frames --sequence flight-00"))
def render(
    dataset: DatasetArgument,
    folder: Annotated[Path, typer.Argument(help="New folder.", show_default=False)],
    sequence: Annotated[str, typer.Option(help="Name of one sequence.")],
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of frames, from the first; default: all.")
    ] = None,
) -> None:
    """Write one sequence as a 7-Scenes folder: JPEG images and .pose.txt."""
    from cvo_export.datasets.seven_scenes import write_sequence

    found = opened(dataset)
    if sequence not in found.sequence_names:
        raise UsageError(
            f"sequence: expected one of {found.sequence_names[0]} to "
            f"{found.sequence_names[-1]}, found {sequence}"
        )
    count = write_sequence(found, found.sequence_names.index(sequence), folder, frames)
    print(f"{folder}: {count} frames of {sequence}")


@app.command(
    epilog=examples(
        "cvo-export dataset 7scenes:scenes/redkitchen",
        "cvo-export dataset tum:freiburg1_room --picture room.png",
    )
)
def dataset(
    dataset: DatasetArgument,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw the trajectory into a .png, .svg or .pdf (extra [plot])."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Describe a data set, and say which splits and confidences it supports.

    Frames, skipped frames and why, camera, extent, speed, up axis, rates, gaps, whether
    the images agree with the poses, and what looks like wrong units, directions or axes.
    """
    from cvo_edge.files import whole_file
    from cvo_export.datasets.picture import check_picture, draw

    if picture is None:
        _describe(dataset)
        return
    check_picture(picture, "picture")
    check_output(picture, force=force)
    # Opened first: a picture that cannot be written is refused before any work.
    with whole_file(picture) as stream:
        found, roles = _describe(dataset)
        draw(found, stream, picture.suffix, roles)
    print(f"picture     {picture}")


def _describe(dataset: str) -> tuple[PoseDataset, Mapping[str, NDArray[np.int64]]]:
    """Print what a data set is and supports; return it with the roles of its default split."""
    from cvo_export.bundles.supported import supported, supported_text
    from cvo_export.data.splits import default_kind
    from cvo_export.datasets import open_dataset
    from cvo_export.datasets.describe import describe

    found = open_dataset(dataset)
    print(*describe(found), sep="\n")
    splits = supported(found)
    print(*supported_text(found, splits), sep="\n")
    usual = next(each for each in splits if each.kind == default_kind(found))
    return found, {} if usual.split is None else usual.split.roles
