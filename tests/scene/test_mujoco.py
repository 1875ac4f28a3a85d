"""Models of MuJoCo as scenes: the same motion as MuJoCo's own, what is refused, and what is not acted upon."""

import re
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest

from benchmarks.body_motions import accelerations as motions
from benchmarks.body_motions import state_of
from tests.scene.mechanics import mechanics
from tests.scene.mujoco_model_fields import IDLE, READ, REFUSED_FIELDS
from vmri_jax.scene import Fixed, Scene, Spherical
from vmri_jax.scene.mujoco_model import REFUSED, Compiled

mujoco = pytest.importorskip("mujoco")

PAGE = Path(__file__).parents[2] / "docs/coming_from/mujoco.md"
TREE = """
<mujoco>
  <option gravity="0 0 -9.81" integrator="RK4" timestep="0.0002"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" stiffness="2" springref="20" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03"/>
      <body name="hand" pos="0.5 0 0" euler="0 0 30" gravcomp="0.5">
        <joint name="wrist" type="ball"/>
        <geom type="box" size="0.05 0.1 0.15" pos="0.1 0.02 -0.2"/>
        <body name="weight" pos="0.2 0 -0.3" gravcomp="1.5"><geom type="sphere" size="0.06"/></body>
      </body>
      <body name="slider" pos="0.2 0 0">
        <joint name="rail" type="slide" axis="1 0.2 0" stiffness="50"/>
        <geom type="cylinder" size="0.05 0.04"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
LOOP = """
<mujoco>
  <option gravity="0 0 -9.81" integrator="RK4" timestep="0.00002"><flag contact="disable"/></option>
  <worldbody>
    <body name="crank"><joint name="a" type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 1" size="0.03"/>
      <body name="rod" pos="0 0 1"><joint name="b" type="hinge" axis="0 1 0"/><site name="rod end" pos="1.5 0 0.5"/>
        <geom type="capsule" fromto="0 0 0 1.5 0 0.5" size="0.03"/></body>
    </body>
    <body name="rocker" pos="1.5 0 0"><joint name="c" type="hinge" axis="0 1 0"/><site name="tip" pos="0 0 1.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 1.5" size="0.03"/></body>
  </worldbody>
  <equality><connect name="pin" site1="rod end" site2="tip" solref="0.002 1"/></equality>
</mujoco>
"""
ARM = """
<mujoco>
  <option {option}><flag {flags}/></option>
  <default><geom type="capsule" size=".02" mass="1" contype="0" conaffinity="0"/></default>
  <worldbody>
    <site name="hook" pos="0.3 0 1"/>
    <body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" {joint}/><geom fromto="0 0 0 .3 0 0" {geom}/>
      <site name="tip" pos="0.3 0 0"/>{child}</body>{body}
  </worldbody>
  {more}
</mujoco>
"""


def arm(more="", **parts):
    """An arm on a hinge, with attributes and elements of XML."""
    names = ("option", "flags", "joint", "geom", "child", "body")
    return mujoco.MjModel.from_xml_string(ARM.format(more=more, **{name: parts.get(name, "") for name in names}))


def motion(model, qpos, qvel, t_end):
    """MuJoCo's state at the end, by its own Runge-Kutta method of order four."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    for _ in range(round(t_end / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def accelerations(scene):
    """Accelerations of the centres of mass at the start, by the continuous equations of the scene."""
    return {name: np.asarray(a[:3]) for name, (_, _, a) in motions(scene, state_of(scene)).items()}


def their_accelerations(model, data):
    """Accelerations of the centres of mass of MuJoCo's bodies, (nbody, 3)."""
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    found = np.zeros((model.nbody, 3))
    for b in range(1, model.nbody):
        felt = np.zeros(6)
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, b, felt, 0)
        found[b] = felt[3:] + model.opt.gravity  # what a body feels is -g at rest
    return found


def test_a_tree_accelerates_as_in_mujoco():
    """With springs, a damper, and gravity that is compensated in part, differently in bodies that are welded
    together."""
    model = mujoco.MjModel.from_xml_string(TREE)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.3)
    data.qvel[:] = rng.normal(size=model.nv)
    scene = Scene.from_mujoco(model, qpos=data.qpos, qvel=data.qvel)
    assert [body.name for body in scene.bodies] == ["upper", "hand", "slider"]  # the weight is welded to the hand
    ours, theirs = accelerations(scene), their_accelerations(model, data)
    hand = [model.body(name).id for name in ("hand", "weight")]
    np.testing.assert_allclose(
        ours["hand"], model.body_mass[hand] @ theirs[hand] / model.body_mass[hand].sum(), rtol=1e-9, atol=1e-9
    )
    for name in ("upper", "slider"):
        np.testing.assert_allclose(ours[name], theirs[model.body(name).id], rtol=1e-9, atol=1e-9)


