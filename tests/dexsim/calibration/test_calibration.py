"""Current to torque: robust lines against references, a motor of known truth, the file, what no hand gives."""

import dataclasses
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats

from dexsim.calibration import maps
from dexsim.calibration.fit import JointPress, calibrate, find_swings, fit_joint, fit_line
from dexsim.errors import CalibrationError

# --- lines -----------------------------------------------------------------------------------


def ar1(rng, count, rho):
    white = rng.standard_normal(count) * math.sqrt(1 - rho**2)
    white[0] /= math.sqrt(1 - rho**2)
    return scipy.signal.lfilter([1.0], [1.0, -rho], white)


def holds(line, gain, offset):
    return abs(line.gain - gain) <= line.gain_error, abs(line.offset - offset) <= line.offset_error


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_intervals_hold_the_truth(rho):
    """Recordings of 400 samples; autocorrelation at a rising force is the hard case. The value is least squares'."""
    rng, hits, off = np.random.default_rng(2), [], []
    x, one = np.linspace(0, 8, 400), np.zeros(400, int)
    for _ in range(60):
        y = 0.05 * x + 0.3 + 0.02 * ar1(rng, 400, rho)
        line, reference = fit_line(x, y, one), scipy.stats.linregress(x, y)
        hits.append(holds(line, 0.05, 0.3))
        off.append((line.gain - reference.slope) / reference.stderr)
    assert np.all(np.mean(hits, 0) >= 0.9)
    assert line.gain_error < 8 * reference.stderr  # that of independent errors
    assert np.std(off) < 0.4 and line.r_squared == pytest.approx(reference.rvalue**2, abs=0.01)


@pytest.mark.parametrize("kind", ["one-sided", "dropped"])
def test_gain_within_two_percent_at_five_percent_outliers(kind):
    """Outliers of up to 20 times the noise, all to one side, or reads of 0."""
    rng, x = np.random.default_rng(4), np.linspace(0.5, 8, 300)
    for _ in range(40):
        y = 0.05 * x + 0.02 + 0.01 * rng.standard_normal(300)
        bad = rng.permutation(300)[:15]
        y[bad] = 0.0 if kind == "dropped" else y[bad] + rng.uniform(0.05, 0.2, 15)
        assert fit_line(x, y, np.zeros(300, int)).gain == pytest.approx(0.05, rel=0.02)


def test_what_differs_between_presses_widens_the_intervals():
    number, gain = np.repeat(np.arange(4), 100), np.array([0.0485, 0.0495, 0.0505, 0.0515])
    force = np.tile(np.linspace(0, 8, 100), 4)
    value = gain[number] * force + 0.02 * np.random.default_rng(0).standard_normal(400)
    line, alone = fit_line(force, value, number), fit_line(force, value, 0 * number)
    # That of the mean of four gains.
    expected = scipy.stats.t.ppf(0.975, 3) * np.std(gain, ddof=1) / 2
    assert line.gain_error == pytest.approx(expected, rel=0.3) and line.gain_error > 1.5 * alone.gain_error


# --- a motor of known truth --------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Motor:
    """Nm/A, shares and A, of the joint; the reading is off by `bias` and has `noise`."""

    torque_constant: float
    efficiency: float = 1.0
    back_efficiency: float = 1.0
    no_load_current: float = 0.0
    ripple: float = 0.0
    ripple_phase: float = 0.0
    bias: float = 0.0
    noise: float = 0.0


MOTOR = Motor(
    torque_constant=0.9, efficiency=0.8, back_efficiency=0.7, no_load_current=0.02, ripple=0.02, bias=0.004, noise=0.004
)
LEVER = 0.06  # m


def recording(seed=0, motor=MOTOR, *, force_noise=0.03):
    """Press slowly, three times up and down, to 8 N while the joint yields by 0.05 rad, 300 ripples/rad; steps of 1 mA.

    Motoring, the motor must give torque / efficiency; driven back, only torque * back_efficiency holds it. On top comes
    the current that it draws without load, in the direction of motion.
    """
    rng, phase = np.random.default_rng(seed), np.arange(600) / 200 % 1.0
    share, way = 1.0 - np.abs(2.0 * phase - 1.0), np.where(phase < 0.5, 1.0, -1.0)  # up and down again
    force, loss = 8.0 * share, np.where(way > 0, 1.0 / motor.efficiency, motor.back_efficiency)
    ripple = 1.0 + motor.ripple * np.sin(300 * 0.05 * share + motor.ripple_phase)
    current = LEVER * force / (motor.torque_constant * ripple) * loss + motor.no_load_current * way
    current = np.round(current + motor.bias + motor.noise * rng.standard_normal(600), 3)
    return JointPress(np.maximum(force + force_noise * rng.standard_normal(600), 0.0), current)


