"""A labelled street world for ray casting: one static scene, and moving or parked cars."""

from dataclasses import dataclass, fields, replace

import numpy as np
import open3d as o3d

from segslam.bench.simulation.cars import meshes_at, moving_cars, parked_cars
from segslam.bench.simulation.mesh import Flags, Instances, Mesh, as_instance, join_meshes
from segslam.bench.simulation.site import Route, Site, frontages, street_of
from segslam.bench.simulation.streets import furnish
from segslam.bench.simulation.terrain import Terrain, ground_mesh
from segslam.bench.simulation.world_settings import WorldConfig
from segslam.core.trajectory import Poses
from segslam.core.types import Label, Labels, Points, Transform, Vector

VIEW_M = 100.0  # chosen: moving and parked cars are visible up to this distance
NUMBERED = (Label.CAR, Label.TRUCK, Label.TRUNK, Label.POLE)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """The first hit of each ray. `range_m` is infinite for rays without a hit; their other fields are undefined."""

    range_m: Vector
    labels: Labels
    instances: Instances
    cos_incidence: Vector
    """Cosine of the angle between the ray and the surface normal, 0 to 1."""
    glass: Flags


class World:
    """Streets along one drive, and its cars. Equal arguments make equal worlds."""

    def __init__(self, T_world_lidar: Poses, time_s: Vector, *, config: WorldConfig, seed: int) -> None:
        """The poses are level (`level_revisits`), z up; `time_s` (n,) ascends.

        Every pose is `config.sensor_height_m` above the road, and no static object stands on the path. On another
        `config.day` the streets are the same, but parked and moving cars differ.
        """
        rng = np.random.default_rng([seed, 1])
        at = T_world_lidar[:, :3, 3] - np.array([0.0, 0.0, config.sensor_height_m])
        steps = np.linalg.norm(np.diff(at[:, :2], axis=0), axis=1)
        self.day = config.day
        self.route = Route(at, np.asarray(time_s, dtype=np.float64), np.concatenate([[0.0], np.cumsum(steps)]))
        street = street_of(self.route, T_world_lidar)
        self.ground = Terrain(street, rng)
        site = Site(self.ground)
        sides = frontages(street)
        today = np.random.default_rng([seed, 1, config.day]) if config.day else None
        parked = [car for side in sides for car in parked_cars(site, side, self.route, config, rng, today=today)]
        meshes = _numbered([car.mesh for car in parked])
        parked = [replace(car, mesh=one) for car, one in zip(parked, meshes, strict=True)]
        things = [thing for side in sides for thing in furnish(site, side, config, rng)]
        standing = [car.mesh for car in parked if not car.changes]
        self.static = join_meshes([ground_mesh(self.ground), *standing, *_numbered(things)])
        self.scene = scene_of(self.static)
        self.parked = [car for car in parked if car.changes]
        self.moving = moving_cars(self.route, config, today or rng)

    def cast(self, T_world_lidar: Transform, directions: Points, *, time_s: float = 0.0) -> Hits:
        """The first hits of rays from the sensor's origin; `directions` (n, 3) are unit vectors in the LiDAR frame."""
        rays = rays_of(T_world_lidar, directions)
        hits = cast_mesh(self.scene, self.static, rays)
        rows = np.flatnonzero((hits.labels == Label.TERRAIN) & np.isfinite(hits.range_m))
        ground_at = rays[rows, :2] + hits.range_m[rows, None] * rays[rows, 3:5]
        hits.labels[rows] = self.ground.label_at(ground_at[:, 0], ground_at[:, 1])  # road, sidewalk, ...
        at = T_world_lidar[:2, 3]
        for car in self.parked:
            if car.start_s <= time_s < car.end_s and np.hypot(*(at - car.at)) < VIEW_M:
                _put_nearer(hits, car.mesh, rays)
        for thing in meshes_at(self.moving, self.route, time_s=time_s, near_xy=at, view_m=VIEW_M):
            _put_nearer(hits, thing, rays)
        return hits


def _numbered(things: list[Mesh]) -> list[Mesh]:
    """Meshes with one instance number each, on triangles of the classes that have instances in SemanticKITTI."""
    return [as_instance(thing, number, only=NUMBERED) for number, thing in enumerate(things, start=1)]


def rays_of(T_world_lidar: Transform, directions: Points) -> np.ndarray:
    """(n, 6) float32: origin and direction in the world of rays from the sensor; `directions` in the LiDAR frame."""
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3] = T_world_lidar[:3, 3]
    R_world_lidar = T_world_lidar[:3, :3].astype(np.float32)
    np.einsum("ij,kj->ik", directions.astype(np.float32), R_world_lidar, out=rays[:, 3:])  # faster than BLAS
    return rays


def scene_of(part: Mesh) -> o3d.t.geometry.RaycastingScene:
    """A ray casting scene of a mesh."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(_tensor(part.vertices, np.float32), _tensor(part.triangles, np.uint32))
    return scene


def _tensor(values: np.ndarray, dtype: type) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=dtype))


def cast_mesh(scene: o3d.t.geometry.RaycastingScene, part: Mesh, rays: np.ndarray) -> Hits:
    """The first hits of rays (n, 6; float32 origin and direction) on a mesh; `scene` is `scene_of(part)`."""
    answer = scene.cast_rays(_tensor(rays, np.float32))
    range_m = answer["t_hit"].numpy()
    hit = np.where(np.isfinite(range_m), answer["primitive_ids"].numpy(), 0)
    cos = np.abs(np.einsum("ij,ij->i", answer["primitive_normals"].numpy(), rays[:, 3:]))
    return Hits(range_m, part.labels[hit], part.instances[hit], cos, part.glass[hit])


def _put_nearer(hits: Hits, thing: Mesh, rays: np.ndarray) -> None:
    """In place: replace hits by nearer hits on a mesh. Only rays that pass near it are cast."""
    low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
    away = (low + high) / 2 - rays[0, :3]
    distance, radius = float(np.linalg.norm(away)), float(np.linalg.norm(high - low)) / 2
    if distance <= radius:
        rows = np.arange(len(rays))
    else:
        toward = (away / distance).astype(np.float32)
        rows = np.flatnonzero(np.einsum("ij,j->i", rays[:, 3:], toward) > np.sqrt(1.0 - (radius / distance) ** 2))
    found = cast_mesh(scene_of(thing), thing, rays[rows])
    first = found.range_m < hits.range_m[rows]
    for field in fields(Hits):
        getattr(hits, field.name)[rows[first]] = getattr(found, field.name)[first]
