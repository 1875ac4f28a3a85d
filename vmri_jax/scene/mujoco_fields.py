"""Every field of a compiled `mujoco.MjModel` and its use in a scene: read, refused by name, or without influence on the motion.

A field has its name in Python, ``jnt_stiffness``, ``opt.density``, ``vis.map.force``, and a flag the name of its bit,
``opt.disableflags.SPRING``. ``flex*`` stands for all fields that begin with "flex" and have no entry of their own.

Source: the comments in MuJoCo's mjmodel.h, and its documentation, "XML reference".
"""

from dataclasses import dataclass, field

CONSTRAINTS = "CONSTRAINT"
"""The flag that switches off contact, limits, dry friction and equalities at once."""
PASSIVE = "SPRING DAMPER"
"""The flags that together switch off all passive forces, with the forces of the fluid and the compensation of gravity."""

READ = {
    "bodies, their masses, and which are welded together": """nbody body_mass body_inertia body_ipos body_iquat body_pos body_quat
        body_parentid body_weldid body_mocapid""",
    "joints": """njnt nq nv jnt_type jnt_bodyid jnt_pos jnt_axis jnt_qposadr jnt_dofadr dof_jntid body_jntadr
        body_jntnum""",
    "springs, dampers and armature in joints": "jnt_stiffness dof_damping qpos_spring dof_armature",
    'limits of joints, for limits="spring"': "jnt_range jnt_solref dof_invweight0",
    "the start, where no qpos is given": "qpos0 nkey key_qpos key_qvel",
    "gravity and its compensation": "opt.gravity body_gravcomp",
    "equalities connect, weld, and of joints and fixed tendons": """tendon_adr tendon_num wrap_type wrap_objid wrap_prm neq eq_type eq_objtype eq_obj1id eq_obj2id eq_active0 eq_data
        nsite site_bodyid site_pos site_quat""",
    "which bodies could touch": "ngeom geom_bodyid pair_geom1 pair_geom2 nexclude exclude_signature",
    "names": "names name_*",
    "flags that switch features off": """opt.disableflags opt.enableflags opt.disableactuator opt.disableflags.CONSTRAINT
        opt.disableflags.EQUALITY opt.disableflags.FRICTIONLOSS opt.disableflags.LIMIT opt.disableflags.CONTACT
        opt.disableflags.SPRING opt.disableflags.DAMPER opt.disableflags.GRAVITY opt.disableflags.FILTERPARENT
        opt.disableflags.ACTUATION""",
}
"""Fields that the reader uses itself or through MuJoCo's kinematics, by their content."""

IDLE = {
    "shapes and pictures": """vis.* cam_* ncam light_* nlight mat_* nmat tex_* ntex ntexdata skin_* nskin* mesh_* nmesh* npolygonmax hfield_*
        nhfield* geom_matid geom_group geom_castshadow geom_rgba site_type site_dataid site_matid site_group site_size site_rgba
        site_sameframe jnt_group paths npaths""",
    "sensors": "sensor_* nsensor* opt.magnetic opt.disableflags.SENSOR",
    "data of users, and other fields of keyframes": "body_user jnt_user geom_user site_user nuser* numeric_* nnumeric* text_* ntext* tuple_* ntuple* key_*",
    "values that MuJoCo derives from other fields": """stat.* signature flg_* ngravcomp body_rootid body_dofnum body_dofadr
        body_treeid body_geomnum body_geomadr body_simple body_sameframe body_subtreemass body_invweight0 body_margin body_contype
        body_conaffinity body_bvhadr body_bvhnum bvh_* nbvh* oct_* noct dof_bodyid dof_parentid dof_treeid dof_Madr dof_simplenum
        dof_M0 dof_length tree_bodyadr tree_bodynum tree_dofadr tree_dofnum ntree B_* D_* M_* mapD2M mapM2D mapM2M
        nB nC nD nM nJmom nemax nnames nnames_map names_map""",
    "memory": "narena nbuffer njmax nconmax nhistory",
    "how MuJoCo integrates and solves; here a scheme and its step are chosen": """opt.timestep opt.integrator opt.cone opt.jacobian
        opt.solver opt.iterations opt.tolerance opt.impratio opt.ls_iterations opt.ls_tolerance opt.noslip_iterations
        opt.noslip_tolerance opt.ccd_iterations opt.ccd_tolerance opt.sdf_initpoints opt.sdf_iterations opt.disableflags.CLAMPCTRL
        opt.disableflags.WARMSTART opt.disableflags.REFSAFE opt.disableflags.MIDPHASE opt.disableflags.EULERDAMP
        opt.disableflags.AUTORESET opt.disableflags.NATIVECCD opt.disableflags.ISLAND opt.disableflags.MULTICCD
        opt.enableflags.ENERGY opt.enableflags.FWDINV opt.enableflags.INVDISCRETE opt.enableflags.DIAGEXACT""",
}
"""Fields without influence on the motion, by their purpose."""


