"""The example in the README runs as written and prints what the page shows."""

import re
from pathlib import Path

import pytest

from eitskin.datasets import State

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.slow
def test_the_example_in_the_readme_finds_the_touch_that_it_simulates(capsys) -> None:
    page = README.read_text()
    (example,) = re.findall(r"```python\n(.*?)```\n", page, re.DOTALL)
    scope: dict[str, object] = {}
    exec(compile(example, str(README), "exec"), scope)  # noqa: S102
    estimate, scene = scope["estimate"], scope["scene"]
    (touch,) = scene.touches
    assert estimate.state is State.TOUCH
    assert estimate.bend_angle_deg == pytest.approx(scene.bend.angle_deg, abs=1.0)
    (found,) = estimate.touches
    assert found[:2] == pytest.approx((touch.x, touch.y), abs=3e-3)
    shown = capsys.readouterr().out
    assert f"```text\n{shown}```" in page, "the page shows what the example prints"
