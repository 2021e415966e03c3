"""The README's animation, `hand.gif`: two shipped policies, force and turns in large print, and the taxel maps.

python docs/images/hand.py
"""

import dataclasses
import functools
import io
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import dexsim
from dexsim.control import commanded_force
from dexsim.hand.description import Hand
from dexsim.hand.mjcf import hand_poses
from dexsim.render.panel import ACCENT, EMPTY, FAINT, INK, PANEL, force_color, taxel_image
from dexsim.render.picture import draw_scene, goal_position, look
from dexsim.render.render import CAMERAS
from dexsim.render.snapshot import Snapshot
from dexsim_ppo import load_policy

WORLDS = {"grasp": 6, "rotate": 3}  # of 16 episodes, a capsule and a cube
COMMANDS = (0.1, 0.9, 0.4)  # of the grasp, in equal parts of the time after the catch
SECONDS, CAUGHT, RATE = 8.0, 1.4, 10  # s, s, pictures a second
WIDTH, SCENE, HEADER, MAPS = 600, 350, 52, 138  # pixels of one half: width, then heights
CHART, CHART_FORCE = (18, 24, 218, 164), 6.0  # pixels in the scene; N of its full height
TITLE, LABEL = ImageFont.load_default(28), ImageFont.load_default(24)
VIEWS = {  # turned and nearer than the presets; the grasp's leaves room for the chart
    "grasp": dataclasses.replace(CAMERAS["grasp"], azimuth=118.0, distance=0.34, target=(0.05, 0.045, 0.10)),
    "rotate": dataclasses.replace(CAMERAS["rotate"], azimuth=80.0, distance=0.41),
}


def film(task: str, world: int, worlds: int = 16) -> Snapshot:
    """Snapshots [T] of one of several episodes of a shipped policy; the grasp's command changes in steps."""
    policy = load_policy(task)
    env = policy.make_env()
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    show = jax.jit(jax.vmap(functools.partial(dexsim.take_snapshot, env)))
    state, carry = reset(jax.random.split(jax.random.key(0), worlds)), policy.initial_carry(worlds)
    shots, fixed = [], np.ones(worlds, bool)  # the task itself changes no command
    for tick in range(round(SECONDS / env.control_period)):
        if hasattr(state.goal, "command"):
            part = (tick * env.control_period - CAUGHT) / (SECONDS - CAUGHT) * len(COMMANDS)
            command = np.full(worlds, COMMANDS[max(int(part), 0)], np.float32)
            state = dataclasses.replace(state, goal=dataclasses.replace(state.goal, command=command, fixed=fixed))
        carry, action = policy.act(carry, state.obs["actor"])
        state = step(state, action)
        shots.append(jax.device_get(jax.tree.map(lambda x: x[world], show(state))))
    frames = np.round(np.arange(0, SECONDS, 1 / RATE) / env.control_period).astype(int)
    return jax.tree.map(lambda *x: np.stack(x)[frames], *shots)