def test_a_loop_between_sites_accelerates_as_in_mujoco():
    """From a start that MuJoCo's soft loop has left open by 1e-7; its accelerations are differences of its motion."""
    model = mujoco.MjModel.from_xml_string(LOOP)
    h = 2e-3
    before, start, after = (motion(model, 0.0, 0.0, 0.2 + t) for t in (-h, 0.0, h))
    gap = np.linalg.norm(start.site_xpos[0] - start.site_xpos[1])
    assert 1e-9 < gap < 1e-4, gap
    scene = Scene.from_mujoco(model, qpos=start.qpos, qvel=start.qvel)
    assert len(scene.dropped) == 1  # a planar loop of hinges
    theirs = (before.xipos - 2 * start.xipos + after.xipos) / h**2
    for name, ours in accelerations(scene).items():
        np.testing.assert_allclose(ours, theirs[model.body(name).id], atol=1e-3)


ROBOT = """
<mujoco>
  <option gravity="0 0 -9.81"><flag contact="disable" {flags}/></option>
  <default><joint armature="0.05" damping="0.1" solreflimit="0.1 1"/><geom type="capsule" size=".04"/></default>
  <worldbody>
    <body name="torso" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1" ref="1"/><joint name="pitch" axis="0 1 0" pos="0 0 .2"/>
      <geom fromto="0 0 -.3 0 0 .3"/>
      <body name="thigh" pos="0.1 0.1 -.3">
        <joint name="hip roll" axis="1 0 0" stiffness="2" springref="30"/><joint name="hip pitch" axis="0 1 0" pos="0 .05 0" range="-20 60"/>
        <geom fromto="0 0 0 .1 0 -.4"/>
        <body name="carrier" pos=".1 0 -.4"><joint name="knee" axis="0 1 0" range="-10 10"/><geom size=".02" fromto="0 0 0 .05 0 0"/>
          <body name="shin"><joint name="slide" type="slide" axis="0 .2 -1"/><geom fromto="0 0 0 -.1 0 -.4"/></body></body>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="hip roll" coef="1"/><joint joint="slide" coef="-2"/></fixed></tendon>
  <equality>
    <joint name="bend" joint1="knee" joint2="hip pitch" polycoef="0 .5 .2 -.1 .3" solref="0.0004 1"/>
    <tendon name="held" tendon1="t" solref="0.0004 1"/>
  </equality>
  <actuator><motor joint="knee" gear="3"/><general joint="hip pitch" dyntype="integrator" gainprm="2"/></actuator>
  <keyframe><key name="stand"/><key name="leap" qpos=".1 1.3 .2 .3 .4 -.1 .2" qvel="1 -.5 .3 .2 -.4 .6 .1"/></keyframe>
</mujoco>
"""
"""A planar root, two joints of one body, armature, laws of joints and tendons, keyframes."""


def test_a_robot_accelerates_as_in_mujoco():
    """From a keyframe; MuJoCo's equalities are soft, so that they are off here."""
    model = mujoco.MjModel.from_xml_string(ROBOT.format(flags='equality="disable" limit="disable"'))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 1)
    scene = Scene.from_mujoco(model, key="leap")
    assert {type(body).__name__: 0 for body in scene.bodies}.keys() == {"RigidBody", "Frame"}
    assert sum(x.size for x in scene.start[:2]) == model.nv == 7
    ours, theirs = accelerations(scene), their_accelerations(model, data)
    for name in ("torso", "thigh", "shin"):
        np.testing.assert_allclose(ours[name], theirs[model.body(name).id], rtol=1e-9, atol=1e-9)
    again = Scene.from_mujoco(model, key=1)
    np.testing.assert_array_equal(again.bodies[-1].velocity, scene.bodies[-1].velocity)


URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.02 0.01 0.1" rpy="0.1 0.2 0"/><mass value="2"/>
    <inertia ixx="0.08" iyy="0.06" izz="0.04" ixy="0.004" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
    <inertia ixx="0.04" iyy="0.03" izz="0.02" ixy="0" ixz="0" iyz="0.001"/></inertial></link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.3 0 0" rpy="0 0.1 0"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="90" velocity="3"/><dynamics damping="0.3"/></joint>
