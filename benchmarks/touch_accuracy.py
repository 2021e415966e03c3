"""Accuracy of touch: distances against exact shapes, forces against closed forms, the paper's method against the grid.

Called by `touch.py`. Every function returns rows (dictionaries) for its table. Needs no physics engine and no file but
the shipped taxel layout; the one mesh is made by trimesh.
"""

import dataclasses
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from dexsim.core.assets import asset_path
from dexsim.geometry import grid, mesh, sdf, surface_points
from dexsim.geometry.distance import signed_distance
from dexsim.hand.kinematics import HandPose
from dexsim.hand.layout import lattice, on_surface, read_layout
from dexsim.touch import feel as tactile
from dexsim.touch.feel import Touch, feel_links
from dexsim.touch.reduce import reduce_touch, reduce_touch_links
from dexsim.touch.skin import Skin

SHAPES = {
    "sphere": (0.0275, 0, 0),
    "box": (0.025, 0.02, 0.03),
    "capsule": (0.013, 0.025, 0),
    "cylinder": (0.02, 0.025, 0),
    "ellipsoid": (0.03, 0.02, 0.04),
}
SMOOTH = ("sphere", "capsule", "ellipsoid", "torus mesh")
# Sampling error of the force (rms) that a lattice of that pitch [mm] makes at that depth [mm], ball of 10 mm.
PITCH_BOUND = {
    (0.3, 0.8): 0.008,
    (0.3, 1.0): 0.007,
    (0.3, 1.5): 0.041,
    (0.3, 2.0): 0.063,
    (0.3, 3.0): 0.097,
    (0.5, 0.8): 0.002,
    (0.5, 1.0): 0.008,
    (0.5, 1.5): 0.022,
    (0.5, 2.0): 0.045,
    (0.5, 3.0): 0.122,
    (1.0, 0.8): 0.001,
    (1.0, 1.0): 0.002,
    (1.0, 1.5): 0.005,
    (1.0, 2.0): 0.019,
    (1.0, 3.0): 0.042,
}
WINKLER = Skin(margin=0.0, thickness=0.02, law="linear", c10=0.1e6)


def turned_solid(kind: str, seed: int = 0) -> sdf.Shape:
    """One primitive turned against the axes, so that no grid lies along its faces."""
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn = turn * np.sign(np.linalg.det(turn))
    return sdf.Shape(
        (kind,),
        jnp.asarray([SHAPES[kind]], jnp.float32),
        jnp.zeros((1, 3)),
        jnp.asarray(turn[None], jnp.float32),
        jnp.array([True]),
    )


def upright(kind: str, *size: float) -> sdf.Shape:
    """One primitive along the axes."""
    return sdf.Shape(
        (kind,), jnp.asarray([(*size, 0, 0)[:3]], jnp.float32), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.array([True])
    )


def shipped_skin() -> SimpleNamespace:
    """The shipped layout with what `tactile.feel_links` asks of a hand, without reading a model."""
    patches = read_layout(asset_path("hand/taxels.csv"))
    stack = {
        name: np.stack([getattr(p, name) for p in patches.values()]).astype(np.float32)
        for name in ("position", "normal", "area")
    }
    return SimpleNamespace(
        tip_body=np.arange(len(patches)),
        taxel_position=stack["position"],
        taxel_normal=stack["normal"],
        taxel_area=stack["area"],
    )


def distance_errors(quick: bool) -> list[dict]:
    """Depth error of each method within -3 to +1 mm of each shape's surface."""

    def methods():
        for nodes in (32, 64) if quick else (32, 64, 128):
            yield f"grid {nodes}", lambda s, n=nodes: grid.bake(s, nodes=n)
        for count in (1024,) if quick else (256, 1024, 4096):
            yield f"points {count}", lambda s, n=count: surface_points.from_shape(s, n)

    rows, run = [], jax.jit(signed_distance)

    def compare(kind, box, exact_at, geometries):
        points = np.random.default_rng(1).uniform(box[0] - 1e-3, box[1] + 1e-3, (100_000, 3)).astype(np.float32)
        exact = np.asarray(exact_at(points))
        near = (exact > -0.003) & (exact < 0.001)
        points, exact = points[near], exact[near]
        for name, geometry in geometries:
            ours = np.asarray(run(points, geometry))
            error = 1e6 * np.abs(ours - exact)
            rows.append(
                {
                    "shape": kind,
                    "method": name,
                    "mean_um": error.mean(),
                    "p95_um": np.quantile(error, 0.95),
                    "max_um": error.max(),
                    "missed_%": 100 * np.mean((exact < 0) & (ours >= 0)),
                    "false_%": 100 * np.mean((exact >= 0) & (ours < 0)),
                    "ok": bool(error.mean() <= 10) if name == "grid 64" and kind in SMOOTH else None,
                }
            )

    for kind in SHAPES:
        shape = turned_solid(kind)
        compare(kind, sdf.bounds(shape), lambda p, s=shape: run(p, s), ((n, make(shape)) for n, make in methods()))
    ring = mesh.load_mesh(trimesh.creation.torus(0.022, 0.009, 96, 48))
    compare(
        "torus mesh",
        ring.bounds,
        lambda p: mesh.signed_distance(ring, p)[0],
        (
            ("grid 64", grid.bake(ring, cache=False)),
            ("points 1024", surface_points.from_mesh(ring)),
        ),
    )
    return rows


