"""A module imports from lower layers only, and siblings do not import each other."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "segslam"
LAYERS = (  # top first; a room is a module or a folder
    {"cli"},
    {"experiments", "report"},
    {"runs", "results", "viewer"},
    {"slam", "log", "run_files", "map", "evaluation"},
    {"alignment", "straightening"},
    {"odometry", "keyframes", "proximity", "segregator", "refine", "verify", "pose_graph", "datasets", "simulation",
     "beam_angles"},
    {"semantics"},  # below datasets, whose scans come with labels
    {"trajectory"},
    {"geometry", "points", "beside", "interrupts", "cliques"},
    {"types", "config"},
    {"errors", "allocator"},
)  # fmt: skip
BOTTOM = {"types", "config"}  # config names the classes of types
FOREIGN = {
    "gtsam": {"pose_graph"},
    "mcap": {"log", "datasets"},
    "rerun": {"viewer", "cli"},
    "small_gicp": {"refine", "experiments"},
}


def _room(parts: tuple[str, ...]) -> str:
    return parts[0].removesuffix(".py")


def _imports(file: Path) -> list[str]:
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module] if node.module != "segslam" else [f"segslam.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return names


def _level(room: str) -> int:
    return next(level for level, rooms in enumerate(LAYERS) if room in rooms)


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_module_imports_from_lower_layers_only(file: Path) -> None:
    room = _room(file.relative_to(PACKAGE).parts)
    for name in _imports(file):
        top, _, rest = name.partition(".")
        if top in FOREIGN:
            assert room in FOREIGN[top], f"{top} belongs to {FOREIGN[top]}, not to {room}"
        if top != "segslam" or room in ("__init__", "__main__") or not rest:
            continue
        other = rest.split(".")[0]
        if other != room and not {room, other} <= BOTTOM:
            assert _level(room) < _level(other), f"{room} imports {name}"
