"""Current to torque: robust lines against references, a motor of known truth, the file, refusals."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from virtual_press import press, varied_presses

from dexsim.actuator.current import Motor
from dexsim.calibration.fit import calibrate
from dexsim.calibration.joint import JointPress, find_direction, find_presses, fit_joint
from dexsim.calibration.line import fit_line
from dexsim.calibration.maps import (
    alignment,
    joint_torque,
    load_calibration,
    normalise,
    save_calibration,
    taxel_force,
)
from dexsim.calibration.plot import plot_calibration
from dexsim.calibration.press import lever_arms
from dexsim.core.errors import CalibrationError

# --- lines -----------------------------------------------------------------------------------


def ar1(rng, count, rho):
    white = rng.standard_normal(count) * math.sqrt(1 - rho**2)
    white[0] /= math.sqrt(1 - rho**2)
    return scipy.signal.lfilter([1.0], [1.0, -rho], white)


def holds(interval, truth):
    return interval[0] <= truth <= interval[1]


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_intervals_hold_the_truth(rho):
    """Recordings of 400 samples; autocorrelation at a rising force is the hard case. The value is least squares'."""
    rng, hits, off = np.random.default_rng(2), np.zeros(2), []
    x = np.linspace(0, 8, 400)
    for _ in range(200):
        y = 0.05 * x + 0.3 + 0.02 * ar1(rng, 400, rho)
        line, reference = fit_line(x, y), scipy.stats.linregress(x, y)
        hits += holds(line.gain_interval, 0.05), holds(line.offset_interval, 0.3)
        off.append((line.gain - reference.slope) / reference.stderr)
    assert np.all(hits / 200 >= 0.9) and np.all(hits / 200 <= 0.985)
    assert np.std(off) < 0.4 and line.r_squared == pytest.approx(reference.rvalue**2, abs=0.01)


@pytest.mark.parametrize("kind", ["random", "one-sided", "dropped"])
def test_gain_within_two_percent_at_five_percent_outliers(kind):
    """100 recordings each; outliers of up to 20 times the noise, all to one side, or reads of 0."""
    rng, worst = np.random.default_rng(4), 0.0
    x = np.linspace(0.5, 8, 300)
    for _ in range(100):
        y = 0.05 * x + 0.02 + 0.01 * rng.standard_normal(300)
        bad = rng.permutation(300)[:15]
        if kind == "dropped":
            y[bad] = 0.0
        else:
            spike = rng.uniform(0.05, 0.2, 15)
            y[bad] += spike if kind == "one-sided" else spike * rng.choice([-1, 1], 15)
        worst = max(worst, abs(fit_line(x, y).gain / 0.05 - 1))
    assert worst < 0.02


def test_intervals_hold_the_truth_where_presses_differ():
    hits = np.zeros(2)
    for seed in range(100):
        force, value = varied_presses(np.random.default_rng(seed), gain=0.05, offset=0.02)
        line = fit_line(force, value, find_presses(force))
        hits += holds(line.gain_interval, 0.05), holds(line.offset_interval, 0.02)
        plain = fit_line(force, value)
    assert np.all(hits >= 88) and plain.gain_share < line.gain_share
    # What no sample shows is added in quadrature.
    assert line.widened(0.3).gain_share == pytest.approx(np.hypot(line.gain_share, 0.3))
    assert line.widened(0.3).offset_interval == line.offset_interval


# --- a motor of known truth --------------------------------------------------------------------

MOTOR = Motor(
    torque_constant=0.9,
    efficiency=0.8,
    back_efficiency=0.7,
    no_load_current=0.02,
    ripple=0.02,
    ripple_count=300.0,
    bias=0.004,
    noise=0.004,
    resolution=0.001,
)
LEVER = 0.06


def recording(seed=0, motor=MOTOR, **options):
    options = {"lever": LEVER, "force_noise": 0.03, **options}
    return press(motor, jax.random.key(seed), **options)


def test_both_lines_of_a_motor_with_losses():
    """Loading: F lever / (K eta_f) + i0 + bias; unloading: F lever eta_b / K - i0 + bias."""
    hits, runs = np.zeros(4), 60
    for seed in range(runs):
        phase = seed * 2.399963  # rad, the ripple's place at the start differs from day to day
        fit = fit_joint(recording(seed, dataclasses.replace(MOTOR, ripple_phase=phase)), "A")
        truth = {"loading": (LEVER / (0.9 * 0.8), 0.024), "unloading": (LEVER * 0.7 / 0.9, -0.016)}
        for k, name in enumerate(truth):
            line, (gain, offset) = getattr(fit, name), truth[name]
            assert line.gain == pytest.approx(gain, rel=0.02)
            hits[2 * k] += line.gain_interval[0] <= gain <= line.gain_interval[1]
            hits[2 * k + 1] += line.offset_interval[0] <= offset <= line.offset_interval[1]
        # Half the gap at the middle force: half of the difference of the lines there.
        gap = 4.0 * (truth["loading"][0] - truth["unloading"][0]) / 2 + 0.02
        assert fit.friction == pytest.approx(gap, rel=0.05)
    assert np.all(hits >= 0.9 * runs), hits


