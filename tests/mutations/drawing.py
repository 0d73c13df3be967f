"""Draw wrong formulas: a sign, a factor, an index or a boundary of one statement each.

Which are drawn follows from the text of the statements and the seed alone, so a formula that
moves, or one that changes elsewhere, leaves the others in the draw.
"""

import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

FORMULAS = {  # files with formulas, and how many mutations are drawn of them
    "geometry": (("geometry/**/*.py",), 40),
    "simulator": (
        (
            "simulator/electrical/*.py",
            "simulator/instrument/*.py",
            "simulator/linalg/*.py",
            "simulator/mechanics/*.py",
            "simulator/deformation/*.py",
            "simulator/bends/*.py",
            "simulator/bodies/*.py",
        ),
        80,
    ),
    "datasets": (("datasets/generation/*.py", "datasets/recipe/*.py", "datasets/store/*.py"), 40),
    "fit": (("training/adaptation/*.py", "training/twin/*.py", "training/joint/*.py"), 25),
    "estimates": (
        (
            "training/pipeline/*.py",
            "training/method/*.py",
            "training/reconstruction/*.py",
            "training/paper/*.py",
            "training/evaluation/scores.py",
            "training/evaluation/cramer_rao.py",
        ),
        25,
    ),
    "codec": (("hardware/protocol/*.py", "hardware/boards/text*.py", "eitskin/protocol.py"), 15),
    "boards": (("hardware/*.py", "hardware/virtual/*.py", "hardware/diagnosis/*.py"), 20),
}
NEGATED = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
SHIFTED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
SWAPPED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}


@dataclass(frozen=True, slots=True)
class Drawn:
    """One wrong formula: the file's text with one statement of `function` changed.

    Attributes:
        room: key of `FORMULAS`.
        file: from the root of the tree.
        line: of the statement.
        function: dotted name of what the statement is in.
        old, new: the statement as it is and as it becomes, in one line each.
        text: the whole file with it.
    """

    room: str
    file: str
    line: int
    function: str
    old: str
    new: str
    text: str

    @property
    def what(self) -> str:
        """The change in words."""
        return f"{self.function}, line {self.line}: {self.old}  ->  {self.new}"

    def order(self, seed: int) -> str:
        """Place in the draw: a hash of the statements, not of where they stand."""
        return hashlib.sha256(f"{seed} {self.old} {self.new}".encode()).hexdigest()


def draw(root: Path, seed: int, per_room: dict[str, int] | None = None) -> list[Drawn]:
    """The mutations of a seed, room by room, at most one a statement and three a function."""
    chosen: list[Drawn] = []
    for room, (patterns, count) in FORMULAS.items():
        paths = sorted({path for pattern in patterns for path in root.glob(pattern)})
        sites = [each for path in paths for each in _sites(root, room, path)]
        statements, functions = set(), []
        left = count if per_room is None else per_room.get(room, 0)
        for each in sorted(sites, key=lambda each: each.order(seed)):
            place = (each.file, each.function)
            if left and each.old not in statements and functions.count(place) < 3:
                statements.add(each.old)
                functions.append(place)
                chosen.append(each)
                left -= 1
    return chosen


def _sites(root: Path, room: str, path: Path) -> Iterator[Drawn]:
    source = path.read_text(encoding="utf-8")
    for function, statement in _statements(ast.parse(source)):
        old = ast.unparse(statement)
        for node in list(_own_expressions(statement)):
            for change, restore in _changes(node):
                change()
                new = ast.unparse(statement)
                restore()
                if new != old:
                    text = _replaced(source, statement, new)
                    yield Drawn(room, str(path.relative_to(root)), statement.lineno, function,
                                *_heads(old, new), text)  # fmt: skip