</robot>
"""


def test_an_arm_from_a_urdf_accelerates_as_in_mujoco(tmp_path):
    """Limits, which a scene does not have, are switched off."""
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    with pytest.raises(ValueError, match=r"limits \(joint bend\)"):
        Scene.from_mujoco(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = [0.3, -0.4], [0.5, 0.7]
    scene = Scene.from_mujoco(path, qpos=data.qpos, qvel=data.qvel, ignore=["limits"])
    theirs = their_accelerations(model, data)
    for name, ours in accelerations(scene).items():
        np.testing.assert_allclose(ours, theirs[model.body(name).id], rtol=1e-9, atol=1e-9)


def test_joints_and_tendons_that_equalities_tie():
    """Two rows, zero where the angles satisfy the laws of the model and nowhere else; all else is in
    `test_a_robot_accelerates_as_in_mujoco`."""
    scene = Scene.from_mujoco(mujoco.MjModel.from_xml_string(ROBOT.format(flags='limit="disable"')))
    angles = {"hip pitch": 0.4, "knee": np.polyval([0.3, -0.1, 0.2, 0.5, 0.0], 0.4), "hip roll": 0.6, "slide": 0.3}

    def rows(**moved):
        named = angles | {name.replace("_", " "): value for name, value in moved.items()}
        q = [
            np.array([named.get(name, 0.1) for name in names], float) for names in (scene.names.slow, scene.names.fast)
        ]
        assert sum(x.size for x in q) == 7
        return mechanics(scene, (*q, *scene.start[2:])).rows

    np.testing.assert_allclose(rows(), [0.0, 0.0], atol=1e-14)
    assert np.count_nonzero(np.abs(rows(knee=0.5)) > 1e-3) == np.count_nonzero(np.abs(rows(hip_roll=0.5)) > 1e-3) == 1


def test_limits_as_springs():
    """A hinge that has gone beyond its limit is pushed back with MuJoCo's stiffness for the inertia at the hinge."""
    model = mujoco.MjModel.from_xml_string(ROBOT.format(flags='equality="disable"'))
    with pytest.raises(ValueError, match=r"limits \(joint hip pitch, joint knee\)"):
        Scene.from_mujoco(model)
    with pytest.raises(ValueError, match=r"limits is 'soft'; it must be 'refuse' or 'spring'"):
        Scene.from_mujoco(model, limits="soft")  # pyright: ignore[reportArgumentType]
    names = [effect.name for effect in Scene.from_mujoco(model, limits="spring").effects]
    assert [name for name in names if name.endswith("limit")] == ["hip pitch limit", "knee limit"]
    limited = '<tendon><fixed name="t" limited="true" range="0 1"><joint joint="hinge" coef="1"/></fixed></tendon>'
    with pytest.raises(ValueError, match=r"for limits of hinges and slides, and t have limits of another kind\."):
        Scene.from_mujoco(arm(limited), limits="spring")
    assert Scene.from_mujoco(arm(limited), limits="spring", ignore=["limits"]).bodies
    # MuJoCo's margin of a joint lies inside its range: -25 to 25 degrees with 5 degrees are -20 to 20
    margin = f'range="-25 25" margin="{np.radians(5)}" solreflimit="0.1 1"'
    pendulum = arm(joint=margin, option='gravity="0 0 0"')
    scene = Scene.from_mujoco(pendulum, qpos=[np.radians(25)], limits="spring")
    inertia = 1 / pendulum.dof_invweight0[0]
    spin = np.asarray(state_of(scene).q_s), accelerations(scene)["arm"]
    turning = np.linalg.norm(spin[1]) / np.linalg.norm(pendulum.body_ipos[1])
    assert turning == pytest.approx(np.radians(5) / 0.1**2, rel=1e-6), inertia


def test_starts_that_equalities_and_keyframes_do_not_allow():
    model = mujoco.MjModel.from_xml_string(ROBOT.format(flags='limit="disable"'))
    with pytest.raises(ValueError, match=r"bend is violated by 0\.\d+ at the start\. Here equalities hold exactly"):
        Scene.from_mujoco(model, key="leap")
    with pytest.raises(ValueError, match=r"there is no keyframe 'jump'.*leap"):
        Scene.from_mujoco(model, key="jump")
    with pytest.raises(ValueError, match=r"key is 2; the model has 2 keyframes, counted from 0"):
        Scene.from_mujoco(model, key=2)
    with pytest.raises(ValueError, match=r"key and qpos or qvel are given"):
        Scene.from_mujoco(model, key=0, qpos=model.qpos0)