def half(hand: Hand, task: str, shots: Snapshot) -> list[Image.Image]:
    """Pictures [T]: a line of text, the scene, one map of taxels for each finger."""
    kinds, view = load_policy(task).make_env().primitive_kinds, VIEWS[task]
    poses = hand_poses(hand, shots.joint_position)
    top = float(np.quantile(shots.taxel_force[shots.taxel_force > 0], 0.99))
    measured = np.array([float(commanded_force(force, force > 0.01)) for force in shots.finger_force])
    pictures = []
    for t, pose in enumerate(poses):
        shot = jax.tree.map(lambda x, t=t: x[t], shots)
        picture = Image.new("RGB", (WIDTH, HEADER + SCENE + MAPS), PANEL)
        picture.paste(Image.fromarray(draw_scene(hand, kinds, shot, pose, view, (WIDTH, SCENE), top)), (0, HEADER))
        draw = ImageDraw.Draw(picture)
        if shot.turns is None:
            force = f"{shot.target_force:.1f} N", f"{measured[t]:.1f} N"
            title = [("Commanded ", FAINT), (force[0], INK), ("   measured ", FAINT), (force[1], ACCENT)]
            chart(draw, shots.target_force, measured, t)
        else:
            title = [("Quarter turns ", FAINT), (f"{int(shot.turns)}", ACCENT)]
            at = look(view, (WIDTH, SCENE)).project(goal_position(view))[0]
            draw.text((at[0], HEADER + at[1] + 44), "goal", fill=INK, font=LABEL, anchor="mm")
        x = 18.0
        for text, color in title:
            draw.text((x, HEADER // 2), text, fill=color, font=TITLE, anchor="lm")
            x += draw.textlength(text, TITLE)
        pitch = WIDTH // len(hand.finger_names)
        for f, name in enumerate(hand.finger_names):
            force = shot.taxel_force[f]
            colors = np.where(force[:, None] > 0, force_color(force, top), np.array(EMPTY, np.uint8))
            cells = Image.fromarray(taxel_image(colors, hand.taxel_grid)).resize((70, 84), Image.Resampling.NEAREST)
            picture.paste(cells, (pitch * f + (pitch - 70) // 2, HEADER + SCENE + 10))
            at = (pitch * f + pitch // 2, HEADER + SCENE + MAPS - 22)
            draw.text(at, name, fill=FAINT, font=LABEL, anchor="mm")
        pictures.append(picture)
    return pictures


def chart(draw: ImageDraw.ImageDraw, target: np.ndarray, measured: np.ndarray, now: int) -> None:
    """Force over time up to now: command and measurement [T] N in the colours of the title."""
    left, top, right, bottom = CHART
    for force in (0, 3, 6):
        y = HEADER + bottom - force / CHART_FORCE * (bottom - top)
        draw.line((left + 24, y, right, y), fill=FAINT)
        draw.text((left + 16, y), str(force), fill=FAINT, font=LABEL, anchor="rm")
    x = np.linspace(left + 24, right, len(target))
    for values, color in ((target, INK), (measured, ACCENT)):
        y = HEADER + bottom - np.clip(values / CHART_FORCE, 0, 1) * (bottom - top)
        draw.line([*zip(x[: now + 1].tolist(), y[: now + 1].tolist(), strict=True)], fill=color, width=3)


def join(left: list[Image.Image], right: list[Image.Image]) -> list[Image.Image]:
    """Two halves side by side, pictures [T]."""
    pictures = []
    for a, b in zip(left, right, strict=True):
        pictures.append(Image.new("RGB", (2 * WIDTH + 4, a.height), EMPTY))
        pictures[-1].paste(a, (0, 0))
        pictures[-1].paste(b, (WIDTH + 4, 0))
    return pictures


def write(pictures: list[Image.Image], path: Path) -> None:
    """An animated GIF with one palette, half of it by frequency, half by variety of colour."""
    some = np.concatenate([np.asarray(picture) for picture in pictures[:: len(pictures) // 6]])
    rare = np.unique(some.reshape(-1, 3) // 12, axis=0).astype(np.uint8) * 12 + 6
    colors: list[int] = []
    for pixels in (some, rare[None]):
        colors += (Image.fromarray(pixels).quantize(120, Image.Quantize.MEDIANCUT, kmeans=2).getpalette() or [])[:360]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    buffer = io.BytesIO()
    frames[0].save(buffer, "GIF", save_all=True, append_images=frames[1:], duration=1000 // RATE, loop=0, optimize=True)
    path.write_bytes(buffer.getvalue())


def main() -> None:
    hand = dexsim.load_hand()
    halves = (half(hand, task, film(task, world)) for task, world in WORLDS.items())
    write(join(*halves), Path(__file__).with_name("hand.gif"))


if __name__ == "__main__":
    main()