def test_both_lines_of_a_motor_with_losses():
    """Loading: F lever / (K eta_f) + i0 + bias; unloading: F lever eta_b / K - i0 + bias."""
    hits, gain, offset = [], np.array([LEVER / (0.9 * 0.8), LEVER * 0.7 / 0.9]), np.array([0.024, -0.016])
    for seed in range(20):
        phase = seed * 2.399963  # rad, the ripple's place at the start differs from day to day
        data = recording(seed, dataclasses.replace(MOTOR, ripple_phase=phase))
        lines, _ = fit_joint(data, "A")
        np.testing.assert_allclose(lines.gain, gain, rtol=0.02)
        hits.append(np.abs([lines.gain - gain, lines.offset - offset]) <= [lines.gain_error, lines.offset_error])
        # Half the gap at the middle force: half of the difference of the lines there.
        assert lines.friction == pytest.approx(4.0 * (gain[0] - gain[1]) / 2 + 0.02, rel=0.05)
    assert np.all(np.sum(hits, 0) >= 18)
    # With one direction its line stands for both.
    one, notes = fit_joint(JointPress(data.force[:100], data.value[:100]), "A")
    np.testing.assert_allclose(one.gain, gain[0], rtol=0.03)
    assert one.gain_error[1] > 0.29 * gain[0] > one.gain_error[0] and np.isnan(one.friction)
    assert [note.partition(":")[0] for note in notes] == ["moved one way only", "fewer than 3 presses"]
    # What no sample shows is added in quadrature.
    wider, _ = fit_joint(dataclasses.replace(data, gain_error=0.3), "A")
    np.testing.assert_allclose(wider.gain_error, np.hypot(lines.gain_error, 0.3 * lines.gain))


def test_a_doubtful_line_is_noted():
    data = recording()
    bad = np.arange(len(data.value)) % 6 == 0
    for value, says in (
        (data.value + 0.5 * bad, r"^loading \(A\): \d+ of \d+ samples are outliers$"),
        (data.value + 0.15 * np.random.default_rng(0).standard_normal(len(bad)), "loading .*: hardly a line$"),
        (data.value + 0.3 * np.random.default_rng(0).standard_normal(len(bad)), "gain known to .* % only$"),
    ):
        _, notes = fit_joint(dataclasses.replace(data, value=value), "A")
        assert any(re.search(says, note) for note in notes), notes
    assert fit_joint(data, "A")[1] == []


def calibrated(hand, motor=MOTOR, names=None, **options):
    names = names or hand.joint_names
    real = {name: recording(k, motor) for k, name in enumerate(names)}
    ideal = Motor(torque_constant=1.0, noise=5e-4)  # torque read as a current at 1 Nm/A
    sim = {name: recording(100 + k, ideal, force_noise=0.0) for k, name in enumerate(names)}
    return calibrate(hand, real, sim, **options), real, sim


@pytest.fixture(scope="module")
def fitted(hand):
    return calibrated(hand)


def test_a_hand_that_counts_backwards(hand, fitted):
    """Currents negative while closing, as the XHand's: torques positive all the same."""
    calibration, real, sim = fitted
    turned = {name: JointPress(p.force, -p.value) for name, p in real.items()}
    other = calibrate(hand, turned, sim)
    current = jnp.linspace(0.05, 0.6, 12)
    np.testing.assert_allclose(maps.joint_torque(other, -current), maps.joint_torque(calibration, current), rtol=1e-4)


def test_taxel_counts_become_newtons(fitted):
    calibration = dataclasses.replace(fitted[0], force_per_count=np.array([0.1, 0.2, 0.1, 0.1, 0.3]))
    counts = np.arange(5)[:, None] + np.array([[-7, 0, 10]])
    expected = np.maximum(counts * calibration.force_per_count[:, None], 0)
    np.testing.assert_allclose(maps.taxel_force(calibration, counts), expected, rtol=1e-6)