def test_half_of_gravity():
    """The arm falls with half the acceleration, and what compensates gravity is a potential."""
    model = arm(child="")
    model.body_gravcomp[1] = 0.5
    assert len(Scene.from_mujoco(model).effects) == 2  # MuJoCo does not act upon it either
    mujoco.mj_setConst(model, mujoco.MjData(model))
    half, whole = Scene.from_mujoco(model), Scene.from_mujoco(arm(child=""))
    assert half.system().force is None
    assert accelerations(half)["arm"][2] == pytest.approx(accelerations(whole)["arm"][2] / 2, rel=1e-9)


def test_a_start_that_leaves_a_loop_open_is_refused_with_the_gap():
    bar = '<body name="coupler" pos=".3 0 0"><joint name="k" axis="0 1 0"/><geom fromto="0 0 0 .6 0 0"/></body>'
    pin = '<equality><connect name="pin" body1="coupler" anchor=".6 0 0"/></equality>'
    four = arm(pin, child=bar)
    for model in (four, arm(pin + '<statistic extent="1000"/>', child=bar)):  # an extent for the camera
        with pytest.raises(
            ValueError, match=r"pin is open at the start by 0\.4\d+ m\. Here equalities hold.*give a qpos"
        ):
            Scene.from_mujoco(model, qpos=[0.5, 0.0])
    weld = '<equality><weld name="w" body1="arm" relpose="-.1 0 -1 .9961947 0 .0871557 0"/></equality>'  # 10 degrees
    with pytest.raises(ValueError, match=r"w is open at the start by 0\.1 m and 0\.175 rad"):
        Scene.from_mujoco(arm(weld))
    assert not Scene.from_mujoco(arm(weld, flags='equality="disable"')).dropped


def test_angles_of_an_import_count_their_turns():
    """A spring relaxed at 6 rad and limits at 4.15 rad, from a keyframe at 3.5 rad; directors would lose the turns."""
    joint = '<joint name="h" axis="0 0 1" limited="true" range="-4.15 4.15" stiffness="2" springref="6"/>'
    body = f'<body name="b">{joint}<geom type="sphere" size=".1" pos=".5 0 0"/></body>'
    key = '<keyframe><key name="away" qpos="3.5"/></keyframe>'
    text = f'<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody>{key}</mujoco>'
    model = mujoco.MjModel.from_xml_string(text)
    scene = Scene.from_mujoco(model, key="away", limits="spring")
    numbers = {effect.name: scene.params[effect.name] for effect in scene.effects}
    assert numbers["h spring"]["neutral"] == pytest.approx(2.5)
    assert [numbers["h limit"][side] for side in ("lower", "upper")] == pytest.approx([-7.65, 0.65])
    with pytest.raises(ValueError, match=r"h limit: lower is -7\.65; the angle of h comes from"):
        Scene.from_mujoco(model, key="away", limits="spring", coordinates="directors")


def test_a_small_gap_is_closed_by_the_joints():
    """An arm at 30 degrees is welded to the world by sites, one turned by these; its start is off by 1e-5 rad."""
    turned = "<site name='s' pos='0 0 1' euler='0 30 0'/>"
    more = '<equality><weld name="w" site1="s" site2="here"/></equality>'
    model = arm(more, body=turned, child='<site name="here"/>')
    exact = Scene.from_mujoco(model, qpos=[np.pi / 6], coordinates="directors")
    close = Scene.from_mujoco(model, qpos=[np.pi / 6 + 1e-5], coordinates="directors")
    with pytest.raises(ValueError, match=r"nothing can move: w leave no freedom"):
        Scene.from_mujoco(model, qpos=[np.pi / 6])
    np.testing.assert_allclose(close.bodies[0].position, exact.bodies[0].position, atol=1e-13)  # 1e-17; off by 1e-6
    (weld,) = [effect for effect in close.effects if effect.name == "w"]
    assert isinstance(weld, Fixed)
    np.testing.assert_allclose(weld.at, [0, 0, 1], atol=1e-13)


