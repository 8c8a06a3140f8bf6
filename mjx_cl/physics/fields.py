"""Fields of a MuJoCo model that are changed at run time."""

# what faults change; `gravity` is mjOption's
FAULTY = (
  "actuator_gear",
  "geom_friction",
  "body_mass",
  "body_inertia",
  "body_ipos",
  "dof_armature",
  "dof_damping",
  "dof_frictionloss",
  "jnt_range",
  "gravity",
)

# after whose change mj_setConst must renew what follows from them, says MuJoCo's documentation
DERIVING = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "qpos0")
