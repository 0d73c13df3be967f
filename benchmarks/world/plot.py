"""Plot of `bench world`: error of the signal against the time of the deformation."""

from pathlib import Path

from eitskin.benchmarks.world.models import KINEMATIC, SOLVED, TABULATED
from eitskin.benchmarks.world.run import MEDIAN, WORST, World
from eitskin.extras import require

_COLOURS = {KINEMATIC: "#c0392b", TABULATED: "#1f5fa8", SOLVED: "#2e8b57"}
_LABELS = {
    KINEMATIC: "kinematic: dent without corrections, hinge",
    TABULATED: "tabulated",
    SOLVED: "solved in 3D",
}
_MARKERS = {"press": "o", "supported press": "^", "bent press": "D", "bend": "s"}


def plot(found: World, path: Path) -> None:
    """Plot the error of each model at each case over its time; markers tell kinds of cases."""
    matplotlib = require("matplotlib", "bench")
    figure_class = require("matplotlib.figure", "bench").Figure
    with matplotlib.rc_context(
        {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    ):
        figure = figure_class(figsize=(9.0, 5.4), layout="constrained")
        axes = figure.subplots()
        for model, colour in _COLOURS.items():
            for kind, marker in _MARKERS.items():
                rows = found.of(model, kind)
                label = _LABELS[model] if kind == "press" else None
                times = [max(row.seconds, 1e-4) for row in rows]
                errors = [100 * row.error for row in rows]
                axes.loglog(times, errors, marker, color=colour, label=label, alpha=0.8)
        for limit, name in ((MEDIAN, "target, median"), (WORST, "target, worst")):
            axes.axhline(100 * limit, color="#999999", linewidth=0.8, linestyle=(0, (4, 3)))
            axes.text(0.01, 104 * limit, name, transform=axes.get_yaxis_transform())
        axes.set_xlabel("time of the deformation at all points of the mesh [s]")
        axes.set_ylabel("error of the signal against the reference [%]")
        axes.set_title(
            "Presses: flat on a rigid base (circles), on other supports (triangles), bent "
            "(diamonds); bends (squares)",
            fontsize=10,
        )
        axes.grid(visible=True, which="major", color="#e4e4e4", linewidth=0.7)
        axes.legend(frameon=False)
        figure.supxlabel(str(found.provenance), fontsize=8, color="#555555")
        figure.savefig(path, dpi=120, facecolor="white")
