"""``cvo-export publish``, ``calibrate`` and ``sign``: commands that write bundles."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cvo_edge.programs.options import examples
from cvo_edge.vocabulary import Crop, Decode, Precision, Provider, SplitKind
from cvo_export.cli.app import (
    CapOption,
    DatasetArgument,
    JointOption,
    NameOption,
    RuleOption,
    ScoreOption,
    SidesOption,
    app,
    opened,
)
from cvo_export.vocabulary import GivenRotation


@app.command(
    epilog=examples(
        "cvo-export publish runs/redkitchen bundles/redkitchen",
        "cvo-export publish runs/redkitchen bundles/redkitchen-int8 --precision int8",
    )
)
def publish(
    run_dir: Annotated[Path, typer.Argument(help="A finished run.", show_default=False)],
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    precision: Annotated[
        Precision, typer.Option(help="int8: quantise the backbone and calibrate it separately.")
    ] = "fp32",
    provider: Annotated[
        Provider, typer.Option(help="Engine that the bundle is calibrated for and runs on.")
    ] = "onnxruntime",
    decode: Annotated[
        Decode,
        typer.Option(help="half: JPEG files are read at half size, faster; nothing else can be."),
    ] = "full",
    rule: RuleOption = None,
    cap: CapOption = None,
    joint: JointOption = "max",
    score: ScoreOption = None,
    sides: SidesOption = None,
    name: NameOption = None,
    dataset: Annotated[
        str | None, typer.Option(help="New location of the data set, if it has moved.")
    ] = None,
) -> None:
    """Export a run to ONNX, calibrate that graph and write its bundle."""
    from cvo_edge.programs.inspect import inspect_lines
    from cvo_export.publish import publish as publish_run
    from cvo_export.training.run import load_run

    calibration = publish_run(
        load_run(run_dir, dataset),
        bundle,
        name or bundle.resolve().name,
        rule=rule,
        cap=cap,
        joint=joint,
        score=score,
        sides=sides,
        precision=precision,
        provider=provider,
        decode=decode,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command(
    epilog=examples(
        "cvo-export calibrate my-network.onnx tum:freiburg1_room bundles/room",
        "cvo-export calibrate bundles/redkitchen 7scenes:scenes/office bundles/office",
    )
)
def calibrate(
    model: Annotated[
        Path, typer.Argument(help="An ONNX file, or a bundle folder.", show_default=False)
    ],
    dataset: DatasetArgument,
    bundle: Annotated[Path, typer.Argument(help="Bundle folder to write.", show_default=False)],
    split: Annotated[
        SplitKind | None,
        typer.Option(
            help="Unit of the split; default: sequence if there are three or more, otherwise block."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the split; default: 0.")] = None,
    rule: RuleOption = None,
    cap: CapOption = None,
    joint: JointOption = "max",
    score: ScoreOption = None,
    sides: SidesOption = None,
    rotation: Annotated[
        GivenRotation | None,
        typer.Option(help="ONNX file: chart of its bounds; default: tangent_predicted."),
    ] = None,
    crop: Annotated[
        Crop | None, typer.Option(help="ONNX file: crop applied to the image; default: none.")
    ] = None,
    origin: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            help="ONNX file: x y z (m) that its positions are relative to; default: 0 0 0.",
            show_default=False,
        ),
    ] = None,
    given_input: Annotated[
        str | None,
        typer.Option(
            "--input",
            help="ONNX file: its input, e.g. layout=nchw,range=0-1,mean=.5/.5/.5,order=bgr.",
            show_default=False,
        ),
    ] = None,
    given_outputs: Annotated[
        list[str] | None,
        typer.Option(
            "--output",
            help="ONNX file: an output, e.g. pose=NAME or rotation=NAME,form=quaternion_wxyz.",
            show_default=False,
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            help="ONNX file: HEIGHTxWIDTH of its input, if the graph does not say.",
            show_default=False,
        ),
    ] = None,
    new_data: Annotated[
        bool,
        typer.Option("--new-data", help="Bundle: treat a data set of the same name as unseen."),
    ] = False,
    provider: Annotated[
        Provider | None,
        typer.Option(help="Engine to calibrate for; default: the bundle's own, or onnxruntime."),
    ] = None,
    decode: Annotated[
        Decode | None,
        typer.Option(help="How JPEG files are read, see publish; default: the bundle's, or full."),
    ] = None,
    name: NameOption = None,
) -> None:
    """Calibrate an existing network, an ONNX file or a bundle's, on data it has not seen.

    An ONNX file has the input image, uint8 of shape (1, height, width, 3), RGB,
    and the output pose (1, 7); for intervals that adapt, also the outputs lower
    and upper (1, 6). --input, --output and --size adapt a file of another form.
    """
    from cvo_edge.programs.inspect import inspect_lines
    from cvo_export.calibrate import calibrate as calibrate_network

    calibration = calibrate_network(
        model,
        opened(dataset),
        bundle,
        name or bundle.resolve().name,
        kind=split,
        seed=seed,
        rule=rule,
        cap=cap,
        joint=joint,
        score=score,
        sides=sides,
        rotation=rotation,
        crop=crop,
        origin_m=origin,
        given_input=given_input,
        given_outputs=given_outputs or (),
        size_text=size,
        new_data=new_data,
        provider=provider,
        decode=decode,
    )
    print(*inspect_lines(calibration), sep="\n")


@app.command(epilog=examples("cvo-export sign bundles/kitchen --key key.pem --bundle-version 7"))
def sign(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder.", show_default=False)],
    key: Annotated[Path, typer.Option(help="Ed25519 private key (PEM).", show_default=False)],
    bundle_version: Annotated[
        int | None,
        typer.Option(
            help="Devices reject versions below one they have run; default: seconds since 1970.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Sign a bundle for devices that accept only signed ones (run --public-key)."""
    from cvo_export.sign import sign as sign_bundle

    signature = sign_bundle(bundle, key, bundle_version)
    print(f"{signature.name}: version {signature.version}, signed with the key {signature.key}")
