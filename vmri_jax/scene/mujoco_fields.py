"""The parts of a compiled `mujoco.MjModel` that no scene expresses, by the fields that bring them about.

A field has its name in Python, ``jnt_stiffness``, ``opt.density``, and a flag the name of its bit, ``opt.disableflags.SPRING``.

Source: the comments in MuJoCo's mjmodel.h, and its documentation, "XML reference".
"""

from dataclasses import dataclass, field

CONSTRAINTS = "CONSTRAINT"
"""The flag that switches off contact, limits, dry friction and equalities at once."""
PASSIVE = "SPRING DAMPER"
"""The flags that together switch off all passive forces, with the forces of the fluid and the compensation of gravity."""


@dataclass(frozen=True)
class Refusal:
    """A part of a model that no scene expresses; `ignore` may name it unless it is not `ignorable`.

    without: the motion of the model if `ignore` names this part; for a part that it may not name, advice.
    fields: the fields whose entries define the part, each with the flags that switch it off, see `Compiled.off`.
    """

    without: str
    fields: dict[str, tuple[str, ...]] = field(default_factory=dict)
    ignorable: bool = True


REFUSED = {
    "actuators": Refusal(
        "actuators exert no force, and their armature and damping are left out",
        {
            "nactuator": ("ACTUATION",),
            "actuator_armature": (),
            "actuator_damping": ("DAMPER",),
            "actuator_dampingpoly": ("DAMPER",),
        },
    ),
    "tendons": Refusal(
        "their springs, dampers, dry friction and armature do not act",
        {
            "tendon_stiffness": ("SPRING",),
            "tendon_stiffnesspoly": ("SPRING",),
            "tendon_damping": ("DAMPER",),
            "tendon_dampingpoly": ("DAMPER",),
            "tendon_frictionloss": (CONSTRAINTS, "FRICTIONLOSS"),
            "tendon_armature": (),
        },
    ),
    "contact": Refusal(
        "bodies pass through each other",
        {
            "geom_contype": (CONSTRAINTS, "CONTACT"),
            "geom_conaffinity": (CONSTRAINTS, "CONTACT"),
            "npair": (CONSTRAINTS, "CONTACT"),
        },
    ),
    "limits": Refusal(
        'joints turn and slide, and tendons stretch, without end; limits="spring" makes those of joints springs',
        {"jnt_limited": (CONSTRAINTS, "LIMIT"), "tendon_limited": (CONSTRAINTS, "LIMIT")},
    ),
    "armature of ball and free joints": Refusal("it is left out"),
    "frictionloss": Refusal("joints have no dry friction", {"dof_frictionloss": (CONSTRAINTS, "FRICTIONLOSS")}),
    "springs that are not linear": Refusal(
        "the springs that are named are left out, with their linear part",
        {"jnt_stiffnesspoly": ("SPRING",), "jnt_springyield": ("SPRING",)},
    ),
    "dampers that are not linear": Refusal(
        "the dampers that are named are left out, with their linear part", {"dof_dampingpoly": ("DAMPER",)}
    ),
    "springs and dampers of ball and free joints": Refusal("they are left out"),
    "couplings": Refusal("joints and tendons in these equalities move independently"),
    "soft equalities": Refusal(
        "they are kept to round-off, as all equalities are",
        {"eq_solref": (CONSTRAINTS, "EQUALITY"), "eq_solimp": (CONSTRAINTS, "EQUALITY")},
    ),
    "fluid": Refusal("bodies move in a vacuum", {"opt.density": (PASSIVE,), "opt.viscosity": (PASSIVE,)}),
    "mocap bodies": Refusal("they rest where they start", {"nmocap": ()}),
    "plugins": Refusal("their forces do not act", {"nplugin": ()}),
    "sleep": Refusal("bodies at rest are moved like others", {"opt.enableflags.SLEEP": ()}),
    "several joints of one body": Refusal(
        'take coordinates="joint", with hinges and slides in place of a ball', ignorable=False
    ),
    "compensation of gravity by actuators": Refusal(
        "take actuatorgravcomp off the joints: gravcomp of bodies then acts by itself",
        {"jnt_actgravcomp": ("GRAVITY", PASSIVE)},
        ignorable=False,
    ),
    "flexible bodies": Refusal("make them of rigid bodies and joints", {"nflex": ()}, ignorable=False),
}
"""The parts that the reader refuses, by their names in messages and in `ignore`."""
