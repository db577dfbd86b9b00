"""Single scans from files: .bin, .npy, .ply, .pcd."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from segslam.datasets.kitti import read_returns
from segslam.datasets.point_cloud2 import INTENSITY_FIELDS
from segslam.types import Points, SegslamError, Vector


def read_cloud(file: Path) -> Points:
    """Points (n, 3) of a file, as stored: .bin (float32 x y z intensity), .npy (n, 3 or more), .ply, .pcd.

    Raises SegslamError (BadScan for an invalid .bin), naming the file.
    """
    if not file.is_file():
        raise SegslamError(f"{file}: no such file; give a scan (.bin, .npy, .ply, .pcd)")
    match file.suffix:
        case ".bin":
            return read_returns(file)[:, :3]
        case ".npy":
            return _read_npy(file)[:, :3]
        case ".ply" | ".pcd":
            return _read_by_open3d(file)
    raise SegslamError(f"{file}: unknown format {file.suffix or '(no extension)'}; give .bin, .npy, .ply or .pcd")


def read_intensities(file: Path) -> Vector | None:
    """Intensities (n,) of a file that `read_cloud` reads; None if it has none.

    They are the fourth column of .bin and .npy files, and a field with one of the usual names in .ply and .pcd files.
    """
    if file.suffix == ".bin":
        return read_returns(file)[:, 3]
    if file.suffix == ".npy":
        values = _read_npy(file)
        return values[:, 3] if values.shape[1] > 3 else None
    return _intensities_by_open3d(file) if file.suffix in (".ply", ".pcd") else None


def _read_npy(file: Path) -> Float64[np.ndarray, "_ _"]:
    try:
        values = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise SegslamError(f"{file}: cannot be read ({error}); save an array by numpy.save") from error
    if values.ndim != 2 or values.shape[1] < 3 or values.dtype.kind not in "fiu":
        raise SegslamError(f"{file}: contains {values.dtype} of shape {values.shape}; expected (n, 3) numbers, x y z")
    return values.astype(np.float64)


def _read_by_open3d(file: Path) -> Points:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        cloud = open3d.io.read_point_cloud(file)
    points = np.asarray(cloud.points)
    if not len(points):
        raise SegslamError(f"{file}: no points could be read; is it a whole {file.suffix} file?")
    return points


def _intensities_by_open3d(file: Path) -> Vector | None:
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        fields = open3d.t.io.read_point_cloud(file).point
    name = next((name for name in INTENSITY_FIELDS if name in fields), None)
    return fields[name].numpy().ravel().astype(np.float64) if name else None