def calibrated(hand, motor=MOTOR, names=None, **options):
    names = names or hand.joint_names
    real = {name: recording(k, motor) for k, name in enumerate(names)}
    ideal = Motor(torque_constant=1.0, noise=5e-4)  # torque read as a current at 1 Nm/A
    sim = {name: recording(100 + k, ideal, force_noise=0.0) for k, name in enumerate(names)}
    return calibrate(hand, real, sim, created="2026-01-01", **options), real, sim


@pytest.fixture(scope="module")
def fitted(hand):
    return calibrated(hand)


def test_a_hand_that_counts_backwards(hand, fitted):
    """Currents negative while closing, as the XHand's: torques positive all the same."""
    calibration, real, sim = fitted
    turned = {name: JointPress(p.force, -p.value) for name, p in real.items()}
    other = calibrate(hand, turned, sim)
    current = jnp.linspace(0.05, 0.6, 12)
    np.testing.assert_allclose(joint_torque(other, -current), joint_torque(calibration, current), rtol=1e-4)
    force, value = normalise(other.real, 0, turned["thumb_bend"].force, turned["thumb_bend"].value)
    for axis in (force, value):  # the paper's [0, 1]
        assert axis.max() == pytest.approx(1.0, abs=0.02) and axis.min() > -0.1


def test_taxel_counts_become_newtons(fitted):
    calibration = dataclasses.replace(fitted[0], force_per_count=np.array([0.1, 0.2, 0.1, 0.1, 0.3]))
    counts = np.arange(5)[:, None] + np.array([[-7, 0, 10]])
    expected = np.maximum(counts * calibration.force_per_count[:, None], 0)
    np.testing.assert_allclose(taxel_force(calibration, counts), expected, rtol=1e-6)


def test_alignment_tells_where_the_papers_maxima_mislead(hand):
    """Pressed twice as hard in simulation: with proportional lines the maxima still align; with an
    offset of a quarter of the maximum they do not, by that share."""
    plain = Motor(torque_constant=1.0)
    biased = Motor(torque_constant=1.0, bias=LEVER * 8.0 / 3)
    sim = {n: recording(0, plain, peak=16.0, force_noise=0.0) for n in hand.joint_names}
    for motor, ratio in ((plain, 1.0), (biased, 0.75)):
        real = {n: recording(0, motor, force_noise=0.0) for n in hand.joint_names}
        calibration = calibrate(hand, real, sim)
        np.testing.assert_allclose(alignment(calibration), ratio, rtol=0.01)
        assert any("maxima" in note for note in calibration.notes) == (ratio != 1.0)


def test_joints_without_a_recording_take_their_class(hand):
    some = ("thumb_bend", "thumb_rota2", "index_joint1", "index_joint2")
    calibration, *_ = calibrated(hand, names=some)
    strong, weak = [0, 4], [2, 5]
    for joint, name in enumerate(hand.joint_names):
        if name not in some:
            mates = strong if hand.torque_limit[joint] > 1 else weak
            np.testing.assert_allclose(calibration.real.gain[:, joint], calibration.real.gain[:, mates].mean(1))
            assert np.all(calibration.real.samples[:, joint] == 0)
            assert any(note.startswith(f"{name}: not recorded") for note in calibration.notes)
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
    direction = find_direction(force)
    assert np.mean(direction[direction != 0] == np.where(phase < 0.5, 1, -1)[direction != 0]) > 0.99
    assert 0.02 < np.mean(direction == 0) < 0.2
    assert np.all(find_direction(np.linspace(5, 0, 100))[15:-1] == -1)
    # A press begins where the force rises; half a press at the beginning is one of its own.
    triangle = 8 * (1 - np.abs(2 * (np.arange(600) / 200 % 1) - 1))
    np.testing.assert_array_equal(np.unique(find_presses(triangle)), [0, 1, 2])
    number = find_presses(triangle[100:])
    assert list(np.unique(number)) == [0, 1, 2] and number[90] == 0 and number[110] == 1
    assert np.all(find_presses(np.linspace(0, 5, 90)) == 0)