@dataclass(frozen=True)
class Refusal:
    """A part of a model that no scene expresses.

    Attributes:
        without: the motion of the model if `ignore` names this part; for a part that `ignore` may not name, advice.
        fields: the fields whose entries define the part, each with the flags that switch it off: any entry is enough, of an entry with several flags all of them.
        parts: fields without meaning if the part is absent.
        ignorable: whether `ignore` may name this part.
    """

    without: str
    fields: dict[str, tuple[str, ...]] = field(default_factory=dict)
    parts: str = ""
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
        "nu nout na actuator_* jnt_actuatorid tendon_actuatorid jnt_actfrclimited jnt_actfrcrange",
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
        "ntendon nJten nwrap tendon_* ten_J_* wrap_*",
    ),
    "contact": Refusal(
        "bodies pass through each other",
        {
            "geom_contype": (CONSTRAINTS, "CONTACT"),
            "geom_conaffinity": (CONSTRAINTS, "CONTACT"),
            "npair": (CONSTRAINTS, "CONTACT"),
        },
        """geom_type geom_size geom_pos geom_quat geom_dataid geom_sameframe geom_aabb geom_rbound geom_condim geom_priority
        geom_plugin geom_friction geom_margin geom_gap geom_solmix geom_solref geom_solimp geom_surfacevel geom_adhesion pair_dim
        pair_signature pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_adhesion pair_friction opt.o_margin
        opt.o_solref opt.o_solimp opt.o_friction opt.enableflags.OVERRIDE opt.enableflags.SPECULATIVE""",
    ),
    "limits": Refusal(
        'joints turn and slide, and tendons stretch, without end; limits="spring" makes those of joints springs',
        {"jnt_limited": (CONSTRAINTS, "LIMIT"), "tendon_limited": (CONSTRAINTS, "LIMIT")},
        "jnt_margin jnt_solimp",
    ),
    "armature of ball and free joints": Refusal("it is left out"),
    "frictionloss": Refusal(
        "joints have no dry friction", {"dof_frictionloss": (CONSTRAINTS, "FRICTIONLOSS")}, "dof_solref dof_solimp"
    ),
    "springs that are not linear": Refusal(
        "the springs that are named are left out, with their linear part",
        {"jnt_stiffnesspoly": ("SPRING",), "jnt_springyield": ("SPRING",)},
        "nplastic jnt_plasticadr",
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
    "fluid": Refusal(
        "bodies move in a vacuum", {"opt.density": (PASSIVE,), "opt.viscosity": (PASSIVE,)}, "opt.wind geom_fluid"
    ),
    "mocap bodies": Refusal("they rest where they start", {"nmocap": ()}),
    "plugins": Refusal(
        "their forces do not act", {"nplugin": ()}, "plugin plugin_* npluginattr npluginstate body_plugin"
    ),
    "sleep": Refusal(
        "bodies at rest are moved like others", {"opt.enableflags.SLEEP": ()}, "opt.sleep_tolerance tree_sleep_policy"
    ),
    "several joints of one body": Refusal(
        'take coordinates="joint", with hinges and slides in place of a ball', ignorable=False
    ),
    "compensation of gravity by actuators": Refusal(
        "take actuatorgravcomp off the joints: gravcomp of bodies then acts by itself",
        {"jnt_actgravcomp": ("GRAVITY", PASSIVE)},
        ignorable=False,
    ),
    "flexible bodies": Refusal(
        "make them of rigid bodies and joints",
        {"nflex": ()},
        "flex* nflex* nJfe efm0_* efmC_perm nefm0L nefm0dof nefmCvert opt.enableflags.IPC",
        ignorable=False,
    ),
}
"""The parts that the reader refuses, by their names in messages and in `ignore`."""
