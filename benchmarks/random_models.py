"""Random models of MuJoCo with every feature of its table: those that are read accelerate as in MuJoCo, all others are
refused by name.

A model is a tree of up to four bodies with random joints, inertias, springs, keyframe and actuators, with the fields
that have no influence on the motion away from their defaults, and with flags and refused features drawn at random.
"""

from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np

from benchmarks.imports import apart
from benchmarks.measure import Tell, silent
from benchmarks.report import Report

CHANCE = 0.12
"""Probability of each feature that a scene does not express, of each flag and of each actuator that acts."""
LARGEST_DIFFERENCE = 1e-8
"""Difference of accelerations, relative to the largest of the model, above which a model counts as wrong: round-off of
chains of four bodies is below 1e-10, and a missing feature changes accelerations by parts of one."""
REFUSED_PARTS = {
    "limits": ("joint", 'range="-50 60"'),
    "frictionloss": ("joint", 'frictionloss="0.3"'),
    "contact": ("geom", 'contype="1" conaffinity="1"'),
    "fluid": ("option", 'density="1.2" wind="1 2 0"'),
    "compensation of gravity by actuators": ("joint", 'actuatorgravcomp="true"'),
}
"""Features that are refused by name, as attributes of an element."""
ACTUATORS = (
    '<motor joint="{joint}" gear="2"/>',
    '<motor joint="{joint}" ctrllimited="true" ctrlrange="{low} 2"/>',
    '<motor joint="{joint}" forcelimited="true" forcerange="{low} 3"/>',
    '<general joint="{joint}" dyntype="integrator" gainprm="3"/>',
    '<general joint="{joint}" dyntype="filter" dynprm="0.1" gainprm="3"/>',
    '<position joint="{joint}" kp="4"/>',
    '<velocity joint="{joint}" kv="0.5"/>',
    '<damper joint="{joint}" kv="0.5" ctrlrange="0 1"/>',
    '<motor site="{site}" gear="1 2 3 1 0 0" ctrllimited="true" ctrlrange="{low} 2"/>',
)
"""Actuators; {low} is -1, or 1 so that a control of zero acts as 1."""
IDLE = (
    'integrator="implicitfast"', 'integrator="RK4"', 'timestep="0.01"', 'cone="elliptic"', 'solver="CG"',
    'jacobian="sparse"', 'iterations="3"', 'tolerance="1e-3"', 'impratio="5"', 'magnetic="1 2 3"',
    'noslip_iterations="2"', 'ls_iterations="9"',
)  # fmt: skip
"""Options without influence on accelerations."""
FLAGS = ("spring", "damper", "gravity", "actuation", "limit", "frictionloss", "clampctrl", "contact", "equality",
         "eulerdamp", "warmstart", "sensor", "midphase", "island", "filterparent", "refsafe")  # fmt: skip
"""Features that a flag may switch off."""


def sizes(name: str) -> range:
    """ "quick" or "full": seeds of the models."""
    return range(300 if name == "full" else 12)


