"""Breaks lines of the package one by one, and reports which of these faults the tests notice.

python -m tools.mutation --lines 60 --seed 1 --out build/mutation.json

Each fault is written into a copy of the repository in a temporary folder, and the tests of its room run there. The
same seed gives the same faults.
"""

import argparse
import ast
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "segslam"
TESTS: dict[str, tuple[str, ...]] = {
    "odometry": ("tests/odometry",),
    "registration": ("tests/registration", "tests/verification"),
    "verification": ("tests/verification", "tests/test_rejections.py"),
    "graph": ("tests/graph", "tests/core/test_robust.py", "tests/cli/test_optimize.py", "tests/slam/test_slam.py"),
}
"""Room of the package -> its tests. What takes least time comes first."""
SWAPPED_NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
SWAPPED_OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
}
UNTOUCHED = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)
"""Texts of errors, and what has no effect while running."""
NO_TESTS = 5
"""Exit status of pytest if it finds no test with the mark."""
COPIED = ("segslam", "tests", "tools", "configs", "docs")


@dataclass(frozen=True)
class Fault:
    """One change of a text, by position: lines from 1, columns in characters from 0."""

    file: str
    line: int
    column: int
    old: str
    new: str

    def applied(self, source: str) -> str:
        lines = source.splitlines(keepends=True)
        text = lines[self.line - 1]
        end = self.column + len(self.old)
        if text[self.column : end] != self.old:
            raise ValueError(f"{self.file}:{self.line} has no {self.old!r} in column {self.column}")
        lines[self.line - 1] = text[: self.column] + self.new + text[end:]
        return "".join(lines)


@dataclass(frozen=True)
class Outcome:
    """What the tests did with a fault; `by` names the first test that failed."""

    fault: Fault
    before: str
    after: str
    is_noticed: bool
    by: str
    seconds: float


def faults_of(source: str, file: str = "") -> list[Fault]:
    """All faults of the code within functions, in the order of their lines."""
    finder = _Finder(source, file)
    found = {fault for node in _code(ast.parse(source)) for fault in finder.faults(node)}
    return sorted(found, key=lambda fault: (fault.line, fault.column, fault.new))


def chosen(faults: Sequence[Fault], *, num_lines: int, seed: int) -> list[Fault]:
    """One fault each of so many lines at random."""
    rng = random.Random(seed)
    by_line: dict[tuple[str, int], list[Fault]] = {}
    for fault in faults:
        by_line.setdefault((fault.file, fault.line), []).append(fault)
    lines = rng.sample(sorted(by_line), min(num_lines, len(by_line)))
    return [rng.choice(by_line[line]) for line in lines]


def files_of(room: str) -> list[Path]:
    """The modules of a room of the package."""
    return sorted((ROOT / SOURCE / room).rglob("*.py"))


