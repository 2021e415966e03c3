"""Touch measured: accuracy against closed forms, and cost at thousands of environments.

    python benchmarks/touch.py                                     # both tables, on the device that JAX finds
    python benchmarks/touch.py --quick                             # a minute on a laptop
    python benchmarks/touch.py --tables cost --num-envs 32768 --step

Needs neither a physics engine nor a mesh file; only `--step` (the query's time over that of a full step of the grasp
task) and `--kinematics` load the hand's model. A step without touch is faster by more than that share: `throughput.py
--leave-out touch` measures it. Costs are medians over repeats of a compiled loop whose every turn moves the
objects; FLOPs and bytes are XLA's own count of one turn (of a loop's body, as in the points' scan and table, it counts
one round only); the floor is the longer of bytes at the memory bandwidth and FLOPs at the arithmetic rate that this
program measures on the same device.
"""

import argparse
import dataclasses
import functools
import json
import statistics
import time

import jax
import jax.numpy as jnp
import numpy as np
import touch_accuracy as accuracy

from dexsim.geometry import grid, sdf, surface_points
from dexsim.hand.kinematics import forward_kinematics, taxel_positions
from dexsim.touch.feel import feel, feel_links, spread
from dexsim.touch.reduce import reduce_touch, reduce_touch_links
from dexsim.touch.skin import Skin, skin_stress

SKIN = Skin()


def union() -> sdf.Shape:
    """Four primitives, one of each collision kind and a sphere."""
    size = jnp.array([[0.02, 0.02, 0.025], [0.012, 0.015, 0], [0.015, 0.03, 0], [0.02, 0, 0]])
    position = jnp.array([[0, 0, 0], [0, 0, 0.03], [0, 0.01, 0], [0.01, 0, -0.01]])
    return sdf.Shape(
        ("box", "capsule", "cylinder", "sphere"), size, position, jnp.tile(jnp.eye(3), (4, 1, 1)), jnp.ones(4, bool)
    )


def brute_distance(points: jax.Array, surface: surface_points.SurfacePoints) -> jax.Array:
    """The nearest of all points through one matrix of scores, as a first program would do it."""
    score = 0.5 * jnp.sum(surface.position**2, -1) - jnp.dot(points, surface.position.T, precision="highest")
    index = jnp.argmin(score, -1)
    return jnp.sum((points - surface.position[index]) * surface.normal[index], -1)


@dataclasses.dataclass(frozen=True)
class Case:
    """One line of the cost table: how an environment's object comes from its index, and how it is felt."""

    name: str
    geometry: object
    path: str = "links"  # or "taxels": positions in the palm frame first; or "brute"


def cases(names: list[str] | None) -> list[Case]:
    box = accuracy.turned_solid("box")
    points = surface_points.from_shape(box)
    makers = {
        "closed box": lambda n: Case(n, box),
        "closed box, palm frame": lambda n: Case(n, box, path="taxels"),
        "closed union of 4": lambda n: Case(n, union()),
        "grid float32": lambda n: Case(n, grid.bake(box)),
        "points 1024, scan": lambda n: Case(n, points),
        "points 1024, brute force": lambda n: Case(n, points, path="brute"),
    }
    return [make(name) for name, make in makers.items() if names is None or any(part in name for part in names)]


@functools.lru_cache(maxsize=1)
def box_grasps(num_envs: int):
    """Fingertips that press a box; every case of one size sees the same."""
    return accuracy.random_grasps(accuracy.turned_solid("box"), num_envs)


def reader(case: Case, hand, kinematics: bool):
    """`read(geometry, pose or joints, shift [3], index)` of one environment: taxel forces, finger forces, centres."""
    total = jnp.ones(5)

    def read(geometry, pose, shift, index):
        del index
        pose = forward_kinematics(hand, pose) if kinematics else pose
        if case.path == "links":
            touch = feel_links(hand, pose, geometry, shift, jnp.eye(3), total, SKIN)
            return touch.force, *reduce_touch_links(touch.force, hand, pose)
        taxels = taxel_positions(hand, pose)
        if case.path == "taxels":
            touch = feel(taxels, jnp.asarray(hand.taxel_area), geometry, shift, jnp.eye(3), total, SKIN)
            return touch.force, *reduce_touch(touch.force, taxels)
        depth = jnp.maximum(SKIN.margin - brute_distance(taxels - shift, geometry), 0.0)
        skin_force = skin_stress(depth / SKIN.thickness, SKIN) * hand.taxel_area
        force = spread(skin_force, total)
        return force, *reduce_touch(force, taxels)

    return read