def xml(seed: int) -> str:
    """The model with this seed, in MuJoCo's XML, with one keyframe."""
    random = np.random.default_rng(seed)

    def chance(p: float = CHANCE) -> bool:
        return bool(random.random() < p)

    def numbers(size: int, scale: float = 1.0) -> str:
        return " ".join(f"{x:.6f}" for x in scale * random.normal(size=size))

    extra = {"joint": "", "geom": 'contype="0" conaffinity="0"', "option": ""}
    for where, attribute in REFUSED_PARTS.values():
        if chance(CHANCE / 2):
            extra[where] = attribute if where == "geom" else f"{extra[where]} {attribute}"
    joints: list[str] = []

    def joint(body: int, kinds: list[str]) -> str:
        name, kind = f"j{len(joints)}", str(random.choice(kinds))
        if kind == "ball":
            return f'<joint name="ball{body}" type="ball" pos="{numbers(3, 0.1)}"/>'
        joints.append(name)
        parts = [f'name="{name}" type="{kind}" axis="{numbers(3)}" pos="{numbers(3, 0.1)}" ref="{numbers(1, 5.0)}"']
        parts += [f'stiffness="{random.uniform(0, 20):.5f}" springref="{numbers(1, 9.0)}"'] * chance(0.4)
        parts += [f'damping="{random.uniform(0, 2):.5f}"'] * chance(0.4)
        parts += [f'armature="{random.uniform(0, 0.3):.5f}"'] * chance(0.4)
        parts += [f'actuatorfrcrange="{random.choice([-1, 1])} 2"'] * chance(CHANCE / 2)
        parts += ['user="1 2" group="3" margin="0.01" solimplimit="0.8 0.9 0.01"'] * chance(0.3)
        return f"<joint {' '.join(parts)} {extra['joint']}/>"

    def shape(welded: bool = False) -> str:
        kind, size = (("sphere", 1), ("capsule", 2), ("box", 3), ("ellipsoid", 3), ("cylinder", 2))[random.integers(5)]
        sizes = " ".join(f"{x:.5f}" for x in random.uniform(0.05, 0.2, size=size))
        mass = f'mass="{random.uniform(0.2, 2):.4f}"' if chance(0.5) else f'density="{random.uniform(100, 2000):.1f}"'
        place = f'pos="{numbers(3, 0.2)}" euler="{numbers(3, 40.0)}"'
        seen = 'rgba="1 0 0 1" group="2" friction="2 1 1" margin="0.01" solref="0.1 2"' if chance(0.3) else ""
        inner = f'<geom type="{kind}" size="{sizes}" {place} {mass} {seen} {extra["geom"]}/>'
        return f'<body pos="{numbers(3, 0.2)}" euler="{numbers(3, 40.0)}">{inner}</body>' if welded else inner

    def body(number: int, children: dict[int, list[int]]) -> str:
        gravcomp = f'gravcomp="{random.uniform(0, 1.5):.4f}"' if chance(0.25) else ""
        inner = []
        if children[-1] == number and chance(0.3):
            inner.append("<freejoint/>")
        else:
            several = chance(0.25)
            inner += [joint(number, ["hinge", "slide"] if several else ["hinge", "hinge", "slide", "ball"])]
            inner += [joint(number, ["hinge", "slide"])] * several if several else []
        inner += [shape(), shape(welded=True)] if chance(0.3) else [shape()]
        if chance(0.3):
            inner.append(
                f'<inertial pos="{numbers(3, 0.1)}" mass="{random.uniform(0.5, 2):.4f}" diaginertia="0.03 0.02 0.04"'
                f' euler="{numbers(3, 40.0)}"/>'
            )
        inner.append(f'<site name="s{number}" pos="{numbers(3, 0.1)}"/>')
        inner += [body(child, children) for child in children[number]]
        return (
            f'<body name="b{number}" pos="{numbers(3, 0.4)}" euler="{numbers(3, 40.0)}" {gravcomp}'
            f' user="7">{"".join(inner)}</body>'
        )

    count = int(random.integers(1, 5))
    children: dict[int, Any] = {number: [] for number in range(count)} | {-1: 0}
    for number in range(1, count):
        children[int(random.integers(number))].append(number)
    tree = body(0, children)
    actuators = []
    for name in joints:
        if chance(0.5):
            kind = ACTUATORS[random.integers(len(ACTUATORS)) if chance(0.5) else 0]
            low = 1 if chance() else -1
            actuators.append(kind.format(joint=name, site="s0", low=low))
    sensors = f'<sensor><jointpos joint="{joints[0]}"/></sensor>' if joints and chance(0.3) else ""
    tendon = ""
    if joints and chance(0.3):
        stiff = 'stiffness="2"' if chance() else ""
        tendon = f'<tendon><fixed name="t" {stiff}><joint joint="{joints[0]}" coef="1.5"/></fixed></tendon>'
    flags = " ".join(f'{flag}="disable"' for flag in FLAGS if chance(CHANCE / 2))
    idle = " ".join({option.split("=")[0]: option for option in IDLE if chance(0.3)}.values())
    gravity = f'gravity="{numbers(3, 5.0)}"' if chance(0.7) else ""
    return f"""<mujoco><compiler angle="degree" autolimits="true"/><size nuser_body="1" nuser_jnt="2"/>
      <option {gravity} {idle} {extra["option"]}><flag {flags}/></option>
      <worldbody>{tree}</worldbody>{tendon}<actuator>{"".join(actuators)}</actuator>{sensors}</mujoco>"""


def model_of(seed: int) -> tuple[Any, Any]:
    """The compiled model, and its `mujoco.MjData` at a random start with controls and activations, some of them not
    zero."""
    mujoco: Any = import_module("mujoco")
    model = mujoco.MjModel.from_xml_string(xml(seed))
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 0.4)
    data.qvel[:] = random.normal(size=model.nv)
    if random.random() < CHANCE:
        data.ctrl[:] = random.normal(size=model.nu)
    if random.random() < CHANCE:
        data.act[:] = random.normal(size=model.na)
    return model, data


def compare(seed: int) -> dict[str, Any]:
    """The row of one model: the difference of accelerations relative to the largest one, or the features that are
    refused."""
    from vmri_jax.scene import Scene  # only now: scenes start JAX
    from vmri_jax.scene.mujoco_model import Compiled

    mujoco: Any = import_module("mujoco")
    model, data = model_of(seed)
    row = {"model": seed, "bodies": model.nbody - 1, "coordinates": model.nv}
    keyed = keyframe(mujoco, seed, data)
    refused = [kind for kind, _ in Compiled(mujoco, keyed, data=data).beyond()]
    try:
        scene = Scene.from_mujoco(keyed, key=0)
    except ValueError as error:
        if not refused or any(kind not in str(error) for kind in refused):
            raise
        return row | {"refused": ", ".join(refused)}
    difference, size = apart(scene, model, data)
    return row | {"difference": difference / size}


def keyframe(mujoco: Any, seed: int, data: Any) -> Any:
    """The model with a keyframe of these data."""
    values = {"qpos": data.qpos, "qvel": data.qvel, "ctrl": data.ctrl, "act": data.act}
    parts = [f'{name}="{" ".join(f"{x:.17g}" for x in value)}"' for name, value in values.items() if len(value)]
    keys = f"<keyframe><key {' '.join(parts)}/></keyframe></mujoco>"
    return mujoco.MjModel.from_xml_string(xml(seed).replace("</mujoco>", keys))


def run(seeds: range, name: str, tell: Tell = silent) -> Iterator[Report]:
    """All models, one report."""
    rows = []
    for seed in seeds:
        tell(f"model {seed}")
        rows.append(compare(seed))
    read = [row["difference"] for row in rows if "difference" in row]
    counts = Counter(kind for row in rows if "refused" in row for kind in row["refused"].split(", "))
    notes = [
        (
            f"{len(read)} of {len(rows)} models are read; their accelerations differ by at most "
            f"{max(read, default=0.0):.1e} of the largest one"
        ),
        f"refused: {', '.join(f'{kind} {number}' for kind, number in counts.most_common())}",
    ]
    yield Report("models", name, rows, [], notes)
