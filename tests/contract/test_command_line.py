"""The command line from a user's view: records, gates, exit codes, signals."""

import fcntl
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from cvo_edge import Odometer, open_source, read_records
from cvo_edge.programs.bench import benchmark
from cvo_edge.programs.bench_report import benchmark_lines

CVO_EDGE = [sys.executable, "-c", "from cvo_edge.__main__ import main; main()"]
# A script that runs the tests in the background makes their processes ignore SIGINT.
FOREGROUND = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from cvo_edge.__main__ import main; main()",
]


def cvo_edge(*arguments, **options):
    command = [*CVO_EDGE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def refused(result, code):
    """Check for one line on stderr, the documented code, and no traceback."""
    assert result.returncode == code, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("cvo-edge: ")
    return lines[0]


def records_in(output):
    """Decoded JSON lines of a run, without its header."""
    header, *records = map(json.loads, output.splitlines())
    assert header["kind"] == "header"
    return records


def test_run_and_ten_lines_of_python_give_equal_numbers(bundle_dir, clip_dir):
    result = cvo_edge("run", bundle_dir, clip_dir, "--max-frames", 5)
    assert result.returncode == 0
    records = records_in(result.stdout)
    with Odometer.load(bundle_dir) as odometer:
        for record, estimate in zip(
            records, odometer.stream(list(open_source(str(clip_dir)))[:5]), strict=True
        ):
            expected = estimate.to_dict()
            assert record["pose"] == expected["pose"]
            assert record["interval"] == json.loads(json.dumps(expected["interval"]))
    assert "frames      5: 5 ok" in result.stderr


def test_summary_has_coverage_where_there_is_ground_truth(bundle_dir, clip_dir, tmp_path):
    out = tmp_path / "out.jsonl"
    result = cvo_edge("run", bundle_dir, clip_dir, "--ground-truth", clip_dir, "-o", out)
    assert result.returncode == 0
    assert result.stdout == ""
    assert "coverage" in result.stderr
    frames = len(list(clip_dir.glob("*.color.jpg")))
    assert len(records_in(out.read_text())) == frames
    ok = sum(record["status"] == "ok" for record in records_in(out.read_text()))
    assert ok >= 0.9 * frames
    assert f"of {ok} frames" in result.stderr


def test_the_region_is_recorded_on_request_and_only_where_there_is_one(bundle_dir, clip_dir):
    regions = bundle_dir.with_name("synthetic-room-mcqr")
    joint = ("--scope", "joint", "--region", "--quiet")
    result = cvo_edge("run", regions, clip_dir, "--max-frames", 2, *joint)
    assert result.returncode == 0
    for record in records_in(result.stdout):
        interval = record["interval"]
        assert interval["region"].keys() == {"radius", "scale", "centres"}
        assert len(interval["region"]["centres"]) >= 1
    unbounded = cvo_edge("run", regions, clip_dir, *joint, "--max-frames", 1, "--confidence", 0.99)
    assert records_in(unbounded.stdout)[0]["interval"]["region"] is None
    assert "expected a bundle of mcqr" in refused(cvo_edge("run", regions, clip_dir, "--region"), 2)
    refused(cvo_edge("run", bundle_dir, clip_dir, *joint), 2)
    assert "jsonl" in refused(cvo_edge("run", regions, clip_dir, *joint, "--format", "csv"), 2)


def test_the_suffix_of_the_output_chooses_the_format(bundle_dir, clip_dir, tmp_path):
    options = ("--max-frames", 1, "--quiet", "--fps", 30, "-o")
    output = tmp_path / "a.tum"
    assert cvo_edge("run", bundle_dir, clip_dir, *options, output).returncode == 0
    assert np.loadtxt(output).shape == (8,)
    assert "# stamps: fps\n" in output.read_text()
    content = output.read_bytes()
    assert "--format" in refused(
        cvo_edge("run", bundle_dir, clip_dir, *options, output, "--format", "csv"), 2
    )
    assert output.read_bytes() == content


def test_quiet_is_quiet(bundle_dir, clip_dir):
    result = cvo_edge("run", bundle_dir, clip_dir, "--max-frames", 1, "--quiet")
    assert (result.returncode, result.stderr) == (0, "")


def test_a_reader_that_leaves_ends_it_quietly(bundle_dir, clip_dir):
    with subprocess.Popen(
        [*CVO_EDGE, "run", str(bundle_dir), str(clip_dir), "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait() == 0


@pytest.mark.parametrize("library", ["libc", "msgspec", "numpy", "cv2", "onnxruntime"])
def test_a_signal_while_it_starts_is_no_defect(bundle_dir, library):
    """A signal during an import surfaces as another error of the imported module."""
    command = [*FOREGROUND, "bench", str(bundle_dir), "--frames", "1000000"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while library not in Path(f"/proc/{process.pid}/maps").read_text():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate()
    # Before our code runs, Python's default action applies.
    assert process.returncode in (143, -signal.SIGTERM)
    assert said == ""


@pytest.fixture(scope="module")
def many_frames(clip_dir, tmp_path_factory):
    """Links to one image: a source of a minute or more."""
    frames = tmp_path_factory.mktemp("frames")
    image = min(clip_dir.glob("*.color.jpg"))
    for index in range(20_000):
        (frames / f"{index}.jpg").symlink_to(image)
    return frames


@pytest.mark.parametrize("mode", ["latency", "throughput", "live"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_it_with_every_record_whole(
    bundle_dir, many_frames, tmp_path, number, code, mode
):
    out = tmp_path / "out.jsonl"
    options = ["-o", str(out), "--quiet", "--mode", mode, "--fps", "50"]
    with subprocess.Popen(
        [*FOREGROUND, "run", str(bundle_dir), str(many_frames), *options],
        stderr=subprocess.PIPE,
    ) as process:
        while not (out.exists() and out.stat().st_size > 5000):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        assert process.wait() == code
        assert process.stderr.read() == b""
    content = out.read_text()
    assert content.endswith("\n")
    sequence = [record["seq"] for record in records_in(content)]
    if mode == "live":  # frames are dropped while the network is busy
        assert sequence == sorted(set(sequence))
    else:
        assert sequence == list(range(len(sequence)))
    assert 0 < len(sequence) < 20_000


def test_killed_without_warning_loses_no_acknowledged_record(bundle_dir, clip_dir):
    with subprocess.Popen(
        [*CVO_EDGE, "run", str(bundle_dir), str(clip_dir), "--quiet"], stdout=subprocess.PIPE
    ) as process:
        header, first = process.stdout.readline(), process.stdout.readline()
        process.kill()
        rest = process.stdout.read()
    assert json.loads(header)["kind"] == "header"
    assert json.loads(first)["seq"] == 0
    complete = rest.decode().splitlines()[: rest.count(b"\n")]
    assert [json.loads(line)["seq"] for line in complete] == list(range(1, len(complete) + 1))


@pytest.mark.parametrize("format", ["jsonl", "csv", "tum", "table"])
def test_a_disk_that_fills_up_within_a_line_keeps_every_line_before_it_and_no_part_of_it(
    bundle_dir, clip_dir, tmp_path, format
):
    # The limits cut lines at different bytes.
    for limit in (2500, 2501, 2550):
        output = tmp_path / f"records-{limit}"

        def small_disk(limit=limit):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        result = cvo_edge(
            *("run", bundle_dir, clip_dir, "-o", output, "--format", format, "--fps", 30),
            *("--no-cache", "--quiet"),
            preexec_fn=small_disk,
        )
        assert str(output) in refused(result, 7)
        content = output.read_bytes()
        assert content.endswith(b"\n")
        assert 1000 < len(content) <= limit
        if format == "jsonl":
            assert [record.seq for record in read_records(output)] == list(
                range(content.count(b"\n") - 1)
            )


def test_a_slow_reader_is_waited_for_also_where_another_process_would_not(bundle_dir, clip_dir):
    receiver, sender = os.pipe()
    fcntl.fcntl(receiver, fcntl.F_SETPIPE_SZ, 4096)
    os.set_blocking(sender, False)
    command = [*CVO_EDGE, "run", bundle_dir, clip_dir, "--quiet", "--max-frames", "40"]
    with subprocess.Popen([*map(str, command)], stdout=sender, stderr=subprocess.PIPE) as process:
        os.close(sender)
        with os.fdopen(receiver, "rb") as stream:
            time.sleep(2.0)
            lines = stream.readlines()
        assert process.wait() == 0, process.stderr.read()
    assert len(lines) == 1 + 40


def test_closed_or_full_standard_output_is_exit_7(bundle_dir):
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full:
            result = subprocess.run(
                [*CVO_EDGE, "inspect", str(bundle_dir)],
                stdout=full,
                stderr=subprocess.PIPE,
                text=True,
                check=False,
            )
        assert result.returncode == 7
        assert len(result.stderr.strip().splitlines()) == 1
    closed = without_stdout("inspect", bundle_dir)
    assert closed.returncode == 7
    assert len(closed.stderr.strip().splitlines()) == 1


def test_a_closed_standard_output_is_no_fault_of_a_command_that_does_not_use_it(
    bundle_dir, clip_dir, tmp_path
):
    path = tmp_path / "a.jsonl"
    words = ("run", bundle_dir, clip_dir, "--max-frames", 2, "--quiet", "-o", path)
    done = without_stdout(*words)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(records_in(path.read_text())) == 2


def without_stdout(*words):
    return subprocess.run(
        ["sh", "-c", 'exec "$@" >&-', "sh", *CVO_EDGE, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )


def test_an_output_that_is_an_input_is_refused(bundle_dir, clip_dir):
    image = next(iter(sorted(clip_dir.glob("*.color.jpg"))))
    before = image.read_bytes()
    refused(cvo_edge("run", bundle_dir, clip_dir, "-o", image), 2)
    refused(cvo_edge("run", bundle_dir, image, "-o", image), 2)
    refused(cvo_edge("run", bundle_dir, clip_dir, "-o", bundle_dir / "model.onnx"), 2)
    assert image.read_bytes() == before


def test_what_a_path_holds_cannot_forge_a_line(bundle_dir):
    refused(cvo_edge("run", bundle_dir, "a\nb\x1b[31m"), 6)
    refused(cvo_edge("run", bundle_dir, "x" * 5000), 6)


def test_ground_truth_that_matches_nothing_is_said(bundle_dir, clip_dir, tmp_path):
    truth = tmp_path / "truth.txt"
    truth.write_text("1 0 0 0 0 0 0 1\n")
    result = cvo_edge("run", bundle_dir, clip_dir, "--max-frames", 1, "--ground-truth", truth)
    assert result.returncode == 6
    assert (
        "expected true poses of the frames, found 0 of 1 frames matched by stamp (frames without a "
        "stamp, poses at 1.000 .. 1.000 s; --stamps or --fps stamps frames)" in result.stderr
    )


def test_a_folder_in_place_of_a_file_of_a_bundle_is_refused(copied_bundle):
    for name, code in (("model.onnx", 4), ("calibration.json", 3)):
        path = copied_bundle / name
        content = path.read_bytes()
        path.unlink()
        path.mkdir()
        for command in (("verify", copied_bundle), ("inspect", copied_bundle)):
            if (name, command[0]) != ("model.onnx", "inspect"):
                refused(cvo_edge(*command), code)
        path.rmdir()
        path.write_bytes(content)


def test_a_frame_without_an_interval_covers_nothing(bundle_dir, clip_dir, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, path in enumerate(sorted(clip_dir.glob("*.color.jpg"))[:4]):
        image = cv2.imread(str(path))
        # Every second image is black.
        cv2.imwrite(str(frames / path.name), image * (number % 2))
    shown = cvo_edge("run", bundle_dir, frames, "--ground-truth", clip_dir)
    counted = [line for line in shown.stderr.splitlines() if line.startswith("all six")]
    assert counted[0].endswith("of 2 frames")
    for path in frames.iterdir():
        cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path))))
    black = cvo_edge("run", bundle_dir, frames, "--ground-truth", clip_dir)
    assert "coverage    none of the 4 frames with a true pose has status ok" in black.stderr


def test_bench_of_a_source_without_frames_ends(bundle_dir, tmp_path):
    path = tmp_path / "empty.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (64, 48))
    writer.release()
    refused(cvo_edge("bench", bundle_dir, path), 6)


def test_too_little_address_space_is_one_line(bundle_dir, clip_dir):
    """Below a limit, libraries fail to load or end the process without a word."""
    limit = 200 << 20
    result = cvo_edge(
        "run",
        bundle_dir,
        clip_dir,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    assert "expected an address space of at least 512 MiB, found a limit of 200" in refused(
        result, 1
    )


@pytest.mark.parametrize(
    "error", ["ImportError('x.so: failed to map segment')", "RuntimeError('std::bad_alloc')"]
)
def test_a_library_without_memory_is_one_line(error):
    code = (
        "import typer; from cvo_edge.process import guarded; app = typer.Typer()\n"
        f"@app.command()\ndef work(): raise {error}\n"
        "guarded('cvo-edge', app)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "--"], capture_output=True, text=True, check=False
    )
    assert "not enough memory for a library" in refused(done, 1)


def test_exit_2_for_what_cannot_be_asked(bundle_dir, clip_dir):
    assert "0.5, 0.8, 0.9, 0.95, 0.99" in refused(
        cvo_edge("run", bundle_dir, clip_dir, "--confidence", 0.42), 2
    )
    assert "nearest: 0.9 and 0.95" in refused(
        cvo_edge("run", bundle_dir, clip_dir, "--confidence", 0.93), 2
    )
    assert "--fps" in refused(cvo_edge("run", bundle_dir, clip_dir, "--format", "tum"), 2)
    refused(cvo_edge("run", bundle_dir, clip_dir, "--scope", "both"), 2)
    refused(cvo_edge("run", bundle_dir), 2)
    refused(cvo_edge("walk"), 2)


@pytest.mark.parametrize(
    ("option", "choices"),
    [
        ("--scope", "'marginal', 'joint'"),
        ("--mode", "'live', 'latency', 'throughput'"),
        ("--format", "'jsonl', 'csv', 'tum', 'table'"),
    ],
)
def test_a_word_that_is_no_choice_is_refused_with_the_choices(bundle_dir, option, choices):
    assert choices in refused(cvo_edge("run", bundle_dir, "unused", option, "x"), 2)


COMMANDS = [
    (),
    ("run",),
    ("bench",),
    ("verify",),
    ("inspect",),
    ("schema",),
    ("doctor",),
    ("cache",),
]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_page_fits_80_columns(command):
    env = {**os.environ, "COLUMNS": "80", "PYTHONIOENCODING": "utf-8"}
    shown = cvo_edge(*command, "--help", env=env)
    assert (shown.returncode, shown.stderr) == (0, "")
    assert max(len(line) for line in shown.stdout.splitlines()) <= 80
    if command in (("run",), ("bench",)):
        assert f"cvo-edge {command[0]} " in shown.stdout[shown.stdout.index("Examples:") :]


def test_a_reader_that_leaves_a_help_page_ends_it_quietly():
    receiver, sender = os.pipe()
    os.close(receiver)
    done = subprocess.run(
        [*CVO_EDGE, "run", "--help"], stdout=sender, stderr=subprocess.PIPE, check=False
    )
    os.close(sender)
    assert (done.returncode, done.stderr) == (0, b"")


def test_the_shell_completes_commands_options_and_choices(tmp_path):
    def completed(words):
        env = {
            **os.environ,
            "_CVO_EDGE_COMPLETE": "complete_bash",
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split(" ")) - 1),
        }
        return cvo_edge(env=env).stdout.split()

    assert completed("cvo-edge ver") == ["verify"]
    assert completed("cvo-edge run --sco") == ["--scope"]
    assert completed("cvo-edge run --scope ") == ["marginal", "joint"]
    home = {
        **os.environ,
        "HOME": str(tmp_path),
        "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1",
    }
    assert cvo_edge("--install-completion", "bash", env=home).returncode == 0
    assert "_CVO_EDGE_COMPLETE" in (tmp_path / ".bash_completions" / "cvo-edge.sh").read_text()


@pytest.mark.parametrize("method", ["cjp", "cqr", "csp", "mcqr"])
def test_inspect_fits_80_columns(bundle_dir, method):
    shown = cvo_edge("inspect", bundle_dir.with_name(f"synthetic-room-{method}")).stdout
    lines = shown.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith("0.9 joint") for line in lines)


def test_exit_3_4_5_for_a_broken_bundle(copied_bundle, clip_dir):
    model = copied_bundle / "model.onnx"
    whole = model.read_bytes()
    model.write_bytes(whole[:-1])
    assert "sha256" in refused(cvo_edge("run", copied_bundle, clip_dir), 5)
    model.unlink()
    refused(cvo_edge("run", copied_bundle, clip_dir), 4)
    model.write_bytes(whole)
    path = copied_bundle / "calibration.json"
    path.write_bytes(path.read_bytes().replace(b"0", b"1", 1))
    refused(cvo_edge("run", copied_bundle, clip_dir), 3)
    refused(cvo_edge("inspect", copied_bundle), 3)
    refused(cvo_edge("verify", copied_bundle), 3)


def test_exit_6_for_a_source_that_gives_nothing(bundle_dir, tmp_path):
    refused(cvo_edge("run", bundle_dir, tmp_path / "nowhere"), 6)
    refused(cvo_edge("run", bundle_dir, tmp_path), 6)
    for index in range(2):
        (tmp_path / f"{index}.png").write_bytes(b"\x89PNG damaged")
    result = cvo_edge("run", bundle_dir, tmp_path, "--quiet")
    refused(result, 6)
    assert [record["status"] for record in records_in(result.stdout)] == ["invalid"] * 2


def test_exit_6_for_a_video_cut_short_with_its_records_kept(bundle_dir, tmp_path):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (320, 240))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    generator = np.random.default_rng(0)
    for _ in range(30):
        writer.write(generator.integers(0, 255, (240, 320, 3)).astype(np.uint8))
    writer.release()
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.6)])
    result = cvo_edge("run", bundle_dir, path, "--quiet")
    if "opens" in result.stderr:
        pytest.skip("this OpenCV opens no video without its index")
    assert "of 30" in refused(result, 6)
    assert len(result.stdout.splitlines()) > 1


