"""A labelled street world that rays can be cast into: one scene that stands still, and cars that come and go."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from segslam.simulation.ground import Ground, ground_mesh, ground_of
from segslam.simulation.mesh import Flags, Instances, Mesh, as_instance, merge
from segslam.simulation.settings import WorldConfig
from segslam.simulation.site import Site, frontages
from segslam.simulation.streets import furnish
from segslam.simulation.traffic import VIEW_M, MovingCar, ParkedCar, Route, meshes_at, moving_cars, parked_cars
from segslam.trajectory import Poses
from segslam.types import Label, Labels, Points, Transform, Vector

BEYOND_M = 60.0  # chosen: the street is seen this far past the ends of the drive
APART_M = 15.0  # chosen: but not where it would come this near to another piece of the drive
NUMBERED = (Label.CAR, Label.TRUCK, Label.TRUNK, Label.POLE)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each ray met first. `range_m` is infinite where it met nothing; the rest means nothing there."""

    range_m: Vector
    labels: Labels
    instances: Instances
    cos_incidence: Vector
    """Of the angle between the ray and the surface's normal, 0 to 1."""
    glass: Flags


class World:
    """Streets along one drive. Made by `build_world`; the same arguments make the same world."""

    def __init__(
        self, ground: Ground, static: Mesh, route: Route, parked: list[ParkedCar], moving: list[MovingCar]
    ) -> None:
        self.ground = ground
        self.static = static
        self._scene = _scene(static)
        self._route = route
        self._parked = parked
        self._moving = moving

    def cast(self, T_world_lidar: Transform, directions: Points, *, time_s: float = 0.0) -> Hits:
        """What rays from the sensor's origin meet; `directions` (n, 3) are unit vectors in the LiDAR frame."""
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = T_world_lidar[:3, 3]
        R_world_lidar = T_world_lidar[:3, :3].astype(np.float32)
        np.einsum("ij,kj->ik", directions.astype(np.float32), R_world_lidar, out=rays[:, 3:])  # beats BLAS's threads
        hits = _relabelled(_cast(self._scene, self.static, rays), self.ground, rays)
        for thing in self._changing(time_s, T_world_lidar[:2, 3]):
            _put_nearer(hits, thing, rays)
        return hits

    def _changing(self, time_s: float, near_xy: np.ndarray) -> Iterator[Mesh]:
        for car in self._parked:
            if car.start_s <= time_s < car.end_s and np.hypot(*(near_xy - car.at)) < VIEW_M:
                yield car.mesh
        yield from meshes_at(self._moving, self._route, time_s, near_xy)


def build_world(T_world_lidar: Poses, time_s: Vector, *, config: WorldConfig, seed: int) -> World:
    """Streets along a drive whose poses are level (`levelling.level`), z up, `time_s` (n,) ascending.

    Every pose of the drive stands `config.sensor_height_m` above its road; no thing stands on any piece of the path.
    """
    rng = np.random.default_rng([seed, 1])
    route = _route(T_world_lidar, time_s, config.sensor_height_m)
    path = _street(route, T_world_lidar)
    ground = ground_of(path, rng)
    site = Site(ground)
    sides = frontages(path)
    parked = [car for side in sides for car in parked_cars(site, side, route, config, rng)]
    things = [thing for side in sides for thing in furnish(site, side, config, rng)]
    standing = [car.mesh for car in parked if not car.changes]
    static = merge([ground_mesh(ground), *_numbered([*standing, *things])])
    changing = [car for car in parked if car.changes]
    return World(ground, static, route, changing, moving_cars(route, config, rng))


def _route(T_world_lidar: Poses, time_s: Vector, height_m: float) -> Route:
    """The road right under the sensor, pose by pose."""
    at = T_world_lidar[:, :3, 3] - [0.0, 0.0, height_m]
    steps = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1)
    return Route(at, np.asarray(time_s, dtype=np.float64), np.concatenate([[0.0], np.cumsum(steps)]))