def measure(case: Case, num_envs: int, loops: int, repeats: int, hand, machine: dict, kinematics: bool) -> dict:
    """Time, counts and the machine's floor of one case."""
    pose = box_grasps(num_envs)
    if kinematics:
        pose = jax.random.uniform(jax.random.key(0), (num_envs, hand.num_joints), minval=0.2, maxval=1.0)
    # With a model the fingers are where the joints put them: the object waits before the palm.
    base = jnp.array([0.075, -0.005, 0.13]) if kinematics else jnp.zeros(3)
    index = jnp.arange(num_envs, dtype=jnp.int32)
    read = jax.vmap(reader(case, hand, kinematics), (None, 0, 0, 0))

    def turn(carry, _, geometry, pose):
        shift, _ = carry
        force, finger, centre = read(geometry, pose, shift, index)
        # The next turn depends on this one; the taxel forces are kept, as a step of an environment keeps them.
        shift = base + 1e-4 * jnp.tanh(centre.sum(1)) + 1e-6 * finger[:, :3]
        return (shift, force), None

    def loop(geometry, pose, shift):
        force = jnp.zeros((num_envs, *hand.taxel_area.shape))
        return jax.lax.scan(lambda c, x: turn(c, x, geometry, pose), (shift, force), None, length=loops)[0]

    shift = jnp.tile(base, (num_envs, 1))
    run = jax.jit(loop)
    jax.block_until_ready(run(case.geometry, pose, shift))
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run(case.geometry, pose, shift))
        seconds.append((time.perf_counter() - start) / loops)
    once = jax.jit(read).lower(case.geometry, pose, shift, index).compile()
    counted = once.cost_analysis()
    counted = counted[0] if isinstance(counted, list) else counted
    flops, moved = float(counted.get("flops", 0)), float(counted.get("bytes accessed", 0))
    seconds_median = statistics.median(seconds)
    queries = num_envs * hand.taxel_area.size
    floor = max(moved / machine["bytes_per_s"], flops / machine["flops_per_s"])
    memory = once.memory_analysis()
    return {
        "case": case.name + (" + kinematics" if kinematics else ""),
        "num_envs": num_envs,
        "ms": 1e3 * seconds_median,
        "spread": (max(seconds) - min(seconds)) / seconds_median,
        "Gqueries_per_s": 1e-9 * queries / seconds_median,
        "GFLOP": 1e-9 * flops,
        "GB": 1e-9 * moved,
        "temp_MB": 1e-6 * memory.temp_size_in_bytes if memory else None,
        "bytes_per_query": moved / queries,
        "flops_per_query": flops / queries,
        "times_floor": seconds_median / floor if floor else None,
    }


def machine_limits() -> dict:
    """Memory bandwidth and arithmetic rate of this device, measured: a copy, and chains of multiply-adds."""
    large = 1 << (28 if jax.default_backend() == "gpu" else 24)

    def rate(run, x, work):
        jax.block_until_ready(run(x))
        best = min(_seconds(run, x) for _ in range(5))
        return work / best

    ones = jnp.ones(large, jnp.float32)
    moved = rate(jax.jit(lambda x: x + 1), ones, 8 * large)

    def chain(x):
        for _ in range(512):
            x = x * 1.0001 + 0.5
        return x

    count = large // 16
    return {"bytes_per_s": moved, "flops_per_s": rate(jax.jit(chain), ones[:count], 1024 * count)}


def _seconds(run, x) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run(x))
    return time.perf_counter() - start


def full_step(num_envs: int) -> float:
    """Milliseconds of a step of the grasp task, touch included."""
    import throughput

    env = throughput.make("grasp", "full", "auto", num_envs)
    return throughput.measure(env, num_envs, steps=8, repeats=3)["ms_per_step"]