def test_exit_7_for_an_output_that_cannot_be_written(bundle_dir, clip_dir, tmp_path):
    refused(cvo_edge("run", bundle_dir, clip_dir, "-o", tmp_path / "no" / "out.jsonl"), 7)
    if Path("/dev/full").exists():
        result = cvo_edge("run", bundle_dir, clip_dir, "-o", "/dev/full", "--quiet")
        assert "No space left" in refused(result, 7)


@pytest.mark.parametrize("mode", ["latency", "throughput", "live"])
def test_bench_reports_the_documented_keys(bundle_dir, clip_dir, tmp_path, mode):
    report_file = tmp_path / "bench.json"
    arguments = ("bench", bundle_dir, clip_dir, "--frames", 10, "--warmup", 2, "--mode", mode)
    result = cvo_edge(*arguments, "--json", report_file)
    assert result.returncode == 0, result.stderr
    report = json.loads(report_file.read_text())
    for stage in ("read", "preprocess", "model", "conformal", "total"):
        assert list(report["latency_ms"][stage]) == ["p50", "p90", "p95", "p99", "mean"]
    for key in (
        "raw_model_ms",
        "ratio_to_raw",
        "throughput_fps",
        "load_ms",
        "first_interval_ms",
        "cpu_ms_per_frame",
        "memory_mib",
        "environment",
        "frames_skipped",
        "waited_for_cores",
    ):
        assert key in report
    assert (report["mode"], report["frames"], report["frames_valid"]) == (mode, 10, 10)
    assert set(report["memory_mib"]) == {"peak_rss", "rss", "anonymous"}
    assert f"mode {mode}: 10 frames after 2 warm-up" in result.stdout