def test_joints_without_a_recording_take_their_class(hand):
    some = ("thumb_bend", "thumb_rota2", "index_joint1", "index_joint2")
    calibration, *_ = calibrated(hand, names=some)
    strong, weak = [0, 4], [2, 5]
    for joint, name in enumerate(hand.joint_names):
        if name not in some:
            mates = strong if hand.torque_limit[joint] > 1 else weak
            np.testing.assert_allclose(calibration.real.gain[:, joint], calibration.real.gain[:, mates].mean(1))
            error = calibration.real.gain_error[:, joint]
            np.testing.assert_allclose(error, np.abs(calibration.real.gain[:, joint]))
            assert any(name in note and "not pressed" in note for note in calibration.notes)
    with pytest.raises(CalibrationError, match="thumb_rota2: no press of a joint of 0.4 Nm"):
        calibrated(hand, names=("thumb_bend",))
    with pytest.raises(CalibrationError, match="no joint 'elbow'"):
        calibrate(hand, {"elbow": recording()}, {})
    with pytest.raises(CalibrationError, match="calibration: thumb: force_per_count = 2: must be between"):
        calibrated(hand, names=some, force_per_count=2.0)  # What could not be read again is not made.


def test_a_class_of_both_signs_has_no_mean(hand):
    _, real, sim = calibrated(hand, names=("thumb_bend", "index_joint1", "index_joint2", "index_bend"))
    real["index_joint2"] = dataclasses.replace(real["index_joint2"], value=-real["index_joint2"].value)
    with pytest.raises(CalibrationError, match="gain signs differ on the hand between index_joint2 and index_bend"):
        calibrate(hand, real, sim)