BAD = {
    "at least 20": lambda f, v: (f[:10], v[:10]),
    "at least 20 samples of rising": lambda f, v: (f[:21], v[:21]),
    "one length": lambda f, v: (f[:-1], v),
    "not a number": lambda f, v: (np.where(np.arange(600) == 3, np.inf, f), v),
    "force stays between 4.* press": lambda f, v: (4 + 0.02 * f, v),
    "does not follow the force": lambda f, v: (f, 0.1 + np.random.default_rng(0).normal(0, 0.01, v.shape)),
    "value stays at its maximum .* saturated": lambda f, v: (f, np.minimum(v, 0.05)),
    "force stays at its maximum .* saturated": lambda f, v: (np.minimum(f, 2.0), v),
    "give A, not counts": lambda f, v: (f, 1000 * v),
    "give N, not counts": lambda f, v: (1000 * f, v),
    "check joint and finger names": lambda f, v: (f, v * np.where(np.arange(600) % 200 < 100, 1, -1)),
}


@pytest.mark.parametrize("says", BAD)
def test_bad_recordings_are_refused_in_one_line(says):
    data = recording()
    with pytest.raises(CalibrationError, match=f"^thumb_bend on the hand.*{says}") as error:
        fit_joint(JointPress(*BAD[says](data.force, data.value)), "A", where="thumb_bend on the hand")
    assert "\n" not in str(error.value)


# --- file ---------------------------------------------------------------------------------------


def test_a_file_keeps_every_bit(hand, fitted, tmp_path):
    path = tmp_path / "policy" / "calibration.toml"
    side = dataclasses.replace(fitted[0].real, friction=np.full(12, np.nan))  # a direction was not recorded
    original = dataclasses.replace(fitted[0], real=side, serial='left "Ä"\\3')
    save_calibration(path, original)
    back = load_calibration(path, hand)
    assert jax.tree.structure(back) == jax.tree.structure(original)
    for ours, theirs in zip(jax.tree.leaves(back), jax.tree.leaves(original), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_cut_anywhere_it_is_refused(hand, fitted, tmp_path):
    path = tmp_path / "c.toml"
    save_calibration(path, fitted[0])
    whole = path.read_bytes()
    for length in [*range(0, len(whole) - 1, 197), *range(len(whole) - 30, len(whole) - 1)]:
        path.write_bytes(whole[:length])
        with pytest.raises(CalibrationError) as caught:
            load_calibration(path, hand)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_failed_write_leaves_the_old_file(fitted, tmp_path, monkeypatch):
    path = tmp_path / "c.toml"
    save_calibration(path, fitted[0])
    before = path.read_bytes()
    monkeypatch.setattr("os.fsync", lambda handle: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(CalibrationError, match="No space left"):
        save_calibration(path, dataclasses.replace(fitted[0], serial="new"))
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["c.toml"]
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_calibration(tmp_path / "none.toml")


@pytest.mark.slow
def test_the_figure_shows_what_was_recorded(fitted, tmp_path):
    from PIL import Image

    calibration, real, sim = fitted
    path = tmp_path / "c.png"
    plot_calibration(path, calibration, real, sim, ("thumb_bend", "index_joint1"))
    picture = np.asarray(Image.open(path).convert("RGB"), int)
    assert picture.shape[1] > 800 and np.mean(np.ptp(picture, axis=-1) > 60) > 0.003
    with pytest.raises(CalibrationError, match="nothing to draw"):
        plot_calibration(path, calibration, {}, sim)


# --- the simulation's side --------------------------------------------------------------------------


def test_lever_arms_are_c_mujocos(hand):
    """J^T n at a taxel, from mj_jac at the same point of the tip's body."""
    rng = np.random.default_rng(6)
    model = mujoco.MjModel.from_xml_path(str(hand.model_path))
    data = mujoco.MjData(model)
    for finger in range(5):
        angle = rng.uniform(hand.joint_lower, hand.joint_upper)
        taxel = int(rng.integers(hand.num_taxels))
        data.qpos[[model.joint(name).qposadr[0] for name in hand.joint_names]] = angle
        mujoco.mj_forward(model, data)
        body = model.body(hand.body_names[hand.tip_body[finger]]).id
        turn = data.xmat[body].reshape(3, 3)
        point = data.xpos[body] + turn @ hand.taxel_position[finger, taxel]
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        torque = jacobian.T @ (turn @ hand.taxel_normal[finger, taxel])
        expected = torque[[model.joint(name).dofadr[0] for name in hand.joint_names]]
        np.testing.assert_allclose(lever_arms(hand, angle, finger, taxel), expected, atol=2e-6)