def test_what_a_system_does_not_tell_is_null_and_said(bundle_dir, monkeypatch):
    """Without /proc, as in some sandboxes."""
    hidden = lambda path: Path("/no/proc") / path.name if path.parts[1:2] == ("proc",) else path  # noqa: E731
    read, found = Path.read_text, Path.glob
    monkeypatch.setattr(Path, "read_text", lambda path, *a, **k: read(hidden(path), *a, **k))
    monkeypatch.setattr(Path, "glob", lambda path, *a, **k: found(hidden(path), *a, **k))
    report = benchmark(bundle_dir, frames=2, warmup=0)
    assert (report["first_interval_ms"], report["waited_for_cores"]) == (None, None)
    assert report["memory_mib"]["rss"] is None
    assert report["memory_mib"]["peak_rss"] > 1.0
    text = "\n".join(benchmark_lines(report))
    assert "first interval unknown" in text
    assert "no /proc" in text


@pytest.mark.parametrize("name", ["SIGUSR1", "SIGRTMIN"])
def test_a_signal_without_a_meaning_is_named_in_one_line(name):
    number = int(getattr(signal, name))
    script = (
        "import signal, sys, typer; from cvo_edge.process import guarded; app = typer.Typer(); "
        "app.command()(lambda number: signal.raise_signal(int(number))); guarded('cvo-edge', app)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(number)], capture_output=True, text=True, check=False
    )
    assert name in refused(done, 128 + number)


