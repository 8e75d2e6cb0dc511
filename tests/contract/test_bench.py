"""What ``bench`` compares: with the script that one would write, and with an earlier report."""

import copy
import json
from html.parser import HTMLParser
from inspect import getattr_static

import numpy as np
import pytest

from cvo_edge import Odometer, open_source
from cvo_edge.errors import BundleMismatchError, GateError, SourceError, UsageError
from cvo_edge.input.half import halve
from cvo_edge.programs import bench_page, regressions, script, stages
from cvo_edge.programs.bench import benchmark
from cvo_edge.programs.cli import app

TOLERANCE = 0.15


@pytest.fixture(scope="module")
def report(bundle_dir, clip_dir):
    found = benchmark(bundle_dir, f"{clip_dir}/.", frames=4, warmup=1, stages=True)
    assert found["source"] == str(clip_dir)
    turns = script.against_script(bundle_dir, str(clip_dir), frames=4, rounds=1)
    return {"software": "cvo-edge 1", **found, "against_script": turns}


def written(tmp_path, report):
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(report))
    return path


def compared(tmp_path, old, new):
    path = written(tmp_path, old)
    return regressions.compared(str(path), regressions.read_report(path), new, TOLERANCE)


def changed(report, place, factor):
    """A report with one number, or word, changed."""
    changed = copy.deepcopy(report)
    *path, last = place.split()
    part = changed
    for name in path:
        part = part[name]
    part[last] = f"another {part[last]}" if factor is None else factor * part[last]
    return changed


def test_the_script_and_each_mode_take_the_same_frames(report):
    found = report["against_script"]
    assert (found["frames"], found["script_frames"], found["rounds"]) == (4, 4, 1)
    for name in ("script", "latency", "throughput"):
        per_frame, whole = found[name]["ms_per_frame"], found["script"]["ms_per_frame"]
        assert 0 < found[name]["first_record_ms"]["median"] <= 4 * per_frame["median"] + 0.001
        ratio = found[name]["over_script"]["median"]
        assert ratio == pytest.approx(per_frame["median"] / whole["median"], rel=0.001)
    lines = list(script.script_lines(found))
    assert len(lines) == 6
    assert lines[-1] == "the script makes no checks and no intervals"


@pytest.mark.parametrize(
    ("least", "most", "said"),
    [
        (0.8, 0.9, "cvo-edge is faster"),
        (1.1, 1.2, "the script is faster"),
        (0.9, 1.1, "no clear difference"),
    ],
)
def test_who_is_faster_must_be_so_in_every_round(least, most, said):
    assert script.verdict({"least": least, "most": most}) == said


@pytest.mark.parametrize(
    ("place", "share", "name"),
    [
        ("ratio_to_raw median", 1.0, "array to interval over the bare call"),
        ("against_script latency over_script median", 1.0, "mode latency over the script"),
        ("cpu_ms_per_frame", 1.0, "CPU time over the bare call"),
        ("memory_mib peak_rss", 1.0, "peak memory, MiB"),
        ("latency_ms total p50", 2.0, "total, ms"),
    ],
)
def test_growth_beyond_the_tolerance_is_a_regression_and_noise_is_not(
    tmp_path, report, place, share, name
):
    for growth, expected in ((1.1 * share, [name]), (0.9 * share, []), (-3.0 * share, [])):
        new = changed(report, place, 1.0 + growth * TOLERANCE)
        comparison = compared(tmp_path, report, new)
        assert comparison.differences == []
        worse = [figure for figure in comparison.figures if figure.regression]
        assert [figure.name for figure in worse] == expected
        text = "\n".join(regressions.comparison_lines(comparison))
        assert text.count("regression") == 1 + len(expected)
        if expected:
            with pytest.raises(GateError, match=rf"found {name} {worse[0].ratio:.2f} times"):
                regressions.check(comparison)
        else:
            regressions.check(comparison)


@pytest.mark.parametrize(
    "place",
    [
        *("bundle_digest", "mode", "source", "environment cpu"),
        "environment versions onnxruntime",
    ],
)
def test_what_makes_reports_incomparable_is_named(tmp_path, report, place):
    comparison = compared(tmp_path, report, changed(report, place, None))
    (difference,) = comparison.differences
    assert f"not comparable: {difference}" in regressions.comparison_lines(comparison)
    with pytest.raises(BundleMismatchError, match="is not comparable"):
        regressions.check(comparison)


def test_a_difference_is_text_without_control_characters(tmp_path, report):
    comparison = compared(tmp_path, report | {"bundle": "old\x1b[31m"}, report)
    (difference,) = comparison.differences
    assert difference.startswith(r"bundle old\x1b[31m ")


def without(report, key):
    return {name: value for name, value in report.items() if name != key}


