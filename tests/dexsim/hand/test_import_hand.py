"""Hands from makers' files. The stand-ins have the quirks of public ones: a URDF's frames and packages, joints that are
turned round, a wrist above the palm, followers, tendons, absent meshes and torques."""

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dexsim import check_hand, import_hand
from dexsim.calibration.press import fingertip_strength
from dexsim.errors import AssetError, ConfigError
from dexsim.hand.anatomy import orient
from dexsim.hand.folder import write_hand
from dexsim.hand.kinematics import forward_kinematics
from dexsim.hand.load import load_hand
from dexsim.hand.posture import find_grasp
from dexsim.hand.vendor import ImportConfig, read_hand
from dexsim.randomization import Randomization, sample_hand
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp

TURN = Rotation.from_euler("xyz", [0.4, -0.9, 2.1]).as_matrix()  # of the file's palm against ours
ROOTS = {"index": (0, 0.035, 0.09), "middle": (0, 0.01, 0.095), "ring": (0, -0.015, 0.09), "thumb": (0.01, 0.05, 0.02)}
LENGTHS = (0.04, 0.03)
PLAIN = ImportConfig()


def urdf(folder, *, reverse=(), turn=TURN, effort="0.6", mirror=False):
    """A hand of eleven motors and a wrist: three fingers of two hinges that a hinge spreads, and a thumb that turns and
    bends twice. Meshes are STL of a package, one of the links is a box."""
    (folder / "meshes").mkdir(exist_ok=True)
    side = np.diag([1.0, -1.0, 1.0]) if mirror else np.eye(3)
    for part, length in enumerate(LENGTHS):
        bar = trimesh.creation.capsule(height=length - 0.01, radius=0.009, count=[16, 16])
        bar.apply_translation([0, 0, length / 2 - bar.bounds.mean(0)[2]])
        bar.vertices = bar.vertices @ turn.T
        bar.export(folder / "meshes" / f"bar{part}.stl")
    rpy = " ".join(f"{x:.9f}" for x in Rotation.from_matrix(turn).as_euler("xyz"))
    palm = '<visual><origin xyz="{}" rpy="{}"/><geometry><box size="0.03 0.1 0.1"/></geometry></visual>'
    links = [
        '<link name="forearm"/>',
        f'<link name="palm">{palm.format(vector(turn @ [-0.015, 0, 0.04]), rpy)}<inertial><mass value="0.3"/>'
        '<inertia ixx="3e-4" iyy="3e-4" izz="3e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    ]
    joints = [joint("wrist", "forearm", "palm", [0, 0, 0.1], [1, 0, 0], (-0.5, 0.5), effort)]
    for finger, root in ROOTS.items():
        thumb, above, place = finger == "thumb", "palm", side @ np.array(root)
        # The thumb turns about the palm's z and bends toward the fingers.
        first, bend = ((0, 0, -1), (1, 0, 0)) if thumb else ((1, 0, 0), (0, 1, 0))
        if thumb:
            first, bend = side @ first * np.linalg.det(side), -side @ bend * np.linalg.det(side)
        span = (0.0, 1.4) if thumb else (-0.3, 0.3)
        for part, axis in enumerate((first, bend, bend)):
            child, hinge = f"{finger}_link{part}", f"{finger}_{part}"
            low, high = span if part == 0 else (0.0 if thumb else -0.1, 1.6)
            if hinge in reverse:
                axis, low, high = -np.array(axis), -high, -low
            joints.append(joint(hinge, above, child, turn @ place, turn @ axis, (low, high), effort))
            length = 0.0 if part == 0 else LENGTHS[part - 1]
            way = np.array([0, 0, 1.0]) if not thumb else side @ np.array([0, 0.8, 0.6])
            tilt = Rotation.align_vectors([turn @ way], [turn @ [0, 0, 1.0]])[0].as_euler("xyz")
            file = f'<mesh filename="package://hand_description/meshes/bar{part - 1}.stl"/>'
            shape = f'<origin rpy="{vector(tilt)}"/><geometry>{file}</geometry>'
            links.append(f'<link name="{child}">' + (f"<visual>{shape}</visual>" if part else "") + "</link>")
            above, place = child, length * way
    path = folder / "hand.urdf"
    path.write_text(f'<robot name="hand">{"".join(links)}{"".join(joints)}</robot>')
    return path


def joint(name, parent, child, place, axis, span, effort):
    limit = f'<limit lower="{span[0]}" upper="{span[1]}" effort="{effort}" velocity="6"/>'
    where = f'<origin xyz="{vector(place)}"/><axis xyz="{vector(axis)}"/>'
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>{where}{limit}</joint>'
    )


def vector(values):
    return " ".join(f"{x:.9f}" for x in values)


