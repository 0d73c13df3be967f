"""Tables of presses, and the store in which solutions are found again."""

import dataclasses
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, PartialError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Cylinder, Mechanics
from eitskin.simulator.deformation import press_table as tables
from eitskin.simulator.deformation import solution_store
from eitskin.simulator.deformation import solution_store as store
from eitskin.simulator.deformation.dents import Dents, PlacedDent
from eitskin.simulator.deformation.press_table import (
    PressTable,
    load_press_table,
    press_problems,
    press_table,
)
from eitskin.simulator.deformation.solution_store import Problem, load_or_solve, processes
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.materials import NeoHookean

DESIGN = SensorDesign.reference()
REFERENCE = Mechanics()


@pytest.fixture(scope="module")
def table() -> PressTable:
    return press_table(DESIGN, REFERENCE, Cylinder())


def disc(dent, n=40):
    """Points (r, z) of the layer within the dent's reach, a little off its faces."""
    r, z = np.meshgrid(np.linspace(1e-4, 0.9 * dent.reach, n), np.linspace(2e-4, 4.8e-3, 9))
    return r.ravel(), z.ravel()


@pytest.mark.slow
def test_between_tabulated_depths_dents_are_those_of_a_press(table) -> None:
    stack = REFERENCE.stack(DESIGN)
    press = AxisymmetricPress(stack, Cylinder(), finest=0.0075 / 40)
    dent, pressed = table.dent_from_depth(9e-4), press.to_depth(9e-4)
    assert dent.force == pytest.approx(pressed.force, rel=0.01)
    assert dent.thinning == pytest.approx(pressed.thinning(1), rel=0.002)
    in_gel = (pressed.z > 0.0035 - 1e-9) & (pressed.z < 0.0085 + 1e-9)
    r, z = np.meshgrid(pressed.r, pressed.z[in_gel] - 0.0035, indexing="ij")
    near = r < dent.reach
    u = moved(dent, r[near], z[near])[:2].T
    solved = pressed.displacement[:, in_gel][near]
    assert u == pytest.approx(solved, abs=0.004 * np.abs(solved).max())
    # A stack relaxes by shares that differences of moduli give as well.
    soft, hard = (
        AxisymmetricPress(
            dataclasses.replace(REFERENCE, gel=NeoHookean(mu)).stack(DESIGN),
            Cylinder(),
            finest=2e-3,
        ).to_depth(9e-4)
        for mu in (19e3, 21e3)
    )
    assert dent.share == pytest.approx(np.log(hard.force / soft.force) / np.log(21 / 19), abs=0.01)


def moved(dent, r, z):
    """u, w, du/dz, dw/dz, du/dr and dw/dr at places by themselves, (6, n)."""
    return dent.motion(r, z[:, None])[..., 0].T


@pytest.mark.parametrize("force", [0.1, 20.0])
def test_a_dent_keeps_volume_and_is_found_by_force_and_by_depth(table, force) -> None:
    dent = table.dent_from_force(force)
    assert table.dent_from_depth(dent.depth).force == pytest.approx(force, rel=1e-9)
    r, z = disc(dent)
    u, _, shear, stretch, radial, tilt = moved(dent, r, z)
    J = (1 + u / r) * ((1 + radial) * (1 + stretch) - shear * tilt)
    assert J == pytest.approx(np.ones(len(J)), abs=2e-3 * max(1.0, force / 10))
    assert np.sqrt(np.mean((J - 1) ** 2)) < 3e-4 * max(1.0, force / 10)


@pytest.mark.parametrize("force", [1e-5, 1e-3, 0.05])
def test_light_presses_of_a_flat_punch_are_in_proportion_to_their_force(table, force) -> None:
    dent, known = table.dent_from_force(force), table.dent_from_force(0.3)
    assert table.dent_from_depth(dent.depth).force == pytest.approx(force, rel=1e-9)
    for name, error in (("depth", 0.1), ("thinning", 0.03)):
        slope, expected = getattr(dent, name) / force, getattr(known, name) / 0.3
        assert slope == pytest.approx(expected, rel=error)
    below, above = (moved(table.dent_from_force(f), *disc(known)) / f for f in (force, 0.3))
    assert below == pytest.approx(above, abs=0.04 * np.abs(above).max())


