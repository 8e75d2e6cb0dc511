"""Every command and every Python example in the documents runs.

An HTML comment before a fenced block gives its class: ``<!-- test: run -->`` (run with the
demonstration bundle and clip), ``<!-- test: train -->`` (run on a tiny rendered data set),
``<!-- test: tutorial -->`` (run on a small rendered video) or ``<!-- test: parse -->`` (only
programs, commands and options are checked).
"""

import re
import shlex
import shutil
import tomllib
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from pathlib import Path

import cv2
import pytest
import torch
import typer
from typer.main import get_command

from cvo_edge.output.records import read_records
from cvo_edge.programs.cli import app as edge_app
from cvo_export.cli import app as export_app
from cvo_export.datasets import open_dataset
from cvo_export.datasets.seven_scenes import write_sequence

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/**/*.md", "*/README.md", "bench/results/README.md")
    for path in ROOT.glob(pattern)
)
SHELLS, CLASSES = ("sh", "console", "bash", "shell"), ("run", "train", "tutorial", "parse")
COMMANDS = {"cvo-edge": get_command(edge_app), "cvo-export": get_command(export_app)}
OTHERS = ("openssl", "ray", "git", "colcon", "ros2", "evo_traj", "ffmpeg", "my-consumer")
# Options that reduce a command's work; the last occurrence of an option counts.
SMALL = {
    ("cvo-edge", "run"): ["--max-frames", "4"],
    ("cvo-edge", "bench"): ["--frames", "5", "--warmup", "1"],
    ("cvo-export", "train"): [
        *("--weights", "none", "--size", "64x48", "--copies", "0", "--steps", "100"),
        *("--backbone", "test_efficientnet"),
    ],
}
# The video of the tutorial has few frames, all of which are used.
SHORT = {
    **SMALL,
    ("cvo-export", "reconstruct"): ["--step", "0.001", "--tag-size", "0.3"],
    # Intervals for another recording need features of a larger backbone.
    ("cvo-export", "train"): [
        *SMALL["cvo-export", "train"],
        *("--backbone", "mobilenetv2_100", "--split", "random"),
    ],
}
SCENE = "synthetic:room,flights=8,frames=12,size=64x48"


@dataclass(frozen=True)
class Block:
    page: str
    line: int
    language: str
    kind: str | None
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def commands(self) -> list[list[str]]:
        text = self.text.replace("\\\n", " ")
        lines = [part for line in text.splitlines() for part in line.split(" | ")]
        split = [shlex.split(line, comments=True) for line in lines]
        return [words for words in split if words]


@cache
def blocks(page: str) -> list[Block]:
    """Return the fenced blocks of a page; the line before the fence gives the class."""
    found, before, opened = [], "", None
    for number, line in enumerate((ROOT / page).read_text("utf-8").splitlines(), start=1):
        fence = re.match(r"\s*```(\w*)", line)
        if fence and opened is None:
            kind = re.fullmatch(r"<!-- test: (\w+) -->", before)
            opened, rows = (number, fence[1], kind and kind[1]), []
        elif fence:
            found.append(Block(page, *opened, "\n".join(rows)))
            opened = None
        elif opened is not None:
            rows.append(line)
        before = line.strip() or before
    assert opened is None, f"{page}: a block without end"
    return found


def pages_with(*kinds: str) -> list[str]:
    return [page for page in PAGES if any(block.kind in kinds for block in blocks(page))]


def without_environment(words: list[str]) -> tuple[dict[str, str], list[str]]:
    given = list(takewhile(lambda word: re.match(r"[A-Z_]+=", word), words))
    return dict(word.split("=", 1) for word in given), words[len(given) :]


def parse(words: list[str]) -> None:
    """Raise an error if a command line is invalid."""
    program, *rest = without_environment(words)[1]
    if program in COMMANDS:
        parse_own(program, rest)
    elif program == "make":
        targets = re.findall(r"(?m)^([a-z0-9 -]+):", (ROOT / "Makefile").read_text("utf-8"))
        assert set(rest) <= set(" ".join(targets).split()), words
    elif program == "pip":
        assert rest[0] == "install", words
        for wanted in filter(lambda word: word.startswith("."), rest):
            check_extras(wanted)
    elif program.endswith("python"):
        name = rest[1].replace(".", "/") + "/__main__.py" if rest[0] == "-m" else rest[0]
        assert (ROOT / name).is_file(), words
    else:
        assert program in OTHERS, words


def parse_own(program: str, words: list[str]) -> None:
    group = COMMANDS[program]
    try:
        with group.make_context(program, list(words)) as context:
            name, command, rest = group.resolve_command(context, words)
            command.make_context(name, list(rest), parent=context).close()
    except typer.Exit as leaving:  # --help, --version
        check_left(leaving, words)


def check_extras(wanted: str) -> None:
    folder, _, extras = wanted.removesuffix("]").partition("[")
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text("utf-8"))["project"]
    asked = set(filter(None, extras.split(",")))
    assert asked <= set(project["optional-dependencies"]), wanted


