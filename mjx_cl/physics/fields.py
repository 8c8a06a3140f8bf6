"""What MuJoCo's documentation says of model fields that are changed at run time."""

# after whose change mj_setConst must renew the constants that follow from them
DERIVING = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature", "qpos0")
