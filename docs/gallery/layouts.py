"""Layouts: what can be known of a press at all, and what four electrodes more would bring."""

import numpy as np

from eitskin.benchmarks.layouts.bound import Layout, Sampling, SheetBound, sheet_bound
from eitskin.benchmarks.layouts.candidates import paper, sweeps

from style import RISING, colours, figure, save, sensor, wanted

# The paper's eight electrodes, and twelve evenly spaced around the same rim.
eight = paper()
twelve = next(layout for layout in sweeps()["count"] if len(layout.design.electrodes) == 12)


def bound(layout: Layout, spacing: float) -> SheetBound:
    """The Cramer-Rao bound of 10 N all over the sheet: no unbiased estimate errs by less."""
    return sheet_bound(layout, Sampling(spacing, margin=0.010))


# On a coarse grid of 4 x 2 places, for the sake of time.
least = {}
for layout in (eight, twelve):
    found = bound(layout, 0.040)
    # As many frames as the time of one of the paper's allows, or the fraction of one.
    paced = np.median(found.place) * np.sqrt(layout.scan_time / eight.scan_time)
    least[layout.name] = (np.median(found.place), paced)
    print(
        f"{layout.name}: {len(layout.protocol)} values, median {1e3 * least[layout.name][0]:.2f} mm"
    )
    print(f"  in the time of one of the paper's frames {1e3 * paced:.2f} mm")
(frame8, paced8), (frame12, paced12) = least[eight.name], least[twelve.name]

# A frame of 66 values knows much more than one of 28, but takes 2.4 times as long.
assert frame12 < 0.6 * frame8
assert frame12 < paced12 < paced8

if wanted():
    drawn, axes = figure(1, 2, (7.2, 2.4))
    for each, layout in zip(axes, (eight, twelve), strict=True):
        found = bound(layout, 0.010)
        shown = each.pcolormesh(1e3 * found.x, 1e3 * found.y, 1e3 * found.place, vmin=0, vmax=4,
                                cmap=colours(RISING), shading="gouraud")  # fmt: skip
        sensor(each, layout.design, numbers=False)
        each.set_title(layout.name)
    drawn.colorbar(shown, ax=axes, label="bound of the\nposition of 10 N [mm]", shrink=0.7)
    save(drawn, __file__)
