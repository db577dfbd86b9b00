"""The streets: level under the car, free of obstacles, reproducible from the seed, and following the settings."""

import numpy as np
import pytest
from helpers.drives import simulate_drive

from segslam.bench.simulation.sensor import Sensor, sweep
from segslam.bench.simulation.tracks import example_drive, read_drive
from segslam.bench.simulation.world import World
from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig, WorldConfig
from segslam.core.types import GROUND_LABELS, Label

STILL = WorldConfig(moving_cars=0)
CAR_HALF_WIDTH_M = 0.95


@pytest.fixture(scope="module")
def loop():
    drive = example_drive()
    return drive.T_world_lidar, drive.time_s


@pytest.fixture(scope="module")
def world(loop):
    return World(*loop, config=STILL, seed=1)


def directions(num: int = 2000, *, seed: int = 0) -> np.ndarray:
    """(num, 3) unit vectors all round, between 25 degrees down and 5 up."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0, 2 * np.pi, num), np.radians(rng.uniform(-25, 5, num))
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def test_the_sensor_rides_at_its_height_over_its_road_on_every_visit(world, loop):
    poses, _ = loop
    ground = world.ground.height_at(*poses[:, :2, 3].T)
    # 5 cm: hills of some 3 %, and lanes side by side with one height each
    np.testing.assert_allclose(poses[:, 2, 3] - ground, 1.73, atol=0.05)


def test_the_road_is_under_all_of_the_path(world, loop):
    poses, _ = loop
    assert (world.ground.label_at(*poses[:, :2, 3].T) == Label.ROAD).all()


def test_nothing_stands_in_the_way_of_the_car(world, loop):
    """The car's box swept along the whole drive holds no surface but ground: rays along and across it meet none."""
    poses, _ = loop
    for height in (-1.3, -0.7, 0.0):
        for T_world_lidar in poses[::2]:
            lowered = T_world_lidar.copy()
            lowered[2, 3] += height
            hits = world.cast(lowered, np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))
            things = ~np.isin(hits.labels, GROUND_LABELS)
            assert (hits.range_m[things] > CAR_HALF_WIDTH_M + 0.1).all()


def test_surfaces_but_the_ground_keep_away_from_the_path(world):
    """Every vertex of every thing but what hangs above the car."""
    solid = np.unique(world.static.triangles[~np.isin(world.static.labels, GROUND_LABELS)])
    vertices = world.static.vertices[solid]
    row, column = world.ground.cells(vertices[:, 0], vertices[:, 1])
    above = vertices[:, 2] - world.ground.height_at(vertices[:, 0], vertices[:, 1])
    in_reach = (above > 0.0) & (above < 2.3)
    assert world.ground.path_m[row, column][in_reach].min() > CAR_HALF_WIDTH_M + 0.3


