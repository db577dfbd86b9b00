"""The map of a yard with known keyframes: kept points, removed points, and the content of the files."""

import io
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest
import yaml
from helpers.rooms import HALF_M, PLACES, SENSOR_M, THING_AT, placed_keyframes, thing
from matplotlib.image import imread
from scipy.spatial import cKDTree

from segslam.core import geometry
from segslam.core.config import MapConfig
from segslam.core.types import GraphEstimate, Label, SegslamError
from segslam.labels.encodings import COLORS
from segslam.output.map.before_after import BeforeAfter, _details, most_changed
from segslam.output.map.from_above import LEAST_PX, LEGEND_PX, PATH, drawn_map, round_length_m
from segslam.output.map.grid import NUM_DIRECTIONS, free_range_m
from segslam.output.map.picture import MARGIN_M
from segslam.output.map.write import write_map

CONFIG = MapConfig()


def _map_points(
    folder: Path, config: MapConfig = CONFIG, thing_in: int | None = 2
) -> tuple[np.ndarray, dict[str, int]]:
    summary = write_map(placed_keyframes(thing_in), [folder / "map.ply"], config=config)
    return np.asarray(o3d.io.read_point_cloud(str(folder / "map.ply")).points), summary


def _share_in(points: np.ndarray, wanted: np.ndarray) -> float:
    """Share of the wanted points that have a point of the map within half a voxel's diagonal and a little."""
    distance_m, _ = cKDTree(points).query(wanted)
    return float(np.mean(distance_m < 0.2))


def test_voxels_that_others_saw_through_are_removed_and_all_others_stay(tmp_path: Path) -> None:
    without, _ = _map_points(tmp_path, thing_in=None)
    points, summary = _map_points(tmp_path)
    assert _share_in(points, thing()) < 0.02
    assert _share_in(points, without) == 1.0
    assert summary["num_map_voxels_seen_through"] > 50


def test_without_views_the_thing_stays(tmp_path: Path) -> None:
    points, summary = _map_points(tmp_path, MapConfig(view_range_m=0.0))
    assert summary["num_map_voxels_seen_through"] == 0
    assert _share_in(points, thing()) == 1.0


def test_points_of_moving_classes_are_removed_without_any_view(tmp_path: Path) -> None:
    placed = placed_keyframes()
    labels = placed[2][0].labels
    labels[labels == Label.CAR] = Label.MOVING_CAR
    summary = write_map(placed, [tmp_path / "map.ply"], config=MapConfig(view_range_m=0.0))
    points = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "map.ply")).points)
    assert summary["num_map_moving_points"] == len(thing())
    assert _share_in(points, thing()) == 0.0


def test_all_cloud_formats_hold_the_same_points_and_colours(tmp_path: Path) -> None:
    files = [tmp_path / f"map.{ending}" for ending in ("ply", "pcd", "las", "laz")]
    summary = write_map(placed_keyframes(), files, config=CONFIG)
    clouds = [o3d.io.read_point_cloud(str(file)) for file in files[:2]]
    points, colors = (np.asarray(values) for values in (clouds[0].points, clouds[0].colors))
    assert len(points) == summary["num_map_points"]
    np.testing.assert_array_equal(np.asarray(clouds[1].points), points)
    np.testing.assert_array_equal(np.asarray(clouds[1].colors), colors)
    for file in files[2:]:
        las = laspy.read(file)
        np.testing.assert_allclose(las.xyz, points, atol=0.00051)  # LAS counts millimetres
        np.testing.assert_array_equal(np.column_stack([las.red, las.green, las.blue]) // 257, np.rint(255 * colors))
        assert set(np.unique(las.user_data)) == {Label.ROAD, Label.BUILDING}
        assert set(np.unique(las.classification)) == {11, 6}


def test_the_label_travels_with_the_cloud(tmp_path: Path) -> None:
    write_map(placed_keyframes(), [tmp_path / "map.ply"], config=CONFIG)
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "map.ply"))
    height_m, labels = cloud.point.positions.numpy()[:, 2] + SENSOR_M, cloud.point.label.numpy().ravel()
    assert (labels[height_m > 0.2] == Label.BUILDING).all()
    assert (labels[height_m < 1e-4] == Label.ROAD).all()  # between, the walls' feet share voxels with the ground