def _street(route: Route, T_world_lidar: Poses) -> np.ndarray:
    """(n, 3) the route at steps of at most a metre, with the street going on straight before it and after it."""
    length = route.travel_m[-1]
    stations = np.linspace(0.0, length, int(np.ceil(length)) + 1)
    moving = np.concatenate([[True], np.diff(route.travel_m) > 1e-6])
    driven = np.column_stack([np.interp(stations, route.travel_m[moving], route.at[moving, axis]) for axis in range(3)])
    before = _straight_on(driven, route.at[0], -T_world_lidar[0, :2, 0])
    after = _straight_on(driven, route.at[-1], T_world_lidar[-1, :2, 0])
    return np.concatenate([before[::-1], driven, after])


def _straight_on(driven: np.ndarray, end: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """(n, 3) points a metre apart on from one end at its height, up to where the drive itself passes again."""
    reach = np.arange(1.0, BEYOND_M + 1.0)[:, None]
    points = end + np.hstack([reach * heading / np.linalg.norm(heading), np.zeros_like(reach)])
    elsewhere = driven[np.linalg.norm(driven[:, :2] - end[:2], axis=1) > APART_M]
    if len(elsewhere) == 0:
        return points
    distance, _ = cKDTree(elsewhere[:, :2]).query(points[:, :2])
    met = np.flatnonzero(distance < APART_M)
    return points[: met[0]] if len(met) else points


def _numbered(things: list[Mesh]) -> list[Mesh]:
    """Each thing with its own number on its triangles of classes that are counted, as SemanticKITTI's instances."""
    return [as_instance(thing, number, only=NUMBERED) for number, thing in enumerate(things, start=1)]


def _scene(part: Mesh) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(_tensor(part.vertices, np.float32), _tensor(part.triangles, np.uint32))
    return scene


def _tensor(values: np.ndarray, dtype: type) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=dtype))


def _cast(scene: o3d.t.geometry.RaycastingScene, part: Mesh, rays: np.ndarray) -> Hits:
    answer = scene.cast_rays(_tensor(rays, np.float32))
    range_m = answer["t_hit"].numpy()
    hit = np.where(np.isfinite(range_m), answer["primitive_ids"].numpy(), 0)
    cos = np.abs(np.einsum("ij,ij->i", answer["primitive_normals"].numpy(), rays[:, 3:]))
    return Hits(range_m, part.labels[hit], part.instances[hit], cos, part.glass[hit])


def _relabelled(hits: Hits, ground: Ground, rays: np.ndarray) -> Hits:
    """Terrain as what it is at each point: road, sidewalk, ..."""
    rows = np.flatnonzero((hits.labels == Label.TERRAIN) & np.isfinite(hits.range_m))
    at = rays[rows, :2] + hits.range_m[rows, None] * rays[rows, 3:5]
    labels = hits.labels.copy()
    labels[rows] = ground.label_at(at[:, 0], at[:, 1])
    return replace(hits, labels=labels)


def _put_nearer(hits: Hits, thing: Mesh, rays: np.ndarray) -> None:
    """In place, ray by ray: what of a thing is met before what was met so far. Only rays that pass near it are cast."""
    low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
    away = (low + high) / 2 - rays[0, :3]
    distance, radius = float(np.linalg.norm(away)), float(np.linalg.norm(high - low)) / 2
    if distance <= radius:
        rows = np.arange(len(rays))
    else:
        toward = (away / distance).astype(np.float32)
        rows = np.flatnonzero(np.einsum("ij,j->i", rays[:, 3:], toward) > np.sqrt(1.0 - (radius / distance) ** 2))
    found = _cast(_scene(thing), thing, rays[rows])
    first = found.range_m < hits.range_m[rows]
    for field in fields(Hits):
        getattr(hits, field.name)[rows[first]] = getattr(found, field.name)[first]
