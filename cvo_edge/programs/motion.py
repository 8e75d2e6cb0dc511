"""The commands on trajectories of any estimator: arguments and output only."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from cvo_edge.errors import GateError, UsageError
from cvo_edge.files import check_output, write_report
from cvo_edge.programs.options import (
    INTERVALS,
    REPORT,
    ForceOption,
    JsonFileOption,
    existing_file,
)
from cvo_edge.vocabulary import (
    MotionCovariance,
    MotionEngine,
    MotionFormat,
    MotionRule,
    Scope,
    TrajectoryFormat,
)

if TYPE_CHECKING:
    from cvo_edge.motion.horizons import Horizon

_INPUT = "Input"
# More would not fit into a file of 64 KiB.
MOST_HORIZONS = 12
# Of the name in motion.json.
MOST_LETTERS = 200

FilesArgument = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="EST GT [EST GT ...]",
        help="Pairs of files: an estimate, then its ground truth.",
        readable=False,
        show_default=False,
    ),
]
PairsOption = Annotated[
    Path | None,
    typer.Option(
        "--pairs",
        help="More pairs: lines EST GT [GROUP [TIMES]], relative to this file; quote spaces.",
        readable=False,
        show_default=False,
        rich_help_panel=_INPUT,
    ),
]
TrajectoryFormatOption = Annotated[
    TrajectoryFormat | None,
    typer.Option(
        "--format",
        help="Format of all files; default: as the first line of each shows.",
        show_default=False,
        rich_help_panel=_INPUT,
    ),
]
TimesOption = Annotated[
    Path | None,
    typer.Option(
        "--times",
        help="Seconds, one a line, for files without times (kitti).",
        readable=False,
        show_default=False,
        rich_help_panel=_INPUT,
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option(
        "--fps",
        min=0.01,
        max=10_000.0,
        help="Poses per second of files without times (kitti).",
        show_default=False,
        rich_help_panel=_INPUT,
    ),
]
CorrectOption = Annotated[
    str | None,
    typer.Option(
        "--correct",
        metavar="time,frame,scale",
        help="Correct these of what the report finds: each truth's clock and body frame, and one "
        "scale of all estimates.",
        show_default=False,
    ),
]
MotionArgument = Annotated[
    Path,
    typer.Argument(help="motion.json of conformalize.", readable=False, show_default=False),
]
ConfidenceOption = Annotated[
    float, typer.Option(help="A confidence stored in the file.", rich_help_panel=INTERVALS)
]
RuleOption = Annotated[
    MotionRule,
    typer.Option(help="What the confidence is stated about.", rich_help_panel=INTERVALS),
]
ScopeOption = Annotated[
    Scope,
    typer.Option(
        help="Whether it holds for each degree of freedom or for all six at once.",
        rich_help_panel=INTERVALS,
    ),
]


def conformalize(
    files: FilesArgument = None,
    output: Annotated[
        str, typer.Option("-o", "--output", help="File to write, or - for stdout.")
    ] = "motion.json",
    force: ForceOption = False,
    name: Annotated[
        str, typer.Option(help="Estimator and vehicle, shown in reports.")
    ] = "estimator",
    pairs: PairsOption = None,
    group: Annotated[
        list[str] | None,
        typer.Option(
            help="Drive of each pair, in their order; by default, pairs with one truth are one.",
            show_default=False,
            rich_help_panel=_INPUT,
        ),
    ] = None,
    format: TrajectoryFormatOption = None,
    times: TimesOption = None,
    fps: RateOption = None,
    horizon: Annotated[
        str | None,
        typer.Option(
            help="Frames (f), seconds (s) or metres (m) back, with commas; default: those of "
            "1f,1s,5s,10m,100m that half of the drives are long enough for.",
            show_default=False,
        ),
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(
            help="Windows of tubes, with commas, or none; default: those of 10s,100m that "
            "half of the drives are long enough for.",
            show_default=False,
        ),
    ] = None,
    scale: Annotated[
        str,
        typer.Option(
            metavar="auto|none|COLUMN,...",
            help="auto: learn where the estimator errs more, if that pays; columns of the files "
            "may help; none: do not.",
        ),
    ] = "auto",
    correct: CorrectOption = None,
    engine: Annotated[
        MotionEngine,
        typer.Option(
            help="local: in this process; ray: on a Ray cluster (extra ray), for many recordings. "
            "All its machines need the files at the same paths."
        ),
    ] = "local",
) -> None:
    """Learn intervals on an estimator's motion from trajectories with ground truth."""
    from cvo_edge.programs.conformalize import Wanted, calibrate
    from cvo_edge.programs.trajectories import Reading, listed_files, wanted_corrections

    wanted = wanted_corrections(correct)
    horizons = _horizons("--horizon", horizon)
    windows = [] if window == "none" else _horizons("--window", window)
    columns = _columns(scale)
    if not output:
        raise UsageError("--output: expected a file or -, found nothing")
    if not 0 < len(name) <= MOST_LETTERS or not name.isprintable():
        raise UsageError(
            f"--name: expected 1 to {MOST_LETTERS} printable characters, found {name[:80]!r}"
        )
    given = listed_files(files or [], pairs, group or [])
    read = [path for each in given for path in each.paths]
    check_output(output, *read, pairs, times, force=force)
    calibrate(
        given,
        Reading(format, times, fps),
        Wanted(name, horizons, windows, scale != "none", columns, wanted),
        output,
        engine,
    )