def show(title: str, rows: list[dict], file) -> None:
    """A table for people, and a JSON line per row in `file`."""
    print(f"\n{title}")
    if rows:

        def text(value):
            if value is None:
                return "-"
            if isinstance(value, (bool, np.bool_)):
                return "yes" if value else "NO"
            return f"{value:.4g}" if isinstance(value, (float, np.floating)) else str(value)

        keys = list(rows[0])
        lines = [keys] + [[text(row[key]) for key in keys] for row in rows]
        width = [max(len(line[k]) for line in lines) for k in range(len(keys))]
        for line in lines:
            print("  ".join(cell.ljust(w) for cell, w in zip(line, width, strict=True)), flush=True)
    for row in rows if file else ():
        plain = {key: value.item() if isinstance(value, np.generic) else value for key, value in row.items()}
        print(json.dumps({"table": title, **plain}), file=file, flush=True)


def costs(options, hand, file) -> None:
    machine = machine_limits()
    print(f"\nmachine: {1e-9 * machine['bytes_per_s']:.0f} GB/s, {1e-12 * machine['flops_per_s']:.2f} TFLOP/s measured")
    for num_envs in options.num_envs:
        rows, step = [], full_step(num_envs) if options.step else options.step_ms
        for case in cases(options.cases):
            if case.path == "brute" and num_envs * 600 * 1024 * 4 > options.brute_gb * 1e9:
                continue
            row = measure(case, num_envs, options.loops, options.repeats, hand, machine, options.kinematics)
            row["share_of_step_%"] = 100 * row["ms"] / step if step else None
            rows.append(row)
        by = {row["case"]: row["ms"] for row in rows}
        show(f"cost, {num_envs} environments x 600 taxels" + (f", step {step:.2f} ms" if step else ""), rows, file)
        for top, bottom in (("points 1024, brute force", "points 1024, scan"),):
            suffix = " + kinematics" if options.kinematics else ""
            if top + suffix in by and bottom + suffix in by:
                print(f"  {top} / {bottom}: {by[top + suffix] / by[bottom + suffix]:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", nargs="+", default=["accuracy", "cost"], choices=["accuracy", "cost"])
    parser.add_argument("--num-envs", nargs="+", type=int, default=None)
    parser.add_argument("--cases", nargs="+", default=None, help="parts of the names of cost cases")
    parser.add_argument("--loops", type=int, default=None, help="turns of the compiled loop")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--kinematics", action="store_true", help="start from joint angles (reads the hand's model)")
    parser.add_argument("--step", action="store_true", help="measure a full step of the grasp task for its share")
    parser.add_argument("--step-ms", type=float, default=None, help="milliseconds of a full step, if known")
    parser.add_argument("--brute-gb", type=float, default=None, help="largest matrix that brute force may make")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", default=None, help="also write the rows here, one JSON object a line")
    options = parser.parse_args()
    gpu = jax.default_backend() == "gpu"
    options.num_envs = options.num_envs or ([4096, 8192, 32768] if gpu else [64] if options.quick else [256])
    options.loops = options.loops or (50 if gpu else 2 if options.quick else 5)
    options.brute_gb = options.brute_gb or (45.0 if gpu else 1.0)
    device = jax.devices()[0]
    print(f"{device.device_kind}, JAX {jax.__version__}, seeds fixed")
    file = open(options.json, "w") if options.json else None
    if "accuracy" in options.tables:
        show("distance to exact shapes, -3 to +1 mm round the surface", accuracy.distance_errors(options.quick), file)
        show("force on a flat pad against Winkler's foundation, 200 phases", accuracy.forces(options.quick), file)
        show("closed forms", accuracy.checks(), file)
        show("random grasps", accuracy.grasps(options.quick), file)
    if "cost" in options.tables:
        if options.kinematics:
            from dexsim.hand.load import load_hand

            hand = load_hand()
        else:
            hand = accuracy.shipped_skin()
        costs(options, hand, file)
    if file:
        file.close()


if __name__ == "__main__":
    main()
