"""An arm presses a skin in MuJoCo; the pipeline says from the skin's frames where it did.

python docs/how-to/mujoco/press.py [--picture FILE.png]
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from eitskin.geometry import SensorDesign
from eitskin.simulator import Simulator
from eitskin.simulator.robots.mujoco_skin import MujocoSkin
from eitskin.training import Estimate, Pipeline

ARM = Path(__file__).with_name("arm.xml")
PLACES = ((0.040, 0.020), (0.060, 0.042), (0.075, 0.030), (0.095, 0.018), (0.110, 0.040))
STIFFNESS, DAMPING = 1500.0, 35.0  # of the arm's finger [N/m, N s/m]
HOVER, PRESS = 0.03, -0.006  # height of the finger's goal above its place on the skin [m]


def reach(model: Any, data: Any, goal: np.ndarray) -> None:
    """Set torques by which the finger goes to a place (3,) [m] like a damped spring."""
    jacobian, tip = np.zeros((3, model.nv)), data.site("tip")
    mujoco.mj_jacSite(model, data, jacobian, None, tip.id)
    force = STIFFNESS * (goal - tip.xpos) - DAMPING * (jacobian @ data.qvel)
    data.ctrl[:] = jacobian.T @ force + data.qfrc_bias


def presses(
    model: Any,
    data: Any,
    skin: MujocoSkin,
    pipeline: Pipeline,
    places: Sequence[tuple[float, float]],
) -> Iterator[tuple[Any, Estimate]]:
    """The touch in MuJoCo, and the estimate of its last frame, of a press at each place [m]."""
    corner = data.geom("skin").xpos + np.array([-0.075, -0.03, 0.006 + 0.0075])
    for place in places:
        for height, seconds in ((HOVER, 1.0), (PRESS, 1.2), (HOVER, 0.6)):
            until = data.time + seconds
            while data.time < until:
                reach(model, data, corner + np.array([*place, height]))
                mujoco.mj_step(model, data)
                (frame,) = skin.update([data])
                if frame is not None:
                    made, estimate = skin.touches(data), pipeline.process(frame)
            if height == PRESS:
                (touch,) = made
                yield touch, estimate


def draw(model: Any, data: Any, touch: Any, estimate: Estimate, path: Path) -> None:
    """Write a picture of the arm, and of the touch map with both places."""
    from matplotlib.figure import Figure

    with mujoco.Renderer(model, 540, 960) as renderer:
        renderer.update_scene(data, camera="side")
        scene = renderer.render()
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.imshow(scene)
    left.set_axis_off()
    size = (0, 150, 0, 60)
    right.imshow(estimate.touch_map, origin="lower", extent=size, cmap="Blues", vmin=0, vmax=1.6)
    right.plot(1e3 * touch.x, 1e3 * touch.y, "+", color="k", ms=14, label="contact in MuJoCo")
    for number, (x, y, _) in enumerate(estimate.touches or ()):
        label = "" if number else "touch estimated by the skin"
        right.plot(1e3 * x, 1e3 * y, "o", color="C1", ms=10, mfc="none", label=label)
    right.set(xlabel="x [mm]", ylabel="y [mm]")
    right.legend(loc="lower left", frameon=False)
    figure.savefig(path, dpi=100)


def main(
    picture: Path | None = None, places: Sequence[tuple[float, float]] = PLACES
) -> list[float]:
    """Press at some places; print what MuJoCo and the skin say, and return the errors [mm]."""
    model = mujoco.MjModel.from_xml_path(str(ARM))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    skin = MujocoSkin(Simulator(SensorDesign.reference(), "fast"), model, "skin")
    errors = []
    pipeline = Pipeline.load("reference.eitmodel")
    for touch, estimate in presses(model, data, skin, pipeline, places):
        x, y, _ = max(estimate.touches or (), key=lambda found: found[2])
        errors.append(1e3 * float(np.hypot(x - touch.x, y - touch.y)))
        print(
            f"MuJoCo: {1e3 * touch.x:5.1f}, {1e3 * touch.y:4.1f} mm, {touch.force:.1f} N; "
            f"skin: {1e3 * x:5.1f}, {1e3 * y:4.1f} mm, {len(estimate.touches)} found; "
            f"{errors[-1]:.1f} mm off"
        )
        if picture is not None and len(errors) == len(places):
            draw(model, data, touch, estimate, picture)
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path)
    main(**vars(parser.parse_args()))
