"""Whose file is replaced: every option that names an output, on both command lines."""

import re

import numpy as np
import pytest
import typer

from cvo_edge.errors import SinkError, UsageError
from cvo_edge.files import check_output, picture_metadata
from cvo_edge.output.drawing import write_png
from cvo_edge.programs.cli import app as edge
from cvo_export.cli import app as export

BUNDLE, CLIP = (
    "calibration_artifacts/synthetic-room-cjp",
    "calibration_artifacts/synthetic-room-clip",
)
ROOM = "synthetic:room,flights=2,frames=3"
FOREIGN = {
    "text": b"precious\n",
    # Our name in a document is no sign of our file, nor is a header that it quotes.
    "notes": b'# How to run cvo-edge\n\n{"software": "cvo-edge 0.1.0"}\n',
    "script": b"#!/bin/sh\ncvo-edge run my-bundle frames/ -o out.jsonl\n",
    "page": b'<!doctype html>\n<html><head><title>content="cvo-edge 1"</title></head></html>\n',
    "json": b'{"name": "cvo-edge", "version": 1}\n',
    "picture": b"\x89PNG\r\n\x1a\n\x00\x00\x00\x0dIHDR cvo-edge",
}
# Commands by option that names an output: OUT stands for it, IN for a folder with inputs.
WRITERS = {
    ("run", "output"): f"run {BUNDLE} {CLIP} --max-frames 2 --quiet --fps 1 -o OUT",
    ("demo", "picture"): "demo --picture OUT",
    ("bench", "json_file"): f"bench {BUNDLE} --frames 1 --warmup 0 --no-cache --json OUT",
    ("bench", "report"): f"bench {BUNDLE} --frames 1 --warmup 0 --no-cache --report OUT",
    (
        "odometry",
        "output",
    ): f"odometry {CLIP} --camera IN/camera.json --fps 1 --max-frames 2 --quiet -o OUT",
    ("conformalize", "output"): "conformalize --pairs IN/pairs.txt -o OUT",
    ("annotate", "output"): "annotate IN/0.tum IN/motion.json -o OUT",
    ("audit", "json_file"): "audit IN/0.tum IN/0.true.tum IN/motion.json --json OUT",
    ("audit", "picture"): "audit IN/0.tum IN/0.true.tum IN/motion.json --picture OUT",
    ("convert", "output"): "convert IN/records.jsonl -o OUT",
    ("evaluate", "json_file"): f"evaluate {BUNDLE} {ROOM} --subset all --json OUT",
    ("plot", "out"): f"plot {BUNDLE} {ROOM} --subset all --out OUT",
    ("dataset", "picture"): f"dataset {ROOM} --picture OUT",
}
# What they write is written by functions that others call, too: only that they refuse is tried.
SLOW = [("demo", "picture"), ("evaluate", "json_file"), ("plot", "out")]
SUFFIXES = {
    ("run", "output"): (".jsonl", ".csv", ".tum", ".mcap"),
    ("odometry", "output"): (".jsonl", ".tum"),
    ("annotate", "output"): (".jsonl", ".csv", ".tum"),
    ("convert", "output"): (".jsonl", ".csv", ".tum", ".mcap", ".rrd"),
    ("dataset", "picture"): (".svg",),
    ("bench", "report"): (".html",),
}
# A service adds to its file and replaces none.
ADDED_TO = {("serve", "output"): f"serve {BUNDLE} /dev/video9 -o OUT"}
EXTRAS = {".rrd": "rerun", ".mcap": "mcap", ".svg": "matplotlib", ".pdf": "matplotlib"}
CASES = [
    (key, command, suffix)
    for key, command in WRITERS.items()
    for suffix in SUFFIXES.get(
        key, (".json",) if "json" in key[1] or key[0] == "conformalize" else (".png",)
    )
]


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Inputs: two drives with their truth, records, motion.json, a camera."""
    folder = tmp_path_factory.mktemp("given")
    generator, pairs = np.random.default_rng(1), []
    time = 0.1 * np.arange(200.0)
    for number in range(2):
        for suffix, noise in ((".tum", 0.01), (".true.tum", 0.0)):
            drift = noise * np.cumsum(generator.normal(size=(4, 200)), axis=1)
            turn = 0.1 * np.sin(time) + drift[0]
            moved = [time + drift[1], np.sin(time) + drift[2], 0.1 * number * time + drift[3]]
            columns = [time, *moved, 0 * turn, 0 * turn, np.sin(turn), np.cos(turn)]
            np.savetxt(folder / f"{number}{suffix}", np.stack(columns, axis=1))
        pairs.append(f"{number}.tum {number}.true.tum\n")
    (folder / "pairs.txt").write_text("".join(pairs))
    camera = '{"width": 320, "height": 240, "fx": 292, "fy": 292, "cx": 160, "cy": 120}'
    (folder / "camera.json").write_text(camera)
    for command in (
        f"conformalize --pairs {folder}/pairs.txt -o {folder}/motion.json",
        f"run {BUNDLE} {CLIP} --fps 1 --max-frames 2 --quiet -o {folder}/records.jsonl",
    ):
        edge(command.split(), standalone_mode=False)
    return folder


def names(app):
    """Return command and option of all that an app's commands can write to."""
    written = re.compile("^(output|out|json_file|picture|report)$")
    return {
        (name, each.name)
        for name, command in typer.main.get_command(app).commands.items()
        for each in command.params
        if each.param_type_name == "option" and written.match(each.name)
    }