def _columns(scale: str) -> list[str]:
    """Return the columns of --scale; raises UsageError."""
    if scale in ("auto", "none"):
        return []
    columns = scale.split(",")
    if not all(columns) or len(set(columns)) < len(columns) or {"auto", "none"} & set(columns):
        raise UsageError(
            f"--scale: expected auto, none or names of columns, each once, found {scale!r}"
        )
    return columns


def _horizons(option: str, text: str | None) -> list[Horizon] | None:
    from cvo_edge.motion.horizons import Horizon

    if text is None:
        return None
    try:
        found = [Horizon.parse(each) for each in text.split(",")]
    except UsageError as error:
        raise UsageError(f"{option}: {error}") from None
    if len(set(map(str, found))) < len(found) or len(found) > MOST_HORIZONS:
        raise UsageError(
            f"{option}: expected at most {MOST_HORIZONS}, each once, found {text[:80]}"
        )
    return found


def annotate(
    estimate: Annotated[
        str,
        typer.Argument(
            metavar="EST",
            help="Trajectory of the estimator; - reads lines of tum from standard input.",
            show_default=False,
        ),
    ],
    motion: MotionArgument,
    output: Annotated[
        str, typer.Option("-o", "--output", help="File, or - for stdout.", rich_help_panel=REPORT)
    ] = "-",
    confidence: ConfidenceOption = 0.9,
    rule: RuleOption = "mean",
    scope: ScopeOption = "marginal",
    format: Annotated[
        MotionFormat | None,
        typer.Option(
            help="Format of the records; default: by the file's suffix (.jsonl, .csv, .tum), else "
            "jsonl. csv has a row for each horizon; tum has the poses alone; convert makes mcap of "
            "jsonl.",
            show_default=False,
            rich_help_panel=REPORT,
        ),
    ] = None,
    force: ForceOption = False,
    times: TimesOption = None,
    fps: RateOption = None,
    anchors: Annotated[
        Path | None,
        typer.Option(
            help="Times of poses that are taken as known, seconds, one a line; tubes start there. "
            "The first pose is one in any case.",
            readable=False,
            show_default=False,
            rich_help_panel=_INPUT,
        ),
    ] = None,
    covariance: Annotated[
        MotionCovariance | None,
        typer.Option(
            help="Add a covariance: interval, of each motion, for gates; integrated, of each step, "
            "for a filter that adds steps up.",
            show_default=False,
            rich_help_panel=INTERVALS,
        ),
    ] = None,
) -> None:
    """Put intervals on every motion of a trajectory, one JSON record per pose."""
    from cvo_edge.motion.intervals import MotionCalibration
    from cvo_edge.output.sinks import format_of
    from cvo_edge.programs.annotate import annotate_file, annotate_stream
    from cvo_edge.programs.trajectories import Reading

    calibration = MotionCalibration.load(motion)
    level = calibration.level(confidence, rule, scope)
    written_as = format_of(output, format, get_args(MotionFormat))
    existing = existing_file(False, force, written_as)
    if covariance is not None and written_as != "jsonl":
        raise UsageError(f"--covariance: expected the format jsonl, found {written_as}")
    if calibration.pointed and written_as == "csv":
        raise UsageError("--format: expected jsonl or tum for an estimator without a scale")
    if estimate == "-":
        if anchors is not None:
            raise UsageError("--anchors: expected a file of poses, found standard input")
        Reading(None, times, fps).check_used(timed=False)
        check_output(output, motion, force=force)
        annotate_stream(calibration, level, output, existing, written_as, covariance)
        return
    check_output(output, estimate, motion, times, anchors, force=force)
    poses = Reading(None, times, fps).one(Path(estimate))
    annotate_file(calibration, level, poses, output, existing, written_as, anchors, covariance)