def test_directions_of_a_noisy_triangle():
    rng = np.random.default_rng(5)
    phase = np.arange(600) / 600 * 3 % 1
    force = 8 * (1 - np.abs(2 * phase - 1)) + 0.1 * rng.standard_normal(600)
    force[rng.permutation(600)[:20]] = 0.0  # dropped reads
    direction, press = find_swings(force)
    assert np.mean(direction[direction != 0] == np.where(phase < 0.5, 1, -1)[direction != 0]) > 0.99
    assert 0.02 < np.mean(direction == 0) < 0.2
    assert np.mean(press == np.arange(600) // 200) > 0.99
    falling, one = find_swings(np.linspace(5, 0, 100))
    assert np.all(falling[15:-1] == -1) and not one.any()
    # A press begins where the force rises; half a press at the beginning is one of its own.
    triangle = 8 * (1 - np.abs(2 * (np.arange(600) / 200 % 1) - 1))
    number = find_swings(triangle[100:])[1]
    assert list(np.unique(number)) == [0, 1, 2] and number[90] == 0 and number[110] == 1


BAD = {
    "at least 20 samples": lambda f, v: (f[:10], v[:10]),
    "at least 20 samples of rising": lambda f, v: (f[:21], v[:21]),
    "one length": lambda f, v: (f[:-1], v),
    "not a number": lambda f, v: (np.where(np.arange(600) == 3, np.inf, f), v),
    "force stays between 4.* press": lambda f, v: (4 + 0.02 * f, v),
    "does not follow the force": lambda f, v: (f, 0.1 + np.random.default_rng(0).normal(0, 0.01, v.shape)),
    "value stays at its maximum .* saturated": lambda f, v: (f, np.minimum(v, 0.05)),
    "force stays at its maximum .* saturated": lambda f, v: (np.minimum(f, 2.0), v),
    "give A, not another unit or counts": lambda f, v: (f, 1000 * v),
    "give N, not another unit or counts": lambda f, v: (1000 * f, v),
    "check joint and finger names": lambda f, v: (f, v * np.where(np.arange(600) % 200 < 100, 1, -1)),
}


@pytest.mark.parametrize("says", BAD)
def test_bad_recordings_are_refused_in_one_line(says):
    data = recording()
    with pytest.raises(CalibrationError, match=f"^thumb_bend on the hand.*{says}") as error:
        fit_joint(JointPress(*BAD[says](data.force, data.value)), "A", where="thumb_bend on the hand")
    assert "\n" not in str(error.value)


# --- file ---------------------------------------------------------------------------------------


def refused(path, hand):
    """The one line that refuses a file."""
    with pytest.raises(CalibrationError) as caught:
        maps.load_calibration(path, hand)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and "\n" not in line and len(line) < len(str(path)) + 250
    return line.removeprefix(f"{path}: ")


def test_a_file_keeps_every_bit(hand, fitted, tmp_path):
    path = tmp_path / "policy" / "calibration.toml"
    original = dataclasses.replace(fitted[0], serial='left "Ä"\\3')
    maps.save_calibration(path, original)
    back = maps.load_calibration(path, hand)
    assert jax.tree.structure(back) == jax.tree.structure(original)
    for ours, theirs in zip(jax.tree.leaves(back), jax.tree.leaves(original), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_cut_anywhere_it_is_refused(hand, fitted, tmp_path):
    path = tmp_path / "c.toml"
    maps.save_calibration(path, fitted[0])
    whole = path.read_bytes()
    for length in [*range(0, len(whole) - 1, 397), *range(len(whole) - 10, len(whole) - 1)]:
        path.write_bytes(whole[:length])
        refused(path, hand)


# --- what no hand gives -----------------------------------------------------------------------


def side(gain, offset, largest):
    lines = (np.full((2, 12), v) for v in (gain, offset, 0.01, 0.01, 1.0))
    return maps.Side(*lines, *(np.full(12, v) for v in (0.02, largest, 8.0)))


@pytest.fixture(scope="module")
def sound(hand):
    """Like the XHand's: 0.8 Nm/A at levers of 4 cm."""
    return dataclasses.replace(
        maps.blank_calibration(hand),
        real=side(-0.05, 0.02, 0.5),
        sim=side(0.04, 0.001, 0.3),
        force_per_count=np.full(5, 0.1),
        force_per_torque=np.array([[12.0] * 5, [11.0] * 5, [13.0] * 5]),
    )


def changed(calibration, name, value):
    """With other numbers, such as "real.gain", of the first joint or finger."""
    part, _, field = name.rpartition(".")
    owner = getattr(calibration, part) if part else calibration
    numbers = np.array(getattr(owner, field))
    numbers[(..., 0) if numbers.ndim else ()] = value
    owner = dataclasses.replace(owner, **{field: numbers})
    return dataclasses.replace(calibration, **{part: owner}) if part else owner


WRONG = [
    ({"real.gain": -1e-9}, "thumb_bend: current of the full torque by real.gain = 2.75e-08"),
    ({"real.gain": [-0.05, 0.05]}, "thumb_bend: real.gain unloading over loading = -1: must be between"),
    ({"real.gain": np.nan}, "thumb_bend: real.gain"),
    ({"sim.gain": 1.0}, "thumb_bend: magnitude of sim.gain = 1: must .* 0.3 Nm/N"),
    ({"real.offset": 5.0}, "thumb_bend: share of the full torque without current"),
    ({"torque_scale": 0.9}, "thumb_bend: torque_scale over the hand's limit = 0.8182"),
    ({"force_per_count": 1e-9}, "thumb: force_per_count = 1e-09: must be between 0.001 and 1 N"),
    ({"force_per_torque": 0.5}, "thumb: force_per_torque = 0.5: .* N/Nm"),
    # Each line goes with the simulation's of its own direction, but not with the middle of both, which is used.
    (
        {"sim.gain": [0.0001, 0.3], "real.gain": [0.0029, 0.0085], "real.offset": [31.0, 0.03]},
        "thumb_bend: current of the full torque by real.gain = 0.02126",
    ),
    (
        {"sim.gain": [0.01, 0.19], "real.offset": [5.0, 0.02]},
        "thumb_bend: share of the full torque without current by real.offset = 9.09",
    ),
]


@pytest.mark.parametrize(("changes", "says"), WRONG)
def test_numbers_that_no_hand_gives_are_refused(hand, sound, tmp_path, changes, says):
    for name, value in changes.items():
        sound = changed(sound, name, value)
    maps.save_calibration(tmp_path / "c.toml", sound)
    assert re.search(says, refused(tmp_path / "c.toml", hand))


DAMAGED = [
    ("[-0.05,", f"[{10**400},", "damaged"),
    ("force_per_count = [", "force_per_count = [0.1, ", "force_per_count must hold 5 numbers"),
    ("friction = ", "fiction = ", "argument 'fiction'"),
    ("version = 4", "version = 1", "expected version 4, got 1"),
    ('"thumb_bend"', '"thumb_bent"', "not a calibration of this hand .*expected joint_names"),
    ("xhand_right", "x" * 5000, "expected hand 'xhand_right', got 'x+"),
]


@pytest.mark.parametrize(("old", "new", "says"), DAMAGED)
def test_a_damaged_file_is_refused(hand, sound, tmp_path, old, new, says):
    path = tmp_path / "c.toml"
    maps.save_calibration(path, sound)
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    assert re.search(says, refused(path, hand))