def test_anchors_of_equalities():
    """Connect by bodies and by sites are one joint at one point; what is welded together or inactive needs none."""
    by_bodies = arm('<equality><connect name="e" body1="arm" anchor=".3 0 0"/></equality>')
    by_sites = arm('<equality><connect name="e" site1="tip" site2="hook"/></equality>')
    for model in (by_bodies, by_sites):
        (pin,) = [effect for effect in Scene.from_mujoco(model).effects if effect.name == "e"]
        assert isinstance(pin, Spherical)
        assert pin.between == ("arm", "ground")
        np.testing.assert_allclose(pin.at, [0.3, 0, 1], atol=1e-15)
    child = '<body name="grip" pos=".3 0 0"><geom fromto="0 0 0 .1 0 0"/></body>'
    for attributes in ('body1="arm" body2="grip" anchor="0 0 0"', 'body1="arm" anchor=".3 0 0" active="false"'):
        model = arm(f'<equality><connect name="e" {attributes}/></equality>', child=child)
        assert "e" not in [effect.name for effect in Scene.from_mujoco(model).effects]


COUPLED = '<equality><joint joint1="hinge"/></equality>'
MOTOR = '<actuator><position name="m" joint="hinge" kp="2"/></actuator>'
PINNED = '<equality><connect name="e" body1="arm" anchor=".3 0 0"/></equality>'
FLAGS = {
    "equality": ('equality="disable"', PINNED, ""),
    "equality, coupled": ('equality="disable"', COUPLED, ""),
    "spring": ('spring="disable"', "", 'stiffness="2"'),
    "damper": ('damper="disable"', "", 'damping="2"'),
    "limit": ('limit="disable"', "", 'range="-10 10"'),
    "frictionloss": ('frictionloss="disable"', "", 'frictionloss="1"'),
    "actuation": ('actuation="disable"', MOTOR, ""),
    "constraint": ('constraint="disable"', PINNED, 'frictionloss="1" range="-10 10"'),
    "gravity": ('gravity="disable"', "", ""),
}


@pytest.mark.parametrize("case", FLAGS)
def test_what_is_switched_off_neither_acts_nor_is_refused(case):
    flags, more, joint = FLAGS[case]
    names = [effect.name for effect in Scene.from_mujoco(arm(more, flags=flags, joint=joint)).effects]
    assert names == (["hinge"] if case == "gravity" else ["hinge", "gravity"])
    compiled = Compiled(mujoco, arm(more, joint=joint))  # which acts, or is refused, where it is not switched off
    acts = (
        compiled.gravity.any()
        if case == "gravity"
        else compiled.equalities or "stiffness" in joint or "damping" in joint
    )
    assert acts or list(compiled.beyond())


def test_flags_of_passive_forces():
    """Springs and dampers off takes the fluid and the compensation of gravity away too, in MuJoCo as here."""
    off = 'spring="disable" damper="disable"'
    body = '<body name="b" gravcomp="1"><joint name="s" type="slide"/><geom fromto="0 0 0 .1 0 0"/></body>'
    for flags, count in (("", 1), (off, 0)):
        model = arm(flags=flags, body=body)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert np.count_nonzero(data.qfrc_passive) == count
        lifts = [effect for effect in Scene.from_mujoco(model).effects if "compensation" in effect.name]
        assert len(lifts) == count
        assert all(lift.kind == "potential" for lift in lifts)
    assert Scene.from_mujoco(arm(option='density="1000"', flags=off)).bodies
    assert Scene.from_mujoco(arm(option='wind="1 0 0"')).bodies  # without density or viscosity it does nothing


TOUCHING = """
<mujoco>
  <option gravity="0 0 0"><flag {flags}/></option>
  <default><geom type="sphere" size="1" {geom}/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 0"/>
    <body name="a"><freejoint/><geom name="a" mass="1"/><geom name="a2" pos=".1 0 0" mass="1"/>
      <body name="b"><joint/><geom name="b" mass="1" pos="0 .1 0"/>
        <body name="c"><geom name="c" mass="1" pos="0 0 .1"/></body>
        <body name="d"><joint/><geom name="d" mass="1" pos=".1 .1 0"/></body></body></body>
    <body name="e"><geom name="e" pos=".2 0 0"/></body>
    <body name="f"><freejoint/><geom name="f" mass="1" contype="2" conaffinity="4" pos="0 .2 0"/></body>
  </worldbody>
  <contact>{contact}</contact>
</mujoco>
"""


