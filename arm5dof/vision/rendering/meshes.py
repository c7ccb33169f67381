"""Triangles of what MuJoCo's scenes are made of, cut as finely as its OpenGL renderer cuts them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np

from arm5dof.errors import UserError

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, SDF = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH", "SDF")
)

LARGE = 0.1
"""Half width, metres, from which a box's faces are divided: light falls on a smaller one much the same all over."""


def capacity(model: mujoco.MjModel) -> int:
    """How many geoms an `mjvScene` of a model must have room for; room for thousands costs milliseconds."""
    return model.ngeom + model.nsite + 2 * model.nwrap + model.nflex + model.nskin + 100


class Mesh(NamedTuple):
    """Triangles of several geoms, in the world frame."""

    vertices: np.ndarray
    """(n, 3) float32, metres."""
    normals: np.ndarray
    """Unit vectors (n, 3) float32, pointing out."""
    owner: np.ndarray
    """Index of the geom that a vertex belongs to, (n,) int."""
    triangles: np.ndarray
    """Indices of vertices (m, 3) int32, counter-clockwise seen from outside."""


class Assembler:
    """Puts together what a model's geoms look like, wherever they are.

    Args:
        model: The model, whose meshes are kept once they are cut into triangles.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._primitives: dict[int, Primitive] = {}

    def mesh(self, geoms: Sequence[mujoco.MjvGeom]) -> Mesh:
        """The triangles of all geoms of an `mjvScene` but its planes.

        Raises:
            UserError: One is of a kind that cannot be drawn, such as a height field.
        """
        alike: dict[tuple[int, int], list[int]] = defaultdict(list)
        for g, geom in enumerate(geoms):
            if geom.type in (MESH, SDF):
                alike[geom.type, geom.dataid].append(g)
            elif geom.type != PLANE:
                alike[geom.type, int(geom.type == BOX and geom.size.max() > LARGE)].append(g)
        parts: list[Mesh] = []
        total = 0
        for (kind, variant), members in alike.items():
            primitive = self._primitive(kind, variant)
            size = np.array([geoms[g].size for g in members])
            scale = np.ones_like(size) if kind in (MESH, SDF) else size[:, [0, 1, 0 if kind == CAPSULE else 2]]
            local = primitive.vertices * scale[:, None]
            local[..., 2] += primitive.lift * size[:, 2:]
            normals = primitive.normals / scale[:, None]
            normals /= np.sqrt(np.einsum("gvi,gvi->gv", normals, normals))[..., None]
            turn = np.array([geoms[g].mat for g in members]).swapaxes(1, 2)
            vertices = local @ turn + np.array([geoms[g].pos for g in members])[:, None]
            n = len(primitive.vertices)
            triangles = primitive.triangles + (total + n * np.arange(len(members), dtype=np.int32))[:, None, None]
            total += n * len(members)
            flat = lambda a: a.reshape(-1, 3)
            parts.append(Mesh(flat(vertices), flat(normals @ turn), np.repeat(members, n), flat(triangles)))
        if not parts:
            empty = np.zeros((0, 3), np.float32)
            return Mesh(empty, empty, np.zeros(0, int), np.zeros((0, 3), np.int32))
        return Mesh(*(np.concatenate(field) for field in zip(*parts, strict=True)))

    def _primitive(self, kind: int, variant: int) -> Primitive:
        if kind in (MESH, SDF):
            mesh = variant // 2  # MuJoCo counts every mesh twice: itself, and its convex hull.
            if mesh not in self._primitives:
                self._primitives[mesh] = _from_model(self._model, mesh)
            return self._primitives[mesh]
        quality = self._model.vis.quality
        try:
            return _unit_primitive(kind, quality.numslices, quality.numstacks, quality.numquads if variant else 1)
        except KeyError:
            name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            raise UserError(f"software rendering draws no {name}: use the back end gl") from None


class Primitive(NamedTuple):
    """A closed surface from which geoms of one kind are made.

    A geom's vertex is `vertices * size`, and `lift * size[2]` further along z: only the halves of a capsule keep their
    shape when it is stretched.
    """

    vertices: np.ndarray
    """(n, 3) float32."""
    lift: np.ndarray
    """(n,) float32."""
    normals: np.ndarray
    """Unit vectors (n, 3) float32, pointing out."""
    triangles: np.ndarray
    """Indices of vertices (m, 3) int32, counter-clockwise seen from outside."""


@lru_cache(maxsize=64)
def _unit_primitive(kind: int, slices: int, stacks: int, quads: int) -> Primitive:
    """A sphere, ellipsoid, capsule, cylinder or box of size 1, as finely divided as the model's visual quality says.
    Raises `KeyError` for any other kind of geom."""
    return {
        SPHERE: lambda: _ball(slices, stacks, capsule=False),
        ELLIPSOID: lambda: _ball(slices, stacks, capsule=False),
        CAPSULE: lambda: _ball(slices, stacks, capsule=True),
        CYLINDER: lambda: _cylinder(slices),
        BOX: lambda: _box(quads),
    }[kind]()


def _from_model(model: mujoco.MjModel, mesh: int) -> Primitive:
    """A mesh of the model as it is, with edges where MuJoCo's renderer has them: where normals and faces disagree."""
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = model.mesh_face[first : first + count] + model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[corners]
    face = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=-1, keepdims=True), 1e-12)
    normals = model.mesh_normal[model.mesh_facenormal[first : first + count] + model.mesh_normaladr[mesh]]
    sharp = (normals * face[:, None]).sum(-1, keepdims=True) < 0.8
    normals = np.where(sharp, face[:, None], normals)
    n = 3 * count
    return _to_primitive(vertices.reshape(n, 3), normals.reshape(n, 3), np.arange(n).reshape(-1, 3))


