"""Every field of a compiled `mujoco.MjModel` and its use in a scene: read, refused by name, or without influence on the motion.

A field has its name in Python, ``jnt_stiffness``, ``opt.density``, ``vis.map.force``, and a flag the name of its bit,
``opt.disableflags.SPRING``. ``flex*`` stands for all fields that begin with "flex" and have no entry of their own.

Source: the comments in MuJoCo's mjmodel.h, and its documentation, "XML reference".
"""

from vmri_jax.scene.mujoco_model import REFUSED

READ = {
    "bodies, their masses, and which are welded together": """nbody body_mass body_inertia body_ipos body_iquat body_pos body_quat
        body_parentid body_weldid body_mocapid""",
    "joints": """njnt nq nv jnt_type jnt_bodyid jnt_pos jnt_axis jnt_qposadr jnt_dofadr dof_jntid body_jntadr
        body_jntnum""",
    "springs, dampers and armature in joints": "jnt_stiffness dof_damping qpos_spring dof_armature",
    'limits of joints, for limits="spring"': "jnt_range jnt_margin jnt_solref dof_invweight0",
    "the start, where no qpos is given": "qpos0 nkey key_qpos key_qvel key_ctrl key_act key_mpos key_mquat",
    "gravity and its compensation": "opt.gravity body_gravcomp ngravcomp",
    "equalities connect, weld, and of joints and fixed tendons": """tendon_adr tendon_num wrap_type wrap_objid wrap_prm neq eq_type eq_objtype eq_obj1id eq_obj2id eq_active0 eq_data
        nsite site_bodyid site_pos site_quat""",
    "which bodies could touch": "ngeom geom_bodyid pair_geom1 pair_geom2 nexclude exclude_signature",
    "names": "names name_*",
    "flags that switch features off": """opt.disableflags opt.enableflags opt.disableactuator opt.disableflags.CONSTRAINT
        opt.disableflags.EQUALITY opt.disableflags.FRICTIONLOSS opt.disableflags.LIMIT opt.disableflags.CONTACT
        opt.disableflags.SPRING opt.disableflags.DAMPER opt.disableflags.GRAVITY opt.disableflags.FILTERPARENT
        opt.disableflags.ACTUATION opt.disableflags.CLAMPCTRL""",
}
"""Fields that the reader uses itself or through MuJoCo's kinematics, by their content."""

IDLE = {
    "shapes and pictures": """vis.* cam_* ncam light_* nlight mat_* nmat tex_* ntex ntexdata skin_* nskin* mesh_* nmesh* npolygonmax hfield_*
        nhfield* geom_matid geom_group geom_castshadow geom_rgba site_type site_dataid site_matid site_group site_size site_rgba
        site_sameframe jnt_group paths npaths""",
    "sensors": "sensor_* nsensor* opt.magnetic opt.disableflags.SENSOR",
    "data of users, and other fields of keyframes": "body_user jnt_user geom_user site_user nuser* numeric_* nnumeric* text_* ntext* tuple_* ntuple* key_*",
    "values that MuJoCo derives from other fields": """stat.* signature flg_* body_rootid body_dofnum body_dofadr
        body_treeid body_geomnum body_geomadr body_simple body_sameframe body_subtreemass body_invweight0 body_margin body_contype
        body_conaffinity body_bvhadr body_bvhnum bvh_* nbvh* oct_* noct dof_bodyid dof_parentid dof_treeid dof_Madr dof_simplenum
        dof_M0 dof_length tree_bodyadr tree_bodynum tree_dofadr tree_dofnum ntree B_* D_* M_* mapD2M mapM2D mapM2M
        nB nC nD nM nJmom nemax nnames nnames_map names_map""",
    "memory": "narena nbuffer njmax nconmax nhistory",
    "how MuJoCo integrates and solves; here a scheme and its step are chosen": """opt.timestep opt.integrator opt.cone opt.jacobian
        opt.solver opt.iterations opt.tolerance opt.impratio opt.ls_iterations opt.ls_tolerance opt.noslip_iterations
        opt.noslip_tolerance opt.ccd_iterations opt.ccd_tolerance opt.sdf_initpoints opt.sdf_iterations
        opt.disableflags.WARMSTART opt.disableflags.REFSAFE opt.disableflags.MIDPHASE opt.disableflags.EULERDAMP
        opt.disableflags.AUTORESET opt.disableflags.NATIVECCD opt.disableflags.ISLAND opt.disableflags.MULTICCD
        opt.enableflags.ENERGY opt.enableflags.FWDINV opt.enableflags.INVDISCRETE opt.enableflags.DIAGEXACT""",
}
"""Fields without influence on the motion, by their purpose."""

_WITH_REFUSED = {
    "actuators": "nu nout na actuator_* jnt_actuatorid tendon_actuatorid jnt_actfrclimited jnt_actfrcrange",
    "tendons": "ntendon nJten nwrap tendon_* ten_J_* wrap_*",
    "contact": """geom_type geom_size geom_pos geom_quat geom_dataid geom_sameframe geom_aabb geom_rbound geom_condim geom_priority
        geom_plugin geom_friction geom_margin geom_gap geom_solmix geom_solref geom_solimp geom_surfacevel geom_adhesion pair_dim
        pair_signature pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_adhesion pair_friction opt.o_margin
        opt.o_solref opt.o_solimp opt.o_friction opt.enableflags.OVERRIDE opt.enableflags.SPECULATIVE""",
    "limits": "jnt_solimp",
    "frictionloss": "dof_solref dof_solimp",
    "springs that are not linear": "nplastic jnt_plasticadr",
    "fluid": "opt.wind geom_fluid",
    "plugins": "plugin plugin_* npluginattr npluginstate body_plugin",
    "sleep": "opt.sleep_tolerance tree_sleep_policy",
    "flexible bodies": "flex* nflex* nJfe efm0_* efmC_perm nefm0L nefm0dof nefmCvert opt.enableflags.IPC",
}
"""Fields without meaning if a part that the reader refuses is absent."""

REFUSED_FIELDS = {kind: " ".join([*part.fields, _WITH_REFUSED.get(kind, "")]) for kind, part in REFUSED.items()}
"""Fields of the parts that the reader refuses, by the name of the part."""
