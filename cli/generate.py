"""`eitskin generate`: a dataset from a recipe."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from eitskin.cli.options import Json, Output, Quiet, Verbose
from eitskin.cli.presses import announce
from eitskin.datasets import Recipe, generate
from eitskin.datasets.recipe import shipped_names, with_seed
from eitskin.geometry import ConfigurationError
from eitskin.simulator import Cylinder, Mechanics


def command(
    recipe: Annotated[
        str, typer.Argument(help=f"Recipe: a .toml file, or one of {', '.join(shipped_names())}.")
    ],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the dataset; new or empty.")],
    workers: Annotated[int, typer.Option(min=1, help="Processes that simulate.")] = 2,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep finished shards in --out, make the others.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random, instead of the recipe's.")
    ] = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Generate a dataset from a recipe; it can be interrupted and resumed."""
    output = Output(as_json, quiet, verbose)
    output.result(*make_dataset(with_seed(_read(recipe), seed), out, workers, resume, output))


def make_dataset(
    recipe: Recipe, out: Path, workers: int, resume: bool, output: Output
) -> tuple[dict[str, Any], str]:
    """Generate with a progress bar; what was made, as data and as a sentence."""
    output.detail(f"{recipe.frames} frames in {recipe.shards} shards, {workers} workers")
    if any(group.state == "touch" for group in recipe.scenes):
        announce(recipe.sensor, Mechanics(), [Cylinder()], output)
    start = time.perf_counter()
    with output.progress() as bar:
        task = bar.add_task(recipe.name, total=recipe.frames, rate="")
        kept: list[int] = []

        def show(done: int, total: int) -> None:
            kept.append(done)
            made = done - kept[0]  # what a resumed run found there says nothing about its speed
            rate = made / (time.perf_counter() - start)
            bar.update(task, completed=done, total=total, rate=f"{rate:.0f}/s" if made else "")

        manifest = generate(recipe, out, workers, progress=show, resume=resume)
    seconds = time.perf_counter() - start
    made = manifest.frames - kept[0]
    megabytes = sum((out / shard.name).stat().st_size for shard in manifest.shards) / 1e6
    data = {
        "out": str(out),
        "recipe": recipe.name,
        "seed": recipe.seed,
        "frames": manifest.frames,
        "made": made,
        "seconds": round(seconds, 3),
        "frames_per_second": round(made / seconds, 1),
        "megabytes": round(megabytes, 3),
    }
    return data, (
        f"{manifest.frames} frames in {out}: {made} made in {seconds:.1f} s "
        f"({made / seconds:.0f}/s), {megabytes:.1f} MB"
    )


def _read(recipe: str) -> Recipe:
    """A recipe by path, or, where it is no path, by the name of a shipped one."""
    if recipe.endswith(".toml") or Path(recipe).is_file():
        return Recipe.from_toml(recipe)
    if "/" in recipe:
        raise ConfigurationError(f"there is no recipe {recipe}; give a .toml file")
    return Recipe.shipped(recipe)