def test_bench_gates_by_exit_8(bundle_dir, clip_dir):
    arguments = ("bench", bundle_dir, clip_dir, "--frames", 10, "--warmup", 2)
    for gate in (("--max-p95-ms", 1e-6), ("--max-rss-mib", 1)):
        failed = cvo_edge(*arguments, *gate)
        assert failed.returncode == 8
        assert "bench: expected" in failed.stderr


def test_verify_passes_here_and_fails_where_outputs_differ(bundle_dir, rewrite, bundle):
    assert "self-test passed" in cvo_edge("verify", bundle_dir).stdout
    import msgspec

    test = bundle.calibration.selftest
    shifted = {name: tuple(v + 0.01 for v in values) for name, values in test.outputs.items()}
    folder = rewrite(
        msgspec.structs.replace(
            bundle.calibration, selftest=msgspec.structs.replace(test, outputs=shifted)
        )
    )
    assert "self-test" in refused(cvo_edge("verify", folder), 8)


def test_inspect_schema_doctor_and_version_answer(bundle_dir):
    shown = cvo_edge("inspect", bundle_dir)
    assert "q_hat at" in shown.stdout
    assert "0.9 joint" in shown.stdout
    as_json = json.loads(cvo_edge("inspect", bundle_dir, "--json").stdout)
    assert as_json["schema_version"] == 1
    schema = json.loads(cvo_edge("schema").stdout)
    calibration = schema["$defs"]["Calibration"]
    assert set(calibration["required"]) <= set(as_json) <= set(calibration["properties"])
    assert calibration["additionalProperties"] is False
    assert json.loads(cvo_edge("doctor", "--json").stdout)["cores_allowed"] >= 1
    assert cvo_edge("--version").stdout.startswith("cvo-edge ")
    assert "Usage" in cvo_edge().stdout