def execute(
    page: str,
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
    done: list[list[str]],
    small: dict[tuple[str, str], list[str]] = SMALL,
) -> None:
    """Run a page's blocks of one class in order; skip commands that are in ``done``."""
    for block in blocks(page):
        if block.kind != kind:
            continue
        if block.language == "python":
            exec(compile(block.text, str(block), "exec"), {"__name__": str(block)})
            continue
        for words in block.commands:
            environment, command = without_environment(words)
            for name, value in environment.items():
                monkeypatch.setenv(name, value)
            parse(command)
            if command[0] in COMMANDS and words not in done:
                run_own(command, small)
                done.append(words)


def run_own(words: list[str], small: dict[tuple[str, str], list[str]]) -> None:
    program, name, *rest = words
    if (name, rest[:1]) == ("train", ["scr"]):
        # It takes minutes until SCR knows a place well enough to be published.
        rest[0] = "cjp"
    arguments = [name, *rest, *small.get((program, name), [])]
    try:
        with COMMANDS[program].make_context(program, arguments) as context:
            COMMANDS[program].invoke(context)
    except typer.Exit as leaving:
        check_left(leaving, words)


def check_left(leaving: typer.Exit, words: list[str]) -> None:
    assert leaving.exit_code == 0, words


@pytest.fixture
def stage(tmp_path, monkeypatch, artifacts_dir) -> None:
    """A folder in which the names used in documents are real files."""
    furnish(tmp_path, artifacts_dir)
    monkeypatch.setenv("CVO_EDGE_CACHE", str(tmp_path / "models"))
    monkeypatch.chdir(tmp_path)


@dataclass
class Workshop:
    folder: Path
    done: list[list[str]]


@pytest.fixture(scope="module")
def workshop(tmp_path_factory, artifacts_dir) -> Workshop:
    """A folder with two recorded scenes, a user's own network and a trained bundle."""
    folder = tmp_path_factory.mktemp("workshop")
    furnish(folder, artifacts_dir)
    flights = open_dataset(SCENE)
    for number in range(8):
        write_sequence(flights, number, folder / f"scenes/kitchen/seq-{number + 1:02}", None)
    shutil.copytree(folder / "scenes/kitchen", folder / "scenes/office")
    shutil.copy(artifacts_dir / "synthetic-room-cjp/model.onnx", folder / "mine.onnx")
    torch.set_num_threads(1)
    done: list[list[str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        execute("README.md", "train", patch, done)
    return Workshop(folder, done)


def furnish(folder: Path, artifacts: Path) -> None:
    (folder / "calibration_artifacts").symlink_to(artifacts)
    (folder / "bundle").symlink_to(artifacts / "synthetic-room-cjp")
    (folder / "frames").mkdir()
    for frame in sorted((artifacts / "synthetic-room-clip").glob("frame-00000[0-3].*")):
        shutil.copy(frame, folder / "frames")


def film(path: Path, flight: int, frames: int) -> None:
    """Write every sixth frame of a flight before a wall with a large tag."""
    step = 6
    spec = f"synthetic:room,flights={flight + 1},frames={step * frames},size=200x150,tag=0.3"
    flights = open_dataset(spec)
    codec = cv2.VideoWriter_fourcc(*"mp4v")
    video = cv2.VideoWriter(str(path), codec, 30.0, (200, 150))
    for frame in range(frames):
        video.write(flights.read_image(step * (flight * frames + frame)))
    video.release()


def test_every_block_of_commands_says_how_it_is_tested() -> None:
    for page in PAGES:
        for block in blocks(page):
            if block.language in (*SHELLS, "python"):
                assert block.kind in CLASSES, f"{block}: expected <!-- test: CLASS --> before it"
            else:
                assert block.kind is None, block
                assert block.language, f"{block}: expected a language"


def test_no_command_hides_from_the_test() -> None:
    for page in PAGES:
        text = (ROOT / page).read_text("utf-8")
        # Skip recorded commands in generated tables; they did run.
        text = re.sub(r"(?s)<!-- table: .*?<!-- end table -->", "", text)
        for number, line in enumerate(text.splitlines(), start=1):
            hidden = re.match(r" {4,}(cvo-edge|cvo-export|make|pip) [a-z]", line)
            assert not hidden, f"{page}:{number}: expected commands in fences, found {line.strip()}"


@pytest.mark.parametrize("page", pages_with("run", "train", "parse"))
def test_programs_commands_and_options_are_there(page) -> None:
    for block in blocks(page):
        if block.language in SHELLS:
            for words in block.commands:
                parse(words)


@pytest.mark.parametrize("page", pages_with("run"))
def test_what_needs_no_training_runs(page, stage, monkeypatch, capfd) -> None:
    execute(page, "run", monkeypatch, [])


@pytest.mark.parametrize("page", pages_with("train"))
def test_what_trains_runs_on_a_small_scene(page, workshop, monkeypatch, capfd) -> None:
    monkeypatch.chdir(workshop.folder)
    execute(page, "train", monkeypatch, workshop.done)


def test_the_tutorial_leads_from_a_video_to_intervals(tmp_path, monkeypatch, capfd) -> None:
    pytest.importorskip("pycolmap")
    torch.set_num_threads(1)
    monkeypatch.chdir(tmp_path)
    film(tmp_path / "desk.mp4", flight=0, frames=90)
    film(tmp_path / "live.mp4", flight=1, frames=12)
    execute("docs/tutorial.md", "tutorial", monkeypatch, [], SHORT)
    records = list(read_records(tmp_path / "records.jsonl"))
    assert any(record.interval and record.interval.bounded for record in records)
