"""Images without training: two touches on the reference sensor by six methods."""

import numpy as np

from eitskin import Protocol, Reconstructor, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch

from style import DIVERGING, circle, colours, figure, save, sensor, wanted

METHODS = ("greit", "noser", "tikhonov", "laplace", "total-variation", "back-projection")
touches = (Touch(0.045, 0.038, 10.0), Touch(0.110, 0.022, 10.0))
design, protocol = SensorDesign.reference(), Protocol.pairwise(8)
sim = Simulator(design, protocol=protocol)
flat, touched = sim.measure(Scene()), sim.measure(Scene(touches=touches))

images = {}
for method in METHODS:
    maker = Reconstructor(design, protocol, method, pixels=800)
    images[method] = 100.0 * maker.image(touched, flat)
    x, y = (axis.ravel() for axis in np.meshgrid(maker.grid.x, maker.grid.y))
    values = images[method].ravel()
    least = int(np.nanargmin(values))
    error = 1e3 * min(np.hypot(x[least] - t.x, y[least] - t.y) for t in touches)
    print(f"{method}: lowest pixel {np.nanmin(values):.2g} %, {error:.0f} mm from a touch")
    assert np.nanmin(values) < 0.0

if wanted():
    drawn, axes = figure(2, 3, (7.2, 2.9))
    for each, (method, image) in zip(axes.flat, images.items(), strict=True):
        limit = np.nanmax(np.abs(image))
        each.imshow(
            image, origin="lower", extent=(0, 150, 0, 60), cmap=colours(DIVERGING),
            vmin=-limit, vmax=limit, interpolation="bicubic",
        )  # fmt: skip
        sensor(each, design, numbers=False, fill=False)
        for touch in touches:
            circle(each, touch.x, touch.y)
        each.set_title(f"{method}, ±{limit:.2g} %")
    save(drawn, __file__)