def test_dents_have_strains_pressure_and_points_of_one_field(table):
    dent, step = table.dent_from_force(7.0), 1e-7
    r, z = disc(dent)
    _, _, shear, stretch, radial, tilt = moved(dent, r, z)
    along = moved(dent, r + step, z)[:2] - moved(dent, r - step, z)[:2]
    upward = moved(dent, r, z + step)[:2] - moved(dent, r, z - step)[:2]
    assert along / (2 * step) == pytest.approx(np.stack([radial, tilt]), abs=1e-6)
    assert upward / (2 * step) == pytest.approx(np.stack([shear, stretch]), abs=1e-6)
    forces = {(0.05, 0.02): 9.0, (0.08, 0.03): 4.0}
    dents = Dents(tuple(PlacedDent(*at, table.dent_from_force(f)) for at, f in forces.items()))
    places = np.random.default_rng(2).uniform((0.03, 0.01), (0.12, 0.05), (30, 2))
    columns = np.empty((30, 4, 3))
    columns[..., :2], columns[..., 2] = places[:, None], (0.0, 0.001, 0.0032, 0.005)
    for field in (dents.gradient, dents.positions, dents.mean_stress):
        together, apart = field(columns), field(columns.reshape(-1, 3))
        assert np.concatenate(together) == pytest.approx(apart, rel=1e-12)
    axis, beside = dents.gradient(np.array([[0.05, 0.02, 0.002], [0.05 + 1e-7, 0.02, 0.002]]))
    assert axis == pytest.approx(beside, abs=1e-4)
    dent = table.dent_from_force(10.0)
    under, far = dent.mean_stress(np.array([0.0, 0.03]), np.full((2, 1), 0.0025))[:, 0]
    mean = -10.0 / (np.pi * dent.contact_radius**2)
    assert 2.0 * mean < under < 0.3 * mean
    assert abs(far) < 0.02 * abs(under)


# Between and beyond


def test_kernels_are_interpolated_between_ratios_and_scale_with_lengths(table, monkeypatch):
    """By four of them; here of a law in the ratio that a cubic in its logarithm does not meet."""
    big = dataclasses.replace(DESIGN, thickness=2 * DESIGN.thickness, encapsulated_thickness=0.024)
    hard = Mechanics(gel=NeoHookean(60e3), encapsulation=NeoHookean(84e3))
    found = press_table(big, hard, Cylinder(0.015))
    assert found.forces == pytest.approx(12 * table.forces, rel=1e-12)
    assert found.knots == pytest.approx(2 * table.knots, rel=1e-12)
    dent, twice = table.dent_from_force(5.0), found.dent_from_force(60.0)
    assert twice.depth == pytest.approx(2 * dent.depth, rel=1e-9)
    assert twice.peak_pressure == pytest.approx(3 * dent.peak_pressure, rel=1e-9)

    def scaled(stack, _):
        ratio = stack.sheets[0].law.shear_modulus / stack.sheets[1].law.shear_modulus
        return dataclasses.replace(table, forces=table.forces * ratio**0.6)

    monkeypatch.setattr(tables, "load_press_table", scaled)
    mechanics = Mechanics(gel=NeoHookean(13e3))
    found = press_table.__wrapped__(DESIGN, mechanics, Cylinder())
    assert found.forces == pytest.approx(table.forces * (28 / 13) ** 0.6, rel=2e-4)
    assert found.moved == pytest.approx(table.moved, abs=1e-12)


