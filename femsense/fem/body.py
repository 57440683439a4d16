"""A body as the solver sees it: mesh, material, clamp, cables and dead loads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.core.arrays import BoolArray, FloatArray, IntArray, as_indices, as_points, freeze
from femsense.core.errors import InputError
from femsense.fem.body_parts import LAWS, Cable, Chamber, Material, segment_nodes
from femsense.fem.mesh import TetMesh, body_parts, element_volumes, embed_points, tie_to_elements
from femsense.fem.stencil import FreeMap, Stencil, make_free_map, make_stencil, reshaped

FLAT = 1e-12
"""A tetrahedron is flat, up to rounding, if its volume is below this share of the median volume."""


@dataclass(frozen=True, eq=False, slots=True)
class BodyModel:
    """A finite-element body with n nodes and m elements: mesh, material, clamp, cables, chambers and dead loads.

    `make_body` and `load_robot` make one. Bodies are immutable: each method `with_…` returns a changed copy.
    """

    mesh: TetMesh
    """Mesh at rest."""
    material: Material
    """Constitutive law and its parameters, per element."""
    clamped: IntArray
    """Indices of the clamped nodes, shape (k,)."""
    clamp_stiffness: float
    """Stiffness of a spring in each direction at every node of `clamp_nodes` [N/m]; inf: these nodes cannot move."""
    clamp_nodes: IntArray
    """Indices of the clamped nodes at which a compliant clamp has springs, shape (s,): those of the declared mesh, without added mid-edge nodes."""
    cables: tuple[Cable, ...]
    """Cables, tied to the mesh."""
    gravity: FloatArray
    """Gravity in the axes of the mesh [m/s²], shape (3,)."""
    dead_forces: FloatArray
    """Dead nodal forces in addition to the weight [N], shape (n, 3)."""
    stencil: Stencil
    """Sparsity pattern and shape functions of the elements."""
    cable_slots: tuple[IntArray, ...]
    """Blocks to which the geometric stiffness of each segment is added, one array (s, 2k, 2k) per cable."""
    free_map: FreeMap
    """Map from free to all degrees of freedom."""
    clamp_turn_stiffness: float = np.inf
    """Rotational stiffness of the clamp, a rigid plate, about `clamp_center` [N m/rad]; inf: it does not rotate."""
    released: list[FreeMap] = field(default_factory=list)
    """The free map without the clamp, after the first use; bodies with the same mesh share this list."""

    @property
    def clamp_is_rigid(self) -> bool:
        """Whether clamped nodes cannot move."""
        return bool(np.isinf(self.clamp_stiffness) and np.isinf(self.clamp_turn_stiffness))

    @property
    def clamp_center(self) -> FloatArray:
        """Centroid of the clamped nodes of the declared mesh at rest [m], shape (3,); of all nodes where none is clamped."""
        nodes = self.mesh.nodes
        return np.asarray((nodes[self.clamp_nodes] if len(self.clamp_nodes) else nodes).mean(axis=0))

    @property
    def reach(self) -> float:
        """Longest side of the box around the body at rest [m]."""
        return self.mesh.reach

    parts: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """The connected part that each node belongs to, shape (n,); a robot has one (see `mesh_checks.check_mesh`)."""
    chambers: tuple[Chamber, ...] = ()
    """Pneumatic chambers: closed inner surfaces."""
    chamber_curvature: tuple[sp.csr_matrix, ...] = ()
    """Second derivatives of the volume of each chamber (see `chambers.curvature_map`), each (nb, n)."""
    carried_mass: FloatArray | None = None
    """Additional masses at the nodes [kg], shape (n,); None: no additional mass."""

    @property
    def cable_names(self) -> tuple[str, ...]:
        return tuple(cable.name for cable in self.cables)

    @property
    def chamber_names(self) -> tuple[str, ...]:
        return tuple(chamber.name for chamber in self.chambers)

    def weight(self) -> FloatArray:
        """Return the nodal forces of gravity [N], shape (n, 3) (consistent: ρ ∫ N dV g), additional masses included."""
        mass = self.material.density * self.stencil.node_volume
        return (mass if self.carried_mass is None else mass + self.carried_mass)[:, None] * self.gravity

    @property
    def mass(self) -> float:
        """Mass of the body without additional masses [kg]."""
        return float(self.material.density * self.stencil.node_volume.sum())

    def dead_load(self) -> FloatArray:
        """Return weight plus other dead forces [N], shape (n, 3)."""
        return self.weight() + self.dead_forces

    def is_clamped(self) -> bool:
        """Return whether the clamp or its springs prevent every rigid motion of every connected part: each has three such nodes that are not on a line."""
        held = self.clamped if np.isinf(self.clamp_stiffness) else self.clamp_nodes  # a plate holds all of them
        return all(_spread_out(self.mesh.nodes[held[self.parts[held] == part]]) for part in range(int(self.parts.max()) + 1))

    def with_gravity(self, vector: npt.ArrayLike) -> BodyModel:
        """Return the body under another gravity [m/s²], shape (3,)."""
        return replace(self, gravity=_finite_vector(vector, "gravity"))

    def with_dead_forces(self, forces: npt.ArrayLike) -> BodyModel:
        """Return the body with other dead forces in addition to its weight [N], shape (n, 3). Raises InputError."""
        wanted = as_points(forces, "dead_forces")
        if wanted.shape != self.mesh.nodes.shape:
            raise InputError("wrong shape", where="dead_forces", found=wanted.shape, expected=self.mesh.nodes.shape)
        return replace(self, dead_forces=freeze(wanted))

    def with_carried_mass(self, mass: npt.ArrayLike) -> BodyModel:
        """Return the body with other additional masses at its nodes [kg], shape (n,); their weight turns with gravity.

        Raises InputError.
        """
        wanted = np.asarray(mass, dtype=float)
        if wanted.shape != (len(self.mesh.nodes),) or not np.isfinite(wanted).all():
            raise InputError("wrong shape", where="carried_mass", found=wanted.shape, expected=(len(self.mesh.nodes),))
        return replace(self, carried_mass=freeze(wanted))

    def with_material(self, material: Material) -> BodyModel:
        """Return the body made of another material."""
        return replace(self, material=material)

    def with_stiffness_scale(self, scale: npt.ArrayLike) -> BodyModel:
        """Return the body with Young's modulus multiplied by a number, or by one factor per element, shape (m,)."""
        return replace(
            self, material=replace(self.material, young_modulus=freeze(self.material.young_modulus * np.asarray(scale)))
        )

    def with_cables(self, cables: tuple[Cable, ...]) -> BodyModel:
        """Return the body with changed cables. Their paths must be unchanged, because the sparsity pattern depends on them."""
        if [c.path for c in cables] != [c.path for c in self.cables]:
            raise InputError("the paths of the cables must stay", where="cables", hint="make_body builds a body with other paths")
        return replace(self, cables=cables)

    def with_cable_places(self, places: Mapping[str, FloatArray]) -> BodyModel:
        """Return the body with other cable paths: name → p points at rest [m], shape (p, 3); each point stays embedded in its element."""
        paths = {c.name: tie_to_elements(self.mesh, places[c.name], c.path.element) for c in self.cables if c.name in places}
        return replace(self, cables=tuple(replace(c, path=paths.get(c.name, c.path)) for c in self.cables))

    def with_rest_nodes(self, nodes: FloatArray) -> BodyModel:
        """Return the body with another stress-free shape: other node positions at rest [m], shape (n, 3). Embedded points and sparsity patterns are kept.

        Raises:
            InputError: an element would be inverted.
        """
        mesh = TetMesh(nodes, self.mesh.tets)
        stencil = reshaped(self.stencil, mesh)
        if (stencil.volumes <= 0).any():
            raise InputError(
                "elements fold over", where="rest shape", expected="positive volumes", hint="a smaller change of shape"
            )
        seeds = [tie_to_elements(self.mesh, c.seed[None], _nearest_element(self.mesh, c.seed)) for c in self.chambers]
        chambers = tuple(replace(c, seed=freeze(tie.positions(nodes)[0])) for c, tie in zip(self.chambers, seeds))
        return replace(self, mesh=mesh, stencil=stencil, chambers=chambers)

    def with_clamp_nodes(self, nodes: npt.ArrayLike) -> BodyModel:
        """Return the body with another set of nodes at which a compliant clamp has springs: s indices, shape (s,). Default: all clamped nodes."""
        return replace(self, clamp_nodes=freeze(as_indices(nodes, len(self.mesh.nodes), "clamp_nodes"), np.int64))

    def with_clamp_stiffness(self, stiffness: float = np.inf, *, turn: float = np.inf) -> BodyModel:
        """Return the body on a compliant clamp: springs at its clamped nodes, and a plate that can rotate.

        Arguments:
            stiffness: stiffness of a spring in each direction at every node of `clamp_nodes` [N/m]. Default inf: these nodes cannot move.
            turn: rotational stiffness of the clamped plate about `clamp_center` [N m/rad]. Default inf: it does not rotate.
                If both are inf, the clamp is rigid.
        """
        if np.isinf(stiffness) and np.isinf(turn):
            free_map = make_free_map(self.stencil, self.mesh, self.clamped)
        else:
            if not self.released:
                self.released.append(make_free_map(self.stencil, self.mesh, np.zeros(0, dtype=np.int64)))
            free_map = self.released[0]
        return replace(self, clamp_stiffness=float(stiffness), clamp_turn_stiffness=float(turn), free_map=free_map)

    def scaled(self, scale: float) -> BodyModel:
        """Return the body scaled about `clamp_center`: its rest positions and the points tied to it.

        Pull points stay in space. Gradients scale with 1/scale and volumes with scale³; sparsity patterns and ties are unchanged.
        """
        center, stencil = self.clamp_center, self.stencil
        mesh = TetMesh(center + scale * (self.mesh.nodes - center), self.mesh.tets)
        grown = replace(
            stencil,
            gradients=freeze(stencil.gradients / scale),
            lanes=[],
            volumes=freeze(stencil.volumes * scale**3),
            node_volume=freeze(stencil.node_volume * scale**3),
        )
        chambers = tuple(replace(c, seed=freeze(center + scale * (c.seed - center))) for c in self.chambers)
        return replace(self, mesh=mesh, stencil=grown, chambers=chambers)