UNHEARD = {
    2: ["run", "BUNDLE", "CLIP", "--confidence", "0.123"],
    3: ["verify", "nowhere"],
    6: ["run", "BUNDLE", "nowhere"],
    7: ["run", "BUNDLE", "CLIP", "-o", "/dev/full"],
    0: ["run", "BUNDLE", "CLIP", "--max-frames", "2"],
}


@pytest.mark.parametrize("code", UNHEARD)
@pytest.mark.parametrize("ear", ["full", "closed", "left"])
def test_the_exit_code_is_the_same_where_nobody_reads_stderr(bundle_dir, clip_dir, code, ear):
    words = {"BUNDLE": str(bundle_dir), "CLIP": str(clip_dir)}
    command = [*CVO_EDGE, *(words.get(word, word) for word in UNHEARD[code])]
    receiver, sender = os.pipe()
    os.close(receiver)
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            ["sh", "-c", 'exec "$@" 2>&-', "sh", *command] if ear == "closed" else command,
            stdout=subprocess.PIPE,
            stderr={"full": full, "closed": None, "left": sender}[ear],
            check=False,
        )
    os.close(sender)
    assert done.returncode == code
    # Messages for stderr do not end up among the records either.
    assert all(json.loads(line)["seq"] >= 0 for line in done.stdout.splitlines()[1:])


