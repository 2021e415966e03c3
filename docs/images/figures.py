"""Every picture of the documentation that the code makes: `make figures`.

README's animation, films of the shipped policies, the live view, and the figures of the results. Figures of results are
drawn from the reports in docs/results. Learning curves are kept as they were measured, copied from the run that a
policy is of.

python docs/images/figures.py [NAME ...]
"""

import dataclasses
import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dexsim
from dexsim.core import cli
from dexsim.core.config import from_dict, override
from dexsim.render.render import render_frame
from dexsim_ppo import evaluate, load_policy, record

ROOT = Path(__file__).resolve().parents[2]
IMAGES, RESULTS = ROOT / "docs" / "images", ROOT / "docs" / "results"
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "tests" / "support")]  # `paper`; the bench of the presses
FILMS: dict[str, tuple[Any, ...]] = {  # policy, s of each episode, and settings of the task
    "grasp": ("grasp", 8),
    "rotate": ("rotate", 20),
    "rotate_without_orientation": ("rotate_without_orientation", 20),
    "rotate_any": (
        *("rotate_without_orientation", 20, "edge=[0.045,0.065]", "proportions=[0.9,1.1]"),
        "randomization.gravity_tilt=0.4",  # Boxes alone: nobody sees a cylinder turn.
    ),
    "rotate_clear": ("rotate_clear", 10),
}


def animation() -> None:
    """hand.gif."""
    import hand

    hand.main()


def films() -> None:
    """A film of each shipped policy, and one of `rotate_any`'s objects."""
    for name, (policy, seconds, *settings) in FILMS.items():
        print(f"film of {name}", flush=True)
        options = ["--episodes", "64", "--no-baseline", "--seconds", f"{seconds}", "--set", *settings]
        evaluate.main([policy, *options, "--video", str(IMAGES / f"{name}.mp4")])


def episodes() -> None:
    """What `dexsim demo` shows where there is no JAX."""
    rows = ("grasp", 4, 0), ("rotate", 2, 0), ("rotate_without_orientation", 2, 0)
    for name, count, seed in (*rows, ("rotate_clear", 2, 2)):  # the first two starts of seed 0 fall at once
        file = ROOT / "assets" / "episodes" / f"{name}.npz"
        record.main([name, "--npz", str(file), "--episodes", str(count), "--seed", str(seed)])


def view() -> None:
    """view.png: the page of recorded episodes, in a headless Chromium."""
    from playwright.sync_api import sync_playwright

    episodes = str(ROOT / "assets" / "episodes" / "grasp.npz")
    page_server = subprocess.Popen([sys.executable, "-m", "dexsim.view", episodes, "--port", "8093"])
    try:
        time.sleep(8)
        with sync_playwright() as chromium:
            options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = chromium.chromium.launch(executable_path="/usr/bin/chromium", args=options)
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.set_default_timeout(300_000)
            page.goto("http://127.0.0.1:8093")
            time.sleep(20)
            page.get_by_role("checkbox").first.click()  # Paused: without a GPU a moving page is never drawn whole.
            for close in page.locator(".mantine-Notification-closeButton").all():
                close.click()
            time.sleep(10)
            page.screenshot(path=str(IMAGES / "view.png"))
            browser.close()
    finally:
        page_server.terminate()
        page_server.wait()


def tables() -> None:
    """The figures of the paper's tables."""
    from paper.command import reports_of
    from paper.experiments import EXPERIMENTS

    for experiment in EXPERIMENTS.values():
        reports = reports_of(experiment, RESULTS)
        if experiment.draw and reports:
            experiment.draw(experiment, reports, RESULTS / experiment.name)


