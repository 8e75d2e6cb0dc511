"""The report of ``bench`` as one page of HTML, which needs no other file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from cvo_edge.errors import UsageError
from cvo_edge.files import SOFTWARE
from cvo_edge.programs.bench_report import TIMED, remarks
from cvo_edge.programs.script import COMPARED, SCRIPT, verdict
from cvo_edge.programs.stages import places

SUFFIXES = (".html", ".htm")
# Blue and orange, which colour-blind readers can tell apart (Okabe and Ito 2008).
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 2rem auto;
  max-width: 1000px; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; }
h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
.note { color: #444; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .2rem .6rem; border-bottom: 1px solid #e3e3e3;
  white-space: nowrap; }
th { background: #f4f6f8; }
th:first-child, td:first-child { text-align: left; }
td.text { text-align: left; white-space: normal; }
td.bar { width: 45%; min-width: 160px; padding: .2rem 0; text-align: left; }
td.bar div { background: #0072b2; height: .8em; min-width: 2px; }
td.bar div.rest { background: #b8c4cc; }
td.bar div.other { background: #d55e00; }
.worse { color: #b04000; font-weight: 600; }
dl { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1rem 0; }
dl div { border: 1px solid #d8dde2; border-radius: 6px; padding: .4rem .8rem; }
dt { color: #444; font-size: 13px; } dd { margin: 0; font-size: 1.25rem; }
"""


def checked_page(path: Path) -> Path:
    """Return the path of a page; raises UsageError for another suffix."""
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(f"--report: expected a name that ends in .html, found {path.name}")
    return path