@pytest.mark.parametrize("command", ["run", "verify", "inspect", "bench"])
def test_a_name_too_long_is_a_bundle_that_is_not_there(clip_dir, command):
    source = [clip_dir] if command == "run" else []
    refused(cvo_edge(command, "x" * 300, *source), 3)


def test_a_name_too_long_is_no_output(bundle_dir, clip_dir):
    refused(cvo_edge("run", bundle_dir, clip_dir, "-o", "x" * 300), 7)


def test_more_outputs_that_are_inputs_are_refused(copied_bundle, clip_dir, tmp_path):
    images = tmp_path / "images"
    shutil.copytree(clip_dir, images)
    image = min(images.glob("*.jpg"))
    key = tmp_path / "key.pem"
    key.write_text("a key")
    calibration = copied_bundle / "calibration.json"
    kept = [path.read_bytes() for path in (image, key, calibration)]
    refused(cvo_edge("run", copied_bundle, images / "*.jpg", "-o", image), 2)
    refused(cvo_edge("run", copied_bundle, tmp_path / "**" / "*.jpg", "-o", image), 2)
    refused(cvo_edge("run", copied_bundle, images, "--public-key", key, "-o", key), 2)
    refused(cvo_edge("bench", copied_bundle, "--frames", 1, "--json", calibration), 2)
    assert [path.read_bytes() for path in (image, key, calibration)] == kept


