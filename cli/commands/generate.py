"""`eitskin generate`: a dataset from a recipe."""

import dataclasses
import shlex
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.filesize import decimal

from eitskin import datasets
from eitskin.cli.options import Output, make_table, with_output
from eitskin.datasets.recipe import shipped_names
from eitskin.errors import ConfigurationError

if TYPE_CHECKING:
    from eitskin.datasets.generation.preparation import CostEstimate


@with_output
def command(
    recipe: Annotated[
        str | None,
        typer.Argument(help=f"Recipe: a .toml file, or one of {', '.join(shipped_names())}."),
    ] = None,
    *,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the dataset; new or empty. Required.")
    ] = None,
    list_recipes: Annotated[
        bool, typer.Option("--list", help="List the shipped recipes, and exit.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes that simulate.")] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option(help="A dask scheduler whose workers simulate, as tcp://127.0.0.1:8786."),
    ] = None,
    shard: Annotated[
        int | None,
        typer.Option(help="Make only this shard, counted from 0, as $SLURM_ARRAY_TASK_ID."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep finished shards in --out, make the others.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only estimate time and size, from a measured sample.")
    ] = False,
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random, instead of the recipe's.")
    ] = None,
    output: Output,
) -> None:
    """Generate a dataset from a recipe; it can be interrupted and resumed."""
    from eitskin.datasets.generation.preparation import estimate_cost
    from eitskin.datasets.recipe.recipe import with_seed

    if list_recipes:
        shipped = {name: datasets.Recipe.from_shipped(name) for name in shipped_names()}
        recipe_facts = {name: (each.frames, each.description) for name, each in shipped.items()}
        rows = [(name, f"{frames:,}", about) for name, (frames, about) in recipe_facts.items()]
        output.result(recipe_facts, make_table(("recipe", "frames", "content"), rows, box=None))
        return
    out = out or (Path() if dry_run else None)
    if recipe is None or out is None:
        raise ConfigurationError(
            "no recipe or no --out is named\nexpected eitskin generate RECIPE --out DIR; "
            "eitskin generate --list has the shipped recipes"
        )
    chosen = with_seed(_read(recipe), seed)
    if dry_run:
        _solve_missing(chosen, workers, output, shard)
        cost = estimate_cost(chosen, out, workers)
        output.result(dataclasses.asdict(cost), _as_text(cost, chosen, workers, out))
        return
    try:
        new_frames = make_dataset(chosen, out, workers, resume, output, scheduler, shard)
    except KeyboardInterrupt:
        again = ["eitskin", "generate", recipe, "--out", str(out)]
        again += [] if seed is None else ["--seed", str(seed)]
        again += [] if scheduler is None else ["--scheduler", scheduler]
        again += ["--resume"] if shard is None else ["--shard", str(shard)]
        # Not through a console, which would break the line.
        typer.echo(f"finished shards are kept; continue with: {shlex.join(again)}", err=True)
        raise
    output.result(*new_frames)


def make_dataset(
    recipe: "datasets.Recipe",
    out: Path,
    workers: int,
    resume: bool,
    output: Output,
    scheduler: str | None = None,
    shard: int | None = None,
) -> tuple[dict[str, Any], str]:
    """Generate with a progress bar; the result as plain data and as a sentence."""
    by = f"the cluster of {scheduler}" if scheduler else f"{workers} workers"
    output.detail(f"{recipe.frames} frames in {recipe.shards} shards, {by}")
    _solve_missing(recipe, workers, output, shard)
    start = time.perf_counter()
    found = {path: path.stat().st_mtime_ns for path in out.glob("shard-*.h5")}
    with output.bars() as show:
        counts: list[int] = []

        def show_frames(done: int, total: int) -> None:
            counts.append(done)
            speed = show(recipe.name, done, total)  # of late; the time left is reckoned from it
            show(recipe.name, done, total, f"{speed:.0f}/s" if speed else "")

        manifest = datasets.generate(
            recipe,
            out,
            workers,
            progress=show_frames,
            resume=resume,
            scheduler=scheduler,
            shard=shard,
            examined=partial(show, "finished shards"),
        )
    seconds = time.perf_counter() - start
    finished, new_shards = counts[-1], counts[-1] - counts[0]
    # Part of the result, which --quiet prints, too: files that were there are gone.
    replaced = sorted(path.name for path, at in found.items() if path.stat().st_mtime_ns != at)
    size = sum(path.stat().st_size for path in out.glob("shard-*.h5"))
    data = {
        "out": str(out),
        "recipe": recipe.name,
        "seed": recipe.seed,
        "frames": finished,
        "made": new_shards,
        "replaced": replaced,
        "complete": manifest is not None,
        "seconds": round(seconds, 3),
        "frames_per_second": round(new_shards / seconds, 1),
        "megabytes": round(size / 1e6, 3),
    }
    remarks = "" if manifest else "; other shards are missing still"
    if replaced:
        names = ", ".join(replaced[:5]) + " and others" * (len(replaced) > 5)
        remarks += f"; damaged or not of this recipe, and therefore made again: {names}"
    return data, (
        f"{finished} frames in {out}: {new_shards} made in {seconds:.1f} s "
        f"({new_shards / seconds:.0f}/s), {decimal(size)}{remarks}"
    )