def make_body(
    mesh: TetMesh,
    *,
    young_modulus: float | FloatArray,
    poisson_ratio: float | FloatArray,
    density: float = 0.0,
    law: str = "corotational",
    clamped: npt.ArrayLike | BoolArray = (),
    cables: tuple[Cable, ...] = (),
    chambers: tuple[Chamber, ...] = (),
    gravity: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> BodyModel:
    """Build a finite-element body with n nodes and m elements from a mesh, its material, its clamp and its drives.

    Three constitutive laws have the same small-strain moduli: the corotational law is linear elasticity in rotating elements, the neo-Hookean law
    describes rubber at larger strains, and the Gent law also its stiffening near a limit of stretch.

    Arguments:
        mesh: mesh at rest [m], of linear (4 nodes) or quadratic (10 nodes) tetrahedra.
        young_modulus: Young's modulus [Pa], above 0: a number, or one value per element, shape (m,).
        poisson_ratio: Poisson's ratio [1], between −1 and 0.5 (0.49 for silicone): a number, or one value per element, shape (m,).
        density: density [kg/m³], at least 0. Default 0: no weight.
        law: constitutive law: "corotational" (default), "neo_hookean" or "gent".
        clamped: indices of the nodes that cannot move, or a mask, shape (n,). Default: none. `BodyModel.with_clamp_stiffness` makes the
            clamp compliant.
        cables: results of `tie_cable`. Default: none.
        chambers: closed cavities under pressure, results of `femsense.fem.cavities.find_chamber`. Default: none.
        gravity: gravity in the axes of the mesh [m/s²], shape (3,). Default: none.

    Returns:
        the body at rest, for `solve_equilibrium`, `compliance` and `Tracker`.

    Raises:
        InputError: a value outside of the ranges above, an unknown law, a node that does not exist, or inverted elements.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> mesh = fs.block_mesh([np.linspace(0.0, 0.10, 11), np.linspace(0.0, 0.02, 3), np.linspace(0.0, 0.02, 3)])
        >>> bar = fs.make_body(mesh, young_modulus=1e6, poisson_ratio=0.45, clamped=mesh.nodes[:, 0] == 0.0)
        >>> corner = np.argmax(mesh.nodes.sum(axis=1))  # of the tip
        >>> forces = np.zeros_like(mesh.nodes)
        >>> forces[corner, 2] = -0.05  # N
        >>> bent = fs.solve_equilibrium(bar, nodal_forces=forces)
        >>> round(1e3 * float(bent.positions[corner, 2] - mesh.nodes[corner, 2]), 1)  # deflection [mm]
        -0.8
    """
    n, m = len(mesh.nodes), len(mesh.tets)
    E, nu = (np.broadcast_to(np.asarray(v, dtype=float), (m,)) for v in (young_modulus, poisson_ratio))
    if not (np.isfinite(E).all() and (E > 0).all()):
        raise InputError("must be positive", where="young_modulus", found=float(E.min()), expected="> 0 Pa")
    if not ((nu > -1).all() and (nu < 0.5).all()):
        raise InputError(
            "out of range", where="poisson_ratio", found=float(nu.max()), expected="−1 < ν < 0.5", hint="0.49 for silicone"
        )
    if law not in LAWS:
        raise InputError("unknown law", where="law", found=law, expected=" | ".join(LAWS))
    from femsense.fem.cavities import check_chambers, curvature_map

    mask = np.asarray(clamped)
    indices = (
        np.flatnonzero(mask)
        if mask.dtype == np.bool_
        else as_indices(clamped, n, "clamped")
        if mask.size
        else np.zeros(0, np.int64)
    )
    if not (np.isfinite(density) and density >= 0):
        raise InputError("out of range", where="density", found=density, expected="≥ 0 kg/m³")
    volumes = element_volumes(mesh)
    if (volumes <= FLAT * np.median(np.abs(volumes))).any():
        raise InputError(
            "inverted or flat tetrahedra",
            where="mesh",
            expected="positive volumes",
            hint="see femsense.fem.mesh_checks.check_mesh",
        )
    check_chambers(chambers)
    ties = [segment_nodes(cable.path) for cable in cables]
    stencil, slots = make_stencil(mesh, [*ties, *(chamber.faces for chamber in chambers)])
    cable_slots = slots[: len(cables)]
    curvature = tuple(curvature_map(c, s, len(stencil.block_columns), n) for c, s in zip(chambers, slots[len(cables) :]))
    material = Material(freeze(E), freeze(nu), float(density), law)
    return BodyModel(
        mesh,
        material,
        freeze(np.unique(indices), np.int64),
        np.inf,
        freeze(indices, np.int64),
        cables,
        _finite_vector(gravity, "gravity"),
        freeze(np.zeros((n, 3))),
        stencil,
        cable_slots,
        make_free_map(stencil, mesh, indices),
        parts=freeze(body_parts(mesh), np.int64),
        chambers=chambers,
        chamber_curvature=curvature,
    )


def _nearest_element(mesh: TetMesh, point: FloatArray) -> IntArray:
    """Return the element with its centre nearest to a point [m], shape (1,)."""
    centres = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    return np.array([int(np.linalg.norm(centres - point, axis=1).argmin())])


def _spread_out(points: FloatArray) -> bool:
    """Return whether three of the points (k, 3) are not on a line."""
    if len(points) < 3:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 1e-9 * spread[0])