class Copy:
    """A copy of the repository whose files can be broken one at a time."""

    def __init__(self, folder: Path) -> None:
        self.root = folder
        for name in COPIED:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("site"))
        for file in (*ROOT.glob("*.toml"), *ROOT.glob("*.md")):
            shutil.copy2(file, folder)
        self._run(["-m", SOURCE, "warm-up"], {}, 900.0)

    def outcome(self, fault: Fault, tests: Sequence[str], *, limit_s: float) -> Outcome:
        """Run the tests but the slow ones; reaching the time limit counts as noticed, as an endless loop would be."""
        file = self.root / fault.file
        source, about = file.read_text(encoding="utf-8"), file.stat()
        broken = fault.applied(source)
        start = time.monotonic()
        # Compiled code of other modules contains that of the kernels which they call.
        with tempfile.TemporaryDirectory() as cache:
            environment = {"NUMBA_CACHE_DIR": cache} if "@kernel(" in source else {}
            try:
                file.write_text(broken, encoding="utf-8")
                for marked in ("not slow and not long", "long"):
                    words = ["-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", marked, *tests]
                    status, text = self._run(words, environment, limit_s)
                    status = 0 if status == NO_TESTS else status
                    if status != 0:
                        break
            finally:
                file.write_text(source, encoding="utf-8")
                os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns))
        before, after = (text.splitlines()[fault.line - 1].strip() for text in (source, broken))
        by = "time limit" if status is None else _first_failure(text) if status else ""
        return Outcome(fault, before, after, status != 0, by, round(time.monotonic() - start, 1))

    def _run(self, words: Sequence[str], environment: dict[str, str], limit_s: float) -> tuple[int | None, str]:
        """Exit status, None at the time limit, and what was printed."""
        given = {"SEGSLAM_DATA": str(ROOT.parent / "shared" / "data")} | os.environ  # beside the original, as for tests
        given |= {"PYTHONPATH": f"{self.root}{os.pathsep}{self.root / 'tests'}"}
        given |= {"PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        with subprocess.Popen(
            [sys.executable, *words],
            cwd=self.root,
            env=given | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                text = process.communicate(timeout=limit_s)[0]
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                return None, ""
            return process.returncode, text


def _first_failure(text: str) -> str:
    """The last line of pytest that names a failed test, or the last line."""
    lines = [line for line in text.splitlines() if line]
    named = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    return (named or lines or ["no output"])[-1].split(" - ")[0][:150]


def _code(node: ast.AST, *, runs: bool = False) -> Iterator[ast.AST]:
    """The nodes of the bodies of functions, without types and what has no effect while running."""
    children = ast.iter_child_nodes(node)
    if isinstance(node, UNTOUCHED):
        return
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        children, runs = iter(node.body), True
    elif isinstance(node, ast.AnnAssign):
        children = iter([node.value] if node.value else [])
    elif runs:
        yield node
    for child in children:
        yield from _code(child, runs=runs)


class _Finder:
    """Finds the faults of the nodes of a source."""

    def __init__(self, source: str, file: str) -> None:
        self._file = file
        self._lines = source.splitlines()
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        self._tokens = [token for token in tokens if token.type in (tokenize.OP, tokenize.NAME)]

    def faults(self, node: ast.AST) -> Iterator[Fault]:
        match node:
            case ast.BinOp():
                yield from self._swapped(node.left, node.op, node.right)
            case ast.AugAssign():
                yield from self._swapped(node.target, node.op, node.value, suffix="=")
            case ast.BoolOp():
                for left, right in zip(node.values, node.values[1:], strict=False):
                    yield from self._swapped(left, node.op, right)
            case ast.Compare():
                operands = [node.left, *node.comparators]
                for left, op, right in zip(operands, node.ops, operands[1:], strict=False):
                    yield from self._swapped(left, op, right)
            case ast.UnaryOp(op=ast.USub()):
                yield self._fault(node.lineno, self._column(node.lineno, node.col_offset), "-", "")
            case ast.Constant(value=int() | float() as value) if value and not isinstance(value, bool):
                column = self._column(node.lineno, node.col_offset)
                old = self._lines[node.lineno - 1][column : self._column(node.lineno, node.end_col_offset or 0)]
                half = value // 2 if isinstance(value, int) else value / 2
                yield self._fault(node.lineno, column, old, repr(half))
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name) as function) if name in SWAPPED_NAMES:
                line, end = function.end_lineno or 0, function.end_col_offset or 0
                yield self._fault(line, self._column(line, end) - len(name), name, SWAPPED_NAMES[name])
            case _:
                pass

    def _swapped(self, left: ast.expr, op: ast.AST, right: ast.expr, suffix: str = "") -> Iterator[Fault]:
        """The fault of an operator between two operands, if it is one of those that are swapped."""
        if type(op) not in SWAPPED_OPERATORS:
            return
        old, new = (text + suffix for text in SWAPPED_OPERATORS[type(op)])
        end_line, end_offset = left.end_lineno or 0, left.end_col_offset or 0
        after = (end_line, self._column(end_line, end_offset))
        until = (right.lineno, self._column(right.lineno, right.col_offset))
        for token in self._tokens:
            if after <= token.start < until and token.string == old:
                yield self._fault(*token.start, old, new)
                return

    def _fault(self, line: int, column: int, old: str, new: str) -> Fault:
        return Fault(self._file, line, column, old, new)

    def _column(self, line: int, offset: int) -> int:
        """Column in characters: the parser counts bytes."""
        return len(self._lines[line - 1].encode()[:offset].decode())


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.mutation", description=str(__doc__).partition("\n")[0])
    parser.add_argument("--lines", type=int, default=60, help="number of lines to break, one at a time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--skip", type=int, default=0, help="leave out the first faults, as after an interruption")
    parser.add_argument("--rooms", nargs="+", choices=TESTS, default=list(TESTS), help="whose lines are broken")
    parser.add_argument("--limit-s", type=float, default=300.0, help="time limit of the tests of one fault")
    parser.add_argument("--out", type=Path, help="JSON file of all outcomes")
    options = parser.parse_args(arguments)
    faults, room_of = [], {}
    for name in options.rooms:
        for path in files_of(name):
            file = str(path.relative_to(ROOT))
            room_of[file] = name
            faults += faults_of(path.read_text(encoding="utf-8"), file)
    picked = chosen(faults, num_lines=options.lines, seed=options.seed)[options.skip :]
    print(f"{len(picked)} of {len(faults)} faults", flush=True)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy = Copy(Path(folder))
        for fault in picked:
            one = copy.outcome(fault, TESTS[room_of[fault.file]], limit_s=options.limit_s)
            outcomes.append(one)
            state = f"noticed by {one.by}" if one.is_noticed else "SURVIVED"
            change = f"{fault.file}:{fault.line}: {one.before}  ->  {one.after}"
            print(f"{change}  {state}  ({one.seconds:.0f} s)", flush=True)
            if options.out:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                options.out.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1) + "\n")
    print(f"{'room':<14}{'noticed':>8}{'survived':>9}")
    for name in (*options.rooms, "all"):
        own = [one.is_noticed for one in outcomes if name in ("all", room_of[one.fault.file])]
        if own or name == "all":
            print(f"{name:<14}{sum(own):>8}{len(own) - sum(own):>9}")


if __name__ == "__main__":
    main()