@pytest.mark.parametrize(
    "content",
    [
        lambda report: "{",
        lambda report: "[]",
        lambda report: '{"software": "cvo-edge 1", "seq": 0}',
        lambda report: json.dumps(report | {"software": "another"}),
        # As earlier versions wrote it.
        lambda report: json.dumps(without(report, "bundle_digest")),
        lambda report: json.dumps(report | {"ratio_to_raw": {"median": 0.0}}),
        lambda report: json.dumps(report | {"raw_model_ms": {"p50": 0.0}}),
        lambda report: json.dumps(report | {"load_ms": -1.0}),
        lambda report: "9" * 400,
    ],
)
def test_a_file_that_is_no_report_is_refused_before_anything_is_measured(
    tmp_path, report, bundle_dir, content
):
    path = tmp_path / "old.json"
    path.write_text(content(report))
    with pytest.raises(SourceError, match=f"{path}: expected a report"):
        app(["bench", str(bundle_dir), "--compare", str(path)], standalone_mode=False)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--against-script", "found none"),
        ("0 --against-script", "found a camera or pipe: 0"),
        ("rtsp://10.0.0.7/x --against-script", "found a camera or pipe"),
        ("--tolerance 0.1", "expected --compare FILE with it"),
        ("--tolerance nan --compare x.json", "expected 0 to 10, found nan"),
    ],
)
def test_what_cannot_be_compared_is_refused(bundle_dir, words, said):
    with pytest.raises(UsageError, match=said):
        app(["bench", str(bundle_dir), *words.split()], standalone_mode=False)


def test_means_of_parts_and_rest_add_up_to_that_of_their_stage():
    generator = np.random.default_rng(0)
    calls = []
    for number in range(50):
        parts = {("read", "file"): 0.1, ("read", "decode"): 0.5, ("read", "decode", "scan"): 0.2}
        call = {path: scale * generator.random() for path, scale in parts.items()}
        if number % 3:  # a part that not every call has
            del call["read", "file"]
        calls.append(call | {("read",): 1.0})
    rows = stages.table({"read": calls, "write": [{("write",): 0.25}] * 50, "conclude": []})
    by_path = {row.path: row for row in rows}
    for path, row in by_path.items():
        parts = [each for each in rows if each.path[:-1] == path]
        assert (parts == []) == ((*path, "rest") not in by_path)
        if parts:
            assert sum(part.mean_us for part in parts) == pytest.approx(row.mean_us)
    assert sum(row.share for row in rows if len(row.path) == 1) == pytest.approx(1.0)
    assert by_path["read",].p50_us == by_path["read",].p90_us == 1e6
    shown = [{"stage": "/".join(row.path), "share": row.share} for row in rows]
    for row, (begin, end) in zip(rows, stages.places(shown), strict=True):
        assert end - begin == pytest.approx(row.share)
        outer = row.path[:-1]
        if outer:
            around = stages.places(shown)[rows.index(by_path[outer])]
            assert around[0] - 1e-9 <= begin <= end <= around[1] + 1e-9


@pytest.mark.parametrize(
    ("method", "mode"), [("scr", "latency"), ("cjp", "throughput"), ("cjp", "live")]
)
def test_every_stage_is_found_and_nothing_stays_timed(artifacts_dir, clip_dir, method, mode):
    places = [(owner, name) for owner, name, _ in stages.HOOKS]
    before = [getattr_static(*place) for place in places]
    with Odometer.load(artifacts_dir / f"synthetic-room-{method}", mode=mode) as odometer:
        source = open_source(str(clip_dir), fps=30.0)
        found = stages.measure(odometer, source, frames=3, warmup=1)
    assert [getattr_static(*place) for place in places] == before
    assert found["frames"] == 3
    named = {row["stage"].rpartition("/")[2] for row in found["rows"]}
    solved = {"solver"} if method == "scr" else set()
    assert named == {stage for _, _, stage in stages.HOOKS} | {"read", "rest"} | solved
    assert all(row["mean_us"] >= 0.0 for row in found["rows"])
    outermost = [row for row in found["rows"] if "/" not in row["stage"]]
    assert [row["stage"] for row in outermost] == list(stages.ROOTS)
    if mode == "latency":
        assert sum(row["mean_us"] for row in outermost) <= 1.001 * found["record_every_us"]
    assert len(list(stages.stage_lines(found, mode))) == len(found["rows"]) + 3


def test_a_timed_source_decodes_at_half_size_where_a_bundle_needs_it(clip_dir):
    sources = [stages.Timed(open_source(str(clip_dir)), stages.Spans()) for _ in range(2)]
    halve(sources[1])
    whole, half = (next(iter(source)).image.shape for source in sources)
    assert half == (whole[0] // 2, whole[1] // 2, 3)


class Opened(HTMLParser):
    """Checks that every tag is closed in its place, and keeps the texts."""

    def __init__(self):
        super().__init__()
        self.stack, self.texts = [], []

    def handle_starttag(self, tag, attributes):
        # What it shows is in the page itself.
        assert not {"src", "href"} & {name for name, _ in attributes}
        if tag != "meta":
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.texts.append(data.strip())


def test_the_page_shows_every_part_of_a_report_and_any_name(tmp_path, report):
    odd = {**report, "source": "<script>a & b</script>"}
    comparison = compared(tmp_path, changed(odd, "ratio_to_raw median", 0.5), odd)
    written = {**odd, "comparison": comparison.as_report()}
    parser = Opened()
    parser.feed(bench_page.page(written))
    assert parser.stack == []
    assert any("<script>a & b</script>" in text for text in parser.texts)
    shown = {row["stage"].rpartition("/")[2] for row in report["stages"]["rows"]}
    figures = {figure.name for figure in comparison.figures}
    assert shown | figures | {"regression", "run, mode latency"} <= set(parser.texts)


def test_a_page_is_named_as_one(bundle_dir):
    with pytest.raises(UsageError, match=r"expected a name that ends in .html, found page.json"):
        app(["bench", str(bundle_dir), "--report", "page.json"], standalone_mode=False)
