"""What the hand measures, by the names of its joints and fingers: two tables for a terminal of 100 columns."""

import dataclasses

import numpy as np
from rich import box
from rich.table import Table

from dexsim.hand.kinematics import Hand
from dexsim_real.sensors.hand import HandMeasurement

_BOARDS = ("palm", "joint", "tip")


@dataclasses.dataclass(frozen=True)
class HandState:
    """What the view shows of the hand."""

    hand: Hand
    measured: HandMeasurement
    target: np.ndarray | None  # [J] rad, the newest joint targets; None before the first
    sent: bool  # whether the motors follow them


def error_text(registers: np.ndarray) -> str:
    """The error registers [3] of a joint: those of its boards that are not zero."""
    errors = [f"{board} 0x{int(bits):04x}" for board, bits in zip(_BOARDS, registers, strict=True) if bits]
    return ", ".join(errors) or "-"


def hand_tables(state: HandState) -> Table:
    """Joints on the left, with the error registers of their boards; fingertips on the right."""
    both = Table.grid(padding=(0, 3))
    both.add_row(_joints(state), _fingers(state))
    return both


def hand_line(state: HandState) -> dict[str, str]:
    """The same in a few words, name to text, for an output without a terminal."""
    hand, measured = state.hand, state.measured
    joints, tips, palm = _heat(state)
    force, hottest, tip = measured.finger_force, int(joints.argmax()), int(tips.argmax())
    pairs = ", ".join(f"{name} {value:.1f}" for name, value in zip(hand.finger_names, force, strict=True))
    errors = [
        f"{name} {error_text(registers)}"
        for name, registers in zip(hand.joint_names, measured.errors, strict=True)
        if np.any(registers)
    ]
    return {
        "angles": " ".join(f"{angle:.2f}" for angle in measured.joint_position) + " rad",
        "force": f"{pairs} N, sum {force.sum():.1f} N",
        "heat": f"{hand.joint_names[hottest]} {joints[hottest]:.0f}, tip of the {hand.finger_names[tip]} "
        f"{tips[tip]:.0f}, palm {palm:.0f} degC",
        "errors": "; ".join(errors) or "none",
    }


def _joints(state: HandState) -> Table:
    hand, measured = state.hand, state.measured
    boards = ("errors: palm", *_BOARDS[1:])
    table = _table(["joint (rad)", "measured", "target" if state.sent else "(not sent)", "A", "degC", *boards])
    heat = _heat(state)[0]
    for joint, name in enumerate(hand.joint_names):
        asked = "-" if state.target is None else f"{state.target[joint]:.3f}"
        table.add_row(
            f"{joint:2d} {name}",
            f"{measured.joint_position[joint]:.3f}",
            asked,
            f"{measured.current[joint]:.2f}",
            f"{heat[joint]:.0f}",
            *(f"{bits:04x}" if bits else "-" for bits in measured.errors[joint]),
        )
    return table


def _fingers(state: HandState) -> Table:
    table = _table(["finger", "N", "degC"])
    force, (_, heat, palm) = state.measured.finger_force, _heat(state)
    for finger, name in enumerate(state.hand.finger_names):
        table.add_row(name, f"{force[finger]:.1f}", f"{heat[finger]:.0f}")
    table.add_row("sum", f"{force.sum():.1f}", "")
    table.add_row("palm board", "", f"{palm:.0f}")
    return table


def _heat(state: HandState) -> tuple[np.ndarray, np.ndarray, float]:
    """Temperatures degC of the joint boards, of the fingertips and of the palm board."""
    heat, joints = state.measured.temperature, state.hand.num_joints
    return heat[:joints], heat[joints:-1], float(heat[-1])


def _table(columns: list[str]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), collapse_padding=True, pad_edge=False, show_edge=False)
    for number, name in enumerate(columns):
        table.add_column(name, justify="right" if number else "left", no_wrap=True)
    return table