def test_every_option_that_names_an_output_is_tested_here():
    assert names(edge) | names(export) == set(WRITERS) | set(ADDED_TO)


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_a_service_adds_to_no_foreign_file(content, tmp_path):
    path = tmp_path / "out.jsonl"
    path.write_bytes(content)
    for command in ADDED_TO.values():
        with pytest.raises(UsageError, match=r"choose another name$"):
            edge(command.replace("OUT", str(path)).split(), standalone_mode=False)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("key", "command", "suffix"), CASES, ids=[f"{key[0]}-{key[1]}{end}" for key, _, end in CASES]
)
def test_only_files_of_ours_are_replaced_without_force(key, command, suffix, given, tmp_path):
    if suffix in EXTRAS or "--picture" in command or key[0] == "plot":
        pytest.importorskip(EXTRAS.get(suffix, "matplotlib"))
    path = tmp_path / f"out{suffix}"
    words = command.replace("OUT", str(path)).replace("IN/", f"{given}/").split()
    app = edge if key in names(edge) else export

    for content in FOREIGN.values():
        path.write_bytes(content)
        with pytest.raises(UsageError) as refused:
            app(words, standalone_mode=False)
        assert str(refused.value) == (
            f"{path}: expected a new file or one of cvo-edge, found another one; choose another "
            "name, or --force to replace it"
        )
        assert path.read_bytes() == content
    if key not in SLOW:
        app([*words, "--force"], standalone_mode=False)
        assert path.read_bytes() not in FOREIGN.values()
        # It says whose it is.
        check_output(path)
    assert list(tmp_path.iterdir()) == [path]


def test_pictures_of_every_format_say_whose_they_are(tmp_path):
    figure = pytest.importorskip("matplotlib.figure").Figure()
    path = tmp_path / "demo.png"
    write_png(path, np.zeros((4, 4, 3), np.uint8))
    check_output(path)
    for suffix in (".png", ".svg", ".pdf"):
        path = tmp_path / f"a{suffix}"
        figure.savefig(path)
        with pytest.raises(UsageError, match="found another one"):
            check_output(path)
        figure.savefig(path, metadata=picture_metadata(suffix))
        check_output(path)


@pytest.mark.parametrize("suffix", [".csv", ".tum", ".jsonl", ".mcap"])
def test_a_conversion_that_fails_leaves_the_old_file(suffix, given, tmp_path, files_limited):
    if suffix in EXTRAS:
        pytest.importorskip(EXTRAS[suffix])
    path, records = tmp_path / f"a{suffix}", given / "records.jsonl"
    words = ["convert", str(records), "-o", str(path)]
    edge(words, standalone_mode=False)
    before = path.read_bytes()
    with files_limited(len(before) - 1), pytest.raises(SinkError) as failed:
        edge(words, standalone_mode=False)
    assert str(failed.value) == f"{path}: cannot be written: File too large"
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