def robustness() -> None:
    """Rotation over one parameter at a time: measured points, training's range, and the value within it."""
    from paper import figures
    from paper.command import reports_of
    from paper.experiments import EXPERIMENTS

    experiment = EXPERIMENTS["robustness"]
    reports = reports_of(experiment, RESULTS)
    rows = [row for row in experiment.rows if row.skill == "rotate" and row.points and row.name in reports]
    if not rows:
        print("robustness: no reports of the shipped rotation; python benchmarks/paper.py robustness makes them")
        return
    figure, axes = figures._subplots(5, 2.3, 2.1, -(-len(rows) // 5))
    for axis in axes.ravel()[len(rows) :]:
        axis.axis("off")
    reference = next(_points(reports["rotate_reference"]))
    for axis, row in zip(axes.ravel(), rows, strict=False):
        points = np.array(list(_points(reports[row.name])))
        off = np.abs(points[:, 2:].T - points[:, 1])
        axis.errorbar(
            points[:, 0], points[:, 1], off, fmt="o", ms=3, capsize=2, color=figures.COLORS[0], label="measured"
        )
        axis.axhline(reference[1], ls=":", color="0.5", lw=1, label="within all training ranges")
        axis.axhspan(reference[2], reference[3], color="0.5", alpha=0.12, lw=0)
        axis.set_xlabel(row.label.partition(": ")[2], fontsize=8)
        axis.tick_params(labelsize=7)
        axis.set_ylim(0, 1.05 * max(points[:, 3].max(), reference[3]))
    for axis in axes[:, 0]:
        axis.set_ylabel("quarter turns a minute", fontsize=8)
    axes[0, 0].legend(fontsize=6, frameon=False, loc="lower left")
    figures._save(figure, RESULTS / "figures" / "robustness_rotate.svg")


def _points(report: dict[str, Any]) -> Iterator[tuple[float, float, float, float]]:
    """Value of the parameter, quarter turns a minute, and their interval."""
    for point in (point for seed in report["seeds"].values() for point in seed["points"]):
        pace, value = point["successes_per_minute"], point["point"]
        yield np.nan if value is None else value, pace["mean"], pace["low"], pace["high"]


def skin() -> None:
    """Stress over compression: the law, taxels under a flat face, and named silicones."""
    from paper import figures

    from dexsim.geometry import sdf
    from dexsim.hand.kinematics import forward_kinematics, taxel_positions
    from dexsim.touch.skin import MATERIALS, Skin, skin_of, skin_stress
    from dexsim.touch.taxel_force import compute_touch

    hand, law = dexsim.load_hand(), Skin()
    pose = forward_kinematics(hand, jnp.zeros(hand.num_joints))
    taxels = np.asarray(taxel_positions(hand, pose))
    face = sdf.Shape(("box",), jnp.full((1, 3), 0.1), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.ones(1, bool))
    foremost, measured = int(np.argmax(taxels[1, :, 0])), []
    for depth in np.linspace(0.0001, 0.69, 24) * law.thickness:
        # The face's plane is `depth` into the rubber over the foremost taxel of the index finger.
        height = taxels[1, :, 0].max() + law.margin - depth + 0.1
        place = jnp.array([height, *taxels[1, :, 1:].mean(0)], jnp.float32)
        touch = compute_touch(hand, pose, face, place, jnp.eye(3), jnp.ones(hand.num_fingers), law)
        stress = touch.skin_force[1, foremost] / np.broadcast_to(hand.taxel_area, taxels.shape[:2])[1, foremost]
        measured.append((touch.depth[1, foremost] / law.thickness, stress))
    strain = np.linspace(0.0, law.max_compression, 36)
    figure, (left, right) = figures._subplots(2, 4.2, 3.2)
    left.plot(100 * strain, 1e-3 * np.asarray(skin_stress(strain, law)), color=figures.COLORS[0], label="Mooney–Rivlin")
    linear = dataclasses.replace(law, law="linear")
    left.plot(100 * strain, 1e-3 * np.asarray(skin_stress(strain, linear)), "--", color="0.5", label="linear")
    points = np.array(measured) * [100, 1e-3]
    left.plot(points[:, 0], points[:, 1], "o", ms=3, color=figures.COLORS[1], label="taxel under a flat face")
    for color, name in zip(figures.COLORS, MATERIALS, strict=False):
        stress = 1e-3 * np.asarray(skin_stress(strain, skin_of(name)))
        right.plot(100 * strain[1:], stress[1:], color=color, label=name.replace("_", " "))
    right.set_yscale("log")
    for axis, title in ((left, "the hand's skin"), (right, "silicones")):
        axis.set(xlabel="compression [%]", ylabel="stress [kPa]", title=title)
        axis.legend(fontsize=7, frameon=False)
    figures._save(figure, RESULTS / "figures" / "stress_strain.svg")


def calibration() -> None:
    """Currents and torques of the index finger's presses on the emulated hand."""
    from calibrating import operator
    from press_plant import PressBench

    from dexsim.calibration.maps import load_calibration, torque_constants
    from dexsim_real.calibrate.__main__ import fit_and_report, record
    from dexsim_real.calibrate.bench import CalibrateArguments
    from dexsim_real.twin.virtual import VirtualPort

    hand = dexsim.load_hand()
    with tempfile.TemporaryDirectory() as folder:
        bench = PressBench(hand, 0, kind="inside")
        port = VirtualPort(bench)
        options = CalibrateArguments(
            port="bench",
            output=Path(folder) / "hand.toml",
            log=Path(folder) / "press.log",
            plot=RESULTS / "figures" / "calibration.svg",
            yes=True,
            realtime=False,
            fingers=("index",),
            sides=False,
        )
        log = record(options, hand, operator(), port=port, clock=port.clock, sleep=port.sleep)
        fit_and_report(options, hand, [log], operator())
        constants = np.abs(torque_constants(load_calibration(options.output, hand))[0].mean(0))
    truth = bench.truth()
    for name in ("index_joint1", "index_joint2"):
        joint = hand.joint_names.index(name)
        true = np.mean([truth[f"{way}_nm_per_a"][joint] for way in ("loading", "unloading")])
        print(f"{name}: torque constant off by {constants[joint] / true - 1:+.1%}")


def contacts() -> None:
    """Contact centres on the taxel lattice and forces of the fingers while the shipped policy rotates, in simulation
    (8 episodes of 30 s) and on the emulated hand (2 trials of 30 s)."""
    from paper import figures

    from dexsim_real.control.controller import Controller
    from dexsim_real.twin.plant.emulated_hand import EmulatedHand
    from dexsim_real.twin.virtual import VirtualRun

    policy, hand, seconds, measured = load_policy("rotate"), dexsim.load_hand(), 30.0, list[np.ndarray]()
    controller = Controller(policy, hand)
    for trial in range(2):
        run = VirtualRun(EmulatedHand(hand, "rotate", seconds=seconds, trials=1, first=trial), controller)
        measured += [tick.readings.taxel_force for _, tick in run.ticking()]
    settings = override(policy.env_config, ["pool_size=64", "trap=0"])
    env = dataclasses.replace(policy, env_config=settings).make_env()
    evaluation = dexsim.Evaluation(env)
    state = evaluation.evaluation_starts(evaluation.evaluation_plan(8, 0))
    step, carry, alive, simulated = jax.jit(jax.vmap(env.step)), policy.initial_carry(8), np.ones(8, bool), []
    for _ in range(round(seconds / env.control_period)):
        carry, action = policy.act(carry, state.obs["actor"])
        state = step(state, action)
        alive &= ~np.asarray(state.terminated)
        simulated.append(np.asarray(state.readings.taxel_force)[alive])

    figure, axes = figures._subplots(hand.num_fingers, 2.0, 2.4, 2)
    worlds = {"simulation": np.concatenate(simulated), "emulated hand": np.array(measured)}
    lattice = np.indices(hand.taxel_grid).reshape(2, -1).T  # column, row
    for color, (name, taxels) in zip(figures.COLORS, worlds.items(), strict=False):
        for finger, title in enumerate(hand.finger_names):
            force = taxels[:, finger].sum(1)
            touching, (above, below) = force > 0.5, axes[:, finger]
            centre = taxels[touching, finger] @ lattice / force[touching, None]
            above.plot(*centre.T, ".", ms=2, alpha=0.2, color=color, label=name, rasterized=True)
            above.set(title=title, xlim=(-0.7, 9.7), ylim=(-0.7, 11.7), xlabel="column", aspect="equal")
            share = np.full(touching.sum(), 1 / len(taxels))
            below.hist(force[touching], np.arange(0.5, 16), weights=share, histtype="step", color=color, label=name)
            below.set_xlabel("force on the taxels [N]")
            print(f"{name}, {title}: touches {touching.mean():.1%}, {force[touching].mean():.1f} N")
    axes[0, 0].set_ylabel("row (tip at the top)")
    axes[1, 0].set_ylabel("share of the time")
    axes[1, -1].legend(fontsize=7, frameon=False)
    figures._save(figure, RESULTS / "figures" / "contacts.svg")


def objects() -> None:
    """objects.jpg: each object that no training has seen, in the hand after 6 s of the middle command."""
    from paper.held_out import NAMES, HeldOutGrasp
    from paper.measure import HELD_OUT_POOL
    from PIL import Image, ImageDraw

    from dexsim.env.env import Env

    policy, hand = load_policy("grasp"), dexsim.load_hand()
    config = from_dict(dexsim.GraspConfig, override(policy.env_config, [f"pool_size={HELD_OUT_POOL}"]))
    env = Env(HeldOutGrasp(config, hand, NAMES), hand, backend="auto")
    evaluation = dexsim.Evaluation(env)
    plan = evaluation.evaluation_plan(5 * len(NAMES), 0)
    chosen = 5 * np.arange(len(NAMES)) + 2
    state = evaluation.evaluation_starts(jax.tree.map(lambda x: x[chosen], plan))
    step, carry = jax.jit(jax.vmap(env.step)), policy.initial_carry(len(NAMES))
    for _ in range(round(6.0 / env.control_period)):
        carry, action = policy.act(carry, state.obs["actor"])
        state = step(state, action)
    shots = jax.device_get(jax.vmap(evaluation.snapshot)(state))
    width, height, columns = 252, 240, 6
    sheet = Image.new("RGB", (columns * width, -(-len(NAMES) // columns) * height), "white")
    for k, name in enumerate(NAMES):
        shot = jax.tree.map(lambda x, k=k: x[k], shots)
        picture = render_frame(hand, env.task.slots, shot, size=(width + height // 2, height))[:, :width]
        tile = Image.fromarray(np.ascontiguousarray(picture))
        ImageDraw.Draw(tile).text((8, 6), name.replace("_", " "), fill="white")
        sheet.paste(tile, (k % columns * width, k // columns * height))
    buffer = io.BytesIO()
    sheet.save(buffer, "JPEG", quality=82)
    (RESULTS / "figures" / "objects.jpg").write_bytes(buffer.getvalue())


MAKERS = {
    maker.__name__: maker
    for maker in (tables, robustness, skin, calibration, contacts, objects, view, animation, films, episodes)
}


def main() -> None:
    cli.enable_caches()
    for name in sys.argv[1:] or MAKERS:
        print(f"figures: {name}", flush=True)
        MAKERS[name]()


if __name__ == "__main__":
    main()