@pytest.mark.parametrize(
    ("flags", "geom", "contact"),
    [
        ("", "", ""),
        ('filterparent="disable"', "", ""),
        ("", "", '<exclude body1="d" body2="a"/><exclude body1="a" body2="world"/>'),
        ("", "", '<exclude body1="d" body2="a"/><pair geom1="a" geom2="d"/><pair geom1="f" geom2="c"/>'),
        ("", 'contype="0"', '<pair geom1="a" geom2="b"/>'),
        ("", 'contype="4"', ""),
        ('contact="disable"', "", '<pair geom1="a" geom2="b"/>'),
        ('constraint="disable"', "", ""),
    ],
)
def test_pairs_in_contact_are_those_of_mujoco(flags, geom, contact):
    """All geoms overlap, so that MuJoCo finds each pair that may collide."""
    model = mujoco.MjModel.from_xml_string(TOUCHING.format(flags=flags, geom=geom, contact=contact))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    theirs = {tuple(sorted(map(int, pair))) for pair in data.contact.geom} if data.ncon else set()
    assert {tuple(map(int, pair)) for pair in Compiled(mujoco, model).touching()} == theirs


def test_a_ball_over_the_floor_is_refused():
    ball = '<body name="ball"><freejoint/><geom type="sphere" size=".1" contype="1"/></body>'
    floor = '<geom name="floor" type="plane" size="5 5 .1" conaffinity="1"/>'
    with pytest.raises(ValueError, match=r"contact \(1 pair of geoms, as of world and ball\).*ignore=\['contact'\]"):
        Scene.from_mujoco(arm(body=ball + floor))


def test_several_joints_of_one_body_cannot_be_ignored():
    """Leaving one out would weld the body to the other's."""
    body = (
        '<body name="point"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><geom fromto="0 0 0 1'
        ' 0 0"/></body>'
    )
    with pytest.raises(ValueError, match=r"several joints of one body \(body point\).*take coordinates=\"joint\""):
        Scene.from_mujoco(arm(body=body), ignore=["several joints of one body"], coordinates="directors")
    ball = body.replace('type="slide" axis="0 1 0"', 'type="ball"')
    with pytest.raises(ValueError, match=r"several joints of one body \(body point\)"):
        Scene.from_mujoco(arm(body=ball))


def test_what_a_scene_does_not_express_is_refused_in_one_list(monkeypatch):
    model = arm(MOTOR, joint='frictionloss="0.1" range="-10 10"')
    with pytest.raises(ValueError, match=r"actuators \(actuator m\); limits \(joint hinge\)"):
        Scene.from_mujoco(model)
    assert Scene.from_mujoco(model, ignore=["actuators", "limits", "frictionloss"]).bodies
    with pytest.raises(ValueError, match=r"ignore: there is no name 'limit'.*limits"):
        Scene.from_mujoco(model, ignore=["limit"])
    with pytest.raises(TypeError, match=r"ignore is 'limits'; give a list, ignore=\['limits'\]"):
        Scene.from_mujoco(model, ignore="limits")
    with pytest.raises(ValueError, match=r"the file nowhere.xml does not exist"):
        Scene.from_mujoco("nowhere.xml")
    with pytest.raises(TypeError, match=r"model is int; give a path, or a mujoco.MjModel"):
        Scene.from_mujoco(3)
    with pytest.raises(ValueError, match=r"qpos has shape \(2,\); the model needs \(1,\)"):
        Scene.from_mujoco(arm(), qpos=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"qpos is \[nan\], which is not finite"):
        Scene.from_mujoco(arm(), qpos=[np.nan])
    monkeypatch.setattr(mujoco, "__version__", "3.3.1")
    with pytest.raises(ImportError, match=r"needs mujoco 4.0 or newer, and finds 3.3.1"):
        Scene.from_mujoco(arm())


def test_a_joint_may_be_called_like_a_body():
    parts = dict.fromkeys(("option", "flags", "joint", "geom", "child", "body", "more"), "")
    model = mujoco.MjModel.from_xml_string(ARM.format(**parts).replace("hinge", "arm"))
    assert [effect.name for effect in Scene.from_mujoco(model).effects] == ["arm joint", "gravity"]


# Every field of a model


def fields(model):
    """Names of all fields of a compiled model, as in `mujoco_model_fields`."""
    for name in dir(model):
        if name in ("opt", "vis", "stat"):
            yield from (f"{name}.{part}" for part in fields(getattr(model, name)))
        elif not name.startswith("_") and not callable(getattr(model, name)):
            value = getattr(model, name)
            plain = isinstance(value, int | float | bytes | np.ndarray)
            yield from [name] if plain else (f"{name}.{part}" for part in fields(value))
    if isinstance(model, mujoco.MjModel):
        for kind, start, bits in (
            ("disable", "mjDSBL_", mujoco.mjtDisableBit),
            ("enable", "mjENBL_", mujoco.mjtEnableBit),
        ):
            yield from (f"opt.{kind}flags.{bit[7:]}" for bit in bits.__members__ if bit.startswith(start))


