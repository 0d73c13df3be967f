"""The live page as a short film: a sensor that is bent, then pressed in two places, and let go.

`python -m eitskin.benchmarks.studies.boards.film --out docs/live-page.gif` runs `eitskin live
--page` on a virtual board, commands one scene after the other as the page's controls do, and
takes a screenshot of each once the page has drawn it: the film shows the page itself, at a pace
of its own. A headless Chromium must be installed.
"""

import argparse
import io
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eitskin.benchmarks.studies.boards.chromium import Size, Tab, chromium
from eitskin.benchmarks.studies.boards.live_windows import RATE, live_loop, updates
from eitskin.benchmarks.studies.boards.page import command_board
from eitskin.errors import PartialError
from eitskin.files import atomic_file

PAGE, SHOWN = Size(1440, 900), (960, 600)
UPDATES = 8  # that the page draws of a scene before its screenshot
MOMENT_MS, PAUSE_MS = 110, 900  # a screenshot is shown; the first one
COLOURS = 192


def story() -> list[dict[str, Any]]:
    """Scenes in their order, as the page posts them: m, N and degrees."""
    rising = [scene(30.0 * step / 8) for step in range(9)]
    turn = [2.0 * math.pi * step / 16 for step in range(17)]
    pressed = [
        scene(
            30.0,
            (0.045 + 0.014 * math.cos(t), 0.030 + 0.012 * math.sin(t), 8.0),
            *([(0.115, 0.030 - 0.012 * math.sin(t), 10.0)] if step > 4 else []),
        )
        for step, t in enumerate(turn)
    ]
    return [*rising, *pressed, *reversed(rising)]


def scene(bend_deg: float, *touches: Sequence[float]) -> dict[str, Any]:
    """One scene: bend angle [deg], and place [m] and force [N] of each touch."""
    placed = [dict(zip(("x", "y", "force"), touch, strict=True)) for touch in touches]
    return {"bend_deg": bend_deg, "touches": placed}


def pictures(tab: Tab, scenes: Sequence[dict[str, Any]]) -> list[bytes]:
    """Screenshots (PNG) of the page, one for each scene once it has been drawn."""
    taken = []
    for each in scenes:
        command_board(tab, "/scene", each)
        tab.until(f"eitskin.updates > {updates(tab) + UPDATES}")
        taken.append(tab.driver.get_screenshot_as_png())
    return taken


def write_film(taken: Sequence[bytes], path: Path) -> None:
    """Write screenshots as one GIF without end, with colours of its own for all of them."""
    from PIL import Image

    images = [Image.open(io.BytesIO(png)).convert("RGB").resize(SHOWN) for png in taken]
    # Colours of the fullest picture: those of each by itself would flicker.
    palette = images[len(images) // 2].quantize(COLOURS)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    shown = [PAUSE_MS, *[MOMENT_MS] * len(others)]
    with atomic_file(path, PartialError) as temporary:
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=shown, loop=0)


def main() -> None:
    """Make the film from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench/page/live-page.gif"))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    with live_loop(given.seed) as live, chromium() as browser:
        tab = browser.open(live.url, PAGE)
        tab.until(f"window.eitskin && eitskin.updates > {RATE}", 120.0)
        time.sleep(1.0)  # the session's references are means of its first frames
        write_film(pictures(tab, story()), given.out)
    print(f"{given.out}: {given.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
