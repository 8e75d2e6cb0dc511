"""The picture of ``results/pareto``: score against milliseconds, on two threads and on one.

python bench/pareto_picture.py    # draw docs/pictures/pareto.png
"""

from __future__ import annotations

import matplotlib as mpl
from pareto_tables import DEFAULT_SIZES, THREADS, Point, front, knee, points
from provenance import ROOT, read_result

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

PICTURE = ROOT / "docs" / "pictures" / "pareto.png"
# A palette for colour-blind readers (Okabe and Ito 2008), as in the pictures of studies.
COLOURS = dict(zip(DEFAULT_SIZES, ("#0072B2", "#D55E00"), strict=True))


def draw() -> None:
    """Draw score against milliseconds on two threads and on one."""
    every = points(read_result("pareto", "pareto"))
    some = [p for p in every if p.score is not None and p.data == "flights"]
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
    for panel, threads in zip(panels, THREADS, strict=True):
        for method, colour in COLOURS.items():
            own = [point for point in some if point.method == method]
            if own:
                _draw_method(panel, own, threads, colour)
        panel.set_xscale("log")
        panel.set_xlabel(f"ms from array to pose, {threads} thread{'s' if threads == '2' else ''}")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3, which="both")
    panels[0].set_ylabel("interval score at 0.9 on new flights")
    panels[1].legend(fontsize=8)
    PICTURE.parent.mkdir(exist_ok=True)
    figure.savefig(PICTURE, dpi=110)
    print(f"-> {PICTURE.relative_to(ROOT)}")


def _draw_method(panel: Axes, own: list[Point], threads: str, colour: str) -> None:
    """Draw points (squares: 8 bits, filled: the default), the front and a ring around the knee."""
    for point in own:
        panel.plot(
            point.frame[threads],
            point.score,
            "o" if point.precision == "fp32" else "s",
            color=colour,
            markerfacecolor=colour if point.default else "white",
        )
    best = front(own, threads)
    label = f"{own[0].method.upper()}: Pareto front"
    panel.plot([p.frame[threads] for p in best], [p.score for p in best], color=colour, label=label)
    if all(point.lost is None or not point.lost[1] for point in own):
        return  # Without standard errors there is no knee.
    at = knee(own, threads)
    place = at.frame[threads], at.score
    panel.plot(*place, "o", color=colour, markerfacecolor="none", markersize=14)
    panel.annotate(
        f"{at.label}, {at.precision}",
        place,
        textcoords="offset points",
        xytext=(10, -14),
        fontsize=8,
    )


if __name__ == "__main__":
    draw()