def treatments(name):
    """How a field is treated: by an entry of its own, or else by those that stand for many."""
    table = [("read", READ), ("idle", IDLE), ("refused", REFUSED_FIELDS)]
    entries = [(how, why, entry) for how, group in table for why, text in group.items() for entry in text.split()]
    exact = [(how, why) for how, why, entry in entries if entry == name]
    return exact or [(how, why) for how, why, entry in entries if fnmatchcase(name, entry)]


def test_every_field_is_read_or_refused_or_without_influence():
    names = list(fields(arm()))
    assert {name: treatments(name) for name in names if len(treatments(name)) != 1} == {}
    every = " ".join([*READ.values(), *IDLE.values(), *REFUSED_FIELDS.values()])
    assert [entry for entry in every.split() if not any(fnmatchcase(name, entry) for name in names)] == []
    counts = Counter(treatments(name)[0][0] for name in names)
    said = (
        f"{len(names)} fields of a model: {counts['read']} are read, {counts['refused']} refused when they are not at "
        "their default, "
    )
    assert f"{said}and {counts['idle']} have no influence on the motion" in PAGE.read_text(), counts


QUIET = {
    "option": 'actuatorgroupdisable="0"',
    "geom": 'contype="2" conaffinity="1"',
    "child": (
        '<body name="link" pos=".3 0 0" gravcomp="0.5"><joint name="k" axis="0 1 0"/><geom fromto="0 0 0 .1 0'
        ' 0"/></body>'
    ),
    "body": '<geom name="floor" type="plane" size="5 5 .1" contype="2" conaffinity="1"/>',
    "more": PINNED + MOTOR + '<tendon><fixed><joint joint="hinge" coef="1"/></fixed></tendon>',
}
"""A model in which everything is there and nothing acts that a scene does not express."""
BY_ELEMENT = {
    "npair": {"more": '<contact><pair geom1="floor" geom2="g"/></contact>', "geom": 'name="g"', "body": QUIET["body"]},
    "nmocap": {"body": '<body name="m" mocap="true"/>'},
    "nflex": {
        "body": (
            '<flexcomp name="f" type="grid" count="3 1 1" spacing=".1 .1 .1" dim="1" mass="1"><contact contype="0"'
            ' conaffinity="0"/><edge stiffness="1"/></flexcomp>'
        )
    },
    "nplugin": {
        "more": (
            '<extension><plugin plugin="mujoco.sensor.touch_grid"><instance name="p"><config key="size" value="1'
            ' 1"/><config key="fov" value="9 9"/></instance></plugin></extension>'
        )
    },
}
"""Models that have what no assignment can bring about: fields that are sizes."""
VALUES = {"geom_conaffinity": 2, "body_jntnum": 2, "eq_solimp": 0.5}
"""Values away from the default; 1 for others."""


def away(field):
    """The quiet model with a field away from its default."""
    if field in BY_ELEMENT:
        return arm(**BY_ELEMENT[field])
    model = arm(**QUIET)
    if field == "nactuator":
        model.opt.disableactuator = 0
    elif field == "opt.enableflags.SLEEP":
        model.opt.enableflags = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    elif field.startswith("opt."):
        setattr(model.opt, field[4:], 1.0)
    else:
        getattr(model, field)[-1] = VALUES.get(field, 1)
    return model


def test_each_refused_field_is_refused_by_name_and_ignored_by_name():
    assert not list(Compiled(mujoco, arm(**QUIET)).beyond())
    for kind, refusal in REFUSED.items():
        for field in refusal.fields:
            compiled = Compiled(mujoco, away(field), "directors" if field == "body_jntnum" else "joint")
            with pytest.raises(ValueError, match=rf"does not express: (.*; )?{kind} \("):
                compiled.refuse([])
            others = [name for name, _ in compiled.beyond() if name != kind]
            assert others in ([], ["several joints of one body"]), (
                field,
                others,
            )  # vertices of a flex are such bodies
            if refusal.ignorable:
                compiled.refuse([kind])
            else:
                with pytest.raises(ValueError, match=re.escape(refusal.without)):
                    compiled.refuse([kind])