def draft_of(path):
    draft = read_hand(path, PLAIN)
    orient(draft, PLAIN)
    import_hand.fit_links(draft, PLAIN)
    return draft


@pytest.fixture(scope="module")
def hands(tmp_path_factory):
    """The same hand as it should be, with joints turned round, and mirrored."""
    cases = {"plain": {}, "reversed": {"reverse": ("index_1", "middle_2", "thumb_2")}, "left": {"mirror": True}}
    return {name: draft_of(urdf(tmp_path_factory.mktemp(name), **options)) for name, options in cases.items()}


class TestUrdf:
    @pytest.mark.parametrize("name", ["plain", "reversed", "left"])
    def test_palm_frame_fingers_and_side_are_found(self, hands, name):
        draft, found = hands[name], "\n".join(hands[name].findings)
        assert list(draft.fingers) == ["thumb", "index", "middle", "ring"] and "frozen at 0  wrist:" in found
        assert draft.side == ("left" if name == "left" else "right")
        assert ("reversed     index_1, middle_2, thumb_2:" in found) == (name == "reversed")
        # In our frame fingers bend about y, and their middle joints are where they were drawn.
        place = np.array(ROOTS["middle"]) * [1, -1 if name == "left" else 1, 1] + [0, 0, LENGTHS[0]]
        (link,) = (link for link in draft.links if link.joint == "middle_2")
        np.testing.assert_allclose([link.axis, link.anchor], [[0, 1, 0], place], atol=2e-3)

    def test_limits_and_fits_are_the_files_also_of_turned_joints(self, hands):
        draft = hands["plain"]
        for link, other in zip(draft.links, hands["reversed"].links, strict=True):
            np.testing.assert_allclose([link.low, link.high], [other.low, other.high])
            np.testing.assert_allclose(link.axis, other.axis, atol=1e-6)
        assert {(link.torque, link.speed) for link in draft.links[1:]} == {(0.6, 6.0)}
        for link in draft.links[1:]:  # masses are on their links, also where the file gives none
            assert link.mass >= 1e-3 and np.linalg.norm(link.centre - link.anchor) < 0.025
        bars = [link.capsule for link in draft.links if link.name.endswith("link1")]
        assert len(bars) == 4 and all(abs(bar.radius - 0.009) < 3e-4 and bar.error[0] < 2e-4 for bar in bars)
        assert draft.palm.centre[0] + draft.palm.half[0] == pytest.approx(0.0, abs=1e-3)

    def test_a_written_left_hand_keeps_the_conventions(self, hands, tmp_path):
        posture, centre, gaps = find_grasp(load_hand(write_hand(hands["left"], "hand", ["--"], tmp_path)), 0.006)
        assert gaps.min() >= 0.006 and gaps.max() < 0.026
        grasp = {"posture": posture, "centre": centre}
        hand = load_hand(write_hand(hands["left"], "hand", ["--"], tmp_path, grasp))
        assert not [check(hand) for what, check in check_hand.CHECKS.items() if "random" not in what and check(hand)]
        # Tips in closed form: roots, lengths, and the last capsule's end, 4 mm beyond its link's and less the rubber.
        tips = np.asarray(forward_kinematics(hand, np.zeros(12, np.float32)).tip_position)
        np.testing.assert_allclose(tips[1:, 2], np.array([0.09, 0.095, 0.09]) + sum(LENGTHS) + 0.004 - 0.003, atol=1e-3)


def test_the_whole_command(tmp_path, capsys):
    """With followers, absent torques and an absent mesh, up to a check that passes."""
    mimic = '<mimic joint="{0}_1" multiplier="0.8" offset="0.1"/></joint>'
    path = urdf(tmp_path, effort="1000", turn=np.eye(3))
    text = path.read_text()
    for finger in ROOTS:
        head, tail = text.split(f'<joint name="{finger}_2"')
        text = head + f'<joint name="{finger}_2"' + tail.replace("</joint>", mimic.format(finger), 1)
    path.write_text(text.replace("bar1.stl", "lost.stl"))
    assert import_hand.main([str(path), "--out", str(tmp_path / "out"), "--yes"]) == 0
    said = capsys.readouterr().out
    for line in ("8 motors, 4 joints that follow", "frozen at 0  wrist", "torque 1 Nm at 8 motors: the file says 1000",
                 "lost.stl", "fingertip of 25 mm", "ok    random actions stay finite"):  # fmt: skip
        assert line in said
    hand = load_hand(tmp_path / "out" / "out.toml")
    assert hand.num_joints == 8 and hand.num_hinges == 12
    np.testing.assert_allclose(sorted(set(hand.body_ratio.round(5))), [0.8, 1.0])
    # What the thumb can oppose, and gains in proportion to stall torques.
    low, high = Grasp(GraspConfig(), hand).finger_force
    thumb, *others = fingertip_strength(hand, np.array(hand.grasp_posture))
    assert low == pytest.approx(max(high / 4, 1.0), abs=1e-3)
    assert high == pytest.approx(min(thumb / 2.75, *others), abs=1e-3)
    nominal = sample_hand(jax.random.key(0), Randomization(scale=0), hand, timestep=0.01, control_period=0.03)
    np.testing.assert_allclose(nominal.actuator.stiffness, 3.0 / 1.1, rtol=1e-3)
    np.testing.assert_allclose(nominal.actuator.damping, 0.1 / 1.1, rtol=1e-3)


MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="palm"><geom type="box" size="0.015 0.05 0.05"/>
{}</body></worldbody>{}</mujoco>"""
CHAIN = """<body name="{0}" pos="0 {1} 0.05"><joint name="{0}_a" axis="0 1 0" range="0 1.5"/>
<geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.03"/><body name="{0}b" pos="0 0 0.03">
<joint name="{0}_b" axis="0 1 0" range="0 1.5"/><geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.025"/></body>
</body>"""
TENDON = '<tendon><fixed name="cord"><joint joint="f_a" coef="1"/><joint joint="f_b" coef="1"/></fixed></tendon>'


def mjcf(folder, tail="", bodies=("thumb", "f", "g")):
    path = folder / "hand.xml"
    chains = "".join(CHAIN.format(name, 0.04 - 0.03 * i) for i, name in enumerate(bodies))
    path.write_text(MJCF.format(chains, tail))
    return path


def test_tendons_can_be_dropped_and_their_joints_coupled(tmp_path):
    path = mjcf(tmp_path, TENDON + '<equality><tendon tendon1="cord"/></equality>')
    options = ImportConfig(drop_tendons=True, couple=("f_b=f_a:0.7",))
    (follower,) = (link for link in read_hand(path, options).links if link.leader)
    assert (follower.joint, follower.leader, follower.ratio) == ("f_b", "f_a", 0.7)


REFUSED = {
    "tendon": (dict(tail=TENDON), {}, "tendons cord: not supported; give --drop-tendons and, .* --couple"),
    "one finger": (dict(bodies=("f",)), {}, "two fingers or more, got 1"),
    "no such palm": ({}, dict(palm="hand"), "Invalid name 'hand'. Valid names: .*'palm'.*'thumb'"),
    "no such joint": ({}, dict(freeze=("wrist",)), "--freeze wrist: no such joint; it has thumb_a"),
    "couple": ({}, dict(couple=("f_b",)), "--couple f_b: expected FOLLOWER=LEADER:RATIO"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_imported_is_one_line(tmp_path, what):
    file, options, says = REFUSED[what]
    with pytest.raises(AssetError, match=says):
        read_hand(mjcf(tmp_path, **file), ImportConfig(**options))


def test_the_frame_is_confirmed(tmp_path):
    with pytest.raises(ConfigError, match="not a terminal: --yes accepts"):
        import_hand.main([str(mjcf(tmp_path)), "--out", str(tmp_path)])
    options = ImportConfig(fingers=(0, 0, 2), normal=(-1, 0, 0.1))
    draft = read_hand(mjcf(tmp_path), options)
    orient(draft, options)
    (link,) = (link for link in draft.links if link.joint == "f_a")
    assert draft.side == "left" and abs(link.axis[1]) == 1 and link.anchor[2] == 0.05


@pytest.mark.parametrize("given", [{}, {"fingers": (0, 0, 1), "normal": (0, 0, 1)}])
def test_joints_without_a_range_are_named_and_show_no_palm_side(tmp_path, given):
    path = mjcf(tmp_path)
    path.write_text(path.read_text().replace(' range="0 1.5"', ""))
    draft = read_hand(path, PLAIN)
    assert sum("no range in the file" in line for line in draft.findings) == 6
    with pytest.raises(AssetError, match="no palm side found"):
        orient(draft, ImportConfig(**given))


def test_meshes_in_millimetres_are_an_error(tmp_path):
    path = urdf(tmp_path)
    for file in tmp_path.glob("meshes/*.stl"):
        trimesh.load(file).apply_scale(1000.0).export(file)
    with pytest.raises(AssetError, match='m long: meshes in millimetres need scale="0.001'):
        read_hand(path, PLAIN)


def test_a_hand_that_is_there_is_not_replaced(tmp_path):
    folder = tmp_path / "hand"
    folder.mkdir()
    path = mjcf(folder)
    for file in (path, folder / "hand.toml"):
        path.rename(file)
        before = file.read_bytes()
        with pytest.raises(AssetError, match=f"{file.name}: exists; give another folder with --out"):
            import_hand.main([str(mjcf(tmp_path)), "--out", str(folder), "--yes"])
        assert file.read_bytes() == before
