"""The solids and what is built of them: sizes, classes, no holes where a ray must not pass."""

import numpy as np
import open3d as o3d
import pytest

from segslam.bench.simulation import objects
from segslam.bench.simulation.mesh import Mesh, as_instance, box, extruded, frustum, join_meshes, placed, stem
from segslam.core.types import Label


def cast(part: Mesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range and triangle of each ray's first hit."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(part.vertices.astype(np.float32), part.triangles.astype(np.uint32))
    answer = scene.cast_rays(np.hstack([origins, directions]).astype(np.float32))
    return answer["t_hit"].numpy(), answer["primitive_ids"].numpy().astype(np.int64)


def extent(part: Mesh) -> np.ndarray:
    return np.ptp(part.vertices, axis=0)


def test_a_box_is_met_on_its_faces_and_nowhere_else():
    part = box(4.0, 2.0, 0.5, 1.5, Label.CAR, at=(1.0, 0.0))
    origins = np.array([[-9.0, 0.0, 1.0], [-9.0, 0.0, 0.4], [1.0, 9.0, 1.0], [1.0, 0.0, 9.0]])
    toward = np.array([[1.0, 0, 0], [1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    np.testing.assert_allclose(cast(part, origins, toward)[0], [8.0, np.inf, 8.0, 7.5], atol=1e-5)


def test_a_frustum_tapers():
    part = frustum((4.0, 2.0, 0.0), (2.0, 1.0, 0.5), 0.0, 2.0, Label.CAR)
    halfway = cast(part, np.array([[9.0, 0.0, 1.0], [-9.0, 0.0, 1.0]]), np.array([[-1.0, 0, 0], [1.0, 0, 0]]))[0]
    np.testing.assert_allclose(halfway, [9.0 - 1.75, 9.0 - 1.25], atol=1e-5)


def test_an_extrusion_is_closed():
    """Rays from a point inside meet it in every direction."""
    profile = np.array([[-2.0, 0.2], [2.0, 0.2], [2.0, 0.8], [1.0, 1.0], [-2.0, 1.0]])
    part = extruded(profile, 1.6, Label.CAR)
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(5000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ranges, _ = cast(part, np.broadcast_to([0.0, 0.0, 0.6], rays.shape), rays)
    assert np.isfinite(ranges).all()


def test_a_stem_has_its_radii_and_lean():
    part = stem((0.2, 0.1), (0.0, 4.0), Label.TRUNK, lean=0.05, sides=64)
    origins = np.array([[-5.0, 0.0, 0.01], [-5.0, 0.0, 3.99]])
    ranges, _ = cast(part, origins, np.array([[1.0, 0, 0], [1.0, 0, 0]]))
    np.testing.assert_allclose(ranges, [4.8, 5.0 + 0.2 - 0.1], atol=5e-3)  # a polygon of 64 sides


def test_merging_keeps_every_part_as_it_was():
    parts = [box(1, 1, 0, 1, Label.CAR), as_instance(box(2, 2, 0, 2, Label.POLE, at=(9.0, 9.0)), 7)]
    whole = join_meshes(parts)
    for part, start in zip(parts, (0, len(parts[0].triangles)), strict=True):
        rows = slice(start, start + len(part.triangles))
        np.testing.assert_array_equal(whole.vertices[whole.triangles[rows]], part.vertices[part.triangles])
        np.testing.assert_array_equal(whole.labels[rows], part.labels)
        np.testing.assert_array_equal(whole.instances[rows], part.instances)
    assert len(join_meshes([]).triangles) == 0


def test_placing_turns_counter_clockwise_then_moves():
    part = placed(box(4.0, 1.0, 0.0, 1.0, Label.CAR), 10.0, 20.0, 3.0, yaw_rad=np.pi / 2)
    np.testing.assert_allclose(extent(part), [1.0, 4.0, 1.0])
    np.testing.assert_allclose(part.vertices.mean(axis=0), [10.0, 20.0, 3.5])


def test_only_the_named_classes_are_numbered():
    tree = as_instance(objects.tree(np.random.default_rng(0)), 70_000, only=(Label.TRUNK,))
    numbers = {label: set(tree.instances[tree.labels == label]) for label in (Label.TRUNK, Label.VEGETATION)}
    assert numbers[Label.VEGETATION] == {0}
    assert numbers[Label.TRUNK] == {70_000 - 65_535}


@pytest.mark.parametrize("seed", range(20))
def test_cars_have_the_size_of_cars(seed):
    length, width, height = extent(objects.car(np.random.default_rng(seed)))
    assert 3.5 < length < 5.7
    assert 1.5 < width < 2.1
    assert 1.3 < height < 2.2


def test_a_car_is_seen_under_and_its_windows_are_glass():
    rng = np.random.default_rng(0)
    car = objects.car(rng)
    side = np.column_stack([np.zeros(3), np.full(3, -9.0), [0.1, 0.5, 1.2]])
    ranges, met = cast(car, side, np.broadcast_to([0.0, 1.0, 0.0], (3, 3)))
    assert np.isinf(ranges[0])
    assert not car.glass[met[1]]
    assert car.glass[met[2]]
    assert (car.labels == Label.CAR).all()


def test_lorries_are_longer_and_taller_than_cars():
    sizes = np.array([extent(objects.truck(np.random.default_rng(seed))) for seed in range(10)])
    assert (sizes[:, 0] > 5.0).all()
    assert (sizes[:, 2] > 2.5).all()


def test_a_wall_has_no_holes_and_relief_along_the_street():
    """Perpendicular rays all meet it at different ranges: bays make positions along the street distinguishable."""
    part = objects.building(np.random.default_rng(1), 20.0, 10.0)
    x, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-9.7, 9.7, 200), np.linspace(0.1, 3.0, 30)))
    origins = np.column_stack([x, np.full(len(x), -10.0), z])
    ranges, met = cast(part, origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
    assert np.isfinite(ranges).all()
    assert ranges.min() > 8.9  # the deepest oriel
    assert ranges.max() < 12.1  # the deepest passage
    assert len(np.unique(np.round(ranges, 2))) >= 3
    assert (part.labels[met] == Label.BUILDING).all()


def test_all_four_sides_of_a_building_face_outward():
    part = objects.building(np.random.default_rng(2), 12.0, 9.0)
    origins = np.array([[0.0, -30.0, 1.5], [0.0, 40.0, 1.5], [-30.0, 4.5, 1.5], [30.0, 4.5, 1.5]])
    ranges, _ = cast(part, origins, np.array([[0, 1.0, 0], [0, -1.0, 0], [1.0, 0, 0], [-1.0, 0, 0]]))
    # reliefs reach 0.9 m out and 2 m in
    np.testing.assert_allclose(ranges, [30.0, 31.0, 24.0, 24.0], atol=2.05)


@pytest.mark.parametrize(("seed", "scale"), [(0, 0.0), (1, 1.0), (2, None)])
def test_a_tree_is_a_trunk_under_a_crown(seed, scale):
    tree = objects.tree(np.random.default_rng(seed), scale=scale)
    trunk, crown = (
        tree.vertices[np.unique(tree.triangles[tree.labels == label])] for label in (Label.TRUNK, Label.VEGETATION)
    )
    assert trunk[:, 2].min() < 0.0
    assert np.percentile(crown[:, 2], 5) > 1.5
    assert 0.15 < np.ptp(trunk[trunk[:, 2] < 0.5][:, 0]) < 1.0


def test_a_hedge_stops_most_rays_with_a_rough_face():
    part = objects.hedge(np.random.default_rng(0), 8.0, 1.0, 1.6)
    rng = np.random.default_rng(1)
    origins = np.column_stack([rng.uniform(-3.5, 3.5, 3000), np.full(3000, -5.0), rng.uniform(0.2, 1.4, 3000)])
    ranges, _ = cast(part, origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
    met = np.isfinite(ranges)
    assert met.mean() > 0.9
    assert 0.05 < ranges[met].std() < 0.6


def test_a_sign_is_a_plate_on_a_post():
    part = objects.sign(np.random.default_rng(0))
    plate = part.vertices[np.unique(part.triangles[part.labels == Label.TRAFFIC_SIGN])]
    post = part.vertices[np.unique(part.triangles[part.labels == Label.POLE])]
    assert plate[:, 2].min() > 1.0
    assert post[:, 2].min() < 0.0
    assert np.ptp(plate[:, 0]) < 0.1 < np.ptp(plate[:, 1])