@pytest.mark.parametrize("wrong", [0.0, 1e3, float("nan")])
def test_forces_beyond_the_table_are_refused(table, wrong) -> None:
    for find in (table.dent_from_force, table.dent_from_depth):
        with pytest.raises(ConfigurationError, match=r"(force|depth).*above 0"):
            find(wrong)


@pytest.mark.slow
def test_tables_of_a_new_stack_are_its_presses(tmp_path, monkeypatch):
    """A thicker and stiffer stack than tables are solved for: all is scaled there and back."""
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    monkeypatch.setattr(solution_store, "LIBRARY", tmp_path / "nothing ships")
    monkeypatch.setattr(tables, "_CELL", 0.2)
    monkeypatch.setattr(tables, "_MAX_DEPTH", 0.15)
    monkeypatch.setattr(tables, "_DEPTHS", 4)
    thick = dataclasses.replace(DESIGN, thickness=0.006)
    stack = Mechanics(NeoHookean(50e3), NeoHookean(60e3)).stack(thick)
    new = load_press_table(stack, Cylinder())
    press = AxisymmetricPress(stack, Cylinder(), finest=0.2 * Cylinder().rims[1])
    for depth in new.depths[1:3]:
        pressed = press.to_depth(depth)
        dent = new.dent_from_depth(depth)
        assert dent.force == pytest.approx(pressed.force, rel=1e-3)
        bottom, top = stack.levels[1:3]
        in_gel = (pressed.z > bottom - 1e-9) & (pressed.z < top + 1e-9)
        r, z = np.meshgrid(pressed.r, pressed.z[in_gel] - bottom, indexing="ij")
        near = r < dent.reach
        solved = pressed.displacement[:, in_gel][near]
        u = moved(dent, r[near], z[near])[:2].T
        assert u == pytest.approx(solved, abs=0.02 * np.abs(solved).max())


# Where they are kept


def test_unstored_tables_are_solved_at_their_size_under_names_of_what_they_depend_on(
    table, tmp_path, monkeypatch
):
    def names(indenter=Cylinder(), **mechanics):  # noqa: B008
        (problem,) = press_problems(DESIGN, Mechanics(**mechanics), indenter)
        return problem.name

    indenters = Cylinder(), Cylinder(rough=False), Cylinder(0.006), Cylinder(edge=0.1)
    assert len({*map(names, indenters), names(bulk_ratio=1e3)}) == 5
    assert names(margin=0.002) == names()
    solved = []
    monkeypatch.setattr(tables, "solve_table", lambda *of: solved.append(of) or table)
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    monkeypatch.setattr(solution_store, "LIBRARY", tmp_path / "nothing ships")
    stacks = [Mechanics(NeoHookean(k * 20e3), NeoHookean(k * 28e3)).stack(DESIGN) for k in (1, 2)]
    first, harder = (load_press_table(stack, Cylinder()) for stack in stacks)
    assert [(stack, layer) for stack, layer, _ in solved] == [(stacks[0], 1)]
    for field in dataclasses.fields(PressTable):
        assert getattr(first, field.name) == pytest.approx(getattr(table, field.name))
    assert harder.forces == pytest.approx(2.0 * table.forces)


# The store of solutions