def _statements(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Simple statements inside functions, and the heads of `if` and `while`."""

    def walk(node: ast.AST, names: tuple[str, ...]) -> Iterator[tuple[str, ast.stmt]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                yield from walk(child, (*names, child.name))
            elif isinstance(child, ast.Raise | ast.Assert | ast.Import | ast.ImportFrom):
                continue
            elif isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
                simple = ast.Assign | ast.AugAssign | ast.AnnAssign | ast.Return | ast.Expr
                if names and isinstance(child, simple | ast.If | ast.While):
                    yield ".".join(names), child
                yield from walk(child, names)

    yield from walk(tree, ())


def _own_expressions(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of the statement's own expressions, without text and messages."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return
    heads = [statement.test] if isinstance(statement, ast.If | ast.While) else [statement]
    waiting: list[ast.AST] = [*heads]
    while waiting:
        node = waiting.pop()
        yield node
        skipped = ast.JoinedStr | ast.Lambda
        if isinstance(node, ast.AnnAssign):
            waiting += [node.value] if node.value else []
        else:
            waiting += [c for c in ast.iter_child_nodes(node) if not isinstance(c, skipped)]


def _changes(node: ast.AST) -> Iterator[tuple]:
    """Pairs of functions: one that makes a formula wrong, and one that takes it back."""

    def attribute(target, name, value):
        before = getattr(target, name)
        return (lambda: setattr(target, name, value)), (lambda: setattr(target, name, before))

    match node:
        case (
            ast.BinOp(left=left, op=op, right=right)
            | ast.AugAssign(target=left, op=op, value=right)
        ) if type(op) in SWAPPED:
            if not any(isinstance(side, _TEXTS) for side in (left, right)):
                yield attribute(node, "op", SWAPPED[type(op)]())
        case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=int() | float() as power)):
            yield attribute(node.right, "value", power + 1)
        case ast.UnaryOp(op=ast.USub(), operand=operand) if not isinstance(operand, ast.Constant):
            yield attribute(node, "op", ast.UAdd())
        case ast.Compare(ops=[op]) if type(op) in NEGATED:
            whole = any(map(_is_whole, (node.left, *node.comparators)))
            table = SHIFTED if whole and type(op) in SHIFTED else NEGATED
            yield attribute(node, "ops", [table[type(op)]()])
        case ast.Subscript(slice=part):
            for each in part.elts if isinstance(part, ast.Tuple) else [part]:
                bounds = [each.lower, each.upper] if isinstance(each, ast.Slice) else [each]
                for bound in bounds:
                    if isinstance(bound, ast.Constant) and type(bound.value) is int:
                        yield attribute(bound, "value", bound.value + 1)
        case ast.Constant(value=float() as factor) if factor not in (0.0, float("inf")):
            yield attribute(node, "value", 2.0 * factor)


_TEXTS = ast.JoinedStr | ast.List | ast.Tuple | ast.Dict | ast.Set


def _is_whole(node: ast.AST) -> bool:
    """Whether a side of a comparison is a whole number for certain."""
    if isinstance(node, ast.Call):
        return getattr(node.func, "id", "") == "len"
    return isinstance(node, ast.Constant) and isinstance(node.value, int)


def _heads(old: str, new: str) -> tuple[str, str]:
    """Statements in one line; of `if` and `while` the first."""
    if old.startswith(("if ", "while ")):
        return old.splitlines()[0], new.splitlines()[0]
    return old, new


def _replaced(source: str, statement: ast.stmt, new: str) -> str:
    """The file's text with the statement, or the head of an `if`, written anew."""
    lines = source.splitlines(keepends=True)
    indent = " " * statement.col_offset
    head = isinstance(statement, ast.If | ast.While)
    last = statement.test.end_lineno if head else statement.end_lineno
    first = new.splitlines()[0] if head else new
    if head and lines[statement.lineno - 1].lstrip().startswith("elif"):
        first = "el" + first
    while head and not lines[last - 1].split("#")[0].rstrip().endswith(":"):
        last += 1
    text = "".join(f"{indent}{line}\n" for line in first.splitlines())
    return "".join([*lines[: statement.lineno - 1], text, *lines[last:]])
