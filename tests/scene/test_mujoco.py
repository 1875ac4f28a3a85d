"""Models of MuJoCo as scenes: the same motion as MuJoCo's own, and what is refused."""

import numpy as np
import pytest

import vmri_jax as vm
from vmri_jax.scene import Scene

mujoco = pytest.importorskip("mujoco")

TREE = """
<mujoco>
  <option gravity="0 0 -9.81" integrator="RK4" timestep="0.0002"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" stiffness="2" springref="20" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03"/>
      <body name="hand" pos="0.5 0 0" euler="0 0 30">
        <joint name="wrist" type="ball"/>
        <geom type="box" size="0.05 0.1 0.15" pos="0.1 0.02 -0.2"/>
        <body name="weight" pos="0.2 0 -0.3"><geom type="sphere" size="0.06"/></body>
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
  <option gravity="0 0 -9.81" integrator="RK4" timestep="0.0002"><flag contact="disable"/></option>
  <worldbody>
    <body name="crank"><joint name="a" type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 1" size="0.03"/>
      <body name="rod" pos="0 0 1"><joint name="b" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 1.5 0 0.5" size="0.03"/></body>
    </body>
    <body name="rocker" pos="1.5 0 0"><joint name="c" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 1.5" size="0.03"/></body>
  </worldbody>
  <equality><connect name="pin" body1="rod" body2="rocker" anchor="1.5 0 0.5"/></equality>
</mujoco>
"""


def motion(model, qpos, qvel, t_end):
    """MuJoCo's centres of mass at the end, by its own Runge-Kutta method of order four."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qvel[:] = qvel
    for _ in range(round(t_end / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    return data


def test_a_tree_moves_as_in_mujoco():
    model = mujoco.MjModel.from_xml_string(TREE)
    data = mujoco.MjData(model)
    qpos, qvel = data.qpos.copy(), 0.3 * np.arange(1.0, model.nv + 1)
    scene = Scene.from_mujoco(model, qpos=qpos, qvel=qvel)
    assert [body.name for body in scene.bodies] == ["upper", "hand", "slider"]  # the weight is welded to the hand
    run = vm.simulate(scene, vm.galerkin(num_micro=1, degree=3), macro_dt=0.01, t_end=0.5)
    found = motion(model, qpos, qvel, 0.5)
    for name in ("upper", "slider"):
        centre = np.asarray(run.position(name))[-1, :3]
        np.testing.assert_allclose(centre, found.xipos[model.body(name).id], atol=1e-6)
    hand = [model.body(name).id for name in ("hand", "weight")]
    masses = model.body_mass[hand]
    np.testing.assert_allclose(
        np.asarray(run.position("hand"))[-1, :3], masses @ found.xipos[hand] / masses.sum(), atol=1e-6
    )
    assert float(run.constraint_residual[:, 0].max()) < 1e-12


def test_a_loop_is_closed_to_round_off():
    model = mujoco.MjModel.from_xml_string(LOOP)
    scene = Scene.from_mujoco(model)
    assert len(scene.dropped) == 1
    run = vm.simulate(scene, vm.galerkin(num_micro=1, degree=2), macro_dt=0.005, t_end=0.5)
    assert float(run.constraint_residual[:, 0].max()) < 1e-12
    stiff = LOOP.replace('anchor="1.5 0 0.5"', 'anchor="1.5 0 0.5" solref="0.002 1"').replace("0.0002", "0.00002")
    found = motion(mujoco.MjModel.from_xml_string(stiff), 0.0, 0.0, 0.5)  # MuJoCo's loop is soft: 2e-4 open by default
    np.testing.assert_allclose(
        np.asarray(run.position("rocker"))[-1, :3], found.xipos[model.body("rocker").id], atol=1e-6
    )


def test_what_a_scene_does_not_express_is_refused_in_one_list():
    text = TREE.replace('<flag contact="disable"/>', "").replace(
        'name="rail"', 'name="rail" armature="0.1" range="-1 1"'
    )
    text = text.replace("</mujoco>", '<actuator><motor joint="shoulder"/></actuator></mujoco>')
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(
        ValueError, match=r"actuators \(1\); contact .*; limits \(of the joints rail\); armature .*ignore="
    ):
        Scene.from_mujoco(model)
    assert Scene.from_mujoco(model, ignore=["actuators", "contact", "limits", "armature"]).bodies
    with pytest.raises(ValueError, match=r"the file nowhere.xml does not exist"):
        Scene.from_mujoco("nowhere.xml")
    with pytest.raises(TypeError, match=r"model is int; give a path, or a mujoco.MjModel"):
        Scene.from_mujoco(3)
    with pytest.raises(ValueError, match=r"qpos has shape \(2,\); the model needs"):
        Scene.from_mujoco(model, qpos=[0.0, 1.0])
