"""`eitskin demo`: everything once, from the bare sensor to a pipeline on a live board."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from eitskin.cli.episode import episode_table, run_episode
from eitskin.cli.evaluate import paper_table
from eitskin.cli.generate import make_dataset
from eitskin.cli.options import Json, Output, Quiet, Seed, Verbose
from eitskin.cli.real_input import run_real_input
from eitskin.cli.train import train_pipeline
from eitskin.datasets import Dataset, Recipe, open_dataset
from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch

if TYPE_CHECKING:
    from eitskin.training.evaluate import TouchScore


def command(
    *,
    out: Annotated[Path, typer.Option(help="Folder for everything that the demo makes.")] = Path(
        "build/demo"
    ),
    data: Annotated[
        Path | None, typer.Option(help="Folder with real recordings; left out when absent.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that simulate.")] = 2,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw the sensor, make training sets, train, compare with the paper, run live.

    Finished datasets in --out are kept, so a demo that was interrupted goes on from there.
    """
    from eitskin.training import Pipeline, evaluate

    output = Output(as_json, quiet, verbose)
    start = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    output.heading("1. The sensor, bent and pressed")
    output.show(f"picture: {_draw(out / 'sensor.png')}")

    output.heading("2. Training and test frames")
    shipped = {name: Recipe.shipped(name) for name in ("quick", "quick_test", "paper_indentation")}
    shipped["paper_indentation"] = dataclasses.replace(
        shipped["paper_indentation"], resolution="standard"
    )
    sets = {
        name: _dataset(recipe, out / name, workers, seed, output)
        for name, recipe in shipped.items()
    }

    output.heading("3. Training")
    trained = train_pipeline(sets["quick"], "quick", None, seed, output)
    model = trained.save(out / "demo.eitmodel")
    output.show(f"saved pipeline: {model}")

    output.heading("4. The paper's table; test frames come from a finer mesh and other seeds")
    report = evaluate(trained, sets["quick_test"])
    indentation = evaluate(trained, sets["paper_indentation"])
    output.show(paper_table(report))
    output.show(_indentation(indentation.touches["1"]))

    output.show("The pipeline that comes with eitskin, trained on 1000 other sensors:")
    shipped_pipeline = Pipeline.load("reference.eitmodel")
    shipped_report = evaluate(shipped_pipeline, sets["quick_test"])
    shipped_indentation = evaluate(shipped_pipeline, sets["paper_indentation"])
    output.show(paper_table(shipped_report))
    output.show(_indentation(shipped_indentation.touches["1"]))

    output.heading("5. The saved pipeline, unchanged, on a virtual board over a serial link")
    live = run_episode(Pipeline.load(model), seed)
    output.show(episode_table(live))

    output.heading("6. Real recordings")
    real = run_real_input(data, out, Pipeline.load(model), output)
    seconds = time.perf_counter() - start
    output.show(f"\ndone in {seconds:.0f} s; everything is in {out}")
    if as_json:
        result = {
            "seconds": round(seconds, 1),
            "test": report.as_dict(),
            "indentation": indentation.as_dict(),
            "shipped": shipped_report.as_dict(),
            "shipped_indentation": shipped_indentation.as_dict(),
            "live": live,
            "real": real,
        }
        output.result(result, "")


def _indentation(score: "TouchScore") -> str:
    """The paper's first experiment in a sentence."""
    error = "none found"
    if score.mean_error_mm is not None:
        error = f"{score.mean_error_mm:.1f} +- {score.deviation_mm:.1f} mm"
    return f"27 positions x 8, 10 N, flat: {error}, {score.found:.1%} found (paper: 4.8 +- 2.8 mm)"


def _draw(path: Path) -> Path:
    """The sensor pressed while flat, and pressed while bent."""
    from eitskin.simulator.view import draw

    pressed = (Touch(0.040, 0.020), Touch(0.110, 0.040))
    bent = (Touch(0.030, 0.030), Touch(0.075, 0.020), Touch(0.120, 0.040))
    scenes = [
        ("flat, pressed with 10 N at two places", Scene(touches=pressed)),
        ("bent by 40 deg, pressed with 10 N at three places", Scene(Bend(40.0), bent)),
    ]
    draw(Simulator(SensorDesign.reference(), "fast"), scenes, path)
    return path


def _dataset(recipe: Recipe, folder: Path, workers: int, seed: int, output: Output) -> Dataset:
    """The dataset of `recipe`; what lies in `folder` already is kept."""
    seeded = dataclasses.replace(recipe, seed=recipe.seed + seed)
    _, sentence = make_dataset(seeded, folder, workers, resume=folder.exists(), output=output)
    output.show(sentence)
    return open_dataset(folder)