def _to_primitive(
    vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, lift: np.ndarray | None = None
) -> Primitive:
    lift = np.zeros(len(vertices)) if lift is None else lift
    as_float = lambda a: np.ascontiguousarray(a, np.float32)
    return Primitive(as_float(vertices), as_float(lift), as_float(normals), np.ascontiguousarray(triangles, np.int32))


def _circle(slices: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(slices) / slices
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _tube(rings: int, slices: int) -> np.ndarray:
    """Triangles between rings of vertices, one above the other, numbered ring by ring."""
    j = np.arange(slices)
    a, b = j, (j + 1) % slices
    quad = np.stack([a, b, b + slices, a, b + slices, a + slices], -1).reshape(-1, 3)
    return (quad + slices * np.arange(rings - 1)[:, None, None]).reshape(-1, 3)


def _ball(slices: int, stacks: int, capsule: bool) -> Primitive:
    elevation = np.pi / 2 * np.linspace(-1, 1, 2 * (stacks // 2) + 1)
    lift = np.sign(elevation) if capsule else np.zeros_like(elevation)
    if capsule:  # The equator twice: between the two lies the barrel.
        middle = stacks // 2
        elevation = np.insert(elevation, middle, 0.0)
        lift = np.where(np.arange(len(elevation)) <= middle, -1.0, 1.0)
    ring = np.cos(elevation)[:, None, None] * _circle(slices)
    height = np.broadcast_to(np.sin(elevation)[:, None, None], (*ring.shape[:2], 1))
    vertices = np.concatenate([ring, height], -1).reshape(-1, 3)
    return _to_primitive(vertices, vertices, _tube(len(elevation), slices), np.repeat(lift, slices))


def _cylinder(slices: int) -> Primitive:
    circle, zero, one = _circle(slices), np.zeros((slices, 1)), np.ones((slices, 1))
    side = np.concatenate([np.c_[circle, -one], np.c_[circle, one]])
    vertices, normals, triangles = [side], [np.tile(np.c_[circle, zero], (2, 1))], [_tube(2, slices)]
    j = np.arange(slices)
    for sign in (-1, 1):
        rim = sum(map(len, vertices))
        vertices += [np.c_[circle, sign * one], np.array([[0, 0, sign]])]
        normals.append(np.tile([0, 0, sign], (slices + 1, 1)))
        fan = np.stack([j, (j + 1) % slices, np.full(slices, slices)], -1)
        triangles.append(rim + fan[:, ::sign])
    return _to_primitive(np.concatenate(vertices), np.concatenate(normals), np.concatenate(triangles))


def _box(quads: int) -> Primitive:
    line = np.linspace(-1, 1, quads + 1)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    i, j = (grid.ravel() for grid in np.mgrid[:quads, :quads])
    corner = i * (quads + 1) + j
    a, b, c, d = corner, corner + quads + 1, corner + quads + 2, corner + 1
    face = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    vertices: list[np.ndarray] = []
    normals, triangles = [], []
    for axis in range(3):
        for sign in (-1, 1):
            points = np.empty((len(u), 3))
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = sign, u, v
            triangles.append(len(vertices) * len(u) + face[:, ::sign])
            vertices.append(points)
            normals.append(np.tile(sign * np.eye(3)[axis], (len(u), 1)))
    return _to_primitive(np.concatenate(vertices), np.concatenate(normals), np.concatenate(triangles))
