"""Model files that ship with gymnasium and dm_control: which are read, and how their motion differs from MuJoCo's.

From a random start, with what is ignored switched off, the accelerations of both are compared. All models then move for
half a second: in MuJoCo by its Runge-Kutta method of order four, as scenes by a composition of order four. The files
alone are needed: pip install --no-deps gymnasium==1.4.0 dm_control==1.0.50.
"""

import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import vmri_jax as vm
from benchmarks.measure import Tell, silent
from benchmarks.report import Report

FOLDERS = {"gymnasium": "envs/mujoco/assets", "dm_control": "suite"}
"""Where packages have models that stand for themselves."""
INSTALL = "pip install --no-deps gymnasium==1.4.0 dm_control==1.0.50"
"""What brings their files, and nothing else."""
IGNORED = ["contact", "limits", "actuators"]
QUICK = ("hopper", "reacher", "acrobot", "cartpole", "swimmer", "point")
"""Beginnings of the names of files that the quick benchmark tries: with few bodies, which compile in seconds."""
T_END, STEP, THEIR_STEP = 0.5, 2e-3, 5e-5
"""s: length of the motion, the macro step, and MuJoCo's step, at both of which errors are below 1e-8."""
SHORTER = 5.0
"""Factor by which MuJoCo's step is shortened where its motion overflows: strong dampers on light bodies, of some 2e5/s
in a gripper, make its method unstable. A smaller one would try more steps in vain, a larger one takes longer than it
must."""
SPREAD, RATE = 0.2, 0.5
"""Standard deviations of coordinates and velocities at the start, rad, rad/s, m and m/s."""


def sizes(name: str, only: Sequence[str] = ()) -> list[tuple[str, Path]]:
    """Packages and files: of the packages that are installed, or those `only` whose names begin like this.

    Raises:
        FileNotFoundError: there are none.
    """
    files: list[tuple[str, Path]] = []
    for package, folder in FOLDERS.items():
        spec = find_spec(package)
        for place in (spec.submodule_search_locations or ()) if spec else ():
            files += [(package, file) for file in sorted((Path(place) / folder).glob("*.xml"))]
    if not files:
        raise FileNotFoundError(f"neither {' nor '.join(FOLDERS)} is installed: {INSTALL}")
    beginnings = tuple(only) or (QUICK if name == "quick" else ("",))
    return [(package, file) for package, file in files if file.stem.startswith(beginnings)]


def _mujoco() -> Any:
    """The package, only when it is needed: other benchmarks do without."""
    return import_module("mujoco")


def start(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """(qpos, qvel) at random, and the model without what is ignored and without its equalities, which MuJoCo keeps
    softly."""
    mujoco = _mujoco()
    off = mujoco.mjtDisableBit
    for flag in (off.mjDSBL_CONTACT, off.mjDSBL_LIMIT, off.mjDSBL_ACTUATION, off.mjDSBL_EQUALITY):
        model.opt.disableflags |= int(flag)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    random, qpos = np.random.default_rng(0), model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, random.normal(size=model.nv), SPREAD)
    return qpos, RATE * random.normal(size=model.nv)


def their_centres(model: Any, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, np.ndarray]:
    """Centres of mass at the end by MuJoCo, by the names that a scene gives to its bodies."""
    data = _mujoco().MjData(model)
    model.opt.timestep = THEIR_STEP
    while not moved(model, data, qpos, qvel):
        model.opt.timestep /= SHORTER
    return of_centres(model, data.xipos)


def their_accelerations(model: Any, data: Any) -> dict[str, np.ndarray]:
    """Accelerations of the centres of mass by MuJoCo at the state of its data, by the names that a scene gives to its
    bodies."""
    mujoco, accelerations = _mujoco(), np.zeros((model.nbody, 3))
    has_gravity = not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    for body in range(1, model.nbody):
        felt = np.zeros(6)  # rotation, translation; a body at rest feels -g
        mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, body, felt, 0)
        accelerations[body] = felt[3:] + has_gravity * model.opt.gravity
    return of_centres(model, accelerations)


