"""Skin on a robot in MuJoCo: steps per second with it and without, and errors of the places.

Run by `python -m eitskin.benchmarks.studies.physics.robots [--seed N]`, with mujoco installed.

The arm of docs/guides/mujoco presses the reference sensor at random places. Prints how far the
pipeline that ships finds touches from the contacts of MuJoCo, and the cost of the skin's frames in
processor time, in one simulation and in 32 at once.
"""

import argparse
import importlib.util
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.extras import require
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.simulator.robots.mujoco_skin import MujocoSkin
from eitskin.simulator.robots.touch_rules import TouchRules
from eitskin.simulator.robots.touch_table import TouchTable
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.pipeline.pipeline import Pipeline

SCRIPT = Path(__file__).parents[3] / "docs" / "guides" / "mujoco" / "press.py"
MARGIN = 0.010  # m, of the random places
PERIOD = 0.1  # s, between frames
CYCLE = 1.0  # s, of one press and one release
SKINS = (("none", False), ("coarse", False), ("coarse", True), ("fast", False))
CHECKED = 200  # touches of the table beside the simulator's


def arm() -> Any:
    """Module of the guide's script."""
    spec = importlib.util.spec_from_file_location("press", SCRIPT)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def places(count: int, seed: int) -> list[tuple[float, float]]:
    """Random places on the reference sensor [m]."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(MARGIN, 0.150 - MARGIN, count)
    y = rng.uniform(MARGIN, 0.060 - MARGIN, count)
    return list(zip(x.tolist(), y.tolist(), strict=True))


def begun(script: Any) -> tuple[Any, Any]:
    """Model of the arm, and its state over the skin."""
    mujoco = require("mujoco", "mujoco")
    model = mujoco.MjModel.from_xml_path(str(script.ARM))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


def errors(script: Any, count: int, seed: int) -> Iterator[str]:
    """Distances between contacts and touches, as a table."""
    model, data = begun(script)
    skin = MujocoSkin(Simulator(SensorDesign.reference(), "fast"), model, "skin")
    pipeline, off, forces, extra = Pipeline.load("reference.eitmodel"), [], [], 0
    for touch, estimate in script.presses(model, data, skin, pipeline, places(count, seed)):
        forces.append(touch.force)
        found = estimate.touches or ()
        extra += max(len(found) - 1, 0)
        if found:
            off.append(min(1e3 * np.hypot(x - touch.x, y - touch.y) for x, y, _ in found))
    yield "| presses | force, mean [N] | found | false | error, median [mm] | largest [mm] |"
    yield "|---|---|---|---|---|---|"
    yield (
        f"| {count} | {np.mean(forces):.1f} | {len(off)} | {extra} | {np.median(off):.1f} | "
        f"{np.max(off):.1f} |"
    )


def pressing(script: Any, model: Any, data: Any, place: tuple[float, float], late: float) -> None:
    """One step of an arm that presses a place [m] every other half cycle, from a time [s] on."""
    mujoco = require("mujoco", "mujoco")
    down = (data.time - late) % CYCLE > CYCLE / 2
    height = script.PRESS if down else script.HOVER / 2
    corner = data.geom("skin").xpos + np.array([-0.075, -0.03, 0.006 + 0.0075])
    script.reach(model, data, corner + np.array([*place, height]))
    mujoco.mj_step(model, data)


def table_errors(count: int, seed: int) -> str:
    """Errors of a table of touches over their signals, in words."""
    sensor, rng = SensorDesign.reference(), np.random.default_rng(seed)
    simulator, rules, outline = Simulator(sensor, "coarse"), TouchRules(), Rectangle(0.150, 0.060)
    began = time.process_time()
    table = TouchTable.solved(simulator, outline, Cylinder(), rules)
    took = time.process_time() - began
    touches = [
        Touch(
            rng.uniform(rules.margin, outline.length - rules.margin),
            rng.uniform(rules.margin, outline.width - rules.margin),
            rng.uniform(0.5, rules.most),
        )
        for _ in range(count)
    ]
    scenes = [Scene(touches=(touch,)) for touch in touches]
    flat, *solved = simulator.measure_all([Scene(), *scenes])
    signals = np.array(solved) / flat
    errors = np.linalg.norm(table.factors(touches) - signals, axis=1)
    errors *= 100.0 / np.linalg.norm(signals - 1.0, axis=1)
    return (
        f"Table of touches beside the simulator, {count} touches: {np.median(errors):.2f} % of the "
        f"signal in the median, {np.quantile(errors, 0.9):.2f} % at the 90th percentile, "
        f"{errors.max():.1f} % at most; solved or read in {took:.0f} s"
    )


def steps(script: Any, count: int, kind: tuple[Any, bool], seconds: float, seed: int) -> str:
    """Row of one number of simulations and one skin, with or without a table, or none."""
    resolution, table = kind
    model, first = begun(script)
    mujoco = require("mujoco", "mujoco")
    simulations = [first, *(mujoco.MjData(model) for _ in range(count - 1))]
    for data in simulations[1:]:
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
    wanted, skin = places(count, seed), None
    if resolution != "none":
        simulator = Simulator(SensorDesign.reference(), resolution)
        skin = MujocoSkin(simulator, model, "skin", PERIOD, touch_table=table)
        warm_up(skin)
    done, frames, touched, of_skin = 0, 0, 0, 0.0
    began = time.process_time()
    while first.time < seconds:
        for number, data in enumerate(simulations):
            pressing(script, model, data, wanted[number], CYCLE * number / count)
        done += count
        if skin is not None:
            start = time.process_time()
            for data, frame in zip(simulations, skin.update(simulations), strict=True):
                frames += frame is not None
                touched += frame is not None and bool(data.ncon and skin.touches(data))
            of_skin += time.process_time() - start
    rate = done / (time.process_time() - began)
    each = f"{1e3 * of_skin / touched:.2f}" if touched else "-"
    share = f"{100 * touched / frames:.0f}" if frames else "-"
    name = f"{resolution}, table" if table else resolution
    return f"| {count} | {name} | {rate:.0f} | {share} | {each} |"


def warm_up(skin: MujocoSkin) -> None:
    """Load tables, factors and kernels, which a long run pays once."""
    skin.simulator.measure_all([Scene(touches=(Touch(x, 0.03, 8.0),)) for x in (0.05, 0.06)])


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--presses", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=6.0)
    given = parser.parse_args()
    script = arm()
    for line in errors(script, given.presses, given.seed):
        print(line)
    print(f"\n{table_errors(CHECKED, given.seed)}\n")
    print("| simulations | skin | steps/s | frames touched [%] | ms a touched frame |")
    print("|---|---|---|---|---|")
    for count in (1, 32):
        for skin in SKINS:
            seconds = given.seconds if count == 1 else given.seconds / 4
            print(steps(script, count, skin, seconds, given.seed), flush=True)
    print(f"\nMeasured on {Provenance.now(given.seed)}")


if __name__ == "__main__":
    main()