def _finite_vector(vector: npt.ArrayLike, where: str) -> FloatArray:
    values = as_points(vector, where)
    if values.shape != (1, 3):
        raise InputError("wrong shape", where=where, found=np.shape(vector), expected="(3,)")
    return freeze(values[0])


def tie_cable(
    mesh: TetMesh,
    name: str,
    path: npt.ArrayLike,
    pull_point: npt.ArrayLike,
    *,
    exit_direction: npt.ArrayLike | None = None,
    min_tension: float = 0.0,
    max_tension: float = np.inf,
    friction: float = 0.0,
) -> Cable:
    """Tie a cable to a mesh: each point of its path is embedded in the element with the nearest centre, and moves with it.

    Arguments:
        mesh: mesh of the body at rest [m].
        name: name of the cable, by which inputs refer to it.
        path: p points of the cable in the body at rest [m], shape (p, 3), from the far end to the exit.
        pull_point: fixed point outside of the body towards which the cable is pulled [m], shape (3,).
        exit_direction: direction in which the cable leaves the pull point, shape (3,), of any length. Only friction depends on it.
            Default: no bend at the pull point.
        min_tension: smallest tension [N]. Default: 0.
        max_tension: largest tension [N]. Default: no limit.
        friction: capstan coefficient μ at each bend [1], at least 0: a bend by the angle φ changes the tension by a factor of up to exp(μ φ).
            Default: 0.

    Returns:
        the cable, for the argument `cables` of `make_body`.

    Raises:
        InputError: negative friction, a direction of length 0, or arrays of another shape.
    """
    if not (np.isfinite(friction) and friction >= 0):
        raise InputError("out of range", where=f"friction of cable {name}", found=friction, expected="≥ 0")
    embedding = embed_points(mesh, as_points(path, f"path of cable {name}"), outside_rule="nearest_centre")
    direction = None
    if exit_direction is not None:
        vector = as_points(exit_direction, f"exit_direction of cable {name}")[0]
        length = np.linalg.norm(vector)
        if length == 0:
            raise InputError(
                "has no length", where=f"exit_direction of cable {name}", found=vector.tolist(), expected="a direction"
            )
        direction = freeze(vector / length)
    return Cable(
        name, embedding, freeze(as_points(pull_point)[0]), direction, float(min_tension), float(max_tension), float(friction)
    )