def audit(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="EST GT [EST GT ...] MOTION",
            help="Pairs of files, then motion.json of conformalize.",
            readable=False,
            show_default=False,
        ),
    ],
    pairs: PairsOption = None,
    confidence: ConfidenceOption = 0.9,
    rule: RuleOption = "mean",
    scope: ScopeOption = "marginal",
    format: TrajectoryFormatOption = None,
    times: TimesOption = None,
    fps: RateOption = None,
    correct: CorrectOption = None,
    json_file: JsonFileOption = None,
    force: ForceOption = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="PNG file: the first recording from above with its tubes, errors and radii by "
            "horizon, coverage by recording (extra \\[plot]).",
            readable=False,
            show_default=False,
            rich_help_panel=REPORT,
        ),
    ] = None,
    min_coverage: Annotated[
        float | None,
        typer.Option(help="Exit 8 if the coverage of a horizon is lower.", rich_help_panel="Gates"),
    ] = None,
) -> None:
    """Check intervals on recordings with ground truth that they were not learnt from."""
    import msgspec

    from cvo_edge.motion.audit import audit as compare
    from cvo_edge.motion.intervals import MotionCalibration
    from cvo_edge.programs.motion_report import audit_lines
    from cvo_edge.programs.trajectories import (
        Reading,
        correct_pairs,
        fits,
        listed_files,
        read_pairs,
        wanted_corrections,
    )

    if min_coverage is not None and not 0.0 <= min_coverage <= 1.0:
        raise UsageError(f"--min-coverage: expected 0 to 1, found {min_coverage:g}")
    *given, motion = files
    wanted = wanted_corrections(correct)
    if "scale" in wanted:
        raise UsageError("--correct: expected time or frame, found scale, which motion.json holds")
    calibration = MotionCalibration.load(motion)
    level = calibration.level(confidence, rule, scope)
    if picture is not None and picture.suffix.lower() != ".png":
        raise UsageError(f"--picture: expected a file .png, found {picture}")
    if picture is not None and calibration.pointed:
        raise UsageError("--picture: expected a calibration in metres, found one without a scale")
    named = listed_files(given, pairs, [])
    read = [path for each in named for path in each.paths]
    others: list[Path | str | None] = [motion, pairs, times]
    for written in (json_file, picture):
        if written is not None:
            check_output(written, *read, *others, force=force)
            others.append(written)
    pairs_read = read_pairs(named, Reading(format, times, fps)).pairs
    if wanted:
        pairs_read, _ = correct_pairs(pairs_read, fits(pairs_read), wanted)
    found = pairs_read.collect()
    report = compare(calibration, level, found)
    failure = None
    if min_coverage is not None:
        failure = report.failure(min_coverage)
    if picture is not None:
        from cvo_edge.programs.motion_picture import draw_audit

        draw_audit(picture, calibration, level, found, report)
    if json_file is not None:
        write_report(json_file, msgspec.to_builtins(report))
    try:
        if json_file != "-":
            print(*audit_lines(report), sep="\n", flush=True)
    except BrokenPipeError:
        # Whoever closed the pipe still wants to know whether the gate failed.
        if failure is None:
            raise
    if failure is not None:
        raise GateError(f"audit: {failure}")
