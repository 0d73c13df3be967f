"""Draw pictures of the pages again, all or those named, and note what they show.

`drawn.json` has, for each script, a digest of the files that its pictures depend on and the
numbers that it printed. A test compares both with today's: `make pictures` after a change.
"""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
NOTES = HERE / "drawn.json"
SCRIPTS = sorted(set(HERE.glob("*.py")) - {HERE / "style.py", HERE / "draw.py"})
MUJOCO = ROOT / "docs" / "how-to" / "mujoco" / "press.py"
FURTHER = {"live_page": sorted((ROOT / "cli" / "page" / "web").iterdir())}


def digest(script: Path) -> str:
    """Digest of a script, the common style, and the files that it names."""
    text = script.read_text(encoding="utf-8")
    named = [path for path in sorted((HERE / "scenes").iterdir()) if path.name in text]
    files = [script, HERE / "style.py", *named, *FURTHER.get(script.stem, ())]
    joined = b"\0".join(path.read_bytes() for path in files)
    return hashlib.sha256(joined).hexdigest()[:16]


def draw(script: Path) -> dict[str, str | list[str]]:
    """Draw a script's pictures; the note on them."""
    target = ["--picture", str(script.with_suffix(".png"))] if script == MUJOCO else [str(HERE)]
    command = [sys.executable, str(script), *target]
    without_screen = {"MUJOCO_GL": "egl"} | os.environ
    shown = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env=without_screen
    ).stdout
    return {"digest": digest(script), "numbers": shown.splitlines()}


if __name__ == "__main__":
    notes = json.loads(NOTES.read_text()) if NOTES.is_file() else {}
    for script in (*SCRIPTS, MUJOCO):
        if len(sys.argv) == 1 or script.stem in sys.argv[1:]:
            print(script.stem, flush=True)
            notes[script.stem] = draw(script)
            NOTES.write_text(json.dumps(dict(sorted(notes.items())), indent=1) + "\n")
