"""The live page in a browser: bent and touched, in a set-up, and moving."""

import io
import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from eitskin import Bend, Pipeline, Scene, SensorDesign, Simulator, Touch
from eitskin.hardware.streams import state_name

from style import wanted

PORT = 8952
URL = f"http://127.0.0.1:{PORT}"
TOUCHES = (Touch(0.040, 0.040, 6.0), Touch(0.110, 0.022, 9.0))
STORY = (  # angle and touches, for a second each
    (0.0, ()),
    (0.0, TOUCHES[:1]),
    (0.0, ()),
    (15.0, ()),
    (30.0, ()),
    (30.0, TOUCHES[1:]),
    (30.0, TOUCHES),
    (30.0, ()),
)

# Simulated without a board's noise, the pretrained pipeline estimates what the page shows.
sim, pipeline = Simulator(SensorDesign.reference()), Pipeline.load("reference.eitmodel")
pipeline.process(sim.measure(Scene()))
pipeline.process(sim.measure(Scene(Bend(30.0))))
estimate = pipeline.process(sim.measure(Scene(Bend(30.0), TOUCHES)))
print(f"{state_name(estimate)}, bent by {estimate.bend_angle_deg:.0f} deg")
for x, y, _ in sorted(estimate.touches or ()):
    print(f"touched at {1e3 * x:.0f}, {1e3 * y:.0f} mm")
assert len(estimate.touches or ()) == len(TOUCHES)


def command(path: str, **body: Any) -> None:
    """Send a command to the page's server, as the page does."""
    headers = {"Origin": URL, "Content-Type": "application/json"}
    request = urllib.request.Request(URL + path, json.dumps(body).encode(), headers)
    urllib.request.urlopen(request).close()


def show(angle: float, touches: tuple[Touch, ...]) -> None:
    """Bend and touch the virtual sensor."""
    shown = [{"x": each.x, "y": each.y, "force": each.force} for each in touches]
    command("/scene", bend_deg=angle, touches=shown)


def photograph(folder: Path) -> None:
    """Screenshots and a film of the page, by Chromium."""
    from PIL import Image

    sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
    from chromium import Size, chromium

    film = []
    with chromium() as browser:
        tab = browser.open(URL, Size(1280, 860))
        tab.until("window.eitskin && eitskin.updates > 30")
        drawer = "document.getElementById('menu').click()"
        tab.run(drawer)
        for angle, touches in STORY:
            show(angle, touches)
            for _ in range(3):
                time.sleep(0.2)
                tab.screenshot(folder / "film.png")
                image = Image.open(io.BytesIO((folder / "film.png").read_bytes())).convert("RGB")
                film.append(image.resize((720, 484), Image.Resampling.LANCZOS))
            if len(touches) == len(TOUCHES):
                time.sleep(2.0)
                tab.screenshot(folder / "live_page.png")
        tab.run(drawer)
        command("/setup")
        tab.until("document.querySelectorAll('#choices button').length")
        time.sleep(1.0)
        tab.screenshot(folder / "live_page_setup.png")
    (folder / "film.png").unlink()
    few = [each.quantize(64, dither=Image.Dither.NONE) for each in film]
    few[0].save(
        folder / "live_page.gif", save_all=True, append_images=few[1:], duration=250, loop=0
    )


target = wanted()
if target is not None:
    board = ["--board", "virtual:?period=0.05&seed=1", "--page", "--page-port", str(PORT)]
    program = [str(Path(sys.executable).with_name("eitskin")), "live", "reference.eitmodel"]
    with tempfile.TemporaryDirectory() as place:
        served = subprocess.Popen([*program, *board, "--quiet"], cwd=place)
        try:
            for _ in range(120):
                try:
                    urllib.request.urlopen(URL).close()
                    break
                except OSError:
                    time.sleep(0.5)
            photograph(target.resolve())
        finally:
            served.terminate()
            served.wait()