def pad(pitch: float, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat lattices [S, N, 3] of 24 mm, shifted in their plane, and areas [S, N]."""
    count = int(round(0.024 / pitch))
    patch = on_surface("plane", lattice(count, count, pitch=pitch))
    shift = np.concatenate([shift, np.zeros((len(shift), 1))], 1)
    taxels = (patch.position + shift[:, None]).astype(np.float32)
    return taxels, np.broadcast_to(patch.area.astype(np.float32), taxels.shape[:2])


def press(taxels, area, geometry, position, skin, turn=None) -> Touch:
    """What lattices feel of an object above them."""
    force = np.ones(len(taxels), np.float32)
    turn = np.eye(3, dtype=np.float32) if turn is None else turn
    return jax.jit(tactile.feel, static_argnames="skin")(
        taxels, area, geometry, np.float32(position), turn, force, skin
    )


def forces(quick: bool) -> list[dict]:
    """Sphere and cylinder on a flat pad against Winkler's foundation, over random lattice phases.

    A taxel's depth is its distance from the surface, so the integral of the foundation is that of R - sqrt(r^2 + c^2)
    with c = R - depth: pi depth^2 (R - 2 depth / 3) for the sphere, Johnson's pi R depth^2 in the limit. The lattice
    samples it. Its error for a paraboloid has a closed form by Poisson's sum, which bounds the cylinder's.
    """
    rows, radius = [], 0.010
    rng = np.random.default_rng(2)
    modulus = 6 * (WINKLER.c10 + WINKLER.c01) / WINKLER.thickness
    upended = np.float32([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    for depth in (0.0005,) if quick else (0.0003, 0.0005, 0.001):
        low = radius - depth
        half = np.sqrt(radius**2 - low**2)  # of the contact
        segment = half * radius - low**2 * np.log((half + radius) / low)
        for pitch in (0.0008, 0.002) if quick else (0.0008, 0.001, 0.0015, 0.002, 0.003):
            shift = rng.uniform(-pitch / 2, pitch / 2, (200, 2))
            taxels, area = pad(pitch, shift)
            bound = PITCH_BOUND[round(1e3 * depth, 1), round(1e3 * pitch, 1)]
            ball = press(taxels, area, upright("sphere", radius), (0, 0, radius - depth), WINKLER)
            wanted = modulus * np.pi * depth**2 * (radius - 2 * depth / 3)
            error = np.asarray(ball.skin_force.sum(1)) / wanted - 1
            _, centre = reduce_touch(ball.skin_force, taxels)
            off = 1e3 * np.linalg.norm(np.asarray(centre)[:, :2], axis=1)
            # 1.25 and 0.1 % allow for the 200 phases drawn here.
            rms = float(np.sqrt(np.mean(error**2)))
            rows.append(
                {
                    "object": "sphere",
                    "depth_mm": 1e3 * depth,
                    "pitch_mm": 1e3 * pitch,
                    "force_rms_%": 100 * rms,
                    "bound_%": 100 * bound,
                    "centre_rms_mm": float(np.sqrt(np.mean(off**2))),
                    "ok": rms <= 1.25 * bound + 1e-3 and (depth < 5e-4 or bool(np.sqrt(np.mean(off**2)) <= 0.15)),
                }
            )
            bar = press(taxels, area, upright("cylinder", radius, 0.1), (0, 0, radius - depth), WINKLER, upended)
            length = round(0.024 / pitch) * pitch
            error = np.asarray(bar.skin_force.sum(1)) / (modulus * segment * length) - 1
            rms = float(np.sqrt(np.mean(error**2)))
            bound = _ridge_sampling(half, pitch)
            rows.append(
                {
                    "object": "cylinder",
                    "depth_mm": 1e3 * depth,
                    "pitch_mm": 1e3 * pitch,
                    "force_rms_%": 100 * rms,
                    "bound_%": 100 * bound,
                    "centre_rms_mm": None,
                    "ok": rms <= 1.25 * bound + 1e-3,
                }
            )
    return rows


def _ridge_sampling(half: float, pitch: float) -> float:
    """Relative rms error, over all phases, of sampling the parabola 1 - (x / half)^2 at a pitch."""
    u = 2 * np.pi * half / pitch * np.arange(1, 200)
    return float(np.sqrt(2 * np.sum((3 * (np.sin(u) / u - np.cos(u)) / u**2) ** 2)))


def checks() -> list[dict]:
    """Flat punch, known load, monotony and gradients, each against its closed form."""
    rows = [_punch(), *_loads()]
    for name, geometry in _geometries().items():
        rows += [_monotone(name, geometry), _gradient(name, geometry)]
    return rows


def _geometries() -> dict:
    ball = upright("sphere", 0.02)
    return {
        "closed form": ball,
        "grid": grid.bake(ball),
        "points": surface_points.from_shape(ball),
    }


def _punch() -> dict:
    taxels, area = pad(0.002, np.zeros((1, 2)))
    half, depth = 0.0079, 0.0004  # no taxel is nearer to a side of the box than to its face
    skin = Skin(margin=0.0)
    touch = press(taxels, area, upright("box", half, half, 0.01), (0, 0, 0.01 - depth), skin)
    covered = np.all(np.abs(taxels[0, :, :2]) < half, axis=1)
    stretch = 1 - depth / skin.thickness
    wanted = np.where(covered, 2 * (stretch**-2 - stretch) * (skin.c10 + skin.c01 / stretch) * 4e-6, 0)
    error = float(np.abs(np.asarray(touch.skin_force[0]) - wanted).max() / wanted.max())
    return {
        "check": "flat punch: equal force where covered, 0 elsewhere",
        "value": error,
        "bound": 1e-4,
        "ok": error <= 1e-4,
    }


def _loads() -> list[dict]:
    """A ball at rest where Winkler's foundation carries it: the taxels must add up to its weight."""
    rows, weight, radius = [], 0.1 * 9.81, 0.01
    skin = dataclasses.replace(WINKLER, c10=0.03e6, thickness=0.002)
    modulus = 6 * skin.c10 / skin.thickness
    depth = np.sqrt(weight / (np.pi * modulus * radius))
    for _ in range(20):  # the foundation's own integral, not its limit for small depths
        depth = np.sqrt(weight / (np.pi * modulus * (radius - 2 * depth / 3)))
    for pitch in (0.001, 0.0022):
        shift = np.random.default_rng(3).uniform(-pitch / 2, pitch / 2, (200, 2))
        touch = press(*pad(pitch, shift), upright("sphere", radius), (0, 0, radius - depth), skin)
        error = float(np.sqrt(np.mean((np.asarray(touch.skin_force.sum(1)) / weight - 1) ** 2)))
        rows.append(
            {
                "check": f"load of 0.1 kg on a ball, {1e3 * depth:.2f} mm deep, pitch {1e3 * pitch:g} mm",
                "value": error,
                "bound": 0.05,
                "ok": error <= 0.05,
            }
        )
    return rows


def _monotone(name: str, geometry) -> dict:
    taxels, area = pad(0.002, np.zeros((1, 2)))
    skin = Skin(margin=0.0, thickness=0.004)

    def total(depth):
        touch = tactile.feel(
            taxels, area, geometry, jnp.stack([0.0007, -0.0004, 0.02 - depth]), jnp.eye(3), jnp.ones(1), skin
        )
        return touch.skin_force.sum()

    force = np.asarray(jax.jit(jax.vmap(total))(jnp.linspace(0, 0.002, 201)))
    fall = float(-np.diff(force).min() / force.max())
    return {
        "check": f"force grows with depth, {name}: largest fall in 201 steps",
        "value": abs(max(fall, 0.0)),
        "bound": 1e-5,
        "ok": fall <= 1e-5,
    }


def _gradient(name: str, geometry) -> dict:
    """Of the summed force in the object's position, against central differences, in double precision."""
    with jax.enable_x64(True):
        taxels, area = (np.asarray(x, np.float64) for x in pad(0.002, np.zeros((1, 2))))
        skin, step = Skin(margin=0.0), 1e-8

        @jax.jit
        def total(position):
            return tactile.feel(taxels, area, geometry, position, jnp.eye(3), jnp.ones(1), skin).skin_force.sum()

        start = jnp.array([0.00071, -0.00043, 0.0193])
        exact = np.asarray(jax.jit(jax.grad(total))(start))
        numeric = [(total(start + step * e) - total(start - step * e)) / (2 * step) for e in jnp.eye(3)]
        error = float(np.abs(exact - np.asarray(numeric)).max() / np.abs(exact).max())
    return {"check": f"gradient against finite differences, {name}", "value": error, "bound": 1e-4, "ok": error <= 1e-4}


def random_grasps(shape: sdf.Shape, count: int, seed: int = 0) -> HandPose:
    """Fingertips [count, F] that each press one of their taxels 0 to 1.5 mm into the object, in its frame.

    A random taxel meets a random point of the surface, its normal against the surface's, turned at random about it.
    """
    skin, rng = shipped_skin(), np.random.default_rng(seed)
    fingers, taxels = skin.taxel_area.shape
    surface = surface_points.from_shape(shape, 4096)
    real = np.flatnonzero(np.abs(np.asarray(surface.position)).max(1) < 1)
    pick = rng.choice(real, (count, fingers))
    point, normal = np.asarray(surface.position)[pick], np.asarray(surface.normal)[pick]
    which = rng.integers(taxels, size=(count, fingers))
    rows = np.arange(fingers)
    at, out = skin.taxel_position[rows, which], skin.taxel_normal[rows, which]
    rotation = _frame(-normal, rng) @ np.swapaxes(_frame(out, rng), -1, -2)
    sunk = point - rng.uniform(0, 0.0015, (count, fingers, 1)) * normal
    position = sunk - np.einsum("...ij,...j->...i", rotation, at)
    position, rotation = jnp.asarray(position, jnp.float32), jnp.asarray(rotation, jnp.float32)
    return HandPose(position, rotation, position, rotation)


def _frame(axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotations [..., 3, 3] with `axis` as third column and a random first one."""
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    first = np.cross(axis, rng.normal(size=axis.shape))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(axis, first), axis], -1)


def grasps(quick: bool) -> list[dict]:
    """Contacts, force and centre of random grasps by the grid and by the paper's method, against closed forms."""
    rows, skin, hand = [], Skin(margin=0.0), shipped_skin()
    count = 100 if quick else 1000
    for kind in ("sphere", "box", "cylinder"):
        shape = turned_solid(kind)
        pose = random_grasps(shape, count)

        def feel(geometry, pose=pose):
            def one(pose):
                touch = feel_links(hand, pose, geometry, jnp.zeros(3), jnp.eye(3), jnp.ones(5), skin)
                return touch.depth, *reduce_touch_links(touch.skin_force, hand, pose)

            run = jax.jit(jax.vmap(one))
            found = [np.asarray(x) for x in run(pose)]
            seconds = []
            for _ in range(3):
                start = time.perf_counter()
                jax.block_until_ready(run(pose))
                seconds.append(time.perf_counter() - start)
            return *found, 1e6 * min(seconds) / count

        found = {
            "closed form": feel(shape),
            "grid": feel(grid.bake(shape)),
            "points 1024": feel(surface_points.from_shape(shape)),
        }
        if not quick:
            found["points 4096"] = feel(surface_points.from_shape(shape, 4096))
        pairs = [("grid", "closed form")]
        pairs += [(name, "grid") for name in found if name.startswith("points")]
        for name, base in pairs:
            (depth, force, centre, cost), (depth_b, force_b, centre_b, _) = found[name], found[base]
            both = (force > 0) & (force_b > 0)
            apart = 1e3 * np.linalg.norm(centre - centre_b, axis=-1)[both]
            rows.append(
                {
                    "shape": kind,
                    "method": name,
                    "against": base,
                    "taxel_contacts_same_%": 100 * np.mean((depth > 0) == (depth_b > 0)),
                    "finger_contacts_same_%": 100 * np.mean((force > 0) == (force_b > 0)),
                    "force_diff_median_%": 100 * np.median(np.abs(force / np.where(both, force_b, 1) - 1)[both]),
                    "force_sum_diff_%": 100 * (force[both].sum() / force_b[both].sum() - 1),
                    "centre_diff_median_mm": np.median(apart),
                    "centre_diff_p95_mm": np.quantile(apart, 0.95),
                    "us_per_grasp": cost,
                }
            )
    return rows
