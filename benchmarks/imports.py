"""Model files that ship with gymnasium and dm_control: which are read, and how their motion differs from MuJoCo's.

From a random start both move for half a second with what is ignored switched off: MuJoCo by its Runge-Kutta method of order four, and the
scene by a composition of order four. The files alone are needed: pip install --no-deps gymnasium==1.4.0 dm_control==1.0.50.
"""

import time
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import vmri_jax as vm
from benchmarks.measure import Tell, silent
from benchmarks.report import Report

COLUMNS = ("file", "bodies", "coordinates", "scene", "first run", "error", "not read")
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
"""Factor by which MuJoCo's step is shortened where its motion overflows: strong dampers on light bodies, of some 2e5/s in a gripper, make its
method unstable. A smaller one would try more steps in vain, a larger one takes longer than it must."""
SPREAD, RATE = 0.2, 0.5
"""Standard deviations of coordinates and velocities at the start, rad, rad/s, m and m/s."""


class Size(NamedTuple):
    """The files to read, each with its package."""

    files: tuple[tuple[str, Path], ...]


def sizes(name: str) -> Size:
    """The files of the packages that are installed.

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
    if name == "quick":
        files = [(package, file) for package, file in files if file.stem.startswith(QUICK)]
    return Size(tuple(files))


def _mujoco() -> Any:
    """The package, only when it is needed: other benchmarks do without."""
    return import_module("mujoco")


def start(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """(qpos, qvel) at random, and the model without what is ignored and without its equalities, which MuJoCo keeps softly."""
    mujoco = _mujoco()
    off = mujoco.mjtDisableBit
    for flag in (off.mjDSBL_CONTACT, off.mjDSBL_LIMIT, off.mjDSBL_ACTUATION, off.mjDSBL_EQUALITY):
        model.opt.disableflags |= int(flag)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    random, qpos = np.random.default_rng(0), model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, random.normal(size=model.nv), SPREAD)
    return qpos, RATE * random.normal(size=model.nv)


def their_centres(model: Any, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, np.ndarray]:
    """Centres of mass at the end by MuJoCo, of bodies that are welded together one, by the names that a scene gives them."""
    from vmri_jax.scene.mujoco_model import Compiled

    mujoco = _mujoco()
    data, compiled, found = mujoco.MjData(model), Compiled(mujoco, model), {}
    model.opt.timestep = THEIR_STEP
    while not moved(model, data, qpos, qvel):
        model.opt.timestep /= SHORTER
    for root in compiled.roots:
        members = np.flatnonzero(model.body_weldid == root)
        masses = model.body_mass[members]
        found[compiled.name("body", root)] = masses @ data.xipos[members] / masses.sum()
    return found


def moved(model: Any, data: Any, qpos: np.ndarray, qvel: np.ndarray) -> bool:
    """Whether MuJoCo has moved the data to the end; else its accelerations have overflowed, after which it starts anew without a word."""
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
    from vmri_jax.scene import Scene

    mujoco = _mujoco()
    model = mujoco.MjModel.from_xml_path(str(file))
    try:
        Scene.from_mujoco(model, ignore=IGNORED)  # with its equalities
    except ValueError as error:
        return {"not read": str(error).split(". Change the model")[0].removeprefix("Scene.from_mujoco: ")}
    qpos, qvel = start(model)
    begin = time.process_time()
    scene = Scene.from_mujoco(model, qpos=qpos, qvel=qvel, ignore=IGNORED)
    made = time.process_time()
    scheme, steps = vm.compose(vm.fully_implicit(1), "suzuki4"), round(T_END / STEP)
    run = vm.simulate(scene, scheme, macro_dt=STEP, num_steps=steps, save_every=steps)
    ran = time.process_time()
    theirs = their_centres(model, qpos, qvel)
    error = max(float(np.abs(run.position(name)[-1, :3] - centre).max()) for name, centre in theirs.items())
    return {
        "bodies": len(theirs),
        "coordinates": sum(x.size for x in scene.start[:2]),
        "scene": made - begin,
        "first run": ran - made,
        "error": error,
    }


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """All files, a report after each."""
    rows: list[dict] = []
    for package, file in size.files:
        tell(file.stem)
        rows.append({"file": f"{package}/{file.name}"} | compare(file))
        errors = [row["error"] for row in rows if "error" in row]
        notes = [
            f"{len(errors)} of {len(rows)} files are read with ignore={IGNORED}; largest error of a centre of mass after {T_END:g} s: "
            f"{max(errors, default=0.0):.1e} m",
            "scene and first run: seconds of processor time, the run with its compiling",
        ]
        yield Report("imports", name, rows, [], notes)