# Asks for a solution; says `looked` when it has looked for the file, and `solving`, and solves when
# a line comes.
ASKER = """
import sys
import numpy as np
from eitskin.simulator.deformation import solution_store as store

def solve(_):
    print("solving", flush=True)
    sys.stdin.readline()
    return {"x": np.array([float(sys.argv[1])])}
load = store._load
def looking(path, make):
    found = load(path, make)
    if path.parent == store.cache_folder():
        print("looked", flush=True)
    return found
store._load = looking
print(float(store.load_or_solve(store.Problem("kept", {}, solve), dict)["x"][0]), flush=True)
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    return tmp_path


@pytest.fixture
def ask(cache):  # noqa: ARG001
    """Function that starts a process which asks for one solution, and would find a number."""
    started = []

    def start(number):
        command = [sys.executable, "-P", "-c", ASKER, str(number)]
        pipe = subprocess.PIPE
        started.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
        assert started[-1].stdout.readline() == "looked\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def said(process, lines):
    return [process.stdout.readline().strip() for _ in range(lines)]


def go_on(process):
    process.stdin.write("\n")
    process.stdin.flush()


@pytest.mark.slow
def test_when_the_one_that_solves_is_killed_another_solves(ask) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    os.kill(first.pid, signal.SIGKILL)
    assert said(second, 2) == ["looked", "solving"]
    go_on(second)
    assert said(second, 1) == ["2.0"]


@pytest.mark.slow
def test_another_waits_for_the_one_that_solves_and_takes_its_solution(ask) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    go_on(first)
    assert said(first, 1) == ["1.0"]
    assert said(second, 2) == ["looked", "1.0"]


def problem(values, **description) -> Problem:
    return Problem("kept", description, lambda _: {"x": np.asarray(values)})


def test_a_folder_that_cannot_be_written_lets_each_solve(cache, monkeypatch) -> None:
    (cache / "file").write_text("")
    monkeypatch.setenv("EITSKIN_CACHE", str(cache / "file"))
    assert load_or_solve(problem([1.0, 1.0]), dict)["x"].tolist() == [1.0, 1.0]
    assert load_or_solve(problem([2.0]), dict)["x"].tolist() == [2.0]


def test_missing_and_damaged_files_are_solved_and_reported_once(cache):
    def fail(_):
        raise ValueError("no equilibrium")

    for _ in range(2):
        with pytest.raises(ValueError, match="no equilibrium"):
            load_or_solve(Problem("kept", {}, fail), dict)
    assert not [*cache.iterdir()]
    load_or_solve(problem(np.arange(300.0)), dict)
    (path,) = cache.glob("*.npz")
    good, found = path.read_bytes(), []
    for place in range(0, len(good), 5):
        path.write_bytes(good[:place] + bytes([good[place] ^ 0x55]) + good[place + 1 :])
        found.append(store._read(path))
    assert found.count(None) > len(found) // 2
    path.write_bytes(good[: len(good) // 2])
    assert load_or_solve(problem(np.ones(2)), dict)["x"].tolist() == [1.0, 1.0]
    path.unlink()
    os.mkfifo(path)
    assert load_or_solve(problem(np.ones(2)), dict)["x"].tolist() == [1.0, 1.0]
    assert path.is_fifo()  # which no file replaces


@pytest.mark.usefixtures("cache")
def test_arrays_are_read_back_bit_by_bit() -> None:
    arrays = [np.array(0.1), np.arange(300.0).reshape(20, 15), np.zeros((0, 3))]
    arrays += [np.linspace(0, 1, 7, dtype=np.float32), np.arange(12).reshape(3, 4)]
    for number, values in enumerate(arrays):
        load_or_solve(problem(values, number=number), dict)
        found = load_or_solve(problem(None, number=number), dict)["x"]
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_everything_missing_is_solved_once_and_reported(cache) -> None:
    problems, reports = [problem([n], number=n) for n in (1.0, 2.0, 1.0)], []

    def solve(report):
        for part in (1, 2):
            report(part, 2)
        return {}

    problems.append(Problem("parts", {}, solve))
    same = {problem([], a=a).name for a in (1.0, 1.0 + 1e-12, 1.0 + 1e-8, "one", {"b": 1.0})}
    assert len(same) == 4  # by nine digits
    store.prepare(problems, lambda *done: reports.append(done))
    assert reports == [(5, 6), (6, 6)]
    assert store.missing(problems) == {}
    assert len(list(cache.glob("*.npz"))) == 3
    store.prepare(problems, lambda *_: pytest.fail("nothing is missing"))


@pytest.mark.slow
def test_a_process_that_dies_is_reported_in_words() -> None:
    with pytest.raises(PartialError, match=r"__main__"), processes(2) as run:
        list(run(signal.raise_signal, [signal.SIGKILL]))