def test_each_voxel_has_one_point_at_most(tmp_path: Path) -> None:
    points, _ = _map_points(tmp_path)
    cells = np.floor(points / CONFIG.voxel_m + 1e-6)
    assert len(np.unique(cells, axis=0)) >= 0.999 * len(cells)  # float32 may round a mean across a border


def test_height_colours_run_from_low_to_high(tmp_path: Path) -> None:
    write_map(placed_keyframes(), [tmp_path / "map.ply"], config=MapConfig(color="height"))
    cloud = o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    heights, colors = np.asarray(cloud.points)[:, 2], np.asarray(cloud.colors)
    low, high = colors[heights.argmin()], colors[heights.argmax()]
    assert low[2] > low[1] > low[0] or low[2] > low[0] > low[1]  # viridis begins in violet ...
    assert high[0] > 0.6 > 0.3 > high[2]  # ... and ends in yellow


def test_the_picture_shows_the_yard_its_trajectory_scale_and_classes(tmp_path: Path) -> None:
    write_map(placed_keyframes(), [tmp_path / "map.png"], config=CONFIG)
    picture = np.rint(255 * imread(tmp_path / "map.png")[:, :, :3]).astype(int)
    side = picture.shape[0]  # a square of the yard and a margin around it, and the legend beside
    assert side == LEAST_PX
    assert picture.shape[1] == LEAST_PX + LEGEND_PX
    px_per_m = side / (2 * (HALF_M + MARGIN_M))

    def color(x_m: float, y_m: float) -> np.ndarray:  # north is up
        return picture[round(side / 2 - y_m * px_per_m), round(side / 2 + x_m * px_per_m)]

    colors = COLORS[Label.ROAD], COLORS[Label.BUILDING], PATH
    road, wall, path = (np.array(list(bytes.fromhex(text[1:]))) for text in colors)
    assert np.abs(color(8.0, 8.0) - road).max() <= 3  # flat: not shaded
    assert (color(8.0, HALF_M - 0.1) / wall).min() > 1.05  # above its surroundings: lighter
    x, y = np.mean(PLACES[2:4], axis=0)
    beside = [color(x + dx, y) for dx in np.linspace(-0.3, 0.3, 15)]
    assert min(np.abs(one - path).max() for one in beside) <= 60  # antialiased
    assert (color(0.0, HALF_M + 2.0) == 255).all()
    assert (picture[:, LEAST_PX:] < 128).any(), "a legend"


def test_the_map_by_odometry_is_smeared_and_the_corrected_one_is_not(tmp_path: Path) -> None:
    """The second half of the visits is 3 m off by odometry."""
    off = geometry.transform(np.eye(3), [3.0, 2.0, 0.0])
    yard = [replace(k, T_odom_keyframe=off @ T if k.id >= 3 else T) for k, T in placed_keyframes(None)]
    poses = {k.id: T for k, T in placed_keyframes(None)}
    clouds = {k.id: (k.points, k.labels) for k in yard}
    estimate = GraphEstimate(poses, 0.0, {(4, 0): 1.0, (5, 1): 0.0})
    drawn = BeforeAfter({k.id: k.T_odom_keyframe for k in yard}, estimate, list(clouds), clouds.__getitem__)
    (tmp_path / "picture.png").write_bytes(drawn.draw())
    picture = imread(tmp_path / "picture.png")[:, :, :3].mean(axis=2)
    lit = [(half > 0.15).mean() for half in np.array_split(picture[40:], 2, axis=1)]
    assert lit[0] > 1.15 * lit[1] > 0.01  # walls twice; paths once
    assert most_changed({k.id: k.T_odom_keyframe for k in yard}, poses, [(1, 0), (4, 0)]) == (4, 0)