def _solve_missing(
    recipe: "datasets.Recipe", workers: int, output: Output, shard: int | None
) -> None:
    """Solve the tables of presses and bends that are absent, with a note and a progress bar.

    A note also says how many frames will be solved in 3D, one by one.
    """
    from eitskin.datasets.generation.generate import needed_specimens
    from eitskin.datasets.generation.preparation import missing_tables, prepare, solved_frames
    from eitskin.simulator.deformation.solution_store import cache_folder

    specimens = needed_specimens(recipe, shard)
    kinds = Counter(path.name.partition("-")[0] for path in missing_tables(recipe, specimens))
    bends, plates = kinds["bend"], kinds["plates"]
    for count, what, duration in (
        (bends, "bends that no clamped sensor", "about half a minute each"),
        (plates, "presses on plates that no sensor", "about a quarter of an hour of one core each"),
        (
            kinds.total() - bends - plates,
            "presses that no sensor",
            "ten seconds to a few minutes each",
        ),
    ):
        if count:
            output.note(
                f"solving {count} table{'s' * (count > 1)} of {what} has needed so far, once: "
                f"{duration}; kept in {cache_folder()}"
            )
    solved = solved_frames(recipe)
    if solved:
        output.note(
            f"solving the touches of up to {solved} frames in 3D, since no tables are made for "
            "their support, outline or indenter: half a minute to minutes each. Progress is in "
            f"files of {recipe.frames_per_shard} frames; a smaller frames_per_shard shows it sooner"
        )
    if kinds:
        with output.counting("tables") as show:
            prepare(recipe, show, workers, specimens)


def _as_text(cost: "CostEstimate", recipe: "datasets.Recipe", workers: int, out: Path) -> str:
    if cost.megabytes > cost.megabytes_free:
        raise ConfigurationError(
            f"the disk of {out} has no room: '{recipe.name}' will take about "
            f"{_size(cost.megabytes)}, got {_size(cost.megabytes_free)}; make room, or choose "
            "a folder elsewhere"
        )
    return (
        f"{recipe.name}: {cost.frames} frames in {cost.shards} shards, about "
        f"{_duration(cost.seconds)} with {workers} workers here and {_size(cost.megabytes)} of "
        f"{_size(cost.megabytes_free)} free; measured on {cost.measured_frames} frames, nothing "
        "was written"
    )


def _size(megabytes: float) -> str:
    return decimal(round(1e6 * megabytes))


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _read(recipe: str) -> "datasets.Recipe":
    """Recipe from a file, or the shipped recipe of that name."""
    name = recipe.removesuffix(".toml")
    if recipe != name and name in shipped_names() and not Path(recipe).exists():
        raise ConfigurationError(f"there is no file {recipe}; did you mean the recipe '{name}'?")
    if recipe.endswith(".toml") or Path(recipe).is_file():
        return datasets.Recipe.from_toml(recipe)
    if "/" in recipe:
        raise ConfigurationError(f"there is no recipe {recipe}; give a .toml file")
    return datasets.Recipe.from_shipped(recipe)