def page(report: Mapping[str, Any]) -> str:
    """Return the page of a report of ``bench``, with the parts that it has."""
    title = f"{report['bundle']}: mode {report['mode']}"
    parts = [*_figures(report), *_quantiles(report)]
    if "stages" in report:
        parts += _stages(report["stages"])
    if "against_script" in report:
        parts += _script(report["against_script"])
    if "comparison" in report:
        parts += _comparison(report["comparison"])
    parts += _machine(report["environment"])
    return "\n".join(
        (
            "<!doctype html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta name="generator" content="{escape(SOFTWARE)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title>",
            f"<style>{_STYLE}</style>",
            "</head>",
            "<body>",
            f"<h1>{escape(title)}</h1>",
            *parts,
            "</body>",
            "</html>",
            "",
        )
    )


def _figures(report: Mapping[str, Any]) -> Iterator[str]:
    source = report["source"] or "a fixed image"
    yield _note(
        f"{report['method']}, {report['precision']} on {report['provider']}; {report['frames']} "
        f"frames of {source} after {report['warmup']} warm-up; "
        f"{report['environment']['threads']} threads on {report['environment']['cpu']}"
    )
    first = report["first_interval_ms"]
    shown = {
        "total, median": f"{report['latency_ms']['total']['p50']:.2f} ms",
        f"{TIMED[report['mode']]} / bare call": f"{report['ratio_to_raw']['median']:.3f}",
        "frames per second": f"{report['throughput_fps']:.1f}",
        "processor time per frame": f"{report['cpu_ms_per_frame']:.2f} ms",
        "peak memory": f"{report['memory_mib']['peak_rss']:.0f} MiB",
        "process start to first interval": "unknown" if first is None else f"{first:.0f} ms",
    }
    yield "<dl>"
    for name, value in shown.items():
        yield f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
    yield "</dl>"
    yield from map(_note, remarks(report))


def _quantiles(report: Mapping[str, Any]) -> Iterator[str]:
    rows = {**report["latency_ms"], "bare model call": report["raw_model_ms"]}
    names = ("p50", "p90", "p95", "p99", "mean")
    yield "<h2>Latency, ms</h2>"
    yield from _table(
        ("", *names),
        (
            [_cell(stage), *(_cell(f"{row[name]:.3f}") for name in names)]
            for stage, row in rows.items()
        ),
    )


def _stages(stages: Mapping[str, Any]) -> Iterator[str]:
    rows = stages["rows"]
    yield "<h2>Where the time of a frame goes</h2>"
    yield from _table(
        ("stage", "mean, us", "p50", "p90", "share", "place in the frame"),
        (_stage(row, *place) for row, place in zip(rows, places(rows), strict=True)),
    )
    yield _note(
        f"{stages['frames']} frames, from the source to a line of JSON in a file; a record every "
        f"{stages['record_every_us']:.0f} us. Means and shares add up, medians need not. Timing "
        f"takes about {stages['timing_us']:.0f} us of each frame, mostly of rests."
    )


def _stage(row: Mapping[str, Any], begin: float, end: float) -> list[str]:
    *outer, name = row["stage"].split("/")
    indent = f"padding-left:{0.6 + 1.3 * len(outer):.1f}em"
    return [
        f'<td style="{indent}">{escape(name)}</td>',
        *(_cell(f"{row[key]:.1f}") for key in ("mean_us", "p50_us", "p90_us")),
        _cell(f"{row['share']:.1%}"),
        _bar(begin, end, "rest" if name == "rest" else ""),
    ]


def _script(found: Mapping[str, Any]) -> Iterator[str]:
    yield "<h2>Beside a script of ten lines</h2>"
    longest = max(found[name]["ms_per_frame"]["median"] for name in (SCRIPT, *COMPARED))

    def row(name: str) -> list[str]:
        each, ratio = found[name], found[name]["over_script"]
        spread = f"{ratio['median']:.3f} ({ratio['least']:.2f} to {ratio['most']:.2f})"
        own = name == SCRIPT
        return [
            _cell("script" if own else f"run, mode {name}"),
            _cell(f"{each['ms_per_frame']['median']:.3f}"),
            _cell(f"{each['first_record_ms']['median']:.1f}"),
            _cell("" if own else spread),
            _cell("" if own else verdict(ratio)),
            _bar(0.0, each["ms_per_frame"]["median"] / longest, "other" if own else ""),
        ]

    yield from _table(
        ("", "ms per frame", "first record, ms", "over the script", "", "ms per frame"),
        map(row, (SCRIPT, *COMPARED)),
    )
    yield _note(
        f"Files to records, {found['frames']} frames, {found['threads']} threads, medians of "
        f"{found['rounds']} rounds in turns. The script makes no checks and no intervals"
        + (", and solves for no pose." if found["solves"] else ".")
    )


def _comparison(found: Mapping[str, Any]) -> Iterator[str]:
    yield f"<h2>Beside {escape(found['earlier'])}</h2>"
    for difference in found["differences"]:
        yield f'<p class="worse">Not comparable: {escape(difference)}</p>'
    yield from _table(
        ("", "old", "new", "new/old", ""),
        (
            [
                _cell(each["name"]),
                *(_cell(f"{each[key]:.3f}") for key in ("old", "new", "ratio")),
                '<td class="worse">regression</td>' if each["regression"] else _cell(""),
            ]
            for each in found["figures"]
        ),
    )
    yield _note(f"Tolerance {found['tolerance']:.0%}; of times in ms, twice as much.")


def _machine(environment: Mapping[str, Any]) -> Iterator[str]:
    yield "<h2>Machine</h2>"
    flat = {**environment, **environment["versions"]}
    del flat["versions"]
    shown = {
        name: ", ".join(f"{each:.2f}" for each in value) if isinstance(value, list) else str(value)
        for name, value in flat.items()
        if value is not None
    }
    yield from _table(
        ("", ""),
        (
            [_cell(name.replace("_", " ")), f'<td class="text">{escape(value)}</td>']
            for name, value in shown.items()
        ),
    )


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _cell(text: str) -> str:
    return f"<td>{escape(text)}</td>"


def _bar(begin: float, end: float, kind: str) -> str:
    place = f"margin-left:{100.0 * min(begin, 0.995):.2f}%;width:{100.0 * (end - begin):.2f}%"
    return f'<td class="bar"><div class="{kind}" style="{place}"></div></td>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield '<div class="scroll"><table>'
    if any(head):
        yield "<tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>"
    for row in rows:
        yield "<tr>" + "".join(row) + "</tr>"
    yield "</table></div>"