def test_the_same_seed_makes_the_same_world_and_another_seed_another(world, loop):
    again, other = (World(*loop, config=STILL, seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(world.static.vertices, again.static.vertices)
    assert world.static.vertices.shape != other.static.vertices.shape


def test_ranges_are_those_of_the_meshes(world, loop):
    """Against every triangle by hand (Moeller and Trumbore 1997); float32 scene, so a millimetre."""
    T_world_lidar, rays = loop[0][40], directions(40)
    hits = world.cast(T_world_lidar, rays)
    corners = world.static.vertices[world.static.triangles]
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    for ray, range_m in zip(rays @ T_world_lidar[:3, :3].T, hits.range_m, strict=True):
        p = np.cross(ray, edge2)
        det = np.einsum("ij,ij->i", edge1, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = T_world_lidar[:3, 3] - corners[:, 0]
            u = np.einsum("ij,ij->i", s, p) / det
            q = np.cross(s, edge1)
            v = q @ ray / det
            t = np.einsum("ij,ij->i", edge2, q) / det
            expected = np.min(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)], initial=np.inf)
        assert range_m == pytest.approx(expected, abs=1e-3)


def test_a_pose_off_the_drive_sees_the_same_world(world, loop):
    """Two metres to the left the same cars stand where they stood."""
    T_world_here = loop[0][40]
    T_world_left = T_world_here.copy()
    T_world_left[:3, 3] += 2.0 * T_world_here[:3, 1]
    seen = []
    for T_world_lidar in (T_world_here, T_world_left):
        sensor = Sensor(SensorConfig(), seed=0)
        one = sweep(world, sensor, T_world_lidar, rng=np.random.default_rng(0))
        near = np.linalg.norm(one.points, axis=1) < 25.0
        seen.append(set(one.instances[near & (one.labels == Label.CAR)]))
    assert len(seen[0] & seen[1]) >= 3


def test_density_knobs_empty_the_street(loop):
    bare = WorldConfig(
        cars=0, trees=0, lamps=0, signs=0, clutter=0, built=0, courts=0, hedged=0, fenced=0, shrubs=0, moving_cars=0
    )
    labels = np.unique(World(*loop, config=bare, seed=1).static.labels)
    np.testing.assert_array_equal(labels, [Label.TERRAIN])


@pytest.mark.parametrize(
    ("knob", "label"),
    [("cars", Label.CAR), ("trees", Label.TRUNK), ("lamps", Label.POLE), ("signs", Label.TRAFFIC_SIGN)],
)
def test_each_knob_governs_its_own_class(loop, world, knob, label):
    others = World(*loop, config=STILL.model_copy(update={knob: 0.0, "courts": 0.0, "shrubs": 0.0}), seed=1)
    before, after = ((one.static.labels == label).sum() for one in (world, others))
    assert after < 0.5 * before  # signs stand on poles


def test_rows_of_equal_trees_are_equally_spaced_and_identical():
    poses = np.tile(np.eye(4), (200, 1, 1))
    poses[:, 0, 3] = np.arange(200)
    config = STILL.model_copy(update={"equal_tree_rows": True, "shrubs": 0.0, "cars": 0.0, "built": 0.0, "trees": 10.0})
    static = World(poses, 0.1 * np.arange(200), config=config, seed=0).static
    trunks = [
        static.vertices[np.unique(static.triangles[(static.labels == Label.TRUNK) & (static.instances == one)])]
        for one in np.unique(static.instances[static.labels == Label.TRUNK])
    ]
    feet = np.array([trunk[:, :2].mean(axis=0) for trunk in trunks])
    side = feet[feet[:, 1] > 0]
    gaps = np.diff(np.sort(side[:, 0]))
    np.testing.assert_allclose(gaps / 10.0, np.rint(gaps / 10.0), atol=0.01)  # a missing tree leaves a double gap
    assert len({len(trunk) for trunk in trunks}) == 1
    assert np.ptp([np.ptp(trunk[:, 2]) for trunk in trunks]) < 1e-9


def test_parked_cars_are_gone_at_the_second_visit_if_configured(world, loop):
    """The shared street of the loop is driven at its start, in its middle and at its end."""
    poses, time_s = loop
    changing = World(poses, time_s, config=STILL.model_copy(update={"parked_cars_gone": 1.0}), seed=1)
    rays = Sensor(SensorConfig(), seed=0).directions
    first, last = (changing.cast(poses[12], rays, time_s=when) for when in (time_s[12], time_s[-1]))
    car = (first.labels == Label.CAR) | (last.labels == Label.CAR)
    changed = first.range_m != last.range_m
    assert changed[car].mean() > 0.3
    first, last = (world.cast(poses[12], rays, time_s=when) for when in (time_s[12], time_s[-1]))
    np.testing.assert_array_equal(first.range_m, last.range_m)


def test_moving_cars_move_and_keep_out_of_the_sensor(loop):
    poses, time_s = loop
    world = World(poses, time_s, config=WorldConfig(moving_cars=8.0), seed=1)
    rays = directions(4000)
    seen = [world.cast(T, rays, time_s=now) for T, now in zip(poses[::15], time_s[::15], strict=True)]
    moving = [one.labels == Label.MOVING_CAR for one in seen]
    assert sum(rows.any() for rows in moving) > len(moving) / 4
    assert min(one.range_m[rows].min() for one, rows in zip(seen, moving, strict=True) if rows.any()) > 1.5
    later = world.cast(poses[0], rays, time_s=float(time_s[-1]))
    assert (later.range_m != seen[0].range_m).any()


def test_simulate_drive_numbers_and_stamps_its_scans(loop):
    poses, time_s = (part[:3] for part in loop)
    config = SimulationConfig(sensor=SensorConfig(name="vlp16"))
    scans = list(simulate_drive(poses, time_s, seed=5, config=config))
    assert [scan.index for scan in scans] == [0, 1, 2]
    assert [scan.stamp_ns for scan in scans] == [0, 100_000_000, 200_000_000]
    assert len(scans[0].points) == len(scans[0].labels)
    again = list(simulate_drive(poses, time_s, seed=5, config=config))
    np.testing.assert_array_equal(scans[2].points, again[2].points)


def test_the_street_of_a_single_pose_extends_both_ways():
    world = World(np.eye(4)[None], np.zeros(1), config=STILL, seed=0)
    hits = world.cast(np.eye(4), directions())
    assert (hits.labels == Label.ROAD).sum() > 400
    assert np.isfinite(hits.range_m).mean() > 0.8


def test_the_example_loop_drives_a_street_in_both_directions_and_again(loop):
    poses, time_s = loop
    assert 280 < len(poses) < 380
    np.testing.assert_allclose(np.diff(time_s), 0.1)
    away = np.linalg.norm(poses[:, :2, 3] - poses[20, :2, 3], axis=1)
    heading = poses[:, :2, 0] @ poses[20, :2, 0]
    later = np.arange(len(poses)) > 80
    assert (later & (away < 4.0) & (heading < -0.95)).any()
    assert (later & (away < 4.0) & (heading > 0.95)).any()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < 1.5
    assert len(example_drive(900).time_s) == 900


@pytest.mark.data
def test_a_real_trajectory_rides_level_over_its_streets(data_dir):
    drive = read_drive(data_dir / "kitti" / "poses" / "06.txt", sequence="06")
    world = World(drive.T_world_lidar, drive.time_s, config=STILL, seed=1)
    over = drive.T_world_lidar[:, 2, 3] - world.ground.height_at(*drive.T_world_lidar[:, :2, 3].T)
    np.testing.assert_allclose(over, 1.73, atol=0.05)


def test_another_day_has_other_cars_in_the_same_streets(loop):
    days = [STILL.model_copy(update={"day": day}) for day in range(3)]
    first, again, other = (World(*loop, config=config, seed=1) for config in days)

    def standing(world, *, cars: bool):
        rows = np.isin(world.static.labels, [Label.CAR, Label.TRUCK]) == cars
        return world.static.vertices[np.unique(world.static.triangles[rows])]

    np.testing.assert_array_equal(standing(first, cars=False), standing(again, cars=False))
    np.testing.assert_array_equal(standing(again, cars=False), standing(other, cars=False))
    places = [len(standing(world, cars=True)) for world in (first, again, other)]
    assert places[1] < places[0]  # some places are empty
    assert not np.isin(standing(again, cars=True), standing(other, cars=True)).all()