def test_two_runs_do_not_write_one_file(bundle_dir, clip_dir, tmp_path):
    output = tmp_path / "records.jsonl"
    live = [*CVO_EDGE, "run", bundle_dir, clip_dir, "-o", output, "--mode", "live", "--fps", "10"]
    with subprocess.Popen([*map(str, live), "--quiet"]) as first:
        while not (output.exists() and output.stat().st_size):
            assert first.poll() is None
            time.sleep(0.01)
        first.send_signal(signal.SIGSTOP)
        refused(cvo_edge("run", bundle_dir, clip_dir, "-o", output), 7)
        first.send_signal(signal.SIGCONT)
        assert first.wait() == 0
    assert [record.status for record in read_records(output)]
    assert cvo_edge("run", bundle_dir, clip_dir, "-o", output, "--quiet").returncode == 0


@pytest.mark.parametrize("many", ["9" * 20, "0", "-1"])
def test_numbers_of_frames_have_bounds(bundle_dir, clip_dir, many):
    refused(cvo_edge("run", bundle_dir, clip_dir, "--max-frames", many), 2)
    refused(cvo_edge("bench", bundle_dir, "--frames", many), 2)


@pytest.mark.parametrize("timeout", ["nan", "inf", "0", "-1"])
def test_a_time_for_verify_must_be_one(bundle_dir, timeout):
    refused(cvo_edge("verify", bundle_dir, "--timeout", timeout), 2)


def test_a_terminal_of_ascii_is_told_what_it_can_show(copied_bundle, rewrite, bundle):
    rewrite(msgspec.structs.replace(bundle.calibration, name="K\u00fcche"))
    env = {**os.environ, "PYTHONIOENCODING": "ascii"}
    result = cvo_edge("inspect", copied_bundle, env=env)
    assert result.returncode == 0
    assert "K\\xfcche" in result.stdout


def test_verify_needs_none_of_the_first_three_files(bundle_dir):
    words = [*CVO_EDGE, "verify", str(bundle_dir)]
    done = subprocess.run(["sh", "-c", 'exec "$@" <&- 2>&-', "sh", *words], check=False)
    assert done.returncode == 0


def test_what_libraries_print_is_not_among_ours(bundle_dir, clip_dir, tmp_path):
    image = min(clip_dir.glob("*.jpg")).read_bytes()
    place = len(image) // 2
    # libjpeg prints warnings and continues to decode.
    (tmp_path / "0.jpg").write_bytes(image[:place] + image[-2:])
    (tmp_path / "1.jpg").write_bytes(image)
    result = cvo_edge("run", bundle_dir, tmp_path, "--quiet")
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_where_no_python_runs(bundle_dir, tmp_path, number):
    """The picture takes minutes to decode, in a library that does not handle signals."""
    jpeg = cv2.imencode(
        ".jpg", np.zeros((8000, 8000, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    )[1].tobytes()
    scan = jpeg[jpeg.rindex(b"\xff\xda") : -2]
    slow = jpeg[:-2] + (60 - jpeg.count(b"\xff\xda")) * scan + jpeg[-2:]
    for name in range(40):
        (tmp_path / f"{name}.jpg").write_bytes(slow)
    with subprocess.Popen(
        [*FOREGROUND, "run", str(bundle_dir), str(tmp_path)], stdout=subprocess.DEVNULL
    ) as process:
        # Processor time, of which the start takes about one second.
        while sum(map(int, Path(f"/proc/{process.pid}/stat").read_text().split()[13:15])) < 400:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        # All pictures would take longer than a test may last.
        assert process.wait() == 128 + number