def test_springs_and_dampers_of_ball_and_free_joints_and_couplings():
    ball = '<body name="b"><joint name="ball" type="ball" {}/><geom fromto="0 0 0 .1 0 0"/></body>'
    for attribute, flag in (("stiffness", "spring"), ("damping", "damper")):
        body, kind = ball.format(f'{attribute}="1"'), "springs and dampers of ball and free joints"
        assert list(Compiled(mujoco, arm(body=body)).beyond()) == [(kind, "joint ball")]
        assert not list(Compiled(mujoco, arm(body=body, flags=f'{flag}="disable"')).beyond())
    body, kind = ball.format('armature="1"'), "armature of ball and free joints"
    assert list(Compiled(mujoco, arm(body=body)).beyond()) == [(kind, "joint ball")]
    cable = '<tendon><spatial name="t"><site site="hook"/><site site="tip"/></spatial></tendon>'
    tied = arm(cable + '<equality><tendon tendon1="t"/></equality>')
    assert [kind for kind, _ in Compiled(mujoco, tied).beyond()] == ["couplings"]


def test_springs_that_are_ignored_are_left_out_whole():
    model = arm(joint='stiffness="2" damping="3"')
    model.jnt_stiffnesspoly[0, 0] = model.dof_dampingpoly[0, 0] = 1.0
    scene = Scene.from_mujoco(model, ignore=["springs that are not linear", "dampers that are not linear"])
    assert [effect.name for effect in scene.effects] == ["hinge", "gravity"]


def test_mocap_bodies_that_are_ignored_rest_where_a_keyframe_puts_them():
    body = '<body name="m" mocap="true" pos=".3 0 1"/>'
    more = (
        '<equality><connect name="e" body1="arm" body2="m" anchor=".3 0 0"/></equality><keyframe><key mpos="0.3 0'
        ' 1.4"/></keyframe>'
    )
    scene = Scene.from_mujoco(arm(more, body=body), ignore=["mocap bodies"])
    assert [body.name for body in scene.bodies] == ["arm"]
    assert scene.effects[1].between == ("arm", "ground")
    with pytest.raises(ValueError, match=r"e is open at the start by 0\.4 m"):
        Scene.from_mujoco(arm(more, body=body), ignore=["mocap bodies"], key=0)


# The page


def test_the_page_says_what_is_read_and_refused():
    page = PAGE.read_text()
    for kind, refusal in REFUSED.items():
        assert f"| {kind} | {'' if refusal.ignorable else 'cannot be ignored: '}{refusal.without} |\n" in page
    for why in (*READ, *IDLE):
        assert f"\n- {why}\n" in page, why


def test_the_program_of_the_page_runs(capsys):
    (program,) = re.findall(r"```py\n(.*?)```", PAGE.read_text(), re.DOTALL)
    exec(program, {})
    assert f"It prints `{capsys.readouterr().out.strip()}`." in PAGE.read_text()


# Actuators, as MuJoCo computes their forces

HELD = '<actuator><motor name="m" joint="hinge" {}/></actuator>'
ACTS = {
    "control of a keyframe": (HELD.format("") + '<keyframe><key ctrl="-1.5"/></keyframe>', "", 0, "actuator m"),
    "no control of zero": (HELD.format('ctrllimited="true" ctrlrange="1 2"'), "", None, "actuator m"),
    "no force of zero": (HELD.format('forcelimited="true" forcerange="1 2"'), "", None, "actuator m"),
    "no torque of zero": (HELD.format(""), 'actuatorfrcrange="1 2"', None, "joint hinge"),
    "activation of a keyframe": (
        '<actuator><general name="m" joint="hinge" dyntype="integrator"/></actuator><keyframe><key act="0.3"/></keyframe>',
        "",
        0,
        "actuator m",
    ),
    "servo at its target": (MOTOR, "", None, "actuator m"),
    "force on a site": ('<actuator><motor name="m" site="tip" ctrlrange="1 2" ctrllimited="true"/></actuator>', "", None, "actuator m"),
}  # fmt: skip


@pytest.mark.parametrize("case", ACTS)
def test_actuators_with_a_force_are_refused(case):
    more, joint, key, named = ACTS[case]
    with pytest.raises(ValueError, match=rf"actuators \({named}\)"):
        Scene.from_mujoco(arm(more, joint=joint), key=key)


@pytest.mark.parametrize("key", [None, 0])
def test_actuators_without_a_force_are_passed_over(key):
    more = HELD.format('ctrllimited="true" ctrlrange="-1 1"') + '<keyframe><key qpos="0.1" ctrl="0"/></keyframe>'
    assert [effect.name for effect in Scene.from_mujoco(arm(more), key=key).effects] == ["hinge", "gravity"]
