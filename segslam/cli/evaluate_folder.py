"""`segslam eval` of two folders: every drive that has poses in both, for example KITTI 00 to 10."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from segslam.core.errors import SegslamError

MEAN = "mean"


def score_folders(
    estimates: Path, references: Path, score: Callable[[Path, Path], dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """The figures of each drive by name, in order, then their means over the drives, called `mean`.

    A drive has a file `NAME.txt` in both folders, or `NAME/poses_kitti.txt` in the first, as run folders have. Raises
    SegslamError if no drive has both.
    """
    found = {file.stem: (_estimate(estimates, file.stem), file) for file in sorted(references.glob("*.txt"))}
    rows = {name: score(made, true) for name, (made, true) in found.items() if made is not None}
    if not rows:
        raise SegslamError(
            f"{estimates}: no drive has poses here and in {references}; give both files one name, 00.txt, or the "
            "runs 00, 01, ..."
        )
    first, *others = rows.values()
    numeric = [key for key, value in first.items() if isinstance(value, float) and all(key in row for row in others)]
    mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in numeric}
    return rows | ({MEAN: mean} if len(rows) > 1 else {})


def _estimate(folder: Path, name: str) -> Path | None:
    candidates = (folder / f"{name}.txt", folder / name / "poses_kitti.txt")
    return next((file for file in candidates if file.is_file()), None)