def test_the_legend_of_a_large_map_grows_with_it() -> None:
    pictures = []
    for factor in (1, 3):
        image = np.full((600 * factor, 1500 * factor, 3), 255, np.uint8)
        png = drawn_map(
            image, (0.0, 15.0, 0.0, 6.0), path_m=np.zeros((2, 3)), title="class", marks=[("car", "#000000")]
        )
        pictures.append(imread(io.BytesIO(png))[:, :, :3])
    small, large = pictures
    assert large.shape[1] == pytest.approx(3 * small.shape[1], abs=3)
    dark = [(picture[:, int(0.9 * picture.shape[1]) :].mean(axis=2) < 0.5).mean() for picture in pictures]
    assert dark[1] == pytest.approx(dark[0], rel=0.2)


def test_the_details_before_and_after_have_one_size() -> None:
    before = {0: np.eye(4), 1: geometry.transform(np.eye(3), [20.0, 0.0, 0.0])}
    after = {0: np.eye(4), 1: geometry.transform(np.eye(3), [1.0, 5.0, 0.0])}
    windows = np.array(_details((before, after), (1, 0)))
    np.testing.assert_allclose(windows[:, 1::2] - windows[:, ::2], [[100.0, 62.5]] * 2)
    np.testing.assert_allclose(windows.reshape(2, 2, 2).mean(axis=2), [[10.0, 0.0], [0.5, 2.5]])


@pytest.mark.parametrize(("longest_m", "length_m"), [(31.0, 20.0), (50.0, 50.0), (0.3, 0.2), (199.0, 100.0)])
def test_a_scale_bar_has_a_round_length(longest_m: float, length_m: float) -> None:
    assert round_length_m(longest_m) == pytest.approx(length_m)


def test_the_ground_is_free_between_rings_up_to_the_last_and_up_to_what_stands_before_it() -> None:
    turn = np.radians(np.arange(0.25, 360.0, 0.5))
    rings = [np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(len(turn), -1.7)]) for r in (5.0, 12.0, 25.0)]
    wall = np.column_stack([np.full(200, 8.0), np.linspace(-1.0, 1.0, 200), np.full(200, -0.7)])
    labels = np.repeat([int(Label.ROAD), int(Label.BUILDING)], [3 * len(turn), len(wall)]).astype(np.uint8)
    free_m = free_range_m(np.concatenate([*rings, wall]), labels)
    assert free_m[NUM_DIRECTIONS // 4] == pytest.approx(25.0)
    assert free_m[0] == pytest.approx(8.0, abs=0.1)
    moving = np.where(labels == Label.BUILDING, Label.MOVING_CAR, labels).astype(np.uint8)
    assert free_range_m(np.concatenate([*rings, wall]), moving)[0] == pytest.approx(25.0)


def test_the_grid_is_free_where_only_rays_passed(tmp_path: Path) -> None:
    """Of the ground only a ring at 6 m returns, as between the beams of a sparse sensor."""
    placed = []
    for keyframe, T in placed_keyframes(None):
        range_m = np.hypot(*keyframe.points[:, :2].T)
        kept = (keyframe.labels == Label.ROAD) & (range_m > 6.0) & (range_m < 6.3)
        placed.append((replace(keyframe, points=keyframe.points[kept], labels=keyframe.labels[kept]), T))
    write_map(placed[:1], [tmp_path / "yard.yaml"], config=CONFIG)
    about = yaml.safe_load((tmp_path / "yard.yaml").read_text())
    grid = _read_pgm(tmp_path / about["image"])[::-1]

    def value(x_m: float, y_m: float) -> int:
        west, south, _ = about["origin"]
        return int(grid[int((y_m - south) / about["resolution"]), int((x_m - west) / about["resolution"])])

    x, y = PLACES[0]
    assert {value(x + dx, y + dy) for dx, dy in ((0.5, 0.5), (-2.1, 1.1), (3.1, 0.1), (0.1, 5.0))} == {254}
    assert value(x + 9.1, y + 0.1) == 205  # beyond the ring nothing is known


def test_the_grid_is_free_in_the_yard_occupied_at_its_walls_and_unknown_beyond(tmp_path: Path) -> None:
    write_map(placed_keyframes(), [tmp_path / "yard.yaml"], config=CONFIG)
    about = yaml.safe_load((tmp_path / "yard.yaml").read_text())
    grid = _read_pgm(tmp_path / about["image"])
    assert about["negate"] == 0
    assert about["origin"] == [-32.0, -32.0, 0.0]

    def value(x_m: float, y_m: float) -> int:
        column, row = (round((at + 32.0) / about["resolution"] - 0.5) for at in (x_m, y_m))
        return int(grid[len(grid) - 1 - row, column])  # the first row is the northernmost

    assert {value(*place) for place in ((0.1, 0.1), (5.1, -7.1), (-9.1, 3.1), THING_AT)} == {254}
    assert {value(0.1, HALF_M + 0.1), value(-HALF_M + 0.1, 2.1)} == {0}
    assert value(20.1, 20.1) == 205
    # as map_server reads it: probability (255 - value) / 255
    assert (255 - 254) / 255 < about["free_thresh"] < (255 - 205) / 255 < about["occupied_thresh"] < 1.0


def test_an_unknown_kind_of_map_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"map\.stl: unknown kind of map; its name must end in \.ply, \.pcd"):
        write_map(placed_keyframes(), [tmp_path / "map.stl"], config=CONFIG)


