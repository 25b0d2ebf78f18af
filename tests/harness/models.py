"""Where geoms of MuJoCo models are."""

import mujoco
import numpy as np


def bounds(model: mujoco.MjModel, geoms) -> np.ndarray:
    """Return the axis-aligned box around geoms at the pose of the compiled model, (2, 3): low, high."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    corners, points = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T, []
    for geom in geoms:
        center, half = model.geom_aabb[geom].reshape(2, 3)
        local = center + corners * half
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = model.geom_dataid[geom]
            local = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        points.append(local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    points = np.concatenate(points)
    return np.stack([points.min(axis=0), points.max(axis=0)])