def apart(scene: Any, model: Any, data: Any) -> tuple[float, float]:
    """Largest difference of the accelerations of a scene and of MuJoCo, and their size, the largest of MuJoCo, or 1
    m/s^2 if that is larger."""
    from benchmarks.body_motions import accelerations, state_of  # only now: scenes start JAX

    ours, theirs = accelerations(scene, state_of(scene)), their_accelerations(model, data)
    differences = (float(np.abs(ours[name][2][:3] - a).max()) for name, a in theirs.items())
    return max(differences), max(1.0, *(float(np.abs(a).max()) for a in theirs.values()))


def of_centres(model: Any, values: np.ndarray) -> dict[str, np.ndarray]:
    """Of bodies that are welded together one value, that of their centre of mass."""
    from vmri_jax.scene.mujoco_model import Compiled

    compiled, centres = Compiled(_mujoco(), model), {}
    for root in compiled.roots:
        members = np.flatnonzero(model.body_weldid == root)
        masses = model.body_mass[members]
        centres[compiled.name("body", root)] = masses @ values[members] / masses.sum()
    return centres


def moved(model: Any, data: Any, qpos: np.ndarray, qvel: np.ndarray) -> bool:
    """Whether MuJoCo has moved the data to the end; else its accelerations have overflowed, after which it starts anew
    without a word."""
    mujoco = _mujoco()
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:] = qpos, qvel
    for _ in range(round(T_END / model.opt.timestep)):
        mujoco.mj_step(model, data)
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            return False
    mujoco.mj_forward(model, data)
    return True


def compare(file: Path) -> dict[str, Any]:
    """The row of one file."""
    from vmri_jax.scene import Scene  # only now: scenes start JAX

    mujoco = _mujoco()
    model = mujoco.MjModel.from_xml_path(str(file))
    try:
        Scene.from_mujoco(model, ignore=IGNORED)  # with its equalities
    except ValueError as error:
        return {"not read": str(error).split(". Change the model")[0].removeprefix("Scene.from_mujoco: ")}
    qpos, qvel = start(model)
    begin = time.process_time()
    scene = Scene.from_mujoco(model, qpos=qpos, qvel=qvel, ignore=IGNORED)
    row: dict[str, Any] = {"scene": time.process_time() - begin, "coordinates": sum(x.size for x in scene.start[:2])}
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    difference, size = apart(scene, model, data)
    row |= {"bodies": len(scene.bodies), "acceleration": difference / size}
    begin = time.process_time()
    scheme, steps = vm.compose(vm.fully_implicit(1), "suzuki4"), round(T_END / STEP)
    run = vm.simulate(scene, scheme, macro_dt=STEP, num_steps=steps, save=steps)
    row["first run"] = time.process_time() - begin
    centres = their_centres(model, qpos, qvel)
    row["error"] = max(float(np.abs(run.position(name)[-1, :3] - centre).max()) for name, centre in centres.items())
    return row


def run(files: list[tuple[str, Path]], name: str, tell: Tell = silent) -> Iterator[Report]:
    """All files, a report after each."""
    rows: list[dict] = []
    for package, file in files:
        tell(file.stem)
        rows.append({"file": f"{package}/{file.name}"} | compare(file))
        errors = [row["error"] for row in rows if "error" in row]
        apart = [row["acceleration"] for row in rows if "acceleration" in row]
        notes = [
            (
                f"{len(apart)} of {len(rows)} files are read with ignore={IGNORED}; accelerations at the start differ "
                f"by at most {max(apart, default=0.0):.1e} of the largest one"
            ),
            (
                f"largest error of a centre of mass after {T_END:g} s, in {len(errors)} models: "
                f"{max(errors, default=0.0):.1e} m"
            ),
            "scene and first run: seconds of processor time, the run with its compiling",
        ]
        yield Report("imports", name, rows, [], notes)