def test_nothing_to_map_is_reported_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="nothing to map"):
        write_map([], [tmp_path / "map.ply"], config=CONFIG)
    assert list(tmp_path.iterdir()) == []


def _read_pgm(file: Path) -> np.ndarray:
    magic, size, deepest, rest = file.read_bytes().split(b"\n", 3)
    width, height = (int(number) for number in size.split())
    assert (magic, deepest) == (b"P5", b"255")
    return np.frombuffer(rest, np.uint8).reshape(height, width)


def test_a_picture_shows_the_whole_path_of_a_sensor_that_sees_only_far_ahead(tmp_path: Path) -> None:
    keyframe, _ = next(iter(placed_keyframes()))
    wall = np.stack([np.full(40, 40.0), np.linspace(-9, 9, 40), np.zeros(40)], axis=1).astype(np.float32)
    ahead = replace(keyframe, points=wall, labels=np.full(40, Label.BUILDING, np.uint8), intensities=None)
    placed = [(replace(ahead, id=row), geometry.transform(np.eye(3), [-16.0 * row, 0.0, 0.0])) for row in range(5)]
    write_map(iter(placed), [tmp_path / "a.png"], config=CONFIG)
    picture = np.rint(255 * imread(tmp_path / "a.png")[:, :, :3]).astype(int)
    path = (np.abs(picture - list(bytes.fromhex(PATH[1:]))).max(axis=2) < 60)[:, :-LEGEND_PX].any(axis=0)
    px_per_m = (picture.shape[1] - LEGEND_PX) / (104 + 2 * MARGIN_M)
    assert np.flatnonzero(path)[0] > 0.5 * MARGIN_M * px_per_m, "a margin, though the path ends where a tile does"
    assert np.ptp(np.flatnonzero(path)) == pytest.approx(64 * px_per_m, rel=0.1)


def test_a_picture_of_ceilings_only_is_refused(tmp_path: Path) -> None:
    keyframe, _ = next(iter(placed_keyframes()))
    points = np.column_stack([np.random.default_rng(0).uniform(-5, 5, (4000, 2)), np.full(4000, 2.5)])
    ceiling = replace(
        keyframe, points=points.astype(np.float32), labels=np.full(4000, Label.BUILDING, np.uint8), intensities=None
    )
    placed = [(replace(ceiling, id=row), geometry.transform(np.eye(3), [0.5 * row, 0.0, 0.0])) for row in range(12)]
    with pytest.raises(SegslamError, match="nothing is seen below the ceiling"):
        write_map(iter(placed), [tmp_path / "a.png"], config=MapConfig())
